"""What the YAML may say of a Feetech arm."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import attrs

from ibrobot_core.api import OptionFault, did_you_mean, documented, option, unknown_names

if TYPE_CHECKING:
    from ibrobot_core.api import Robot

TOOL = "ibrobot feetech"
"""The command that calibrates and imports calibrations."""
_GRIPPER = ("gripper",)
"""The default of options that name joints; it is passed over where another component has the gripper."""


@documented
@attrs.frozen
class FollowerOptions:
    """Options of `type: feetech_so101`: an arm whose joints are STS3215 servos on one bus."""

    port: str = option(help="serial port, e.g. /dev/ttyACM0; a path under /dev/serial/by-id stays the same")
    calibration: str = option(help="name of a calibration, or a path to one; ibrobot feetech calibrate makes it")
    baud_rate: int = option(1_000_000, unit="baud", gt=0, help="of the bus")
    anchored: tuple[str, ...] = option(
        _GRIPPER, help="joints whose calibrated closed end is their lower limit; others have 0 rad in the middle"
    )
    lost_replies: int = option(3, unit="ticks", ge=0, help="replies of one servo in a row that may be missing")
    retries: int = option(2, ge=0, help="how often a request outside of the loop is sent again")
    p_coefficient: int = option(16, ge=0, le=254, help="of the servos' position control; lower shakes less")
    i_coefficient: int = option(0, ge=0, le=254, help="of the servos' position control")
    d_coefficient: int = option(32, ge=0, le=254, help="of the servos' position control")
    acceleration: int = option(254, unit="100 ticks/s^2", ge=0, le=254, help="limit of the servos' own")
    gentle: tuple[str, ...] = option(
        _GRIPPER, help="joints that hold things: half the torque and current, a quarter of the torque in overload"
    )
    health_period: float = option(
        1.0, unit="s", gt=0, help="how often torque, voltage, temperature and current are read"
    )
    warning_temperature: float = option(55.0, unit="deg C", gt=0, le=80, help="of a servo; above it is a warning")
    max_temperature: float = option(65.0, unit="deg C", gt=0, le=80, help="of a servo; above it is a fault")
    warning_voltage_drop: float = option(
        0.15, gt=0, lt=1, help="part of the voltage at the start by which it may fall; more is a warning"
    )
    max_voltage_drop: float = option(
        0.3,
        gt=0,
        lt=1,
        help="part of the voltage at the start by which it may fall; more is a fault, as are the servos' own limits",
    )
    warning_load: float = option(
        0.7, unit="of full torque", gt=0, le=1, help="of a joint, not gentle, for a whole health_period: a warning"
    )
    max_load: float = option(
        0.95, unit="of full torque", gt=0, le=1, help="of a joint, not gentle, for a whole health_period: a fault"
    )
    stall_torque: float | None = option(
        None, unit="Nm", gt=0, help="turns the servos' load into an estimate of effort; without it there is none"
    )
    write_calibration: bool = option(False, help="write the calibration to servos that have another, at the start")


@documented
@attrs.frozen
class LeaderOptions:
    """Options of `type: so101_leader`: an arm of STS3215 servos that a person moves."""

    port: str = option(help="serial port, e.g. /dev/ttyACM1; a path under /dev/serial/by-id stays the same")
    calibration: str = option(help="name of a calibration, or a path to one; ibrobot feetech calibrate makes it")
    baud_rate: int = option(1_000_000, unit="baud", gt=0, help="of the bus")
    joints: Mapping[str, str] = option(
        factory=dict, help="joint of the leader -> joint of the robot; all of the same names where nothing is said"
    )
    inverted: tuple[str, ...] = option((), help="joints of the leader that turn the robot's the other way")
    scaled: tuple[str, ...] = option(
        _GRIPPER, help="joints of the leader whose calibrated range becomes the robot's limits; others map by angle"
    )
    ramp_velocity: float = option(
        1.0, unit="rad/s", gt=0, help="at which the robot approaches the leader's pose at first and after each pause"
    )
    follow_tolerance: float = option(
        0.02, unit="rad", gt=0, help="distance from the leader's pose at which the approach ends"
    )
    deadman: str = option(
        "toggle",
        choices=("toggle", "hold", "none"),
        help="toggle: space follows and pauses; hold: follows while space is held; none: follows once the leader arm "
        "is moved, for runs without a terminal",
    )
    release: float = option(
        0.2, unit="s", gt=0, le=1, help="deadman hold: without a repeat of the key for so long, it counts as released"
    )
    estop_key: str = option("esc", help="key of the emergency stop")
    lost_replies: int = option(3, unit="reads", ge=0, help="replies of one servo in a row that may be missing")


@documented
@attrs.frozen
class EmulatedSignalOptions:
    """Options of `type: feetech_emulator`: a signal of the simulation that moves an emulated arm."""

    socket: str = option(help="the socket that `ibrobot feetech emulate --physics` prints")
    signal: str = option(help="topic of the signal, e.g. /simulation/scene")


def check_follower(options: FollowerOptions, robot: Robot, joints: tuple[str, ...]) -> Iterator[OptionFault]:
    """The joints that options name exist; a component with some of the robot's joints may name the others' too."""
    for key, names in (("anchored", options.anchored), ("gentle", options.gentle)):
        if joints == robot.joint_names or names != _GRIPPER:
            yield from unknown_names(key, names, robot.joint_names, "joint")


def check_leader(options: LeaderOptions, robot: Robot, joints: tuple[str, ...]) -> Iterator[OptionFault]:
    """The leader's joints move joints of the robot, and the options name joints of the leader."""
    for ours, theirs in options.joints.items():
        if theirs not in robot.joint_names:
            yield OptionFault(
                ("joints", ours), f"unknown joint {theirs!r}{did_you_mean(theirs, robot.joint_names, 'known')}"
            )
    known = tuple(options.joints) or robot.joint_names
    for key, names in (("inverted", options.inverted), ("scaled", options.scaled)):
        if names != _GRIPPER:
            yield from unknown_names(key, names, known, "joint of the leader")


def calibration_of(options: FollowerOptions) -> str:
    """The calibration of the arm."""
    return options.calibration


def anchored_joints(options: FollowerOptions) -> tuple[str, ...]:
    """The joints whose closed end is their lower limit."""
    return options.anchored


def serial_port(options: FollowerOptions | LeaderOptions) -> Mapping[str, str]:
    """The port, by the name that all links to it lead to."""
    return {"port": os.path.realpath(options.port)}
