"""Options of `type: gamepad` and `type: spacemouse` under `teleoperation`."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.api import Late, OptionFault, Options, did_you_mean, documented, option
from ibrobot_gamepad.controls import MOUSE_AXES, MOUSE_BUTTONS, PAD_AXES, PAD_BUTTONS

if TYPE_CHECKING:
    from ibrobot_core.api import OperatorEvent, Robot

NONE = "none"
"""Value in a mapping of a function without control."""
TOOL_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
FUNCTIONS = (
    "deadman", "toggle", "gripper_open", "gripper_close", "gripper", "estop",
    "start", "success", "failure", "discard", "intervention",
)  # fmt: skip
"""The functions in `buttons`; `gripper` opens and closes alternately."""
_DEVICE = re.compile(r"[0-9a-fA-F]{4}:[0-9a-fA-F]{4}(:.+)?")


def _check_device(instance: Any, attribute: attrs.Attribute[Any], value: str) -> None:
    if value and not _DEVICE.fullmatch(value):
        raise ValueError(
            f"{value!r} is not VENDOR:PRODUCT or VENDOR:PRODUCT:SERIAL in hexadecimal, e.g. 054c:0ce6; "
            "`ibrobot gamepad list` prints them"
        )


@attrs.frozen
class Layout:
    """The controls of a device."""

    axes: tuple[str, ...]
    buttons: tuple[str, ...]
    numbered_axes: str = "(?!)"
    """Pattern of the numbers that axes may have in place of names; by default they have none."""
    numbered_buttons: str = "(?!)"

    def check_axis(self, name: str) -> str | None:
        """The error in the name of an axis, which may begin with `-`; None if it is valid."""
        plain = name.removeprefix("-")
        if plain in (NONE, *self.axes) or re.fullmatch(self.numbered_axes, plain):
            return None
        return f"unknown axis {name!r}{did_you_mean(plain, self.axes, 'the axes are')}"

    def check_button(self, name: str) -> str | None:
        """The error in the name of a button; None if it is valid. An axis works as a button, too."""
        known = (*self.buttons, *self.axes)
        if name in (NONE, *known) or re.fullmatch(f"{self.numbered_buttons}|{self.numbered_axes}", name):
            return None
        return f"unknown button {name!r}{did_you_mean(name, known, 'the buttons are')}"


PAD = Layout(PAD_AXES, PAD_BUTTONS, r"axis\d{1,2}|hat\d_[xy]", r"button\d{1,2}")
MOUSE = Layout(MOUSE_AXES, MOUSE_BUTTONS)


def _controls(
    fault: Callable[[str], str | None], help: str, names: tuple[str, ...] = (), kind: str = "", are: str = ""
) -> Any:
    """An option that maps names to controls.

    Args:
        fault: returns the error in the name of a control; None if it is valid.
        help: what it maps.
        names: the known names; empty: `check_mapping` checks them.
        kind: of the names, for errors.
        are: begins the list of known names in errors.
    """

    def check(instance: Any, attribute: attrs.Attribute[Any], value: Mapping[str, str]) -> None:
        for name, control in value.items():
            if names and name not in names:
                raise ValueError(f"unknown {kind} {name!r}{did_you_mean(name, names, are)}")
            if (why := fault(control)) is not None:
                raise ValueError(f"{name}: {why}")
        if names is FUNCTIONS and value.get("deadman") == NONE:
            raise ValueError("deadman: must have a button: the robot moves only while it is held")

    return option(factory=dict, help=help, validator=check)


def _joints(layout: Layout) -> Any:
    return _controls(layout.check_axis, "joint -> axis (`-` reverses it, `none`), where not the default")


def _tool(layout: Layout) -> Any:
    help = f"{', '.join(TOOL_AXES)} -> axis (`-` reverses it, `none`), where not the default"
    return _controls(layout.check_axis, help, TOOL_AXES, "axis of the tool", "they are")


def _buttons(layout: Layout) -> Any:
    help = f"function -> button or `none`, where not the default; functions: {', '.join(FUNCTIONS)}"
    return _controls(layout.check_button, help, FUNCTIONS, "function", "the functions are")


def _poses(layout: Layout) -> Any:
    return _controls(layout.check_button, "pose -> button that drives there while held, or `none`")


_CHECK, _EVENTS = Late("ibrobot_gamepad.mapping:check_mapping"), Late("ibrobot_gamepad.mapping:events")


@documented
@attrs.frozen
class JogOptions(Options):
    """Options that gamepads and SpaceMice share."""

    device: str = option("", help="VENDOR:PRODUCT or VENDOR:PRODUCT:SERIAL; empty: the first", validator=_check_device)
    joint_speed: float = option(0.8, unit="rad/s", gt=0, help="speed of a joint at full deflection, and to poses")
    tool_speed: float = option(0.1, unit="m/s", gt=0, help="speed of the tool at full deflection")
    turn_speed: float = option(0.8, unit="rad/s", gt=0, help="speed of turning the tool at full deflection")
    gripper_speed: float = option(1.5, unit="rad/s", gt=0, help="speed of the gripper with its trigger pulled")
    dead_zone: float = option(0.1, ge=0, lt=0.9, help="deflection below which an axis counts as at rest")
    follow: float = option(
        0.1, unit="rad", ge=0, help="how far a joint at rest may be from its setpoint before the setpoint follows"
    )
    long_press: float = option(0.5, unit="s", gt=0, le=5, help="how long the toggle button is held")
    cartesian: bool = option(True, help="whether the tool can be jogged; it needs robot.description.mjcf")
    gripper: str = option("gripper", help="group of joints that the gripper controls move")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check that the controls fit the robot."""
        yield from _CHECK(self, robot)

    def events(self) -> Collection[OperatorEvent]:
        """The events that have a button."""
        events: Collection[OperatorEvent] = _EVENTS(self)
        return events


@documented
@attrs.frozen
class GamepadOptions(JogOptions):
    """Options of `type: gamepad`; the joints' own limits bound every speed."""

    start: str = option("joints", choices=("joints", "tool"), help="what the sticks move initially")
    via: str = option(
        "auto",
        choices=("auto", "hid", "sdl"),
        help="how to read the pad: its own reports (hid), SDL's mapping database (sdl), or the first that knows it",
    )
    trust_link: bool = option(
        False,
        help="whether a pad that reports only changes (Xbox, and all by SDL) may be silent while it moves the robot; a "
        "lost radio link or a frozen pad then ends the motion only when the system notices, which can take seconds",
    )
    joints: Mapping[str, str] = _joints(PAD)
    tool: Mapping[str, str] = _tool(PAD)
    buttons: Mapping[str, str] = _buttons(PAD)
    poses: Mapping[str, str] = _poses(PAD)


@documented
@attrs.frozen
class SpaceMouseOptions(JogOptions):
    """Options of `type: spacemouse`; the joints' own limits bound every speed."""

    start: str = option("tool", choices=("joints", "tool"), help="what the cap moves initially")
    joints: Mapping[str, str] = _joints(MOUSE)
    tool: Mapping[str, str] = _tool(MOUSE)
    buttons: Mapping[str, str] = _buttons(MOUSE)
    poses: Mapping[str, str] = _poses(MOUSE)
