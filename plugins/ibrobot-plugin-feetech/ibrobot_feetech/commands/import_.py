"""`ibrobot feetech import`: imports a calibration of another program, or updates one after a change of adapter."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
from ibrobot_calibration import Calibration, calibration_path, load_calibration
from ibrobot_terminal.plural import counted
from ibrobot_terminal.questions import Declined

from ibrobot_core.api import CalibrationError, HardwareError, option
from ibrobot_core.app import echo
from ibrobot_feetech.calibration import ZERO_AT, save_calibration
from ibrobot_feetech.commands.calibrate import backup
from ibrobot_feetech.commands.dialogue import TerminalGuide
from ibrobot_feetech.commands.joints import Joint, joints_of
from ibrobot_feetech.commands.ranges import Range, doubtful, impossible
from ibrobot_feetech.commands.zero import zero_text
from ibrobot_feetech.usb import usb_port

_LEROBOTS = "LeRobot keeps its calibrations in ~/.cache/huggingface/lerobot/calibration"


@attrs.frozen(kw_only=True)
class ImportCalibration:
    """Import a calibration, and set where its 0 rad is.

    FILE is a path or a name. With --prefix, the joints in FILE may have the prefix or not; those of other parts, such
    as a second arm or wheels, are left out. The command shows what does not fit the joints' limits, and does not access
    any servo.
    """

    file: str = option(typed="FILE", help="a calibration, by path or name")
    name: str | None = option(None, help="name of the new calibration, or a path; by default FILE itself")
    zero_at: str | None = option(
        None,
        choices=tuple(ZERO_AT),
        help="0 rad: the pose set by hand, or the middle of each range; by default that of FILE; range for LeRobot's",
    )
    port: str | None = option(None, help="port of the arm, to store the serial number of its adapter")
    arm: str | None = option(None, help="name of the arm, for the records")
    robot: str | None = option(None, typed="--robot CONFIG", help="robot YAML with the joints; by default an SO-101")
    prefix: str = option("", help="prefix of the joints' names, e.g. left_ for one of two arms")
    yes: bool = option(False, help="overwrite without asking; the old file is kept")

    def __call__(self) -> None:
        path = calibration_path(self.name or self.file)
        wanted = joints_of(self.robot, self.name, "" if self.robot else self.prefix)
        imported, left_out = _load(self.file, wanted, self.prefix, self.zero_at)
        doubts = _doubts(imported, wanted)
        if (
            path.exists()
            and not self.yes
            and not TerminalGuide().confirm(f"{path} exists already. Overwrite it?", flag="--yes")
        ):
            raise Declined
        adapter = imported.adapter if self.port is None else _adapter(self.port)
        made = attrs.evolve(imported, robot=self.arm or imported.robot, adapter=adapter)
        if kept := backup(path):
            echo(f"the old file is kept: {kept}")
        save_calibration(made, path, overwrite=True)
        echo(f"saved: {path}")
        echo(zero_text(made))
        if left_out:
            echo(f"left out: {', '.join(left_out)}")
        for doubt in doubts:
            echo(f"check: {doubt}")


def _load(file: str, wanted: Sequence[Joint], prefix: str, zero_at: str | None) -> tuple[Calibration, list[str]]:
    """The wanted joints of a calibration, under their names here, and the names of those left out.

    Raises:
        CalibrationError: if it is invalid or lacks a joint; names the prefix that its joints have, if they have one.
    """
    plain = [joint.name.removeprefix(prefix) for joint in wanted]
    names = [f"{prefix}{each}" for each in plain]
    try:
        imported = load_calibration(file, names, zero_at=zero_at)
    except CalibrationError as error:
        if isinstance(error.__context__, FileNotFoundError):
            raise CalibrationError(f"{calibration_path(file)}: there is no such file; {_LEROBOTS}") from None
        try:
            imported, names = load_calibration(file, plain, zero_at=zero_at), plain
        except CalibrationError:
            raise CalibrationError(f"{error}{_hint(file, plain)}") from None
    ours = dict(zip(names, (joint.name for joint in wanted), strict=True))
    left_out = [name for name in imported.joints if name not in ours]
    joints = {ours[name]: numbers for name, numbers in imported.joints.items() if name in ours}
    return attrs.evolve(imported, joints=joints), left_out


def _hint(file: str, plain: Sequence[str]) -> str:
    """The prefixes with which a file has the joints, or what to give if it has another arm's."""
    try:
        known = load_calibration(file).joints
    except CalibrationError:
        return ""
    prefixes = [name.removesuffix(plain[0]) for name in known if name.endswith(plain[0])]
    fitting = [each for each in prefixes if each and all(f"{each}{name}" in known for name in plain)]
    if fitting:
        return f"; give --prefix {' or --prefix '.join(fitting)}"
    if len(known) != len(plain):
        return (
            f"; the file has {counted(len(known), 'joint')}, the arm {len(plain)}: name the YAML of its arm by --robot"
        )
    return ""


def _doubts(imported: Calibration, joints: Sequence[Joint]) -> list[str]:
    """What does not fit the limits of the joints.

    Raises:
        CalibrationError: if a joint was hardly moved.
    """
    doubts = []
    for joint in joints:
        numbers = imported.joints[joint.name]
        measured = Range(numbers.range_min, numbers.range_min, numbers.range_max)
        if fault := impossible(joint.name, measured):
            raise CalibrationError(f"{imported.path}: {fault}")
        doubts.append(doubtful(joint, measured, imported.zero_at))
    return [each for each in doubts if each is not None]


def _adapter(port: str) -> str:
    adapter = usb_port(port)
    if adapter is None:
        raise HardwareError(f"{port}: there is no USB adapter; `ibrobot feetech find-port --list` lists them")
    return adapter.serial_number
