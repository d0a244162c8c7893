"""Recording: a recorder that fails costs its episode only; topics that appear late, latched ones, and lost messages."""

from __future__ import annotations

import json
from collections import Counter
from typing import TYPE_CHECKING, Any

import pytest
from ibrobot_data import recording_worker as recording

from ibrobot_core.api import Contract, EpisodeEnd, EpisodeStart, RecorderError, String

if TYPE_CHECKING:
    from fake_runs import Runs

    from ibrobot_core.app import Runtime


class Notes:
    """What a recorder received; `full` makes every write fail."""

    def __init__(self, recorder: object, monkeypatch: pytest.MonkeyPatch) -> None:
        self.begun: list[EpisodeStart] = []
        self.ended: list[EpisodeEnd] = []
        self.written: list[tuple[str, object, int]] = []
        self.full = False
        self.refuses = False
        self.stuck = False
        for name in ("begin", "write", "end"):
            monkeypatch.setattr(recorder, name, getattr(self, name))

    def begin(self, episode: EpisodeStart) -> None:
        if self.refuses:
            raise RecorderError("its disk has 1 MiB left")
        self.begun.append(episode)

    def write(self, topic: str, message: object, received_ns: int) -> None:
        if self.full:
            raise RecorderError("its disk has 1 MiB left")
        self.written.append((topic, message, received_ns))

    def end(self, episode: EpisodeEnd) -> None:
        self.ended.append(episode)
        if self.stuck:
            raise RecorderError("cannot be written")


def ticks(runtime: Runtime, count: int) -> None:
    for _ in range(count):
        assert not runtime.step()


def note(runs: Runs, monkeypatch: pytest.MonkeyPatch, topics: str = "contract") -> tuple[Any, Notes]:
    """A run whose next episode is noted."""
    runtime = runs.start(f"recording={{type: lines, topics: {topics}}}", mode="teleop")
    ticks(runtime, 2)
    runtime.session.episodes.end("unknown")
    ticks(runtime, 1)
    return runtime, Notes(runs.parts.MADE["recording"], monkeypatch)


@pytest.mark.parametrize("stuck", [False, True])
def test_a_recorder_that_fails_costs_its_episode_and_the_robot_goes_on(
    runs: Runs, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, stuck: bool
):
    runtime, notes = note(runs, monkeypatch)
    runtime.session.episodes.begin()
    ticks(runtime, 3)
    notes.full, notes.stuck = True, stuck
    kept = len(notes.written)
    ticks(runtime, 10)
    fault = "recording ended: its disk has 1 MiB left"
    assert [end.outcome for end in notes.ended] == ["unknown"]
    assert len(notes.written) == kept > 0
    assert runtime.session.outcome.faults == [fault]
    assert ("fault", fault) in runs.parts.EVENTS
    assert caplog.text.count(f"{fault}; the robot goes on") == 1
    assert str(runtime.session.episodes.failure) == "its disk has 1 MiB left"
    notes.full = notes.stuck = False
    runtime.session.episodes.end("success")
    runtime.session.episodes.begin()
    ticks(runtime, 3)
    assert len(notes.begun) == 2
    assert len(notes.written) > kept
    assert runtime.session.episodes.failure is None


def test_an_episode_that_is_not_written_to_its_end_does_not_count(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    runtime, notes = note(runs, monkeypatch)
    saved = runtime.session.episodes.saved

    def full(end: EpisodeEnd) -> None:
        raise RecorderError("its disk is full")

    monkeypatch.setattr(runs.parts.MADE["recording"], "end", full)
    runtime.session.episodes.begin()
    ticks(runtime, 3)
    runtime.session.episodes.end("success")
    assert runtime.session.episodes.saved == saved + 1, "nothing is known of it yet"
    ticks(runtime, 1)
    assert runtime.session.episodes.saved == saved
    monkeypatch.setattr(runs.parts.MADE["recording"], "end", notes.end)
    runtime.session.episodes.begin()
    ticks(runtime, 3)
    runtime.session.episodes.end("success")
    ticks(runtime, 1)
    assert runtime.session.episodes.saved == saved + 1


def test_a_recorder_that_does_not_begin_costs_its_episode_and_the_robot_goes_on(
    runs: Runs, monkeypatch: pytest.MonkeyPatch
):
    runtime, notes = note(runs, monkeypatch)
    saved = runtime.session.episodes.saved
    notes.refuses = True
    runtime.session.episodes.begin()
    ticks(runtime, 5)
    runtime.session.episodes.end("success")
    ticks(runtime, 1)
    assert (notes.written, notes.ended) == ([], [])
    assert runtime.session.outcome.faults == ["recording ended: its disk has 1 MiB left"]
    assert runtime.session.episodes.saved == saved, "nothing of it was kept"
    notes.refuses = False
    runtime.session.episodes.begin()
    ticks(runtime, 3)
    runtime.session.episodes.end("success")
    assert notes.written
    assert runtime.session.episodes.saved == saved + 1


@pytest.mark.parametrize("call", ["begin", "write", "end"])
def test_whatever_a_recorder_raises_is_a_fault_of_the_episode(runs: Runs, monkeypatch: pytest.MonkeyPatch, call: str):
    runtime, _ = note(runs, monkeypatch)
    saved = runtime.session.episodes.saved

    def broken(*_: object) -> None:
        raise ValueError("not so")

    monkeypatch.setattr(runs.parts.MADE["recording"], call, broken)
    runtime.session.episodes.begin()
    ticks(runtime, 3)
    runtime.session.episodes.end("success")
    runtime.stop()  # also where the end of the run comes first
    [fault] = runtime.session.outcome.faults
    assert fault.startswith("recording ended: the recorder 'lines' failed: ValueError: not so (a bug at ")
    assert runtime.session.episodes.saved == saved


@pytest.mark.parametrize(("topics", "kept"), [("all", True), ("[/late]", True), ("contract", False)])
def test_topic_that_appears_during_the_episode_is_recorded(
    runs: Runs, monkeypatch: pytest.MonkeyPatch, topics: str, kept: bool
):
    runtime, notes = note(runs, monkeypatch, topics)
    runtime.session.episodes.begin()
    ticks(runtime, 3)
    runtime.session.bus.publish("/late", String("here"))
    ticks(runtime, 1)
    assert ("/late" in {topic for topic, _, _ in notes.written}) == kept
    (start,) = notes.begun
    assert start.any_topic == kept
    assert "/late" not in start.topics


def test_an_episode_begins_with_the_latched_messages(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    runtime, notes = note(runs, monkeypatch, "all")
    runtime.session.bus.publish("/description", String("old"), latched=True)
    runtime.session.bus.publish("/description", String("arm"), latched=True)
    ticks(runtime, 3)
    runtime.session.episodes.begin()
    ticks(runtime, 3)
    stamp_ns = notes.begun[0].stamp_ns
    assert [item for item in notes.written if item[0] == "/description"] == [("/description", String("arm"), stamp_ns)]
    assert notes.written[0][0] == "/description"


def test_an_episode_knows_its_contract(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    runtime, notes = note(runs, monkeypatch)
    runtime.session.episodes.begin()
    ticks(runtime, 2)
    contract = Contract.from_config(runtime.session.config)
    kept = notes.begun[0].metadata
    assert kept["fingerprint"] == contract.fingerprint()
    assert contract.difference(json.loads(kept["contract"])) == ""


def test_lost_messages_are_reported_by_topic(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(recording, "_DEPTH", 50)
    runtime, notes = note(runs, monkeypatch, "[/many, /few]")
    ticks(runtime, 1)
    bus = runtime.session.bus
    for _ in range(80):
        bus.publish("/many", String("before"))
    ticks(runtime, 1)
    runtime.session.episodes.begin()
    ticks(runtime, 1)
    for _ in range(10):
        bus.publish("/few", String("y"))
    for _ in range(45):
        bus.publish("/many", String("x"))
    runtime.session.episodes.end("success")
    ticks(runtime, 1)
    written = Counter(topic for topic, _, _ in notes.written)
    lost = notes.ended[-1].dropped
    assert lost["/few"] > 0
    assert written["/few"] + lost["/few"] == 10
    assert written["/many"] + lost.get("/many", 0) == 45
    assert lost.keys() <= {"/few", "/many"}


def test_a_listed_topic_that_nobody_publishes_is_reported_once(
    runs: Runs, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    runtime, _ = note(runs, monkeypatch, "[/joint_states, /joint_stats]")
    for _ in range(2):
        runtime.session.episodes.begin()
        ticks(runtime, 3)
        runtime.session.episodes.end("success")
        ticks(runtime, 1)
    warning = "recording.topics: no message on /joint_stats so far, so none was recorded; available: "
    assert caplog.text.count(warning) == 1
    assert "/joint_states" in caplog.text.partition(warning)[2]


def test_recording_says_which_policy_acts_with_which_weights(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    runs.make()
    monkeypatch.setattr(runs.parts.Net, "weights", lambda self: "a1")
    runtime = runs.start("recording={type: lines}")
    ticks(runtime, 2)
    runtime.session.episodes.end("unknown")
    ticks(runtime, 1)
    notes = Notes(runs.parts.MADE["recording"], monkeypatch)
    runtime.session.episodes.begin()
    ticks(runtime, 2)
    policy = json.loads(notes.begun[0].metadata["policy"])
    fingerprint = runs.parts.MADE["net"].fingerprint()
    assert policy == {
        "model": "net",
        "type": "net",
        "fingerprint": fingerprint,
        "weights": "a1",
        "execution_mode": "monolithic",
    }
    runtime.session.episodes.end("unknown")
    runtime.switch_mode("teleop")
    ticks(runtime, 2)
    runtime.session.episodes.begin()
    ticks(runtime, 2)
    assert "policy" not in notes.begun[1].metadata


def test_first_episode_of_a_simulation_says_which_policy_acts(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    runtime = runs.start("recording={type: lines}")
    notes = Notes(runs.parts.MADE["recording"], monkeypatch)
    ticks(runtime, 2)
    assert json.loads(notes.begun[0].metadata["policy"])["model"] == "net"
