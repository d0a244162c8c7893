"""`ibrobot convert` with episodes and datasets of a made-up format."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numpy as np
import pytest
from command_line import run_here
from ibrobot_data.episode import stop_if_full
from ibrobot_data.errors import DiskFull
from ibrobot_testing.site import Site

from ibrobot_core.api import (
    ActionPart,
    Contract,
    DatasetError,
    EpisodeEnd,
    EpisodeStart,
    Feature,
    Float64MultiArray,
    Header,
    JointState,
    Message,
    ObservationPart,
    String,
)
from ibrobot_core.app import Align

START_NS = 1_700_000_000_000_000_000
JOINTS = ("pan", "lift")
STATE = Feature("float32", (2,), ("pan.pos", "lift.pos"))
SELECT = ("position.pan", "position.lift")
CONTRACT = Contract(
    10.0,
    (ObservationPart("observation.state", "/joint_states", JointState.ros_type, SELECT, None, Align(), STATE),),
    (ActionPart("arm", "/commands", Float64MultiArray.ros_type, "hold", JOINTS),),
)
pytestmark = pytest.mark.usefixtures("fork_server")
Converter = Callable[..., CompletedProcess[str]]


@pytest.fixture(autouse=True)
def plugin(site: Site) -> None:
    site.add("json-files", Path(__file__).with_name("json_files.py"))


@pytest.fixture
def convert(tmp_path: Path) -> Converter:
    """Convert episodes, one after the other in this process, into `tmp_path / "set"`."""

    def run(*arguments: object) -> CompletedProcess[str]:
        return run_here("convert", *arguments, "--out", tmp_path / "set", "--jobs", 1, "--type", "json")

    return run


def rows(tmp_path: Path) -> list[list[dict[str, Any]]]:
    """The rows of each episode of the dataset."""
    found: list[list[dict[str, Any]]] = json.loads((tmp_path / "set/dataset.json").read_text())["episodes"]
    return found


def record(
    folder: Path,
    seed: float = 0.0,
    seconds: float = 1.0,
    *,
    outcome: str = "success",
    prompt: str = "pick",
    gap: tuple[float, float] = (0.0, 0.0),
    commanders: Mapping[float, str] | None = None,
    contract: Contract | None = CONTRACT,
    damaged: bool = False,
    **metadata: str,
) -> Path:
    """Record states at 100 Hz and commands at 50 Hz: both are `seed` plus the time [s].

    Args:
        folder: the episode's.
        seed: added to every number.
        seconds: the duration.
        outcome: how it ends.
        prompt: the task.
        gap: from when to when [s] there are no states.
        commanders: from when on [s] -> who commands.
        contract: stated by the recording.
        damaged: whether its end cannot be read.
        metadata: more of it.
    """
    from json_files import JsonRecorder  # type: ignore[import-not-found]

    folder.parent.mkdir(parents=True, exist_ok=True)
    metadata |= {"prompt": prompt, "robot_type": "pan_lift"}
    if contract is not None:
        metadata["contract"] = json.dumps(contract.canonical())
    topics = {**CONTRACT.topics, **({"/commander": String.ros_type} if commanders else {})}
    recorder = JsonRecorder()
    recorder.begin(EpisodeStart(folder, START_NS, topics, metadata))

    def write(topic: str, message: Message, at_s: float) -> None:
        recorder.write(topic, message, START_NS + round(at_s * 1e9))

    for i in range(round(seconds * 100)):
        at_s = i / 100
        for since, who in (commanders or {}).items():
            if at_s == since:
                write("/commander", String(who), at_s)
        if i % 2 == 0:
            write("/commands", Float64MultiArray(np.array([seed + at_s, -at_s])), at_s)
        if not gap[0] <= at_s < gap[1]:
            header = Header(START_NS + round(at_s * 1e9))
            write("/joint_states", JointState(header, JOINTS, np.array([seed + at_s, at_s])), at_s)
    if damaged:
        recorder.lines.append(["/joint_states", START_NS + round(seconds * 1e9), "damaged"])
    recorder.end(EpisodeEnd(START_NS + round(seconds * 1e9), outcome))
    return folder


def test_each_row_has_what_was_known_at_its_tick(convert: Converter, tmp_path: Path) -> None:
    record(tmp_path / "a", seed=1.0)
    done = convert(tmp_path / "a")
    assert done.returncode == 0, done.stderr
    (found,) = rows(tmp_path)
    assert [row["task"] for row in found] == ["pick"] * len(found)
    pan = np.array([row["observation.state"][0] for row in found])
    assert np.allclose(np.diff(pan), 0.1, atol=0.011), "a row for each tick of 10 Hz"
    actions = np.array([row["action"] for row in found])
    assert np.allclose(actions[:, 0] - 1.0, -actions[:, 1], atol=1e-6), "both numbers are of one command"
    assert np.all(np.abs(actions[:, 0] - pan) < 0.11)


def test_the_number_of_processes_changes_nothing(tmp_path: Path) -> None:
    for i in range(3):
        record(tmp_path / "all" / f"episode_{i}", seed=i)
    for jobs in (1, 2):
        done = run_here("convert", tmp_path / "all", "--out", tmp_path / f"set{jobs}", "--jobs", jobs, "--type", "json")
        assert done.returncode == 0, done.stderr
    one, two = (json.loads((tmp_path / f"set{jobs}/dataset.json").read_text()) for jobs in (1, 2))
    assert one["episodes"] == two["episodes"]
    assert len(one["episodes"]) == 3


@pytest.mark.parametrize(
    ("missing", "ticks", "words"),
    [("skip", 7, "3 of 10 ticks"), ("hold", 10, "held"), ("refuse", 0, "observation.state")],
)
def test_a_silent_topic(convert: Converter, tmp_path: Path, missing: str, ticks: int, words: str) -> None:
    strict = ObservationPart(
        "observation.state", "/joint_states", JointState.ros_type, SELECT, None, Align("asof", tol_ms=50.0), STATE
    )
    contract = Contract(10.0, (strict,), CONTRACT.action_parts)
    record(tmp_path / "a", gap=(0.3, 0.7), contract=contract)
    done = convert(tmp_path / "a", "--missing", missing)
    assert done.returncode == (1 if missing == "refuse" else 0)
    assert words in done.stdout + done.stderr
    if ticks:
        assert len(rows(tmp_path)[0]) == ticks


def test_unreadable_episodes_are_left_out_and_named(convert: Converter, tmp_path: Path) -> None:
    record(tmp_path / "good")
    record(tmp_path / "bad", seed=5.0, damaged=True)
    record(tmp_path / "bare", seed=6.0, contract=None)
    done = convert(tmp_path / "good", tmp_path / "bad", tmp_path / "bare")
    assert done.returncode == 1
    assert len(rows(tmp_path)) == 1
    assert "bad" in done.stderr + done.stdout
    assert "contract" in done.stderr + done.stdout


def test_only_requested_outcomes_are_converted(convert: Converter, tmp_path: Path) -> None:
    for i, outcome in enumerate(("success", "failure", "unknown")):
        record(tmp_path / "all" / outcome, seed=i, outcome=outcome)
    assert convert(tmp_path / "all", "--outcome", "failure").returncode == 0
    (found,) = rows(tmp_path)
    assert found[0]["observation.state"][0] >= 1.0


def test_append_adds_new_episodes_and_refuses_misfits(convert: Converter, tmp_path: Path) -> None:
    record(tmp_path / "all/a")
    assert convert(tmp_path / "all").returncode == 0
    record(tmp_path / "all/b", seed=1.0)
    refused = convert(tmp_path / "all")
    assert refused.returncode != 0
    assert "--append" in refused.stderr
    assert convert(tmp_path / "all", "--append").returncode == 0
    assert len(rows(tmp_path)) == 2
    other = Contract(20.0, CONTRACT.observation_parts, CONTRACT.action_parts)
    record(tmp_path / "other", seed=2.0, contract=other)
    assert convert(tmp_path / "other", "--append").returncode != 0
    assert len(rows(tmp_path)) == 2


def test_a_copy_is_converted_once(convert: Converter, tmp_path: Path) -> None:
    record(tmp_path / "all/a")
    record(tmp_path / "all/copy")
    done = convert(tmp_path / "all")
    assert len(rows(tmp_path)) == 1
    assert "copy" in done.stdout + done.stderr


def test_only_rows_commanded_by_the_operator_are_kept(convert: Converter, tmp_path: Path) -> None:
    record(tmp_path / "a", seconds=4.0, commanders={0.0: "policy", 2.0: "operator", 3.0: "policy"})
    done = convert(tmp_path / "a", "--only", "interventions", "--context", 0)
    assert done.returncode == 0, done.stderr
    (found,) = rows(tmp_path)
    pan = [row["observation.state"][0] for row in found]
    assert pan[0] >= 1.9
    assert pan[-1] <= 3.1
    assert len(pan) in (9, 10, 11)


def test_converted_episodes_are_kept_when_the_disk_is_full(convert: Converter, tmp_path: Path) -> None:
    full = tmp_path / "full"
    full.touch()
    record(tmp_path / "all/a")
    record(tmp_path / "all/b", seed=1.0, prompt=str(full))
    failed = convert(tmp_path / "all")
    assert failed.returncode != 0
    assert "no space left" in failed.stderr
    assert not (tmp_path / "set/dataset.json").exists()
    full.unlink()
    again = convert(tmp_path / "all", "--json")
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout)["resumed"] == 1
    assert len(rows(tmp_path)) == 2


def test_full_disk_names_no_file_of_the_staging_folder() -> None:
    error = DatasetError("/data/.staging/unit/video.mp4: cannot be written")
    error.__cause__ = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/data/.staging/unit/video.mp4")
    with pytest.raises(DiskFull) as failed:
        stop_if_full(error, "pick:1")
    assert str(failed.value) == "pick:1: No space left on device"
