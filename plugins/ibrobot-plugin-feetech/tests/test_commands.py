"""The commands, typed in a pseudo-terminal by a person who also moves the emulated arm."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path

import attrs
import pytest
from click.testing import CliRunner
from ibrobot_calibration import load_calibration
from ibrobot_feetech.commands.joints import Joint, joints_of
from ibrobot_feetech.commands.ranges import Range, doubtful
from ibrobot_feetech.emulator import EmulatedServo, Emulator
from ibrobot_feetech.options import TOOL
from ibrobot_testing import terminal as terminal_module
from ibrobot_testing.command import command_line

from ibrobot_core.api import CalibrationError

feetech = command_line("feetech")

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
MIDDLES = {1: 2500, 2: 300, 3: 2048, 4: 3900, 5: 1000, 6: 100}
"""Servo -> where its encoder is in the middle pose."""
ENDS = {1: (797, 3297), 2: (900, 3190), 3: (950, 3150), 4: (970, 3120), 6: (1400, 2700)}
"""Servo -> what it reports at its joint's ends, once the middle is at 2048."""


PATIENCE = """
from ibrobot_feetech import bus
bus._ADAPTER_S = 0.25
"""
"""Python source: the emulator, a thread of this process, may be slow on a busy machine."""


class Terminal(terminal_module.Terminal):
    """The commands, with more patience than they need with an arm."""

    def __init__(self, *arguments: str, before: str = "", patience: str = PATIENCE, columns: int = 80) -> None:
        super().__init__(*arguments, before=patience + before, columns=columns)


class Person:
    """Moves joints by hand, a step each time that the servos are asked something."""

    def __init__(self, emulator: Emulator) -> None:
        self.emulator = emulator
        self.done = threading.Event()
        self._path: Iterator[dict[int, int]] = iter(())
        self._left = -1
        for servo, middle in MIDDLES.items():
            emulator.servos[servo].set("homing_offset", 77 * servo - 300)
            emulator.servos[servo].turn(middle)
        emulator.on_request = self._move

    def sweep(self, ends: dict[int, tuple[int, int]]) -> None:
        """Move joints to both ends, and a few readings longer; returns when it is done."""
        self._path = iter(
            [
                {servo: start + (stop - start) * step // 8 for servo, (start, stop) in legs.items()}
                for legs in (
                    {servo: (2048, low) for servo, (low, _) in ends.items()},
                    dict(ends),
                )
                for step in range(9)
            ]
        )
        self._left = 5
        assert self.done.wait(120)

    def turn(self, servo: int, ticks: int) -> None:
        with self.emulator.lock:
            joint = self.emulator.servos[servo]
            joint.turn((joint.encoder + ticks) % 4096)

    def _move(self) -> None:
        pose = next(self._path, None)
        if pose is not None:
            for servo, reported in pose.items():
                self.emulator.servos[servo].turn((reported + MIDDLES[servo] - 2048) % 4096)
        elif self._left > 0:
            self._left -= 1
            if self._left == 0:
                self.done.set()


@pytest.fixture
def emulator() -> Iterator[Emulator]:
    with Emulator(6) as made:
        yield made


@pytest.fixture
def person(emulator: Emulator) -> Person:
    return Person(emulator)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where calibrations are kept."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    return tmp_path / "ibrobot" / "calibration"


def eprom(emulator: Emulator) -> list[bytes]:
    with emulator.lock:
        return [bytes(servo.table[:40]) for servo in emulator.servos.values()]


def ran(*arguments: str, before: str = "", patience: str = PATIENCE) -> tuple[int, str]:
    with Terminal("feetech", *arguments, before=before, patience=patience) as terminal:
        return terminal.end(), terminal.screen


def test_an_arm_is_calibrated_in_the_dialogue_and_the_former_file_is_kept(emulator, person, home):
    home.mkdir(parents=True)
    former = home / "so101_follower.json"
    former.write_text('{"pan": {"id": 1, "drive_mode": 0, "homing_offset": 5, "range_min": 1, "range_max": 9}}')
    before = former.read_text()
    adapter = ADAPTER.format(port=emulator.port)
    with Terminal("feetech", "calibrate", emulator.port, "--arm", "left", before=adapter) as terminal:
        terminal.wait_for("Calibrate again? [y/N]")
        terminal.type("y\r")
        terminal.wait_for("middle of its range. Then press Enter")
        terminal.type("\r")
        terminal.wait_for("to both ends (Enter ends it)")
        person.sweep(ENDS)
        terminal.type("\r")
        terminal.wait_for("0 rad is the pose that was set by hand")
        terminal.wait_for("written to servos 1, 2, 3, 4, 5, 6")
        assert terminal.end() == 0
    found = load_calibration("so101_follower", JOINTS)
    assert (found.robot, found.adapter) == ("left", "5A12")
    assert found.date
    for joint in found.joints.values():
        assert joint.homing_offset == MIDDLES[joint.id] - 2048
        assert (joint.range_min, joint.range_max) == ENDS.get(joint.id, (0, 4095))
        servo = emulator.servos[joint.id]
        written = [servo.get(name) for name in ("homing_offset", "min_position_limit", "max_position_limit")]
        assert written == [joint.homing_offset, joint.range_min, joint.range_max]
        assert servo.get("lock") == 1
    (kept,) = (path for path in home.glob("so101_follower.2*.json") if "meta" not in path.name)
    assert kept.read_text() == before
    _, screen = ran("check", emulator.port)
    assert "6 servos as in the calibration" in screen
    assert "0 rad is the pose that was set by hand" in screen
    code, screen = ran("check", emulator.port, "--write", "--yes", before=adapter.replace("5A12", "5A99"))
    assert code == 1
    assert "this is another arm: its adapter has the USB serial number 5A99" in screen.replace("\r\n", " ")


@pytest.mark.parametrize("name", ["so101_follower", "so101_leader"])
def test_the_command_that_a_missing_calibration_names_makes_it(emulator, person, home, name):
    with pytest.raises(CalibrationError) as missing:
        load_calibration(name, JOINTS, tool=TOOL, device=emulator.port)
    (command,) = re.findall(r"`ibrobot (.*?)`", str(missing.value))
    gripper_of_a_leader = {6: (1400, 1700)} if name == "so101_leader" else {}  # hardly half the follower's range
    with Terminal(*command.split(), "--middle-now") as terminal:
        terminal.wait_for("(Enter ends it)")
        person.sweep(ENDS | gripper_of_a_leader)
        terminal.type("\r")
        terminal.wait_for("written to servos")
        assert terminal.end() == 0
    load_calibration(name, JOINTS)


def test_an_arm_whose_adapter_was_replaced_is_known_after_the_command_that_the_error_names(
    emulator, home, calibration_file
):
    before = ADAPTER.format(port=emulator.port)
    run = ("check", emulator.port, "--name", str(calibration_file))
    assert ran("import", str(calibration_file), "--port", emulator.port, "--yes", before=before)[0] == 0
    assert ran(*run, "--write", "--yes", before=before)[0] == 0
    replaced = before.replace("5A12", "5A99")
    with Terminal("feetech", *run, before=replaced, columns=400) as terminal:
        assert terminal.end() == 1
        (remedy,) = re.findall(r"`ibrobot feetech (import .*?)` stores the new one", terminal.screen)
    assert ran(*remedy.split(), before=replaced)[0] == 0
    assert ran(*run, before=replaced)[0] == 0


def test_a_terminal_without_a_person_lists_the_ports(tmp_path):
    (tmp_path / "ttyACM0").touch()
    code, screen = ran("find-port", "--list", before=PORTS.format(folder=str(tmp_path)))
    assert code == 0
    assert "ttyACM0" in screen


QUESTIONS = ("Calibrate again?", "Go on?", "Then press Enter", "(Enter ends it)")


@pytest.mark.parametrize("question", QUESTIONS)
def test_ctrl_c_at_a_question_leaves_servos_and_files_as_they_were(emulator, person, home, question):
    home.mkdir(parents=True)
    former = home / "so101_follower.json"
    former.write_text("{}")
    for servo in emulator.servos.values():
        servo.set("torque_enable", 1)
    before = eprom(emulator)
    with Terminal("feetech", "calibrate", emulator.port) as terminal:
        for asked in QUESTIONS:
            terminal.wait_for(asked)
            if asked == question:
                break
            terminal.type("y\r" if asked.endswith("?") else "\r")
        terminal.interrupt()
        terminal.wait_for("error: stopped")
        assert terminal.end() == 130
    assert ("Nothing was written" in terminal.screen) == (question in QUESTIONS[2:])
    assert eprom(emulator) == before
    assert former.read_text() == "{}"
    assert len(list(home.iterdir())) == 1


def test_an_existing_file_is_not_overwritten_against_the_answer(emulator, home):
    home.mkdir(parents=True)
    (home / "so101_leader.json").write_text("{}")
    with Terminal("feetech", "calibrate", emulator.port, "--leader") as terminal:
        terminal.wait_for("Calibrate again? [y/N]")
        terminal.type("n\r")
        assert terminal.end() == 1
    assert (home / "so101_leader.json").read_text() == "{}"


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        (ENDS | {3: (2048, 4400)}, "elbow_flex: its range 2048 to 4400 crosses the encoder's end (0/4095)"),
        ({servo: both for servo, both in ENDS.items() if servo != 4}, "wrist_flex: it moved by only 0 ticks"),
        (ENDS | {2: (1747, 2347)}, "shoulder_lift: it moved by 53 deg, its limits are 200 deg apart"),
        (ENDS | {1: (1247, 3747)}, "shoulder_pan: the middle of its range is 39 deg from the middle pose"),
    ],
)
def test_ranges_that_cannot_be_true_are_explained_and_not_kept(emulator, person, home, ends, message):
    before = eprom(emulator)
    with Terminal("feetech", "calibrate", emulator.port, "--middle-now") as terminal:
        terminal.wait_for("(Enter ends it)")
        person.sweep(ends)
        terminal.type("\r")
        terminal.wait_for(message)
        terminal.interrupt()
        assert terminal.end() != 0
    assert eprom(emulator) == before
    assert not home.exists()


def test_a_middle_that_no_offset_reaches_is_explained_and_asked_again(emulator, person, home):
    emulator.servos[2].turn(0)
    with Terminal("feetech", "calibrate", emulator.port) as terminal:
        terminal.wait_for("Then press Enter")
        terminal.type("\r")
        terminal.wait_for("which needs an offset of -2048")
        person.turn(2, 1)
        terminal.wait_for("Then press Enter")
        terminal.type("\r")
        terminal.wait_for("(Enter ends it)")


def test_signs_are_learnt_from_turning_each_joint(emulator, person, home):
    options = ("--middle-now", "--check-signs", "--zero-at", "range")
    with Terminal("feetech", "calibrate", emulator.port, *options) as terminal:
        terminal.wait_for("(Enter ends it)")
        person.sweep(ENDS)
        terminal.type("\r")
        for servo, joint in enumerate(JOINTS, 1):
            terminal.wait_for(f"Turn {joint} a little")
            person.turn(servo, -100 if joint == "elbow_flex" else 100)
            terminal.type("\r")
        terminal.wait_for("written to servos")
        assert terminal.end() == 0
    found = load_calibration("so101_follower", JOINTS).joints
    assert {joint.zero_at for joint in found.values()} == {"range"}
    assert [name for name, joint in found.items() if joint.inverted] == ["elbow_flex"]


def test_ranges_that_are_measured_for_a_time_end_without_enter(emulator, person, home):
    code, screen = ran("calibrate", emulator.port, "--middle-now", "--range-seconds", "0.2")
    assert code == 2
    assert "for 0.2 s" in screen
    assert "elbow_flex: it moved by only 0 ticks" in screen
    assert not home.exists()


def test_a_servo_that_dies_while_measuring_is_named_and_nothing_is_written(emulator, person, home):
    before = eprom(emulator)
    with Terminal("feetech", "calibrate", emulator.port, "--middle-now") as terminal:
        terminal.wait_for("(Enter ends it)")
        emulator.faults.silent.add(4)
        terminal.wait_for("Nothing was written")
        terminal.wait_for("servo 4 (wrist_flex)")
        assert terminal.end() == 1
    assert eprom(emulator) == before
    assert not home.exists()


def test_a_servo_that_dies_while_being_written_leaves_a_state_that_check_repairs(emulator, person, home):
    with Terminal("feetech", "calibrate", emulator.port, "--middle-now", "--yes") as terminal:
        terminal.wait_for("(Enter ends it)")
        person.sweep(ENDS)

        def die() -> None:
            if emulator.servos[3].get("lock") == 0:
                emulator.faults.silent.add(3)

        emulator.on_request = die
        terminal.type("\r")
        terminal.wait_for("not all servos have it (not: elbow_flex, wrist_flex, wrist_roll, gripper)")
        assert terminal.end() == 1
    emulator.on_request = lambda: None
    emulator.faults.silent.clear()
    assert ran("check", emulator.port)[0] == 1
    assert ran("check", emulator.port, "--write", "--yes")[0] == 0
    for joint in load_calibration("so101_follower", JOINTS).joints.values():
        assert emulator.servos[joint.id].get("homing_offset") == joint.homing_offset
        assert emulator.servos[joint.id].get("lock") == 1


def test_an_arm_of_lerobot_is_imported_with_its_0_or_with_the_pose(home, tmp_path):
    file = tmp_path / "theirs.json"
    numbers = {
        joint: {"id": i, "drive_mode": 0, "homing_offset": 0, "range_min": 1000, "range_max": 3000 + 20 * i}
        for i, joint in enumerate(JOINTS, 1)
    }
    file.write_text(json.dumps(numbers))
    run = CliRunner().invoke
    taken = run(feetech, ["import", str(file), "--name", "theirs"])
    assert taken.exit_code == 0, taken.output
    assert "0 rad is the middle of each joint's calibrated range, as in LeRobot" in taken.output
    assert "the pose that was set by hand is up to 3.3 deg from it (shoulder_pan)" in taken.output
    assert load_calibration("theirs").joints["gripper"].zero() == 2060
    again = run(feetech, ["import", str(file), "--name", "theirs", "--zero-at", "pose"])
    assert again.exit_code != 0, "it asks before it overwrites"
    again = run(feetech, ["import", str(file), "--name", "theirs", "--zero-at", "pose", "--yes", "--arm", "left"])
    assert again.exit_code == 0, again.output
    assert "the old file is kept" in again.output
    found = load_calibration("theirs")
    assert (found.zero_at, found.robot, found.joints["gripper"].zero()) == ("pose", "left", 2048)
    assert found.numbers() == numbers
    one_of_two = run(feetech, ["import", str(file), "--name", "left", "--prefix", "left_"])
    assert one_of_two.exit_code == 0, one_of_two.output
    assert load_calibration("left").numbers() == {f"left_{joint}": each for joint, each in numbers.items()}


def numbers_of(prefix="", first=1, **changes):
    """A calibration of an arm, with joints' ranges as SO-101s have them."""
    spans = {"shoulder_pan": 2500, "shoulder_lift": 2300, "elbow_flex": 2200, "wrist_flex": 2200, "wrist_roll": 3600}
    ends = {joint: (2048 - span // 2, 2048 + span // 2) for joint, span in spans.items()} | {"gripper": (2040, 3300)}
    ends |= changes
    return {
        f"{prefix}{joint}": {
            "id": servo, "drive_mode": 0, "homing_offset": 0, "range_min": ends[joint][0], "range_max": ends[joint][1]
        }
        for servo, joint in enumerate(JOINTS, first)
    }  # fmt: skip


WHEELS = {
    f"base_{side}_wheel": {"id": servo, "drive_mode": 0, "homing_offset": 0, "range_min": 0, "range_max": 4095}
    for servo, side in enumerate(("left", "back", "right"), 7)
}
FILES = {
    "LeKiwi": numbers_of("arm_") | WHEELS,
    "XLeRobot": numbers_of("left_arm_") | numbers_of("right_arm_", 11) | WHEELS,
    "two arms": numbers_of("left_") | numbers_of("right_", 7),
    "one": numbers_of(),
}
"""Files with one arm or more, and other servos."""


@pytest.mark.parametrize(
    ("file", "prefix", "theirs", "robot"),
    [
        ("LeKiwi", "arm_", "arm_", None),
        ("LeKiwi", "arm_", "arm_", "so101"),
        ("XLeRobot", "left_arm_", "left_arm_", None),
        ("XLeRobot", "right_arm_", "right_arm_", None),
        ("XLeRobot", "right_arm_", "right_arm_", "so101"),
        ("two arms", "left_", "left_", None),
        ("two arms", "right_", "right_", None),
        ("two arms", "right_", "right_", "so101"),
        ("one", "left_", "", None),
        ("one", "", "", "so101"),
    ],
)
def test_one_arm_of_a_file_is_imported(home, tmp_path, file, prefix, theirs, robot):
    path = tmp_path / "theirs.json"
    path.write_text(json.dumps(FILES[file]))
    named = ["--prefix", prefix] if prefix else []
    done = CliRunner().invoke(
        feetech, ["import", str(path), "--name", "mine", *named, *(["--robot", robot] if robot else [])]
    )
    assert done.exit_code == 0, done.output
    ours = "" if robot else prefix
    assert load_calibration("mine").numbers() == {f"{ours}{joint}": FILES[file][f"{theirs}{joint}"] for joint in JOINTS}
    left_out = [name for name in FILES[file] if not name.startswith(theirs)]
    assert ("left out: " + ", ".join(left_out) in done.output) == bool(left_out)
    assert "check: " not in done.output


@pytest.mark.parametrize(
    ("file", "hint"),
    [
        ("LeKiwi", "give --prefix arm_"),
        ("XLeRobot", "give --prefix left_arm_ or --prefix right_arm_"),
        ("two arms", "give --prefix left_ or --prefix right_"),
    ],
)
def test_a_file_whose_joints_have_prefixes_names_them(home, tmp_path, file, hint):
    path = tmp_path / "theirs.json"
    path.write_text(json.dumps(FILES[file]))
    for prefix in ("", "middle_"):
        with pytest.raises(CalibrationError, match=hint):
            CliRunner().invoke(
                feetech, ["import", str(path), "--name", "mine", "--prefix", prefix], catch_exceptions=False
            )
    assert not list(home.rglob("mine*"))


def arm_of(tmp_path: Path, joints: list[str]) -> Path:
    """A robot YAML with these joints, whose calibration is `mine`."""
    names = json.dumps(joints)
    path = tmp_path / "arm.yaml"
    limits = "lower: -1.5, upper: 1.5, max_velocity: 3.0, max_acceleration: 40.0"
    path.write_text(
        "robot:\n  name: arm\n  robot_type: arm\n  joints:\n"
        + "".join(f"    - {{name: {json.dumps(name)}, {limits}}}\n" for name in joints)
        + f"  groups: {{arm: {names}}}\n"
        f"hardware: {{type: feetech_so101, port: /dev/null, calibration: mine, anchored: [], joints: {names}}}\n"
        "executors: {arm_position: {type: position, group: arm}}\n"
        "teleoperation: {leader: {type: so101_leader, port: /dev/zero, calibration: mine}}\n"
        "control_modes: {teleop: {executors: [arm_position], teleop: leader}}\n"
        "default_control_mode: teleop\n"
    )
    return path


@pytest.mark.parametrize("size", [1, 5, 6, 7, 8, 12])
@pytest.mark.parametrize("numbers", [True, False])
def test_arms_of_any_size_and_with_numbers_as_names_are_imported_and_used(home, tmp_path, size, numbers):
    file = tmp_path / "theirs.json"
    document = {
        str(n): {"id": n, "drive_mode": 0, "homing_offset": n, "range_min": 1048, "range_max": 3048 + n}
        for n in range(1, size + 1)
    }
    file.write_text(json.dumps(document))
    joints = list(document) if numbers else [f"joint{n}" for n in document]
    robot = arm_of(tmp_path, joints)
    if size > len(JOINTS):
        with pytest.raises(CalibrationError, match=f"the file has {size} joints, the arm 6: name the YAML of its arm"):
            CliRunner().invoke(feetech, ["import", str(file), "--name", "mine"], catch_exceptions=False)
        assert not list(home.rglob("mine*"))
    done = CliRunner().invoke(feetech, ["import", str(file), "--name", "mine", "--robot", str(robot)])
    assert done.exit_code == 0, done.output
    found = load_calibration("mine", joints[::-1])
    assert found.numbers() == dict(zip(joints, document.values(), strict=True))


@pytest.mark.parametrize("joint", JOINTS)
def test_a_joint_that_was_hardly_moved_is_refused(home, tmp_path, joint):
    path = tmp_path / "theirs.json"
    path.write_text(json.dumps(numbers_of(**{joint: (2000, 2040)})))
    with pytest.raises(CalibrationError, match=f"theirs.json: {joint}: it moved by only 40 ticks"):
        CliRunner().invoke(feetech, ["import", str(path), "--name", "mine"], catch_exceptions=False)
    assert not list(home.rglob("mine*"))


def test_import_of_a_missing_file_says_where_lerobot_keeps_its_own(home):
    with pytest.raises(
        CalibrationError, match=r"theirs\.json: there is no such file; LeRobot keeps its calibrations in"
    ):
        CliRunner().invoke(feetech, ["import", "missing/theirs.json", "--name", "mine"], catch_exceptions=False)


def test_check_without_a_calibration_prints_the_whole_command_that_makes_one(home):
    with pytest.raises(CalibrationError, match="`ibrobot feetech calibrate /dev/ttyACM3 --name mine` makes one"):
        CliRunner().invoke(feetech, ["check", "/dev/ttyACM3", "--name", "mine"], catch_exceptions=False)


@pytest.mark.parametrize("joint", [each for each in JOINTS if each != "wrist_roll"])
def test_a_range_that_does_not_fit_the_limits_is_shown(home, tmp_path, joint):
    path = tmp_path / "theirs.json"
    path.write_text(json.dumps(numbers_of(**{joint: (0, 4095)})))
    done = CliRunner().invoke(feetech, ["import", str(path), "--name", "mine"])
    assert done.exit_code == 0, done.output
    assert f"check: {joint}: it moved by 360 deg, its limits are " in done.output


def test_zero_in_the_middle_of_the_range_asks_for_limits_about_zero():
    measured = Range(1000, 2000, 3000)
    aside = Joint("elbow_flex", 3, 0.0, 3.0)
    assert "use --zero-at pose" in str(doubtful(aside, measured, "range"))
    assert doubtful(Joint("elbow_flex", 3, -1.5, 1.5), measured, "range") is None
    assert doubtful(attrs.evolve(aside, anchored=True), measured, "range") is None


def test_drift_is_reported_and_written_back(emulator, calibration_file):
    arguments = ("check", emulator.port, "--name", str(calibration_file))
    assert ran(*arguments, "--write", "--yes")[0] == 0
    emulator.servos[3].set("homing_offset", 99)
    code, screen = ran(*arguments)
    assert code == 1
    assert "elbow_flex" in screen
    assert "homing_offset" in screen
    assert "99" in screen
    with Terminal("feetech", *arguments, "--write") as terminal:
        terminal.wait_for("Write to servos 3? [y/N]")
        terminal.interrupt()
        assert terminal.end() == 130
    assert emulator.servos[3].get("homing_offset") == 99
    assert ran(*arguments, "--write", "--yes")[0] == 0
    assert (
        emulator.servos[3].get("homing_offset") == load_calibration(calibration_file).joints["elbow_flex"].homing_offset
    )


@pytest.mark.parametrize("rate_code", [0, 4])
def test_a_new_servo_is_found_at_any_rate_and_gets_its_id(rate_code):
    servo = EmulatedServo(1)
    servo.set("baud_rate", rate_code)
    with (
        Emulator({1: servo}) as emulator,
        Terminal("feetech", "setup-motors", emulator.port, "--joint", "gripper") as terminal,
    ):
        terminal.wait_for("Connect only the servo of gripper (id 6), and power. Then press Enter")
        terminal.type("\r")
        terminal.wait_for("is id 6 at 1000000 baud")
        assert terminal.end() == 0
    assert (servo.id, servo.get("baud_rate"), servo.get("lock")) == (6, 0, 1)


def test_several_servos_are_refused_and_nothing_is_set(emulator):
    before = eprom(emulator)
    code, screen = ran("setup-motors", emulator.port, "--joint", "gripper", "--yes", "--baud", "1000000")
    assert code == 1
    assert "6 servos answer" in screen
    with Terminal("feetech", "setup-motors", emulator.port) as terminal:
        terminal.wait_for("Then press Enter")
        terminal.interrupt()
        assert terminal.end() == 130
    assert eprom(emulator) == before


def test_scan_lists_who_answers_and_hints_where_nobody_does(emulator):
    emulator.faults.silent.add(2)
    code, screen = ran("scan", emulator.port)
    assert code == 0
    assert "shoulder_lift" not in screen
    assert screen.count("STS3215") == 5
    emulator.faults.silent |= set(range(1, 7))
    code, screen = ran("scan", emulator.port, patience="")  # of 250 ids that it asks one by one, none answers
    assert code == 1
    assert "check the arm's power supply" in screen


def test_monitor_only_reads(emulator):
    emulator.servos[1].set("torque_enable", 1)
    emulator.servos[3].set("present_temperature", 61)
    emulator.faults.silent.add(6)
    before = eprom(emulator)
    code, screen = ran("monitor", emulator.port, "--once", "--json")
    servos = {servo["id"]: servo for servo in json.loads(screen)["servos"]}
    assert code == 0
    assert servos[3]["temperature_c"] == 61
    assert not servos[6]["answers"]
    with Terminal("feetech", "monitor", emulator.port) as terminal:
        terminal.wait_for("no reply")
        terminal.wait_for("elbow_flex")
        terminal.interrupt()
        assert terminal.end() == 0
    assert eprom(emulator) == before
    assert emulator.servos[1].torque


def test_torque_comes_without_a_jump_and_goes_after_asking(emulator):
    emulator.servos[2].turn(900)
    assert ran("torque", "on", emulator.port)[0] == 0
    assert emulator.servos[2].get("goal_position") == 900
    assert emulator.servos[2].torque
    with Terminal("feetech", "torque", "off", emulator.port, "--joint", "gripper") as terminal:
        terminal.wait_for("Torque off? [y/N]")
        terminal.interrupt()
        assert terminal.end() == 130
    assert emulator.servos[6].torque
    with Terminal("feetech", "torque", "off", emulator.port, "--joint", "gripper") as terminal:
        terminal.wait_for("Torque off? [y/N]")
        terminal.type("y\r")
        assert terminal.end() == 0
    assert not emulator.servos[6].torque
    assert emulator.servos[5].torque


def test_torque_off_ends_well_although_a_servo_is_in_overload(emulator):
    for servo in emulator.servos.values():
        servo.set("torque_enable", 1)
    emulator.faults.errors[6] = 0x20
    code, screen = ran("torque", "off", emulator.port, "--yes")
    assert code == 0, screen
    assert not any(servo.torque for servo in emulator.servos.values())


def test_torque_off_that_nothing_confirms_is_an_error_that_names_the_servo(emulator):
    emulator.faults.silent.add(4)
    code, screen = ran("torque", "off", emulator.port, "--yes")
    assert code == 1
    assert "servo 4 (wrist_flex), torque_enable: no reply" in screen


def test_torque_of_servos_by_their_ids(emulator):
    for servo in emulator.servos.values():
        servo.set("torque_enable", 1)
    assert ran("torque", "off", emulator.port, "--id", "2", "--id", "5", "--yes")[0] == 0
    assert [servo for servo, each in emulator.servos.items() if each.torque] == [1, 3, 4, 6]
    code, screen = ran("torque", "off", emulator.port, "--id", "2", "--joint", "gripper")
    assert code == 2
    assert "give one or the other" in screen


def test_a_port_that_is_missing_forbidden_or_not_said_is_reported(tmp_path):
    code, screen = ran("scan", str(tmp_path / "ttyACM9"))
    assert code == 2
    assert "there is no such port" in screen
    code, screen = ran("scan", "/dev/ttyACM9", before=FORBIDDEN)
    assert code == 2
    assert "no permission; add yourself to the group" in screen.replace("\r\n", "")


# Root may open anything: the refusal is made up.
FORBIDDEN = """
import errno, serial
def refuse(*arguments, **options):
    raise serial.SerialException(errno.EACCES, 'Permission denied')
serial.Serial = refuse
"""
ADAPTER = """
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo
port = ListPortInfo({port!r})
port.vid, port.pid, port.serial_number = 0x1A86, 0x55D3, "5A12"
list_ports.comports = lambda: [port]
"""
"""Python source: the emulator's port is behind USB."""
PORTS = """
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo
from pathlib import Path
def comports():
    found = []
    for path in sorted(Path({folder!r}).iterdir()):
        port = ListPortInfo(str(path))
        port.vid, port.pid, port.description, port.serial_number = 0x1A86, 0x55D3, "USB Single Serial", "5A" + path.name
        found.append(port)
    return found
list_ports.comports = comports
"""


def test_the_port_is_found_by_pulling_its_cable_and_putting_it_back(tmp_path):
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "ttyACM1").touch()
    before = PORTS.format(folder=str(tmp_path))
    with Terminal("feetech", "find-port", before=before, columns=200) as terminal:
        terminal.wait_for("ttyACM1")
        terminal.wait_for("Then press Enter")
        (tmp_path / "ttyACM1").unlink()
        terminal.type("\r")
        terminal.wait_for("Then press Enter")
        (tmp_path / "ttyACM2").touch()
        terminal.type("\r")
        terminal.wait_for("The arm is at:")
        terminal.wait_for("ttyACM2")
        assert terminal.end() == 0
    code, screen = ran("scan", before=before)
    assert code == 2
    assert "several arms" in screen
    with Terminal("feetech", "find-port", before=before) as terminal:
        terminal.wait_for("Then press Enter")
        terminal.interrupt()
        assert terminal.end() == 130


def test_the_joints_of_one_of_two_arms_have_its_prefix():
    joints = joints_of(prefix="left_")
    assert [joint.name for joint in joints] == [f"left_{joint}" for joint in JOINTS]
    assert [joint.name for joint in joints if joint.anchored] == ["left_gripper"]
