"""`ibrobot feetech import`: imports a calibration of another program, or updates one after a change of adapter."""

from __future__ import annotations

import attrs
import click

from ibrobot_core.api import HardwareError, calibration_path, load_calibration
from ibrobot_core.app import Declined, echo
from ibrobot_feetech.calibration import ZERO_AT, save_calibration
from ibrobot_feetech.commands.calibrate import backup
from ibrobot_feetech.commands.dialogue import TerminalGuide
from ibrobot_feetech.commands.joints import joints_of
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

    FILE is a path or a name. The command does not access any servo.
    """
    path = calibration_path(name or file)
    found = load_calibration(file, [joint.name for joint in joints_of(robot, name)], zero_at=zero_at)
    if path.exists() and not yes and not TerminalGuide().confirm(f"{path} exists already. Overwrite it?", flag="--yes"):
        raise Declined
    adapter = found.adapter if port is None else _adapter(port)
    joints = {f"{prefix}{joint}": numbers for joint, numbers in found.joints.items()}
    made = attrs.evolve(found, joints=joints, robot=arm or found.robot, adapter=adapter)
    if kept := backup(path):
        echo(f"the old file is kept: {kept}")
    save_calibration(made, path, overwrite=True)
    echo(f"saved: {path}")
    echo(zero_text(made))


def _adapter(port: str) -> str:
    found = usb_port(port)
    if found is None:
        raise HardwareError(f"{port}: there is no USB adapter; `ibrobot feetech find-port --list` lists them")
    return found.serial_number
