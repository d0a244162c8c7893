"""The plugin's hooks: hardware `feetech_so101`, teleop `so101_leader`, `ibrobot feetech …`, guides, serial ports."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import Check, HardwareDescriptor, SensorDescriptor, TeleopDescriptor, hookimpl
from ibrobot_core.app import Command, GuideDescriptor, PanelDescriptor
from ibrobot_feetech.options import (
    EmulatedSignalOptions,
    FollowerOptions,
    LeaderOptions,
    check_follower,
    check_leader,
    leader_keys,
    serial_port,
)

if TYPE_CHECKING:
    import click

    from ibrobot_core.api import Context, Hardware, Sensor, Teleop
    from ibrobot_core.app import Guide, Question, RunView


def _follower(options: Any, ctx: Context) -> Hardware:
    from ibrobot_feetech.follower import FeetechFollower

    return FeetechFollower(options, ctx)


def _signal(options: Any, ctx: Context) -> Sensor:
    from ibrobot_feetech.emulator.signals import EmulatedSignal

    return EmulatedSignal(options, ctx)


def _leader(options: Any, ctx: Context) -> Teleop:
    from ibrobot_feetech.leader import LeaderTeleop

    return LeaderTeleop(options, ctx)


def _servos(session: RunView) -> list[tuple[str, ...]]:
    from ibrobot_feetech.panel import servo_rows

    return servo_rows(session)


@hookimpl
def ibrobot_panels() -> Iterable[PanelDescriptor]:
    """State of the servos."""
    yield PanelDescriptor("Servos", ("servo", "temperature", "voltage", "current", "load"), _servos)


def _guide(name: str, title: str, summary: str, run: str, questions: str = "") -> GuideDescriptor:
    """A guide whose functions are in `ibrobot_feetech.guides`."""

    def start(answers: Mapping[str, str | bool], guide: Guide) -> None:
        getattr(import_module("ibrobot_feetech.guides"), run)(answers, guide)

    def ask() -> Sequence[Question]:
        found: Sequence[Question] = getattr(import_module("ibrobot_feetech.guides"), questions)() if questions else ()
        return found

    return GuideDescriptor(name, title, summary, start, ask)


@hookimpl
def ibrobot_guides() -> Iterable[GuideDescriptor]:
    """Ports, motors and calibration."""
    yield _guide("ports", "Serial ports", "List the USB serial ports, and which are adapters of an SO-101.", "list_all")
    yield _guide("port", "Find an arm's port", "Unplug the arm and plug it in again to find its port.", "find")
    yield _guide(
        "motors",
        "Set up motors",
        "Give each servo its id and 1 Mbaud, with one servo connected at a time.",
        "set_up",
        "setup_questions",
    )
    yield _guide(
        "calibration",
        "Calibrate an arm",
        "Measure the middle pose and the range of each joint, moved by hand.",
        "calibrate",
        "calibration_questions",
    )
    yield _guide("servos", "Check an arm", "Compare the servos with their calibration.", "check", "check_questions")


@hookimpl
def ibrobot_hardware() -> Iterable[HardwareDescriptor]:
    """The SO-101 on its servo bus."""
    yield HardwareDescriptor(
        type="feetech_so101", options=FollowerOptions, make=_follower, torque_off="ibrobot feetech torque off",
        summary="SO-101 arm: STS3215 servos on one bus", check_options=check_follower, devices=serial_port,
        calibration=lambda options: options.calibration, anchored=lambda options: options.anchored,
    )  # fmt: skip


@hookimpl
def ibrobot_sensors() -> Iterable[SensorDescriptor]:
    """Signals of the simulation that moves an emulated arm."""
    yield SensorDescriptor(
        type="feetech_emulator",
        kind="simulation",
        options=EmulatedSignalOptions,
        make=_signal,
        summary="a signal of the simulation that moves an emulated arm",
    )


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """The SO-101 leader arm."""
    yield TeleopDescriptor(
        type="so101_leader", options=LeaderOptions, make=_leader, summary="SO-101 leader arm, moved by hand",
        check_options=check_leader, devices=serial_port, calibration=lambda options: options.calibration,
        keys=leader_keys, label="follow the leader arm", needs_terminal=lambda options: options.deadman != "none",
    )  # fmt: skip


def _commands() -> click.Command:
    from ibrobot_feetech.commands import feetech

    return feetech


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot feetech …`."""
    yield Command("feetech", "Set up, calibrate, monitor and emulate the servos of an SO-101.", _commands)


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """Check which serial ports the user may open."""
    from ibrobot_feetech.usb import usb_ports

    ports = usb_ports()
    if not ports:
        yield Check("serial ports", True, "none; connect the arm if you expected one")
    remedy = "sudo usermod -aG dialout $USER, then log in again"
    for port in ports:
        found = "readable and writable" if port.permitted else "no permission"
        yield Check(f"serial port {port.path}", port.permitted, found, remedy)
