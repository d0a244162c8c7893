"""Options of LeRobot's devices."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import attrs
from ibrobot_terminal.hand_moved_options import HandMovedOptions

from ibrobot_core.api import OptionFault, Options, did_you_mean, documented, not_empty, option
from ibrobot_lerobot_devices.units import UNITS, Choices

if TYPE_CHECKING:
    from ibrobot_core.api import Robot

GRIPPER = ("gripper",)
"""Default of `anchored`; ignored if another component has the gripper."""
_CONFIG = "LeRobot's config of it, e.g. {port: /dev/ttyACM0, id: my_arm}; `ibrobot lerobot list TYPE` has its keys"
_TORCH = option(
    False, help="whether its process loads torch; most devices only import it, and 5 s and 500 MB are saved without"
)


def _unit_names(instance: object, attribute: attrs.Attribute[Any], value: Mapping[str, str]) -> None:
    for name, unit in value.items():
        if unit not in UNITS:
            raise ValueError(f"{name}: {unit!r} is not one of: {', '.join(UNITS)}")


def _is_topic(instance: object, attribute: attrs.Attribute[Any], value: str) -> None:
    if not value.startswith("/") or value.endswith("/") or " " in value:
        raise ValueError(f"{value!r} is not a topic: a topic begins with /, e.g. {attribute.default}")


_NAMES = option(factory=dict, help="LeRobot's name of a joint -> joint of the robot, where they differ")
_UNITS = option(
    factory=dict,
    validator=_unit_names,
    help=f"LeRobot's name of a joint, or '*' for all others -> its unit, where LeRobot does not say it: "
    f"{', '.join(UNITS)}",
)
_ZERO_AT = option(
    "pose",
    choices=("pose", "range"),
    help="position of 0 rad of joints with a calibration: the middle of the encoder, which is the pose set by hand at "
    "calibration, or the middle of the calibrated range",
)
_INVERTED = option((), help="joints whose direction is reversed")
_START = option(40.0, unit="s", gt=0, help="how long LeRobot may take to start and to connect")
_LOST = option(3, ge=0, help="consecutive readings that LeRobot may fail to give")


def _port(config: Mapping[str, Any]) -> Mapping[str, str]:
    port = config.get("port")
    return {"port": os.path.realpath(port)} if isinstance(port, str) else {}


@documented
@attrs.frozen
class RobotOptions(Options):
    """Options of hardware `type: lerobot`: a robot of LeRobot's, in a process of its own."""

    robot: str = option(validator=not_empty, help="LeRobot's type of the robot, e.g. koch_follower")
    config: Mapping[str, Any] = option(factory=dict, help=_CONFIG)
    names: Mapping[str, str] = _NAMES
    units: Mapping[str, str] = _UNITS
    zero_at: str = _ZERO_AT
    anchored: tuple[str, ...] = option(
        GRIPPER, help="joints whose calibrated closed end is at their lower limit, as with feetech_so101"
    )
    inverted: tuple[str, ...] = _INVERTED
    lost_readings: int = _LOST
    blocked: float = option(
        0.08,
        unit="s",
        gt=0,
        help="how long a call of LeRobot's may block before it is a fault; control.state_timeout must be longer",
    )
    start_timeout: float = _START
    torch: bool = _TORCH

    def choices(self) -> Choices:
        """What the options say about the conversion of units."""
        return Choices(self.names, self.units, self.zero_at, self.anchored, self.inverted)

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check them against LeRobot and the robot."""
        from ibrobot_lerobot_devices.registry import check_device

        yield from check_device("robot", "robot", self.robot, self.config)
        yield from _check_joints(self, robot)

    def devices(self) -> Mapping[str, str]:
        """The serial port, if the config has one."""
        return _port(self.config)


@documented
@attrs.frozen
class TeleopOptions(HandMovedOptions):
    """Options of teleop `type: lerobot`: a teleoperator of LeRobot's with joint positions, e.g. a leader arm."""

    teleop: str = option(validator=not_empty, help="LeRobot's type of the teleoperator, e.g. koch_leader")
    config: Mapping[str, Any] = option(factory=dict, help=_CONFIG)
    names: Mapping[str, str] = _NAMES
    units: Mapping[str, str] = _UNITS
    zero_at: str = _ZERO_AT
    inverted: tuple[str, ...] = _INVERTED
    scaled: tuple[str, ...] = option(
        GRIPPER,
        help="joints whose values from 0 to 100, or from -100 to 100, map to the robot's limits; others map by angle",
    )
    lost_readings: int = _LOST
    blocked: float = option(0.2, unit="s", gt=0, help="how long a call of LeRobot's may block before it is a fault")
    start_timeout: float = _START
    torch: bool = _TORCH

    def choices(self) -> Choices:
        """What the options say about the conversion of units."""
        return Choices(self.names, self.units, self.zero_at, (), self.inverted, self.scaled)

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check them against LeRobot and the robot."""
        from ibrobot_lerobot_devices.registry import check_device

        yield from check_device("teleoperator", "teleop", self.teleop, self.config)
        yield from _check_joints(self, robot)

    def devices(self) -> Mapping[str, str]:
        """The serial port, if the config has one."""
        return _port(self.config)


@documented
@attrs.frozen
class CmdVelOptions(Options):
    """Options of teleop `type: cmd_vel`: a topic of twists that drives a base, whose axes are joints of the robot."""

    topic: str = option("/cmd_vel", validator=_is_topic, help="topic of geometry_msgs/msg/Twist or TwistStamped")
    frame: str = option("base_link", help="frame of twists with a header, if that names one")
    x: str = option("x", help="joint for linear.x, ahead; a base may lack one of the three")
    y: str = option("y", help="joint for linear.y, to the left")
    theta: str = option("theta", help="joint for angular.z, counterclockwise")


@documented
@attrs.frozen
class CameraOptions(Options):
    """Options of a peripheral `type: lerobot` of kind camera: a camera of LeRobot's."""

    camera: str = option(validator=not_empty, help="LeRobot's type of the camera, e.g. zmq")
    config: Mapping[str, Any] = option(factory=dict, help=_CONFIG)
    encoding: str = option("jpeg", choices=("jpeg", "raw"), help="of messages; depth is always raw")
    jpeg_quality: int = option(90, ge=1, le=100, help="JPEG quality")
    lost_after: float = option(5.0, unit="s", gt=0, help="how long LeRobot may report errors before the camera is lost")
    frame_id: str = option("", help="frame id of the messages; NAME_optical_frame if empty")
    start_timeout: float = _START
    torch: bool = _TORCH

    @property
    def picture(self) -> tuple[int, int] | None:
        """Height and width of the pictures [px], if the config has them."""
        height, width = self.config.get("height"), self.config.get("width")
        return (height, width) if isinstance(height, int) and isinstance(width, int) else None

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check them against LeRobot."""
        from ibrobot_lerobot_devices.registry import check_device

        return check_device("camera", "camera", self.camera, self.config)


def _check_joints(options: RobotOptions | TeleopOptions, robot: Robot) -> Iterator[OptionFault]:
    """Check that the options name joints of the robot."""
    known = robot.joint_names
    for theirs, ours in options.names.items():
        if ours not in known:
            yield OptionFault(("names", theirs), f"unknown joint {ours!r}{did_you_mean(ours, known, 'known')}")
    kinds = ("anchored", "scaled", "inverted")
    for key, names in attrs.asdict(options, filter=lambda field, value: field.name in kinds).items():
        for i, name in enumerate(names):
            if name not in known and names != GRIPPER:
                yield OptionFault((key, i), f"unknown joint {name!r}{did_you_mean(name, known, 'known')}")
