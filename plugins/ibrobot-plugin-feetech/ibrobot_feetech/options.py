"""Options of Feetech arms."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import attrs
from ibrobot_terminal.hand_moved_options import HandMovedOptions

from ibrobot_core.api import HardwareError, OptionFault, Options, did_you_mean, documented, not_empty, option

if TYPE_CHECKING:
    from ibrobot_core.api import Robot

TOOL = "ibrobot feetech"
"""The command that calibrates and imports calibrations."""
_GRIPPER = ("gripper",)
"""Default of options that name joints; ignored if another component has the gripper."""


@documented
@attrs.frozen
class FollowerOptions(Options):
    """Options of `type: feetech_so101`: an arm whose joints are STS3215 servos on one bus."""

    port: str = option(
        validator=not_empty,
        help="serial port, e.g. /dev/ttyACM0, which may change; a path under /dev/serial/by-id does not, nor does "
        "serial:NUMBER, the USB serial number of its adapter",
    )
    calibration: str = option(help="name or path of a calibration, which ibrobot feetech calibrate creates")
    baud_rate: int = option(1_000_000, unit="baud", gt=0, help="baud rate of the bus")
    anchored: tuple[str, ...] = option(
        _GRIPPER, help="joints whose calibrated closed end is at their lower limit; others have 0 rad in the middle"
    )
    lost_replies: int = option(3, unit="ticks", ge=0, help="consecutive replies of a servo that may be missing")
    retries: int = option(2, ge=0, help="retries of requests outside the control loop")
    p_coefficient: int = option(
        16, ge=0, le=254, help="P gain of the servos' position control; a lower value reduces shaking"
    )
    i_coefficient: int = option(0, ge=0, le=254, help="I gain of the servos' position control")
    d_coefficient: int = option(32, ge=0, le=254, help="D gain of the servos' position control")
    acceleration: int = option(254, unit="100 ticks/s^2", ge=0, le=254, help="acceleration limit in the servos")
    gentle: tuple[str, ...] = option(
        _GRIPPER, help="joints that grip: half the torque and current, a quarter of the torque in overload"
    )
    health_period: float = option(
        1.0, unit="s", gt=0, help="how often torque, voltage, temperature and current are read"
    )
    warning_temperature: float = option(55.0, unit="deg C", gt=0, le=80, help="a servo above it causes a warning")
    max_temperature: float = option(65.0, unit="deg C", gt=0, le=80, help="a servo above it causes a fault")
    warning_voltage_drop: float = option(
        0.15, gt=0, lt=1, help="fraction of the initial voltage by which it may drop before a warning"
    )
    max_voltage_drop: float = option(
        0.3,
        gt=0,
        lt=1,
        help="fraction of the initial voltage by which it may drop before a fault; the servos' own limits apply too",
    )
    warning_load: float = option(
        0.7,
        unit="of full torque",
        gt=0,
        le=1,
        help="load for a whole health_period that causes a warning; not for gentle joints",
    )
    max_load: float = option(
        0.95,
        unit="of full torque",
        gt=0,
        le=1,
        help="load for a whole health_period that causes a fault; not for gentle joints",
    )
    stall_torque: float | None = option(
        None, unit="Nm", gt=0, help="scales the servos' load to an estimate of effort; without it effort is missing"
    )
    write_calibration: bool = option(False, help="at the start, write the calibration to servos that differ")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterator[OptionFault]:
        """Check that the joints in the self exist; they may belong to another component of the robot."""
        for key, names in (("anchored", self.anchored), ("gentle", self.gentle)):
            if names != _GRIPPER:
                yield from _unknown(key, names, robot.joint_names, "joint")

    @property
    def calibrated_by(self) -> str:
        """The command that calibrates and imports calibrations."""
        return TOOL

    def devices(self) -> Mapping[str, str]:
        """The port."""
        return _resolved(self.port)


@documented
@attrs.frozen
class LeaderOptions(HandMovedOptions):
    """Options of `type: so101_leader`: an arm with STS3215 servos that is moved by hand."""

    port: str = option(
        validator=not_empty,
        help="serial port, e.g. /dev/ttyACM1, which may change; a path under /dev/serial/by-id does not, nor does "
        "serial:NUMBER, the USB serial number of its adapter",
    )
    calibration: str = option(help="name or path of a calibration, which ibrobot feetech calibrate creates")
    baud_rate: int = option(1_000_000, unit="baud", gt=0, help="baud rate of the bus")
    joints: Mapping[str, str] = option(
        factory=dict, help="joint of the leader -> joint of the robot; by default, joints with equal names"
    )
    prefix: str = option(
        "", help="in place of joints: prefix of the robot's joints that those of the leader lack, e.g. left_"
    )
    inverted: tuple[str, ...] = option((), help="joints of the leader whose direction is reversed")
    scaled: tuple[str, ...] = option(
        _GRIPPER, help="joints of the leader whose calibrated range maps to the robot's limits; others map by angle"
    )
    driven: bool = option(
        True,
        help="whether its motors move it to the robot's pose when an operator takes the robot from a policy, at "
        "ramp_velocity; otherwise the robot approaches the leader",
    )
    lost_replies: int = option(3, unit="reads", ge=0, help="consecutive replies of a servo that may be missing")
    retries: int = option(2, ge=0, help="retries of requests when the mode begins")

    def __attrs_post_init__(self) -> None:
        if self.prefix and self.joints:
            raise ValueError("joints and prefix exclude each other; give one of them")

    def pairs(self, robot: Robot) -> Mapping[str, str]:
        """Joint of the leader -> joint of the robot."""
        return self.joints or {joint.removeprefix(self.prefix): joint for joint in robot.joint_names}

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterator[OptionFault]:
        """Check that the leader's joints map to joints of the robot, and that the self name joints of the leader."""
        for ours, theirs in self.joints.items():
            if theirs not in robot.joint_names:
                yield OptionFault(
                    ("joints", ours), f"unknown joint {theirs!r}{did_you_mean(theirs, robot.joint_names, 'known')}"
                )
        if strange := [joint for joint in robot.joint_names if not joint.startswith(self.prefix)]:
            yield OptionFault(
                ("prefix",),
                f"joint {strange[0]!r} does not begin with {self.prefix!r}; give the device its arm in the mode, "
                "e.g. teleop: {left: DEVICE}, where left is a joint group",
            )
        known = tuple(self.pairs(robot))
        for key, names in (("inverted", self.inverted), ("scaled", self.scaled)):
            if names != _GRIPPER:
                yield from _unknown(key, names, known, "joint of the leader")

    @property
    def calibrated_by(self) -> str:
        """The command that calibrates and imports calibrations."""
        return TOOL

    def devices(self) -> Mapping[str, str]:
        """The port."""
        return _resolved(self.port)


@documented
@attrs.frozen
class EmulatedSignalOptions(Options):
    """Options of `type: feetech_emulator`: a signal of the simulation that moves an emulated arm."""

    socket: str = option(help="socket that `ibrobot feetech emulate --physics` prints")
    signal: str = option(help="topic of the signal, e.g. /simulation/scene")


def _unknown(option: str, names: Sequence[str], known: Sequence[str], what: str) -> Iterator[OptionFault]:
    """A fault for each name that is not among the known ones."""
    for i, name in enumerate(names):
        if name not in known:
            yield OptionFault((option, i), f"unknown {what} {name!r}{did_you_mean(name, known, 'known')}")


def _resolved(port: str) -> Mapping[str, str]:
    """The resolved path of the port."""
    from ibrobot_feetech.usb import find_port

    try:
        return {"port": os.path.realpath(find_port(port))}
    except HardwareError:  # it is not plugged in
        return {"port": port}
