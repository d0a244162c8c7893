"""Every command of `ibrobot`, those of plugins included: wrong files, ASCII terminals, JSON, and the end by signals."""

from __future__ import annotations

import io
import json
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path

import attrs
import click
import pytest
from command_line import run_here

from ibrobot_core.cli.main import cli, main

pytestmark = pytest.mark.integration

BAD = "BAD"
"""Stands for the wrong file in a command line."""
WRONG_FILES = {
    "replay BAD": (),
    "replay EPISODE BAD": (),
    "replay EPISODE so101_blind --sim --dry-run --calibration BAD": (),
    "launch BAD --dry-run": (),
    "mcp BAD --dry-run": (),
    "record BAD --dry-run": (),
    "record so101_blind --sim --dry-run --root BAD": ("missing", "folder"),
    "convert BAD --out new": (),
    "convert EPISODE --out BAD": ("missing", "folder"),
    "convert EPISODE --out new --config BAD": (),
    "convert EPISODE --out new --norm-mode range_m100_100 --calibration BAD": (),
    "convert BAD --to bag --out new": (),
    "eval BAD --mode scripted --out new": (),
    "serve BAD": (),
    "serve BAD --type lerobot": (),
    "action list --config BAD": (),
    "action send /a control_msgs/action/GripperCommand {} --config BAD": (),
    "action send_goal /a control_msgs/action/GripperCommand {} --config BAD": (),
    "bag play BAD": (),
    "bag play EPISODE --config BAD": (),
    "config check BAD": (),
    "config copy BAD new": (),
    "config import BAD": (),
    "config new new.yaml --urdf BAD": (),
    "config show BAD": (),
    "camera preview BAD --seconds 1 --port 0": (),
    "camera snapshot BAD": (),
    "certs BAD --robot one": ("missing", "folder"),
    "contract init BAD": (),
    "contract init EPISODE -o BAD": ("missing",),
    "datasets info BAD": (),
    "datasets merge BAD --out new": (),
    "datasets push BAD somebody/pick": (),
    "description srdf BAD": (),
    "eval merge BAD --out new": (),
    "lerobot new BAD koch_follower": ("missing",),
    "plugins new teleop my_stick --out BAD": ("missing", "folder"),
    "episodes answers BAD": (),
    "episodes delete BAD --yes": (),
    "episodes export BAD /joint_states -o new.csv": (),
    "episodes export EPISODE /joint_states -o BAD": ("missing", "binary", "empty"),
    "episodes info BAD": (),
    "episodes list BAD": (),
    "episodes mark BAD success": (),
    "episodes plot BAD": (),
    "episodes repair BAD": (),
    "episodes trim BAD --begin 0.5 -o new": (),
    "episodes trim EPISODE --begin 0.5 -o BAD": ("missing",),
    "episodes trash BAD": ("folder",),
    "episodes verify BAD": (),
    "export BAD --to onnx": (),
    "damiao scan ./BAD": (),
    "damiao scan BAD": (),
    "damiao off ./BAD --yes": (),
    "damiao set-id ./BAD 1 2": (),
    "damiao zero BAD --yes": (),
    "feetech calibrate BAD --yes": (),
    "feetech calibrate no_port --robot BAD --yes": (),
    "feetech check BAD": (),
    "feetech check no_port --name ./BAD.json": (),
    "feetech check no_port --robot BAD": (),
    "feetech compare BAD --leader-port no_port --yes": (),
    "feetech compare no_port --leader-port BAD --robot BAD --yes": (),
    "feetech emulate --physics BAD": (),
    "feetech emulate --calibration ./BAD": ("missing",),
    "feetech import ./BAD --yes": (),
    "feetech import ./calibration.json --robot BAD --yes": (),
    "feetech monitor BAD --once": (),
    "feetech monitor no_port --robot BAD --once": (),
    "feetech scan BAD": (),
    "feetech setup-motors BAD --yes": (),
    "feetech torque off BAD --yes": (),
    "feetech torque off no_port --robot BAD --yes": (),
    "gamepad map BAD": (),
    "param set /so101 mode teleop --config BAD": (),
    "plan BAD --from rest --goal home": (),
    "service call /a --config BAD": (),
    "service list --config BAD": (),
    "service show /a --config BAD": (),
    "task check BAD": (),
    "task check pick_cube BAD": (),
    "task run BAD": (),
    "task run pick_cube BAD": (),
    "topic echo /a --config BAD": (),
    "train BAD --out new": (),
    "topic hz /a --config BAD": (),
    "topic list --config BAD": (),
    "topic pub /a std_msgs/msg/Bool {data:true} --config BAD": (),
    "ui BAD --no-browser --port 0": ("folder",),
    "camera board -o BAD": (),
    "camera calibrate BAD": (),
    "camera mount BAD EPISODE --camera top": (),
    "camera mount so101_blind BAD --camera top": (),
    "explain BAD": (),
    "preflight BAD": (),
    "identify BAD": (),
    "identify --excite BAD": (),
    "identify EPISODE --robot BAD": (),
    "identify EPISODE --robot so101_blind --against BAD": (),
    "preflight so101_blind --sim --lockstep --against BAD": (),
    "preflight so101_blind --sim --lockstep --seconds 0.5 --take BAD": ("missing", "binary", "unreadable", "empty"),
    "preflight so101_blind --sim --lockstep --seconds 0.5 --out BAD": ("missing", "folder"),
    "datasets card BAD": (),
    "datasets check BAD": (),
}
"""Command line -> the kinds of files that are right there."""
WITHOUT_FILES = {
    "agent add", "agent arm", "agent disarm", "agent list", "agent remove", "agent status",
    "plugins check",
    "config schema", "plugins show", "doctor", "camera list", "damiao emulate", "feetech find-port", "netft emulate",
    "gamepad list",
    "gamepad test", "gamepad udev", "lerobot list", "lerobot torque-off", "datasets pull",
}  # fmt: skip
KINDS = ("missing", "folder", "binary", "unreadable", "empty")


def commands(command: click.Command = cli, names: tuple[str, ...] = ()) -> Iterator[str]:
    """The full names of all commands."""
    if not isinstance(command, click.Group):
        yield " ".join(names)
        return
    if command.invoke_without_command:
        yield " ".join(names)
    context = click.Context(command)
    for name in command.list_commands(context):
        inner = command.get_command(context, name)
        assert inner is not None
        yield from commands(inner, (*names, name))


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    short = ("--lockstep", "--episodes", "1", "--set", "contract.max_duration_s=1")
    with chdir(folder):
        run_here("record", "so101_blind", "--sim", "--headless", *short)
    return folder / "episodes" / "default" / "episodes" / "episode_000001"


@pytest.fixture
def folder(tmp_path: Path, episode: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with an episode, and nothing else that a command could take."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    shutil.copytree(episode, "EPISODE")
    return tmp_path


def make(kind: str, path: Path) -> None:
    """A file that no command can take."""
    if kind == "folder":
        path.mkdir()
    elif kind == "binary":
        path.write_bytes(bytes(range(256)) * 8)
    elif kind == "unreadable":  # also for root, who may read everything
        path.symlink_to("/proc/self/mem")
    elif kind == "empty":
        path.touch()


@attrs.frozen
class Terminal:
    """Runs commands in this process, on an ASCII terminal."""

    monkeypatch: pytest.MonkeyPatch

    def run(self, *arguments: str) -> tuple[int, str, str]:
        """Exit code, standard output and standard error."""
        streams = [io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True) for _ in range(2)]
        for name, stream in zip(("stdout", "stderr"), streams, strict=True):
            self.monkeypatch.setattr(sys, name, stream)
        self.monkeypatch.setattr(sys, "argv", ["ibrobot", *arguments])
        code: object = 0
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
        finally:
            self.monkeypatch.undo()
        assert isinstance(code, int)
        out, err = (
            stream.buffer.getvalue().decode("ascii") for stream in streams if isinstance(stream.buffer, io.BytesIO)
        )
        return code, out, err


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    with pytest.MonkeyPatch.context() as monkeypatch:
        yield Terminal(monkeypatch)
    for number, handler in before.items():
        signal.signal(number, handler)


def test_every_command_is_tested_with_wrong_files() -> None:
    tested = {name for name in commands() if any(line.startswith(f"{name} ") for line in WRONG_FILES)}
    assert set(commands()) - tested == WITHOUT_FILES


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("line", WRONG_FILES)
def test_wrong_file_is_one_error_with_exit_code_2(line: str, kind: str, folder: Path, terminal: Terminal) -> None:
    if kind in WRONG_FILES[line]:
        pytest.skip("not wrong here")
    make(kind, folder / ("BAD.json" if "BAD.json" in line else BAD))

    code, _, err = terminal.run(*line.split())

    errors = [text for text in err.splitlines() if text.startswith("error: ")]
    assert errors, err
    assert (code, [text for text in errors if " a bug at " in text]) == (2, []), err
    assert "Traceback" not in err


JSON = {
    "launch so101_blind --sim --lockstep --duration 0.1 --json": 0,
    "launch so101_blind --sim --dry-run --json": 0,
    "mcp so101_blind --sim --dry-run --json": 0,
    "mcp BAD --json": 2,
    "launch BAD --json": 2,
    "record so101_blind --sim --lockstep --duration 0.1 --root new --json": 0,
    "record BAD --json": 2,
    "replay EPISODE --sim --lockstep --json": 0,
    "replay BAD --json": 2,
    "convert EPISODE --out new --jobs 1 --json": 0,
    "convert BAD --out new --json": 2,
    "eval so101_pick_cube --set contract.max_duration_s=0.1 --episodes 1 --videos 0 --out new --json": 0,
    "eval BAD --out new --json": 2,
    "config check so101 --json": 0,
    "config check BAD --json": 2,
    "plugins --json": 0,
    "plugins show kamera --json": 2,
    "plugins show opencv --json": 0,
    "plugins check attrs --json": 2,
    "plugins new teleop my_stick --out new --json": 0,
    "doctor --json": None,
    "agent list --json": 0,
    "agent add scout --json": 0,
    "agent status --json": 2,
    "camera list --json": 0,
    "camera calibrate BAD --json": 2,
    "camera mount BAD no_episode --json": 2,
    "explain EPISODE --json": 0,
    "explain BAD --json": 2,
    "datasets check BAD --json": 2,
    "episodes answers EPISODE --json": 0,
    "episodes answers BAD --json": 2,
    "episodes info EPISODE --json": 0,
    "episodes info BAD --json": 2,
    "episodes list . --json": 0,
    "episodes list BAD --json": 2,
    "episodes trash . --json": 0,
    "episodes trash BAD --json": 2,
    "feetech monitor BAD --json": 2,
    "gamepad list --json": 0,
    "datasets info BAD --json": 2,
    "preflight so101_blind --sim --lockstep --seconds 0.5 --json": 0,
    "preflight BAD --json": 2,
    "identify BAD --json": 2,
    "plan so101_blind --from rest --goal home --json": 0,
    "plan BAD --from rest --goal home --json": 2,
    "task run pick_cube so101_pick_cube --sim --lockstep --json": 0,
    "task run BAD --json": 2,
}
"""Command line -> its exit code; None where it depends on the machine."""
INTERRUPTED = """
import os, signal, sys
number, at = int(sys.argv.pop(1)), sys.argv.pop(1)
sent = []
def interrupt(event, arguments):
    if event in ("import", "open") and at in str(arguments[0]) and not sent:
        sent.append(at)
        signal.raise_signal(number)
sys.addaudithook(interrupt)
from ibrobot_core.cli.command import main
main()
"""
"""Sends itself a signal when it first imports or opens something whose name has a text."""


def takes_json() -> set[str]:
    """The commands with --json."""
    found = set()
    for name in commands():
        command: click.Command = cli
        for word in name.split():
            assert isinstance(command, click.Group)
            command = command.get_command(click.Context(command), word) or command
        found |= {name for parameter in command.params if "--json" in parameter.opts}
    return found


def test_every_command_with_json_is_tested() -> None:
    assert takes_json() == {name for name in takes_json() if any(line.startswith(f"{name} ") for line in JSON)}


@pytest.mark.usefixtures("first_conversion")
@pytest.mark.parametrize("line", JSON)
def test_json_is_alone_on_standard_output(
    line: str, folder: Path, terminal: Terminal, capfd: pytest.CaptureFixture[str]
) -> None:
    code, out, err = terminal.run(*line.split())

    below = capfd.readouterr().out
    assert not below, "a library or a child of this process prints it"
    assert code == JSON[line] or JSON[line] is None, err
    if code == 2 and not out:
        assert err.startswith("error: ")
    else:
        json.loads(out)


@pytest.mark.parametrize(
    ("line", "at", "number"),
    [
        ("launch so101_blind --sim --json", "so101_blind.yaml", signal.SIGHUP),
        ("replay EPISODE --sim --json", "metadata.yaml", signal.SIGINT),
        ("convert EPISODE --out new --json", "ibrobot_data.run", signal.SIGTERM),
        ("plugins --json", "ibrobot_core.plugins", signal.SIGTERM),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (
                ("convert EPISODE --out new --json", "metadata.yaml", signal.SIGTERM),
                ("config check so101 --json", "so101.yaml", signal.SIGINT),
                ("doctor --json", "ibrobot_core.plugins", signal.SIGHUP),
                ("camera list --json", "list_cameras", signal.SIGINT),
                ("episodes info EPISODE --json", "ibrobot_mcap.commands", signal.SIGTERM),
                ("episodes info EPISODE --json", "metadata.yaml", signal.SIGHUP),
                ("feetech monitor BAD --json", "ibrobot_feetech.bus", signal.SIGINT),
                ("certs new --robot one", "ibrobot_zenoh.certificates", signal.SIGTERM),
                ("serve so101_blind", "so101_blind.yaml", signal.SIGHUP),
            )
        ),
    ],
)
def test_signal_while_a_command_starts_is_one_line(line: str, at: str, number: signal.Signals, folder: Path) -> None:
    command = [sys.executable, "-c", INTERRUPTED, str(int(number)), at, *line.split()]

    ran = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)

    printed = ran.stderr.strip()  # after the ^C of a terminal, an empty line
    assert (ran.returncode, ran.stdout) == (130, ""), ran.stderr
    assert printed == "error: stopped" or printed.startswith("interrupted; finished episodes are kept"), printed
    assert len(printed.splitlines()) == 1


TYPED = {
    "record so101_blind --sim --dry-run --root BAD": "--root BAD: recording.root: ",
    "record so101_blind --sim --dry-run --dataset ../x": "--dataset ../x: recording.dataset: '../x' is not below ",
    "launch so101_blind --sim --dry-run --viewer foo": "--viewer foo: viewer.type: unknown viewer type 'foo'",
    "launch so101_blind --sim --dry-run --mode telop": "--mode telop: default_control_mode: unknown control mode ",
    "convert EPISODE --out new --codec foo": "--codec foo: codec: 'foo' is not one of: ",
    "serve so101_blind --set 'transport={type: zenoh}' --listen bad": "--listen bad: transport.listen: ",
    "serve so101_blind --set 'transport={type: zenoh}' --listen tcp/[::1]:1 --transport foo=3": "--transport foo=3: ",
}
"""Command line -> its error."""


@pytest.mark.parametrize(("deep", "code", "begin"), [((), 0, "note: "), (("--deep",), 2, "error: ")])
def test_config_check_names_a_missing_calibration(
    folder: Path, terminal: Terminal, deep: tuple[str, ...], code: int, begin: str
) -> None:
    found, out, err = terminal.run("config", "check", "so101", *deep)
    lines = [line for line in (out + err).splitlines() if "there is no such calibration" in line]
    assert found == code
    parts = {"hardware": ("/dev/ttyACM0", "so101_follower"), "teleoperation.leader": ("/dev/ttyACM1", "so101_leader")}
    for line, (part, (port, name)) in zip(lines, parts.items(), strict=True):
        assert line.startswith(begin)
        assert f" {part}: " in line
        assert f"`ibrobot feetech calibrate {port} --name {name}` makes one" in line


def calibration_of(ranges: dict[str, tuple[int, int]]) -> str:
    """LeRobot's calibration of an SO-101, with some other ranges."""
    usual = {
        "shoulder_pan": (800, 3300), "shoulder_lift": (900, 3200), "elbow_flex": (950, 3150),
        "wrist_flex": (950, 3150), "wrist_roll": (0, 4095), "gripper": (2040, 3300),
    }  # fmt: skip
    return json.dumps(
        {
            joint: {"id": servo, "drive_mode": 0, "homing_offset": 0, "range_min": least, "range_max": most}
            for servo, (joint, (least, most)) in enumerate((usual | ranges).items(), 1)
        }
    )


@pytest.mark.parametrize(
    ("joint", "ends"),
    [
        *((joint, (2000, 2300)) for joint in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "gripper")),
        ("wrist_roll", (0, 1500)),
        ("gripper", (0, 4095)),
    ],
)
@pytest.mark.parametrize(("deep", "code", "begin"), [((), 0, "note: "), (("--deep",), 2, "error: ")])
def test_config_check_names_a_range_that_does_not_fit(
    folder: Path, terminal: Terminal, joint: str, ends: tuple[int, int], deep: tuple[str, ...], code: int, begin: str
) -> None:
    follower = "hardware.calibration=follower.json", "teleoperation.leader.calibration=follower.json"
    options = [part for each in follower for part in ("--set", each.replace("=", f"={folder}/"))]
    (folder / "follower.json").write_text(calibration_of({}))
    assert terminal.run("config", "check", "so101", *options, "--deep")[0] == 0
    (folder / "follower.json").write_text(calibration_of({joint: ends}))
    found, out, err = terminal.run("config", "check", "so101", *options, *deep)
    lines = [line for line in (out + err).splitlines() if "does not fit its limits" in line]
    assert found == code
    assert lines[0].startswith(begin)
    assert f"hardware: {folder}/follower.json: {joint}: its range, " in lines[0]


def test_recording_that_would_never_end_is_refused(folder: Path, terminal: Terminal) -> None:
    planned = ("--sim", "--mode", "moveit_planning", "--auto", "--lockstep")
    code, _, err = terminal.run("record", "so101_blind", *planned)
    message = "--lockstep: nothing sends mode moveit_planning a goal: add --goal, --duration or --episodes"
    assert (code, err) == (2, f"error: {message}\n")


@pytest.mark.parametrize("line", TYPED)
def test_errors_name_an_option_as_it_was_typed(line: str, folder: Path, terminal: Terminal) -> None:
    make("binary", folder / BAD)
    code, _, err = terminal.run(*shlex.split(line))
    assert code == 2
    assert err.startswith(f"error: {TYPED[line]}"), err


def test_name_of_a_dataset_is_text_whatever_it_looks_like(folder: Path, terminal: Terminal) -> None:
    code, _, err = terminal.run("record", "so101_blind", "--sim", "--dry-run", "--dataset", "2024")
    assert (code, err) == (0, "")
