"""`ibrobot feetech …`: sets up, calibrates and inspects the servos of an arm; one file per command."""

from __future__ import annotations

import click

from ibrobot_feetech.commands.calibrate import calibrate
from ibrobot_feetech.commands.check import check
from ibrobot_feetech.commands.emulate import emulate
from ibrobot_feetech.commands.find_port import find_port
from ibrobot_feetech.commands.import_ import import_calibration
from ibrobot_feetech.commands.monitor import monitor
from ibrobot_feetech.commands.scan import scan
from ibrobot_feetech.commands.setup_motors import setup_motors
from ibrobot_feetech.commands.torque import torque


@click.group()
def feetech() -> None:
    """Set up, calibrate and inspect the servos of an SO-101.

    PORT may be omitted if exactly one SO-101 adapter is plugged in.
    """


for command in (find_port, scan, setup_motors, calibrate, import_calibration, check, monitor, torque, emulate):
    feetech.add_command(command)
