"""Options of `type: imu` under `teleoperation`; nothing here imports NumPy or pyserial."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.api import OptionFault, Options, did_you_mean, documented, not_empty, option

if TYPE_CHECKING:
    from ibrobot_core.api import Robot

BAUD_RATES = {"bno08x": 115_200, "witmotion": 9_600}
"""Model -> its baud rate as it comes from the factory."""
TOOL_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
TILTS = ("roll", "pitch", "yaw")
NONE = "none"
_DEFAULT_TOOL = {"x": "pitch", "y": "-roll", "z": "yaw"}


def _check_tool(instance: Any, attribute: attrs.Attribute[Any], value: Mapping[str, str]) -> None:
    for axis, tilt in value.items():
        if axis not in TOOL_AXES:
            raise ValueError(f"unknown axis of the tool {axis!r}{did_you_mean(axis, TOOL_AXES, 'they are')}")
        plain = tilt.removeprefix("-")
        if plain not in (*TILTS, NONE):
            raise ValueError(f"{axis}: unknown tilt {tilt!r}{did_you_mean(plain, (*TILTS, NONE), 'they are')}")


@documented
@attrs.frozen
class ImuOptions(Options):
    """Options of `type: imu`; the joints' own limits bound every speed."""

    port: str = option(
        validator=not_empty, help="serial port, e.g. /dev/ttyUSB0; a path under /dev/serial/by-id does not change"
    )
    model: str = option(
        choices=tuple(BAUD_RATES), help="bno08x: in UART-RVC mode; witmotion: any that sends angles (0x55 0x53)"
    )
    baud_rate: int | None = option(
        None, unit="baud", gt=0, help="baud rate; None: that of a new device, 115200 or 9600 (witmotion)"
    )
    tool: Mapping[str, str] = option(
        factory=dict,
        validator=_check_tool,
        help="axis of the tool (x, y, z, roll, pitch, yaw) -> tilt that moves it (roll, pitch, yaw; `-` reverses it; "
        "none), where not the default",
    )
    speed: float = option(0.1, unit="m/s", gt=0, help="speed of the tool at full tilt")
    turn_speed: float = option(0.8, unit="rad/s", gt=0, help="speed of turning the tool at full tilt")
    dead_zone: float = option(0.1, unit="rad", ge=0, help="tilt below which the tool rests")
    full_tilt: float = option(0.6, unit="rad", gt=0, le=1.5, help="tilt at which the tool has its full speed")
    deadman: str = option(
        "key",
        choices=("key", "cts", "dsr"),
        help="key: moves while a key is held; cts, dsr: while a button from that line of the port to ground is held",
    )
    deadman_key: str = option("space", help="key of the deadman")
    release: float = option(
        0.2, unit="s", gt=0, le=1, help="deadman key: a key that is not repeated for this long counts as released"
    )
    timeout: float = option(
        0.1, unit="s", gt=0, le=1, help="time without a valid message after which the robot holds until the next press"
    )
    follow: float = option(
        0.1, unit="rad", gt=0, help="how far a joint at rest may be from its setpoint before the setpoint follows"
    )
    gripper: str = option("gripper", help="group of joints that do not belong to the arm")

    def __attrs_post_init__(self) -> None:
        if not self.dead_zone < self.full_tilt:
            raise ValueError(f"dead_zone is {self.dead_zone:g}, must be below full_tilt, which is {self.full_tilt:g}")
        if not self.axes:
            raise ValueError("tool: every axis is none, so nothing could move; give at least one a tilt")

    @property
    def axes(self) -> Mapping[str, str]:
        """Axis of the tool -> tilt, for those that have one."""
        chosen = {**_DEFAULT_TOOL, **self.tool}
        return {axis: tilt for axis, tilt in chosen.items() if tilt.removeprefix("-") != NONE}

    @property
    def rate(self) -> int:
        """The baud rate."""
        return self.baud_rate if self.baud_rate is not None else BAUD_RATES[self.model]

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterator[OptionFault]:
        """Check that the robot has one tool to move."""
        groups = tuple(robot.groups)
        if self.gripper != "gripper" and self.gripper not in groups:
            message = f"unknown group {self.gripper!r}{did_you_mean(self.gripper, groups, 'known')}"
            yield OptionFault(("gripper",), message)
        if robot.description.mjcf is None:
            yield OptionFault((), "tilting moves a tool, which needs robot.description.mjcf: set it", "mjcf")
        arms = {robot.description.arm_of(name) for name in robot.joint_names}
        if len(arms) > 1:
            message = "the robot has several arms: give the device one in the mode, e.g. teleop: {left: DEVICE}"
            yield OptionFault((), message)

    def devices(self) -> Mapping[str, str]:
        """The resolved path of the port."""
        return {"port": os.path.realpath(self.port)}

    def terminal_keys(self, robot: Robot) -> Mapping[str, str]:
        """The keys of the terminal that it reads."""
        return {self.deadman_key: "deadman"} if self.deadman == "key" else {}
