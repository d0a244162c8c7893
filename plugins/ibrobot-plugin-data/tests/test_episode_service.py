"""Episodes through services: what prevents a start, and the file `dataset.yaml`."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import attrs
import pytest
import yaml
from ibrobot_data.episode_dataset import EpisodeDataset
from ibrobot_data.episode_service import (
    CANCEL,
    DISCARD,
    INFO,
    PROGRESS,
    RECORD,
    START,
    STATUS,
    STOP,
    DatasetInfo,
    EpisodeService,
    RecordedEpisode,
)
from ibrobot_data.errors import DiskFull
from ibrobot_provenance.ownership import InUse, Ownership

from ibrobot_core.api import Contract, IbrobotError, NotSupported, RecorderError
from ibrobot_core.app import ConfigError, RequestError

if TYPE_CHECKING:
    from fake_runs import Runs

    from ibrobot_core.app import Runtime

RECORDING = "recording={type: lines, root: kept, dataset: pick}"


def ticks(runtime: Runtime, count: int) -> None:
    for _ in range(count):
        assert not runtime.step()


@pytest.fixture
def run(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> Runtime:
    monkeypatch.chdir(runs.folder)
    runtime = runs.start(RECORDING, mode="teleop", by_operator=True)
    ticks(runtime, 5)
    return runtime


def folders(runs: Runs) -> list[str]:
    return sorted(path.name for path in (runs.folder / "kept" / "pick" / "episodes").glob("*"))


def test_a_list_of_topics_must_have_the_contracts(runs: Runs):
    with pytest.raises(
        RecorderError, match=r"recording.topics leaves out .*/arm/commands.*which the contract needs.*add th"
    ):
        runs.make(RECORDING, "recording.topics=[/joint_states]", mode="teleop", by_operator=True)
    runs.make(RECORDING, "recording.topics=[/joint_states]", mode="teleop")  # a log; the run does not wait for it


@pytest.mark.parametrize(
    ("root", "message"),
    [
        (
            "/proc/none",
            r"recording.root: .* (cannot be written: .*; choose another root|is not writable for this user)$",
        ),
        ("file/below", r"recording.root: .*/file is a file, not a folder"),
    ],
)
def test_unwritable_root_is_an_error_before_anything_starts(runs: Runs, root: str, message: str):
    (runs.folder / "file").write_text("")
    with pytest.raises((RecorderError, ConfigError), match=message):
        runs.make(RECORDING, f"recording.root={root}", mode="teleop", by_operator=True)


def test_no_episode_begins_before_an_emergency_stop_is_reset(run: Runtime, runs: Runs):
    bus = run.session.bus
    bus.call("/estop")
    ticks(run, 3)
    with pytest.raises(RecorderError, match=r"^not recording: emergency stop; reset it first$"):
        bus.call(START, "pick the cube")
    ticks(run, 50)
    bus.call("/reset")
    ticks(run, 3)
    bus.call(START, "pick the cube")
    assert bus.call(STATUS).recording
    run.stop()


def test_services_begin_end_and_discard_episodes(run: Runtime, runs: Runs):
    bus = run.session.bus
    bus.call(START, "pick the cube")
    ticks(run, 3)
    status = bus.call(STATUS)
    assert (status.recording, status.prompt, status.episode) == (True, "pick the cube", 1)
    assert status.elapsed_s == pytest.approx(0.06)
    assert status.rates_hz["/joint_states"] == pytest.approx(50)
    bus.call(STOP, "failure")
    bus.call(START, None)
    ticks(run, 2)
    assert bus.call(STATUS).prompt == "pick the cube", "the last one"
    bus.call(DISCARD, None)
    ticks(run, 2)
    run.stop()
    assert ("ended", 1, "failure") in runs.parts.EVENTS
    assert ("ended", 2, "discarded") in runs.parts.EVENTS
    service = run.session.episodes
    assert isinstance(service, EpisodeService)
    assert service.saved == 1
    assert folders(runs) == ["episode_000001"]


@pytest.fixture
def threaded(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> Iterator[Runtime]:
    """A run in real time, whose topics are heard."""
    monkeypatch.chdir(runs.folder)
    runtime = runs.start(RECORDING, mode="teleop", by_operator=True, lockstep=False)
    until(lambda: not runtime.session.bus.call(STATUS).silent)
    yield runtime
    runtime.stop()


def until(ready: Callable[[], object]) -> None:
    pause = threading.Event()
    for _ in range(2000):
        if ready():
            return
        pause.wait(0.01)
    raise AssertionError("it did not happen")


def recorded(runtime: Runtime, act: Callable[[], object], prompt: str = "") -> RecordedEpisode:
    """What `/record_episode` answers if something is done meanwhile."""
    bus, answers = runtime.session.bus, queue.SimpleQueue[RecordedEpisode]()
    thread = threading.Thread(target=lambda: answers.put(bus.call(RECORD, prompt)))
    thread.start()
    until(lambda: bus.call(STATUS).recording)
    act()
    answer = answers.get(timeout=20.0)
    thread.join()
    return answer


def test_an_episode_is_recorded_in_one_call(threaded: Runtime, runs: Runs):
    bus = threaded.session.bus

    def look_and_cancel() -> None:
        progress = bus.call(PROGRESS)
        assert 0 <= progress.seconds_remaining <= threaded.session.config.contract.max_duration_s
        assert progress.feedback_message == "episode 1, 0 messages lost"
        bus.call(CANCEL)

    answer = recorded(threaded, look_and_cancel, "pick")
    folder = runs.folder / "kept" / "pick" / "episodes" / "episode_000001"
    assert (answer.success, answer.message.endswith("pick/episodes/episode_000001")) == (True, True)
    assert (folder / "metadata.json").is_file(), "it is written when the answer comes"
    assert json.loads((folder / "metadata.json").read_text())["prompt"] == "pick"
    assert bus.call(PROGRESS).seconds_remaining == 0
    assert recorded(threaded, lambda: bus.call(STOP, "success")).success, "however it ends"
    assert bus.call(STATUS).prompt == "pick", "the last one"


def test_the_one_call_says_why_an_episode_is_not_kept(threaded: Runtime):
    bus = threaded.session.bus
    assert recorded(threaded, lambda: bus.call(DISCARD)) == RecordedEpisode(False, "episode 1 was discarded")

    def ask_again_and_discard() -> None:
        with pytest.raises(RecorderError, match="an episode is being recorded; end it first"):
            bus.call(RECORD, "place")
        bus.call(DISCARD)

    assert not recorded(threaded, ask_again_and_discard).success


def test_the_one_call_waits_so_that_lockstep_refuses_it(run: Runtime):
    with pytest.raises(NotSupported, match=r"in lockstep call /record_episode/start and /record_episode/stop"):
        run.session.bus.call(RECORD, "pick")


def test_ib_robots_recorder_says_where_episodes_go(run: Runtime, runs: Runs):
    assert run.session.bus.call(INFO) == DatasetInfo("kept/pick", 0)


def test_metadata_describe_how_the_episode_was_made(run: Runtime, runs: Runs):
    run.session.bus.call(START, "pick")
    ticks(run, 2)
    run.session.bus.call(STOP, "success")
    run.stop()
    (line,) = (runs.folder / "kept" / "pick" / "episodes").glob("*/metadata.json")
    metadata = json.loads(line.read_text())
    assert metadata["prompt"] == "pick"
    assert json.loads(metadata["config"])["robot"]["name"] == "mini"
    assert json.loads(metadata["calibration"]) == {}
    assert json.loads(metadata["plugin_versions"])["fake-parts"] == "1.0"
    dataset = yaml.safe_load((runs.folder / "kept" / "pick" / "dataset.yaml").read_text())
    assert (dataset["name"], dataset["robot"], dataset["prompt"]) == ("pick", "mini", "pick")
    assert dataset["fingerprint"] == metadata["fingerprint"]


def test_invalid_requests_are_refused(run: Runtime):
    bus = run.session.bus
    with pytest.raises(RecorderError, match="no episode is being recorded"):
        bus.call(STOP, "success")
    bus.call(START, "")
    with pytest.raises(RecorderError, match="an episode is being recorded; end it first"):
        bus.call(START, "")
    with pytest.raises(RequestError, match="outcome: 'good' is not one of: success, failure, unknown"):
        bus.call(STOP, "good")


def test_a_silent_topic_of_the_contract_is_named(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(runs.folder)
    runtime = runs.start(RECORDING, mode="plan", by_operator=True)
    ticks(runtime, 5)
    with pytest.raises(RecorderError, match=r"silent: /grip/commands \(nothing yet\)"):
        runtime.session.bus.call(START, "")
    assert folders(runs) == []


def test_a_disk_too_small_for_an_episode_is_refused_with_the_figures(
    run: Runtime, runs: Runs, monkeypatch: pytest.MonkeyPatch
):
    flow = run.session.bus.call(STATUS).bytes_per_s
    assert flow > 50 * (2 * 8 + 2 * 2 * 8), "joint states and commands alone"
    service, kept = run.session.episodes, runs.parts.MADE["recording"]
    assert isinstance(service, EpisodeService)
    monkeypatch.setattr(kept, "min_free", 3 << 20)
    monkeypatch.setattr(service, "free_bytes", lambda: (3 << 20) + flow - 2)
    message = (
        r"has 3 MiB left; an episode of 1 s \(contract.max_duration_s\) takes 0 MiB at 0.\d MiB/s, and 3 MiB stay free"
    )
    with pytest.raises(DiskFull, match=message):
        service.start("")
    assert folders(runs) == []
    monkeypatch.setattr(service, "free_bytes", lambda: (3 << 20) + flow + 2)
    service.start("")
    assert service.running


def test_a_mode_that_begins_its_own_episodes_keeps_them(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(runs.folder)
    runtime = runs.start(RECORDING, mode="policy", by_operator=True)
    ticks(runtime, 5)
    assert runtime.session.bus.call(STATUS).recording
    with pytest.raises(NotSupported, match="mode policy begins and ends its episodes itself"):
        runtime.session.bus.call(STOP, "success")


def test_a_dataset_of_another_contract_is_refused_before_anything_starts(run: Runtime, runs: Runs):
    run.session.bus.call(START, "")
    run.stop()
    runs.parts.MADE.clear()
    with pytest.raises(
        RecorderError, match="its episodes have another contract; record into another dataset"
    ) as caught:
        runs.start(RECORDING, "contract.rate_hz=20", mode="teleop", by_operator=True)
    assert "this run: 20" in str(caught.value)
    assert runs.parts.MADE == {}


def test_buttons_without_effect_are_reported(runs: Runs, caplog: pytest.LogCaptureFixture):
    runtime = runs.start(mode="teleop")
    runs.parts.MADE["stick"].events = ("start", "intervention")
    ticks(runtime, 3)
    assert "start: this run records no episodes by hand" in caplog.text
    assert "intervention: mode teleop has no policy to take the robot from" in caplog.text


def test_buttons_of_a_device_are_passed_to_what_records_episodes(run: Runtime, runs: Runs):
    runs.parts.MADE["stick"].events = ("start", "discard")
    ticks(run, 3)
    events = run.session.operator_events
    assert [events.get_nowait(), events.get_nowait(), events.empty()] == ["start", "discard", True]


def test_an_episode_belongs_to_its_recorder_until_it_has_ended(run: Runtime, runs: Runs):
    bus, root = run.session.bus, runs.folder / "kept" / "pick" / "episodes"
    bus.call(START, "pick")
    ticks(run, 2)
    with pytest.raises(InUse, match="episode_000001: is being recorded by process"):
        Ownership(root / "episode_000001", "is being trimmed", wait_s=0.0)
    bus.call(STOP, "success")
    ticks(run, 2)
    Ownership(root / "episode_000001", "is being trimmed", wait_s=0.0).close()
    bus.call(START, "pick")
    ticks(run, 2)
    run.stop()
    assert [path.name for path in sorted(root.iterdir())] == ["episode_000001", "episode_000002"], "no lock is left"


def test_two_runs_that_record_into_one_dataset_lose_no_episode(run: Runtime, runs: Runs):
    bus, root = run.session.bus, runs.folder / "kept" / "pick" / "episodes"
    root.mkdir(parents=True)
    with Ownership(root / "episode_000001", "is being recorded"):  # another run began, and has not written anything yet
        bus.call(START, "pick")
        ticks(run, 2)
        bus.call(STOP, "success")
        ticks(run, 2)
    assert folders(runs) == ["episode_000002"]
    run.stop()
    service = run.session.episodes
    assert isinstance(service, EpisodeService)
    assert (service.saved, service.failure) == (1, None)


def test_the_first_episodes_of_two_runs_agree_on_one_contract(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(runs.folder)
    config = runs.start(RECORDING, mode="teleop", by_operator=True).session.config
    contract = Contract.from_config(config)
    other = attrs.evolve(contract, rate_hz=contract.rate_hz / 2)
    ready, refused = threading.Barrier(2), list[str]()

    def join(mine: Contract) -> None:
        ready.wait()
        try:
            EpisodeDataset(runs.folder / "new").join(mine, "mini", "")
        except RecorderError as error:
            refused.append(str(error))

    threads = [threading.Thread(target=join, args=(each,)) for each in (contract, other)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (message,) = refused
    assert "its episodes have another contract" in message


NO_TEXT = {
    "mapping": {"task": "pick"},
    "list": ["pick"],
    "number": 3,
    "nan": float("nan"),
    "surrogate": "pick \ud800",
    "zero": "pick\0",
    "long": "x" * 200_000,
}


@pytest.mark.parametrize("prompt", NO_TEXT.values(), ids=NO_TEXT)
def test_a_prompt_that_no_file_can_hold_is_refused_and_no_episode_is_lost(run: Runtime, runs: Runs, prompt: Any):
    for request in (prompt, {"prompt": prompt}):
        with pytest.raises(IbrobotError):
            run.session.bus.call(START, request)
    if isinstance(prompt, str):
        service = run.session.episodes
        assert isinstance(service, EpisodeService)
        with pytest.raises(RecorderError, match="the prompt has "):
            service.start(prompt)
        with pytest.raises(RecorderError, match="the prompt has ") as refused:
            runs.make(RECORDING, mode="teleop", by_operator=True, prompt=prompt)
        assert refused.value.exit_code == 2
    run.session.bus.call(START, {"prompt": "pick the cube"})
    ticks(run, 2)
    run.session.bus.call(STOP, {"outcome": "success"})
    run.stop()
    assert folders(runs) == ["episode_000001"]
