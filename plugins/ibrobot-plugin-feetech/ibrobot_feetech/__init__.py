"""The plugin's hooks: hardware `feetech_so101`, teleop `so101_leader`, `ibrobot feetech …`, guides, serial ports."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ibrobot_terminal import GuideDescriptor, PanelDescriptor

from ibrobot_core.api import Check, Descriptor, HardwareDescriptor, Late, SensorDescriptor, TeleopDescriptor, hookimpl
from ibrobot_core.app import Command
from ibrobot_feetech.options import EmulatedSignalOptions, FollowerOptions, LeaderOptions


@hookimpl(optionalhook=True)
def ibrobot_panels() -> Iterable[PanelDescriptor]:
    """State of the servos."""
    yield PanelDescriptor(
        "servos",
        label="Servos",
        summary="state of each servo",
        columns=("servo", "temperature", "voltage", "current", "load"),
        make=Late("ibrobot_feetech.panel:servo_rows"),
    )


@hookimpl(optionalhook=True)
def ibrobot_guides() -> Iterable[GuideDescriptor]:
    """Ports, motors and calibration."""
    yield GuideDescriptor(
        "ports",
        order=10,
        label="Serial ports",
        summary="List the USB serial ports, and which are adapters of an SO-101.",
        make=Late("ibrobot_feetech.guides:list_all"),
    )
    yield GuideDescriptor(
        "port",
        order=20,
        label="Find an arm's port",
        summary="Unplug the arm and plug it in again to find its port.",
        make=Late("ibrobot_feetech.guides:find"),
    )
    yield GuideDescriptor(
        "motors",
        order=30,
        label="Set up motors",
        summary="Give each servo its id and 1 Mbaud, with one servo connected at a time.",
        make=Late("ibrobot_feetech.guides:set_up"),
        questions=Late("ibrobot_feetech.guides:setup_questions"),
    )
    yield GuideDescriptor(
        "calibration",
        order=40,
        label="Calibrate an arm",
        summary="Measure the middle pose and the range of each joint, moved by hand.",
        make=Late("ibrobot_feetech.guides:calibrate"),
        questions=Late("ibrobot_feetech.guides:calibration_questions"),
    )
    yield GuideDescriptor(
        "servos",
        order=50,
        label="Check an arm",
        summary="Compare the servos with their calibration.",
        make=Late("ibrobot_feetech.guides:check"),
        questions=Late("ibrobot_feetech.guides:check_questions"),
    )
    yield GuideDescriptor(
        "leader",
        order=55,
        label="Compare leader and follower",
        summary="Set three poses by hand, and compare the zeros and directions of both arms.",
        make=Late("ibrobot_feetech.guides:compare"),
        questions=Late("ibrobot_feetech.guides:compare_questions"),
    )


@hookimpl
def ibrobot_hardware() -> Iterable[HardwareDescriptor]:
    """The SO-101 on its servo bus."""
    yield HardwareDescriptor(
        type="feetech_so101",
        options=FollowerOptions,
        make=Late("ibrobot_feetech.follower:FeetechFollower"),
        torque_off="ibrobot feetech torque off",
        summary="SO-101 arm: STS3215 servos on one bus",
    )


@hookimpl
def ibrobot_sensors() -> Iterable[SensorDescriptor]:
    """Signals of the simulation that moves an emulated arm."""
    yield SensorDescriptor(
        type="feetech_emulator",
        kind="simulation",
        options=EmulatedSignalOptions,
        make=Late("ibrobot_feetech.emulator.signals:EmulatedSignal"),
        summary="a signal of the simulation that moves an emulated arm",
    )


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """The SO-101 leader arm."""
    yield TeleopDescriptor(
        type="so101_leader",
        options=LeaderOptions,
        make=Late("ibrobot_feetech.leader:LeaderTeleop"),
        summary="SO-101 leader arm, moved by hand",
        label="follow the leader arm",
    )


@hookimpl(optionalhook=True)
def ibrobot_device_poses() -> Iterable[Descriptor[Any]]:
    """Where a leader stands, without a run."""
    read = Late("ibrobot_feetech.leader:read_pose")
    yield Descriptor("so101_leader", read, "where an SO-101 leader stands", options=LeaderOptions)


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot feetech …`."""
    yield Command(
        "feetech",
        summary="Set up, calibrate, monitor and emulate the servos of an SO-101.",
        about="PORT may be omitted if exactly one SO-101 adapter is plugged in.",
    )
    yield Command("feetech find-port", Late("ibrobot_feetech.commands.find_port:FindPort"))
    yield Command("feetech scan", Late("ibrobot_feetech.commands.scan:Scan"))
    yield Command("feetech setup-motors", Late("ibrobot_feetech.commands.setup_motors:SetUpMotors"))
    yield Command("feetech calibrate", Late("ibrobot_feetech.commands.calibrate:Calibrate"))
    yield Command("feetech import", Late("ibrobot_feetech.commands.import_:ImportCalibration"))
    yield Command("feetech check", Late("ibrobot_feetech.commands.check:CheckArm"))
    yield Command("feetech compare", Late("ibrobot_feetech.commands.compare:CompareArms"))
    yield Command("feetech monitor", Late("ibrobot_feetech.commands.monitor:Monitor"))
    yield Command("feetech torque", Late("ibrobot_feetech.commands.torque:Torque"))
    yield Command("feetech emulate", Late("ibrobot_feetech.commands.emulate:Emulate"))


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """Check which serial ports the user may open."""
    from ibrobot_feetech.usb import usb_ports

    ports = usb_ports()
    if not ports:
        yield Check("serial ports", True, "none; connect the arm if you expected one")
    remedy = "sudo usermod -aG dialout $USER, then log in again"
    for port in ports:
        access = "readable and writable" if port.permitted else "no permission"
        yield Check(f"serial port {port.path}", port.permitted, access, remedy)
