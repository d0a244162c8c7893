"""Runs whose episodes are recorded: what lands in which folder, of which topics, and who commanded."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from fake_runs import finish, seconds
from ibrobot_data.episode_dataset import count_complete

from ibrobot_core.app import installed_plugins

if TYPE_CHECKING:
    from fake_runs import Runs

RECORDING = "recording={type: lines, root: kept, dataset: picks}"


def records(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "records.jsonl").read_text().splitlines()]


def test_an_emergency_stop_ends_an_episode_at_once_as_a_failure(runs: Runs):
    runtime = runs.start(RECORDING, episodes=2)
    seconds(runtime, 0.2)
    runtime.session.bus.call("/estop")
    seconds(runtime, 0.1)
    assert ("ended", 1, "failure") in runs.parts.EVENTS
    runtime.stop()
    metadata = json.loads((runs.folder / "kept/picks/episodes/episode_000001/metadata.json").read_text())
    assert (metadata["outcome"], metadata["faults"]) == ("failure", ["emergency stop"])


def test_each_episode_is_recorded_in_a_folder_of_its_own(runs: Runs, tmp_path: Path):
    runtime = runs.start(RECORDING, episodes=2, seed=12)
    finish(runtime)
    root = tmp_path / "kept" / "picks" / "episodes"
    assert sorted(path.name for path in root.iterdir()) == ["episode_000001", "episode_000002"]
    for number, outcome in ((1, "success"), (2, "failure")):
        metadata = json.loads((root / f"episode_{number:06d}" / "metadata.json").read_text())
        assert metadata["outcome"] == outcome
        assert metadata["seed"] == str(11 + number)
        assert (metadata["robot"], metadata["mode"]) == ("mini", "policy")
    again = runs.start(RECORDING, episodes=1)
    finish(again)
    assert (root / "episode_000003" / "metadata.json").exists()


def test_a_recording_has_its_episode_and_nothing_else(runs: Runs, tmp_path: Path):
    runtime = runs.start(RECORDING, episodes=3)
    states = runtime.session.bus.subscribe("/joint_states", 10_000)
    spans: list[list[int]] = []
    while not runtime.step():
        episodes, now_ns = runtime.session.episodes, runtime.session.clock.now_ns()
        if episodes.running and episodes.number > len(spans):
            spans.append([now_ns, now_ns])
        elif not episodes.running and spans:
            spans[-1][1] = max(spans[-1][1], now_ns) if spans[-1][1] == spans[-1][0] else spans[-1][1]
    spans[-1][1] = runtime.session.clock.now_ns()
    published = [item.received_ns for item in states.drain()]
    states.close()
    runtime.stop()
    assert len(spans) == 3
    for number, (begin, end) in enumerate(spans, 1):
        lines = records(tmp_path / "kept" / "picks" / "episodes" / f"episode_{number:06d}")
        found = [line["received_ns"] for line in lines if line["topic"] == "/joint_states"]
        assert found == [t for t in published if begin < t <= end]


@pytest.mark.parametrize(
    ("topics", "kept"),
    [
        ("contract", {"/joint_states", "/camera/top/image_raw", "/arm/commands", "/grip/commands"}),
        ("[/joint_states]", {"/joint_states"}),
    ],
)
def test_the_topics_asked_for_are_recorded(runs: Runs, topics: str, kept: set[str], monkeypatch: pytest.MonkeyPatch):
    runtime = runs.start(f"recording={{type: lines, topics: {topics}}}", mode="teleop")
    recorder = runs.parts.MADE["recording"]
    seen: set[str] = set()
    monkeypatch.setattr(recorder, "write", lambda topic, message, received_ns: seen.add(topic))
    seconds(runtime, 0.5)
    assert seen == kept


def test_all_topics_may_be_recorded(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    runtime = runs.start("recording={type: lines, topics: all}")
    seen: set[str] = set()
    monkeypatch.setattr(runs.parts.MADE["recording"], "write", lambda topic, message, received_ns: seen.add(topic))
    seconds(runtime, 0.5)
    assert seen >= {"/joint_states", "/arm/commands", "/camera/side/image_raw", "/fake/command"}


def test_each_state_says_who_commanded_however_late_the_operator_is(runs: Runs) -> None:
    """The labels come with the states, not from the thread of the operator's devices."""
    run = runs.start(
        "control_modes.policy.inference={model: net, intervene: lever}", "contract.max_duration_s=100", seed=13
    )
    for _ in range(5):
        run.step()
    labels = run.session.bus.subscribe("/commander", 1000)
    commands = run.session.bus.subscribe("/arm/commands", 1000)
    labels.drain()  # the latched one
    control: Any = run.session.control
    for _ in range(30):
        control.step()  # control alone
    assert len(commands.drain()) == 30
    said: list[Any] = [item.message for item in labels.drain()]
    assert [message.data for message in said] == ["policy"] * 30


def test_resume_counts_the_complete_episodes_of_a_dataset(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    finish(runs.start(RECORDING, episodes=2, seed=12))
    folder = runs.folder / "kept/picks"
    reader = SimpleNamespace(summary=lambda: SimpleNamespace(finished=True), close=lambda: None)
    unfinished = SimpleNamespace(summary=lambda: SimpleNamespace(finished=False), close=lambda: None)
    found = iter((reader, unfinished))
    monkeypatch.setattr(type(installed_plugins()), "open_episode", lambda self, path: next(found))
    assert count_complete(folder) == 1
    assert count_complete(folder / "none") == 0


def test_each_request_to_a_model_is_recorded_with_its_answer(runs: Runs, tmp_path: Path) -> None:
    more = "models.net={type: net, extra_observations: [{key: observation.images.side, peripheral: side}]}"
    inference = "control_modes.policy.inference={model: net, prompt: pick it up}"
    finish(runs.start(RECORDING, inference, more, episodes=1))
    lines = records(tmp_path / "kept" / "picks" / "episodes" / "episode_000001")
    assert "/camera/side/image_raw" in {line["topic"] for line in lines}, "what the model sees beyond the contract"
    answers = [line for line in lines if line["topic"] == "/model_answers"]
    assert len(answers) > 2
    for number, line in enumerate(answers, 1):
        said = line["message"]
        assert (said["request"], said["outcome"], said["error"]) == (number, "used", "")
        assert (said["model"], said["server"], said["prompt"]) == ("net", "a fake", "pick it up")
        assert said["joint_names"] == ["pan", "grip"]
        assert len(said["actions"]) == 2 * 10
        assert said["header"]["stamp_ns"] - said["observed_ns"] == said["latency_ms"] * 1e6
        assert (said["infer_ms"], said["queue_ms"]) == (0.0, 0.0), "lockstep: equal runs make equal bytes"
