"""`ibrobot feetech import`: imports a calibration of another program, or updates one after a change of adapter."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import click

from ibrobot_core.api import Calibration, CalibrationError, HardwareError, calibration_path, load_calibration
from ibrobot_core.app import Declined, echo
from ibrobot_feetech.calibration import ZERO_AT, save_calibration
from ibrobot_feetech.commands.calibrate import backup
from ibrobot_feetech.commands.dialogue import TerminalGuide
from ibrobot_feetech.commands.joints import Joint, joints_of
from ibrobot_feetech.commands.ranges import Range, doubtful, impossible
from ibrobot_feetech.commands.zero import zero_text
from ibrobot_feetech.usb import usb_port


@click.command("import")
@click.argument("file")
@click.option("--name", help="Name of the new calibration, or a path.  [default: FILE itself]")
@click.option(
    "--zero-at",
    type=click.Choice(list(ZERO_AT)),
    help="0 rad: the pose set by hand, or the middle of each range.  [default: that of FILE; range for LeRobot's]",
)
@click.option("--port", help="Port of the arm, to store the serial number of its adapter.")
@click.option("--arm", help="Name of the arm, for the records.")
@click.option("--robot", metavar="CONFIG", help="Robot YAML with the joints; by default an SO-101.")
@click.option("--prefix", default="", help="Prefix of the joints' names, e.g. left_ for one of two arms.")
@click.option("--yes", is_flag=True, help="Overwrite without asking; the old file is kept.")
def import_calibration(
    file: str, name: str | None, zero_at: str | None, port: str | None, arm: str | None, robot: str | None,
    prefix: str, yes: bool,
) -> None:  # fmt: skip
    """Import a calibration, and set where its 0 rad is.

    FILE is a path or a name. With --prefix, the joints in FILE may have the prefix or not; those of other parts, such
    as a second arm or wheels, are left out. The command shows what does not fit the joints' limits, and does not access
    any servo.
    """
    path = calibration_path(name or file)
    wanted = joints_of(robot, name, "" if robot else prefix)
    imported, left_out = _load(file, wanted, prefix, zero_at)
    doubts = _doubts(imported, wanted)
    if path.exists() and not yes and not TerminalGuide().confirm(f"{path} exists already. Overwrite it?", flag="--yes"):
        raise Declined
    adapter = imported.adapter if port is None else _adapter(port)
    made = attrs.evolve(imported, robot=arm or imported.robot, adapter=adapter)
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
        return f"; the file has {len(known)} joints, the arm {len(plain)}: give the robot YAML of its arm by --robot"
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
