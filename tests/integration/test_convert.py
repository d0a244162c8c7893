"""`ibrobot convert`: many episodes, some of them bad, interrupted and gone on with; foreign bags."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import run_here
from ibrobot_data.run import STAGING
from ibrobot_provenance.ownership import Ownership
from ibrobot_ros2 import encode
from ibrobot_testing.site import made_up_site
from ibrobot_testing.terminal import Terminal
from recordings import CONTRACT, JOINTS, SIZE, START_NS, numbered, record
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ibrobot_core.messages import (
    Float64MultiArray,
    Header,
    Image,
    JointState,
    JointTrajectory,
    JointTrajectoryPoint,
    Message,
)

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("first_conversion")]

PROGRAM = "from ibrobot_core.cli.main import main; main()"
STUCK = """
import sys, time
class Stuck:
    def __init__(self, stream):
        self._stream = stream
    def write(self, text):
        self._stream.write(text)
        self._stream.flush()
        if {said!r} in text:
            time.sleep(600)
    def __getattr__(self, name):
        return getattr(self._stream, name)
sys.stderr = Stuck(sys.stderr)
"""
"""Python source: whoever waits for what is `said` finds the program there, and not further on."""
LAMP = "lamp_msgs/msg/Lamp"
PLUGINS = Path(__file__).parents[1] / "shared/plugins"
CALIBRATION = {
    joint: {"id": i + 1, "drive_mode": 0, "homing_offset": 0, "range_min": 1048, "range_max": 3048}
    for i, joint in enumerate(JOINTS)
}
ROBOT = f"""\
robot:
  name: bench
  robot_type: bench_follower
  joints:
    - {{name: pan, lower: -2, upper: 2, max_velocity: 3, max_acceleration: 15}}
    - {{name: lift, lower: -2, upper: 2, max_velocity: 3, max_acceleration: 15}}
    - {{name: gripper, lower: -0.1, upper: 2, max_velocity: 3, max_acceleration: 15}}
  groups: {{arm: [pan, lift, gripper]}}
hardware: {{type: feetech_so101, port: /dev/null, calibration: bench}}
executors:
  arm: {{type: position, group: arm}}
control_modes:
  idle: {{executors: [arm]}}
default_control_mode: idle
contract:
  rate_hz: 30
  observations:
    - key: observation.state
      topic: /joint_states
      select: [position.pan, position.lift, position.gripper]
      align: {{strategy: hold, stamp: header}}
    - key: observation.images.top
      topic: /top
      type: sensor_msgs/msg/Image
      image: {{resize: [{SIZE[0]}, {SIZE[1]}]}}
      align: {{strategy: asof, stamp: header, tol_ms: 200}}
  actions:
    - {{key: action, executor: arm, topic: /commands}}
"""


@attrs.frozen
class Ran:
    """What the command printed, and its exit code."""

    code: int
    out: str
    err: str

    @property
    def report(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.out.splitlines()[-1])
        return found


def run(*arguments: object) -> Ran:
    done = run_here("convert", *arguments)
    return Ran(done.returncode, done.stdout, done.stderr)


def digest(dataset: Path) -> dict[str, str]:
    files = sorted(path for path in dataset.rglob("*") if path.is_file())
    return {str(path.relative_to(dataset)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def rows(dataset: Path) -> dict[str, np.ndarray[Any, Any]]:
    table = pq.read_table(dataset / "data/chunk-000/file-000.parquet").to_pydict()
    return {name: np.array(table[name]) for name in table if not name.startswith("observation.images")}


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("bags") / "blocks/episodes"
    for number in range(1, 5):
        record(root / f"episode_{number:06d}", number, 0.3 + 0.2 * number, "sort the blocks")
    return root


def test_the_number_of_jobs_changes_no_byte(bags: Path, tmp_path: Path) -> None:
    for jobs in (1, 3):
        result = run(bags, "--out", tmp_path / f"jobs{jobs}", "--jobs", jobs)
        assert result.code == 0, result.err
    assert digest(tmp_path / "jobs1") == digest(tmp_path / "jobs3")
    assert not (tmp_path / "jobs1" / STAGING).exists()


def test_killed_it_keeps_what_was_done_and_goes_on_from_there(bags: Path, tmp_path: Path) -> None:
    whole, out = tmp_path / "whole", tmp_path / "killed"
    arguments = [str(bags), "--jobs", "1", "--out"]
    assert run(*arguments, whole).code == 0
    program = STUCK.format(said="frames (2 of 4") + PROGRAM
    with subprocess.Popen(
        [sys.executable, "-c", program, "convert", *arguments, str(out)], stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        lines = [process.stderr.readline() for _ in range(2)]
        os.kill(process.pid, signal.SIGKILL)
        # The pipe is at its end when the processes that it started are gone too.
        lines += process.stderr.read().splitlines()
    assert "frames (2 of 4" in lines[1]
    assert not (out / "meta").exists(), "a dataset that is not whole looks like none"
    result = run(*arguments, out, "--json")
    assert result.code == 0, result.err
    assert 2 <= result.report["resumed"] <= 4, "the processes that convert may have gone on for a while"
    assert digest(out) == digest(whole)


def test_interrupted_by_the_keyboard_it_says_what_is_kept(bags: Path, tmp_path: Path) -> None:
    whole, out = tmp_path / "whole", tmp_path / "stopped"
    assert run(bags, "--out", whole).code == 0
    arguments = [str(bags), "--jobs", "1", "--out", str(out)]
    program = STUCK.format(said="frames (1 of 4") + PROGRAM
    with subprocess.Popen(
        [sys.executable, "-c", program, "convert", *arguments],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stderr is not None
        first = process.stderr.readline()
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        printed = process.stderr.read()
    assert process.returncode == 130, printed
    assert "frames (1 of 4" in first
    assert "interrupted; finished episodes are kept: run the same command again to continue" in printed
    assert "Traceback" not in printed
    result = run(*arguments, "--json")
    assert result.report["resumed"] >= 1, result.err
    assert digest(out) == digest(whole)


def test_events_tell_a_program_each_episode_and_the_result(bags: Path, tmp_path: Path) -> None:
    record(tmp_path / "bad/episode_000001", 1, 0.2, contract=None)
    shutil.copytree(tmp_path / "bad", tmp_path / "bad/.trash/1")  # no command finds what is in the trash
    result = run(bags, tmp_path / "bad", "--out", tmp_path / "set", "--jobs", 1, "--events")
    events = [json.loads(line) for line in result.out.splitlines()]
    assert (result.code, events[0], result.err) == (1, {"event": "begin", "of": 5}, "")
    of_episodes = [event for event in events if event.get("episode")]
    assert [event["done"] for event in of_episodes] == [1, 2, 3, 4, 5]
    assert [bool(event["error"]) for event in of_episodes].count(True) == 1
    assert "has no contract" in next(event["error"] for event in of_episodes if event["error"])
    report = events[-1]
    assert (report["event"], report["episodes"], report["failed"]) == ("report", 4, 1)
    assert report["frames"] == of_episodes[-1]["frames"]


def test_many_with_the_same_fault_are_reported_together(tmp_path: Path) -> None:
    for number in (1, 2, 3):
        record(tmp_path / f"bags/episode_{number:06d}", number, 0.2, contract=None)
    result = run(tmp_path / "bags", "--out", tmp_path / "set")
    (printed,) = [line for line in result.err.splitlines() if line.startswith("left out")]
    assert printed.count("episode_00000") == 3
    assert printed.count("has no contract") == 1


def test_a_bad_episode_is_reported_and_left_out(bags: Path, tmp_path: Path) -> None:
    episodes = tmp_path / "mixed/episodes"
    for number in (1, 3):
        record(episodes / f"episode_{number:06d}", number, 0.5, "sort the blocks")
    record(episodes / "episode_000002", 2, 0.5, gap={"/wrist": (0.0, 9.9)})
    record(episodes / "episode_000004", 4, 0.5, contract=attrs.evolve(CONTRACT, rate_hz=20.0))
    (episodes / "episode_000005").mkdir()
    (episodes / "episode_000005/metadata.yaml").write_text("rosbag2_bagfile_information: [")
    record(episodes / "episode_000006", 6, 0.5)
    (file,) = (episodes / "episode_000006").glob("*.mcap")
    content = bytearray(file.read_bytes())
    at = content.index(b"observation.state")  # in a record that a scan looks into
    content[at : at + 4] = b"\xff\xff\xff\xff"
    file.write_bytes(content.replace(b"sensor_msgs/msg/JointState", b"sensor_msgs/msg/Joint\xff\xff\xff\xff\xff"))
    result = run(episodes, "--out", tmp_path / "set")
    assert result.code == 1
    assert "left out mixed/episode_000002: no message of /wrist, which the contract needs; available: " in result.err
    assert "left out mixed/episode_000004: its contract differs from that of mixed/episode_000001:" in result.err
    assert "left out mixed/episode_000005: " in result.err
    assert "left out mixed/episode_000006: " in result.err
    assert "is damaged: " in result.err
    assert "Traceback" not in result.err
    assert "2 episodes, " in result.out
    assert set(rows(tmp_path / "set")["episode_index"]) == {0, 1}


def test_a_cut_episode_is_converted_as_unknown_and_never_as_a_success(tmp_path: Path) -> None:
    record(tmp_path / "bags/episode_000001", 1, 0.9, "sort the blocks", chunk_size=4096)
    (file,) = (tmp_path / "bags/episode_000001").glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    result = run(tmp_path / "bags", "--out", tmp_path / "set", "--json")
    assert result.code == 0, result.err
    (report,) = result.report["reports"]
    assert (report["outcome"], report["finished"]) == ("unknown", False)
    assert report["missing"]["/joint_states"] > 20
    result = run(tmp_path / "bags", "--out", tmp_path / "judged", "--success")
    assert result.code == 1
    assert "next.success cannot be determined: the episode's outcome is unknown" in result.err


def test_a_contract_that_differs_from_the_recorded_one_is_refused(bags: Path, tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text(ROBOT)
    arguments = (bags / "episode_000001", "--config", tmp_path / "robot.yaml", "--out", tmp_path / "set")
    result = run(*arguments)
    assert result.code == 1
    assert "recorded with another contract; --force-contract uses that of --config:" in result.err
    assert "/wrist" in result.err
    result = run(*arguments, "--force-contract", "--prompt", "x")
    assert result.code == 0, result.err
    info = json.loads((tmp_path / "set/meta/info.json").read_bytes())
    assert "observation.images.top" in info["features"]
    assert "observation.images.wrist" not in info["features"]


def test_a_gap_is_refused_skipped_or_held(tmp_path: Path) -> None:
    record(tmp_path / "bag", 1, 2.0, gap={"/wrist": (0.8, 1.4)})
    result = run(tmp_path / "bag", "--out", tmp_path / "refuse", "--missing", "refuse")
    assert result.code == 1
    assert "observation.images.wrist is missing 1.000 s after the beginning" in result.err
    assert "--missing skip" in result.err
    found = {
        way: run(tmp_path / "bag", "--out", tmp_path / way, "--missing", way, "--json").report
        for way in ("skip", "hold")
    }
    assert (found["skip"]["gaps"], found["hold"]["gaps"]) == (1, 1)
    assert found["skip"]["skipped_ticks"] == found["hold"]["held_ticks"] > 10
    assert found["skip"]["frames"] == found["hold"]["frames"] - found["hold"]["held_ticks"]
    ((row, ticks),) = found["skip"]["reports"][0]["cuts"]
    assert (row > 10, ticks) == (True, found["skip"]["skipped_ticks"])
    assert found["hold"]["reports"][0]["cuts"] == []
    default = run(tmp_path / "bag", "--out", tmp_path / "default")
    assert default.code == 0, default.err
    assert f"bag: {ticks} of {found['skip']['frames'] + ticks} ticks are left out\n" in default.err
    assert f"incomplete ticks left out: 1 time, at most {ticks} ticks in a row\n" in default.out
    kept = json.loads((tmp_path / "default/meta/ibrobot.json").read_bytes())["episodes"][0]
    assert kept["cuts"] == [[row, ticks]]
    printed = run(tmp_path / "bag", "--out", tmp_path / "printed", "--missing", "hold").out
    assert "went missing: observation.images.wrist 1\n" in printed
    assert "episodes without a prompt, whose task is empty: 1; --prompt TEXT sets it" in printed
    asked = run(tmp_path / "bag", "--out", tmp_path / "asked", "--missing", "hold", "--prompt", "stack").out
    assert "without a prompt" not in asked


def test_appending_takes_what_is_new_and_fits(bags: Path, tmp_path: Path) -> None:
    out = tmp_path / "set"
    assert run(bags / "episode_000001", bags / "episode_000002", "--out", out).code == 0
    before = digest(out)
    refused = run(bags, "--out", out)
    assert refused.code != 0
    assert "--append" in refused.err
    result = run(bags, "--out", out, "--append", "--json")
    assert result.code == 0, result.err
    assert (result.report["episodes"], result.report["passed_over"]) == (2, 2)
    assert set(rows(out)["episode_index"]) == {0, 1}, "old tables stay as they are"
    again = run(bags, "--out", out, "--append")
    assert again.code == 0
    assert "nothing was added" in again.out
    assert all(digest(out)[name] == known for name, known in before.items() if not name.startswith("meta"))
    otherwise = run(bags, "--out", out, "--append", "--success")
    assert "was made with other settings: success False, now True" in otherwise.err


def test_appending_tells_episodes_by_their_content_whatever_they_are_called(tmp_path: Path) -> None:
    out = tmp_path / "set"
    for run_, seed in (("monday", 1), ("tuesday", 2)):  # of equal names, and as in lockstep of equal starts
        record(tmp_path / run_ / "blocks/episodes/episode_000001", seed, 0.5)
    assert run(tmp_path / "monday", "--out", out).code == 0
    added = run(tmp_path / "tuesday", "--out", out, "--append", "--json")
    assert (added.report["episodes"], added.report["passed_over"]) == (1, 0), added.err
    shutil.copytree(tmp_path / "monday", tmp_path / "copy/of_monday")
    twice = run(tmp_path / "copy", tmp_path / "tuesday", "--out", out, "--append")
    assert twice.err.count("already in the dataset") == 2
    copied = run(tmp_path / "copy", tmp_path / "monday", "--out", tmp_path / "once", "--json")
    assert [each["passed_over"] for each in copied.report["reports"]] == ["", "is a copy of blocks/episode_000001"]


def test_an_episode_that_changed_since_it_was_converted_is_an_error(tmp_path: Path) -> None:
    uuid = "2b0f0c57-7f0e-4d4c-9d7b-1f6a3c2f9a10"
    episode = tmp_path / "blocks/episodes/episode_000001"
    record(episode, 1, 0.5, uuid=uuid)
    assert run(tmp_path / "blocks", "--out", tmp_path / "set").code == 0
    assert "already" in run(tmp_path / "blocks", "--out", tmp_path / "set", "--append").err
    shutil.rmtree(episode)
    record(episode, 1, 0.8, uuid=uuid)
    changed = run(tmp_path / "blocks", "--out", tmp_path / "set", "--append")
    assert changed.code == 1
    assert "the dataset has another state of this episode, as blocks/episode_000001" in changed.err


def test_joints_in_lerobots_units(bags: Path, tmp_path: Path) -> None:
    document = {
        "robot": {"joints": [{"name": name, "lower": -0.1} for name in JOINTS]},
        "hardware": {"type": "feetech_so101"},
    }
    metadata: dict[str, Any] = {"config": json.dumps(document), "calibration": json.dumps({"arm": CALIBRATION})}
    record(tmp_path / "bag", 1, 0.5, **metadata)
    for mode in ("radians", "degrees", "range_m100_100"):
        result = run(tmp_path / "bag", "--out", tmp_path / mode, "--norm-mode", mode)
        assert result.code == 0, result.err
    radians, degrees, percent = (
        np.concatenate([rows(tmp_path / mode)[key] for key in ("observation.state", "action")])
        for mode in ("radians", "degrees", "range_m100_100")
    )
    # LeRobot's degrees have 4095 ticks to a turn.
    # The middle of 1048..3048 is tick 2048, where radians are zero too; 1000 ticks to either side are 100 %.
    np.testing.assert_allclose(degrees[:, :2], np.degrees(radians[:, :2]) * 4096 / 4095, atol=1e-3)
    ticks = np.clip(radians[:, :2] * 4096 / (2 * np.pi), -1000, 1000)
    np.testing.assert_allclose(percent[:, :2], ticks / 10, atol=1e-3)
    gripper = np.clip((radians[:, 2] + 0.1) * 4096 / (2 * np.pi), 0, 2000)
    np.testing.assert_allclose(percent[:, 2], gripper / 20, atol=1e-3)
    np.testing.assert_array_equal(degrees[:, 2], percent[:, 2])
    kept = json.loads((tmp_path / "degrees/meta/ibrobot.json").read_bytes())
    assert list(kept["calibrations"].values()) == [CALIBRATION]
    assert (kept["fingerprint"], kept["conversion"]["norm_mode"]) == (CONTRACT.fingerprint(), "degrees")
    without = run(bags, "--out", tmp_path / "none", "--norm-mode", "degrees")
    assert "needs the calibration of joint 'pan'; there is none; name one by" in without.err
    assert "or --calibration" in without.err


def test_joints_in_the_units_of_a_plugin(bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(bags, "--out", tmp_path / "radians").code == 0
    with made_up_site(tmp_path / "site", PLUGINS, monkeypatch) as site:
        site.add("other-units", "other_units.py")
        degrees = ("--norm-mode", "degrees", "--units", "other_units")
        for out, given in (("named", degrees), ("none", degrees[:2])):  # in new processes, which have the plugin
            command = [sys.executable, "-c", PROGRAM, "convert", str(bags), "--out", str(tmp_path / out), *given]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert (done.returncode == 0) == (out == "named"), done.stderr
        assert "name the type of the units: several" in done.stderr
    for key in ("observation.state", "action"):  # this plugin takes all numbers for angles
        np.testing.assert_allclose(
            rows(tmp_path / "named")[key], np.degrees(rows(tmp_path / "radians")[key]), rtol=1e-6
        )
    assert json.loads((tmp_path / "named/meta/ibrobot.json").read_bytes())["conversion"]["units"] == "other_units"
    other = run(bags, "--out", tmp_path / "named", "--append", *degrees[:2])
    assert "was made with other settings: units other_units, now None" in other.err
    unknown = run(bags, "--out", tmp_path / "none", "--units", "calibrate")
    assert unknown.code != 0
    assert "unknown units type 'calibrate', did you mean 'calibrated'?" in unknown.err


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("compression", [None, CompressionMode.MESSAGE, CompressionMode.FILE])
def test_foreign_bags_by_the_contract_alone(
    tmp_path: Path, storage: StoragePlugin, compression: CompressionMode | None
) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("string[] marks\nfloat32[] hues\n", LAMP))
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        types: dict[str, type[Message]] = {"/joint_states": JointState, "/top": Image, "/commands": Float64MultiArray}
        topics = {
            topic: writer.add_connection(topic, type_.ros_type, typestore=store) for topic, type_ in types.items()
        }
        lamp = writer.add_connection("/lamp", LAMP, typestore=store)
        for i in range(30):
            t_ns = START_NS + i * 33_333_333
            pixels = numbered(i)
            picture = Image(Header(t_ns), *SIZE, "rgb8", 3 * SIZE[1], pixels.ravel())
            shining = store.types[LAMP](["a"], np.array([0.25, i], np.float32))
            writer.write(lamp, t_ns, store.serialize_cdr(shining, LAMP))
            writer.write(topics["/joint_states"], t_ns, bytes(encode(JointState(Header(t_ns), JOINTS, [i, 1.0, 2.0]))))
            writer.write(topics["/commands"], t_ns, bytes(encode(Float64MultiArray([i + 0.5, 1.0, 2.0]))))
            writer.write(topics["/top"], t_ns, bytes(encode(picture)))
    lamp_too = (
        f"- {{key: observation.hue, topic: /lamp, type: {LAMP}, foreign: true, select: [hues.1], "
        "align: {stamp: receive}}"
    )
    (tmp_path / "robot.yaml").write_text(ROBOT.replace("  actions:", f"    {lamp_too}\n  actions:"))
    result = run(
        tmp_path / "bag",
        "--config",
        tmp_path / "robot.yaml",
        "--prompt",
        "blink",
        "--no-videos",
        "--out",
        tmp_path / "set",
    )
    assert result.code == 0, result.err
    found = rows(tmp_path / "set")
    np.testing.assert_array_equal(found["observation.state"][:, 0], np.arange(30))
    np.testing.assert_array_equal(found["action"][:, 0], np.arange(30) + 0.5)
    np.testing.assert_array_equal(found["observation.hue"].ravel(), np.arange(30))
    assert json.loads((tmp_path / "set/meta/info.json").read_bytes())["robot_type"] == "bench_follower"


@pytest.mark.parametrize(
    ("printed", "more"),
    [
        (lambda i: JointState(Header(0), JOINTS[::-1], [2.0, 1.0, i + 0.5]), ""),
        (
            lambda i: JointTrajectory(Header(0), JOINTS, (JointTrajectoryPoint(0, [i + 0.5, 1.0, 2.0]),)),
            ", select: [points.0.positions.0, points.0.positions.1, points.0.positions.2]",
        ),
    ],
    ids=["leader", "trajectory"],
)
def test_foreign_commands_come_as_what_they_are(tmp_path: Path, printed: Callable[[int], Message], more: str) -> None:
    type_ = printed(0).ros_type
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        states = writer.add_connection("/joint_states", JointState.ros_type, typestore=store)
        commands = writer.add_connection("/commands", type_, typestore=store)
        for i in range(30):
            t_ns = START_NS + i * 33_333_333
            writer.write(states, t_ns, bytes(encode(JointState(Header(t_ns), JOINTS, [i, 1.0, 2.0]))))
            writer.write(commands, t_ns, bytes(encode(printed(i))))
    robot, _, _ = ROBOT.partition("    - key: observation.images.top")
    action = f"{{key: action, executor: arm, topic: /commands, type: {type_}, foreign: true{more}}}"
    (tmp_path / "robot.yaml").write_text(f"{robot}  actions:\n    - {action}\n")
    config = ("--config", tmp_path / "robot.yaml")
    result = run(tmp_path / "bag", *config, "--prompt", "wave", "--out", tmp_path / "set")
    assert result.code == 0, result.err
    np.testing.assert_array_equal(rows(tmp_path / "set")["action"], [[i + 0.5, 1.0, 2.0] for i in range(30)])
    again = run(tmp_path / "set", "--to", "bag", "--out", tmp_path / "again")
    assert again.code == 1
    assert f"action: cannot make a {type_} for /commands, because the action is foreign" in again.err
    assert not (tmp_path / "again").exists()


def test_a_bar_moves_on_a_terminal(bags: Path, tmp_path: Path) -> None:
    with Terminal("convert", str(bags), "--out", str(tmp_path / "set")) as terminal:
        assert terminal.end() == 0
    assert "4 of 4 episodes" in terminal.screen
    assert "frames/s" in terminal.screen


def test_where_things_lie_is_checked_first(bags: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other/thesis.txt").write_text("mine")
    for arguments, message in (
        ((bags, "--out", tmp_path / "other"), "is not empty and has no dataset"),
        ((tmp_path / "nowhere", "--out", tmp_path / "set"), "there is no such episode"),
        ((bags, "--out", tmp_path / "set", "--codec", "mpeg9"), "mpeg9"),
    ):
        result = run(*arguments)
        assert result.code != 0
        assert message in result.err
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["thesis.txt"]
    assert not (tmp_path / "set").exists()


def test_an_episode_without_a_contract_needs_one(tmp_path: Path) -> None:
    record(tmp_path / "bag", 1, 0.4, contract=None)
    result = run(tmp_path / "bag", "--out", tmp_path / "set")
    assert result.code == 1
    assert "the episode has no contract; name a robot YAML that has it with --config" in result.err


def test_only_episodes_of_an_outcome(tmp_path: Path) -> None:
    for number, outcome in ((1, "success"), (2, "failure"), (3, "unknown")):
        record(tmp_path / f"bags/episode_{number:06d}", number, 0.4, outcome=outcome)
    result = run(tmp_path / "bags", "--out", tmp_path / "set", "--outcome", "success", "--success", "--json")
    assert result.code == 0, result.err
    found = rows(tmp_path / "set")["next.success"].ravel()
    assert found[-1]
    assert not found[:-1].any()
    result = run(tmp_path / "bags", "--out", tmp_path / "all", "--success")
    assert "cannot be determined: the episode's outcome is unknown" in result.err


def test_an_episode_that_is_being_recorded_is_left_out_and_names_its_owner(bags: Path, tmp_path: Path) -> None:
    shutil.copytree(bags, tmp_path / "bags")
    with Ownership(tmp_path / "bags/episode_000002", "is being recorded"):
        result = run(tmp_path / "bags", "--out", tmp_path / "set")
    assert result.code == 1
    left_out = (
        f"left out episode_000002: {tmp_path / 'bags/episode_000002'}: is being recorded by process {os.getpid()};"
    )
    assert left_out in result.err
    assert set(rows(tmp_path / "set")["episode_index"]) == {0, 1, 2}
    again = run(tmp_path / "bags", "--out", tmp_path / "set", "--append", "--json")
    assert (again.report["episodes"], again.report["passed_over"]) == (1, 3), again.err
