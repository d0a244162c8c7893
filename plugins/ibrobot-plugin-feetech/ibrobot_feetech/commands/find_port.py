"""`ibrobot feetech find-port`: finds the port of an arm."""

from __future__ import annotations

import click

from ibrobot_core.api import HardwareError, echo
from ibrobot_feetech.commands.dialogue import wait_for_enter
from ibrobot_feetech.usb import UsbPort, usb_ports


@click.command()
@click.option("--list", "only_list", is_flag=True, help="Only list the ports.")
def find_port(only_list: bool) -> None:
    """Find the port of an arm by unplugging its USB cable and plugging it in again."""
    before = usb_ports()
    for port in before:
        _show(port)
    if not before:
        echo("There is no USB serial port.")
    if only_list:
        return
    wait_for_enter("Unplug the arm's USB cable, if it is plugged in.", flag="--list")
    without = {port.path for port in usb_ports()}
    gone = [port for port in before if port.path not in without]
    if len(gone) > 1:
        raise HardwareError(f"several ports are gone: {', '.join(p.path for p in gone)}; unplug one cable at a time")
    wait_for_enter("Plug it in (again).", flag="--list")
    # The number in the path may have changed.
    new = [port for port in usb_ports() if port.path not in without]
    if not new:
        raise HardwareError("no port appeared; check the cable (some only charge) and the arm's board")
    if len(new) > 1:
        raise HardwareError(f"several ports appeared: {', '.join(p.path for p in new)}; plug in one arm at a time")
    echo("\nThe arm is at:")
    _show(new[0])


def _show(port: UsbPort) -> None:
    arm = " (an SO-101's adapter)" if port.is_arm else ""
    number = f", serial number {port.serial_number}" if port.serial_number else ""
    echo(f"{port.path}  {port.description}, USB {port.usb_id}{number}{arm}")
    if port.stable:
        echo(f"    better for a YAML, because it does not change: {port.stable}")
    if not port.permitted:
        echo("    no permission: sudo usermod -aG dialout $USER, then log in again")
