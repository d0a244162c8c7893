"""Assignment of controls to functions of a robot: the defaults, and changes in the YAML."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import get_args

import attrs

from ibrobot_core.api import OperatorEvent, OptionFault, Robot, TeleopError, did_you_mean
from ibrobot_gamepad.controls import Controls
from ibrobot_gamepad.options import NONE, GamepadOptions, SpaceMouseOptions

GRIPPER = ("gripper_open", "gripper_close", "gripper")
"""Functions that move the gripper."""


@attrs.frozen
class _Defaults:
    """The assignment where the YAML has none."""

    joints: tuple[str, ...]
    tool: Mapping[str, str]
    buttons: Mapping[str, str]
    poses: Mapping[str, str]


_PAD = _Defaults(
    ("left_x", "left_y", "right_y", "dpad_y", "right_x", "dpad_x"),
    {"x": "left_y", "y": "-left_x", "z": "right_y", "roll": "right_x", "pitch": "-dpad_y", "yaw": "dpad_x"},
    {
        "deadman": "left_shoulder", "toggle": "right_shoulder", "gripper_open": "left_trigger",
        "gripper_close": "right_trigger", "estop": "east", "start": "start", "success": "south",
        "failure": "right_stick", "discard": "back", "intervention": "left_stick",
    },
    {"home": "west", "rest": "north"},
)  # fmt: skip
_MOUSE = _Defaults(
    ("yaw", "x", "z", "pitch", "roll", "y"),
    {"x": "x", "y": "y", "z": "z", "roll": "roll", "pitch": "pitch", "yaw": "-yaw"},
    {"deadman": "left", "gripper": "right"},
    {},
)


@attrs.frozen
class Axis:
    """An axis of the device, or its reverse."""

    control: str
    sign: int

    @classmethod
    def named(cls, name: str) -> Axis:
        """The axis of a YAML, e.g. `-left_y`."""
        return cls(name.removeprefix("-"), -1 if name.startswith("-") else 1)

    def value(self, controls: Controls, dead_zone: float) -> float:
        """The deflection beyond the dead zone, -1 to 1."""
        value = controls.value(self.control)
        beyond = max(0.0, abs(value) - dead_zone) / (1.0 - dead_zone)
        return self.sign * (beyond if value > 0 else -beyond)

    def __str__(self) -> str:
        return ("-" if self.sign < 0 else "") + self.control


@attrs.frozen
class ControlMap:
    """Controls of a robot's functions; functions without a control are left out."""

    joints: Mapping[str, Axis]
    tool: Mapping[str, Axis]
    """Empty if the tool cannot be jogged."""
    buttons: Mapping[str, str]
    """Function -> button."""
    poses: Mapping[str, str]
    """Pose -> button."""

    def help(self) -> str:
        """A compact table."""
        rows = {"joints": self.joints, "tool": self.tool, "buttons": self.buttons, "poses": self.poses}
        return "\n".join(
            f"{heading:8} " + "  ".join(f"{control} {name}" for name, control in pairs.items())
            for heading, pairs in rows.items()
            if pairs
        )


EVENTS: tuple[OperatorEvent, ...] = get_args(OperatorEvent)


def events(options: GamepadOptions | SpaceMouseOptions) -> tuple[OperatorEvent, ...]:
    """The events that have a button."""
    buttons = _chosen(_defaults(options).buttons, options.buttons)
    return tuple(event for event in EVENTS if event in buttons)


def control_map(options: GamepadOptions | SpaceMouseOptions, robot: Robot) -> ControlMap:
    """The assignment that options define for a robot.

    Raises:
        TeleopError: when they do not fit the robot.
    """
    for fault in check_mapping(options, robot):
        raise TeleopError(f"{'.'.join(str(part) for part in fault.option)}: {fault.message}")
    chosen = _assigned(options, robot)
    joints, tool = ({name: Axis.named(at) for name, at in chosen[each].items()} for each in ("joints", "tool"))
    return ControlMap(joints, tool, chosen["buttons"], chosen["poses"])


def check_mapping(options: GamepadOptions | SpaceMouseOptions, robot: Robot) -> Iterator[OptionFault]:
    """Each joint has an axis, each control one meaning in each mode, and the tool a model."""
    gripper, arm = _parts(options, robot)
    if options.gripper != "gripper" and options.gripper not in robot.groups:
        message = f"unknown group {options.gripper!r}{did_you_mean(options.gripper, tuple(robot.groups), 'known')}"
        yield OptionFault(("gripper",), message)
    if options.cartesian and robot.description.mjcf is None:
        yield OptionFault(("cartesian",), "tool jog needs robot.description.mjcf: set it, or cartesian: false", "mjcf")
    if options.start == "tool" and not options.cartesian:
        yield OptionFault(("start",), "the tool cannot be jogged with cartesian: false: must be joints")
    poses = tuple(robot.description.poses)
    unknown = [
        OptionFault((option, name), f"unknown {what}{did_you_mean(name, known, has)}")
        for option, names, known, what, has in (
            ("joints", options.joints, arm, "joint", "the arm has"),
            ("poses", options.poses, poses, "pose", "the robot has"),
        )
        for name in names
        if name not in known
    ]
    yield from unknown
    for function in options.buttons:
        if function in GRIPPER and not gripper:
            yield OptionFault(("buttons", function), f"the robot has no group {options.gripper!r}")
    for joint in arm[len(_defaults(options).joints) :]:
        if joint not in options.joints:
            yield OptionFault(("joints",), f"no axis is left for {joint}: give it one, or `{joint}: {NONE}`")
    if not unknown:
        yield from _doubles(options, robot)


def _defaults(options: GamepadOptions | SpaceMouseOptions) -> _Defaults:
    return _PAD if isinstance(options, GamepadOptions) else _MOUSE


def _assigned(options: GamepadOptions | SpaceMouseOptions, robot: Robot) -> dict[str, dict[str, str]]:
    """Option -> function -> control, of the functions that the robot has."""
    gripper, arm = _parts(options, robot)
    defaults = _defaults(options)
    poses = {name: control for name, control in defaults.poses.items() if name in robot.description.poses}
    absent = {*(() if gripper else GRIPPER), *(() if options.cartesian else ("toggle",))}
    buttons = _chosen(defaults.buttons, options.buttons).items()
    return {
        "joints": _chosen(dict(zip(arm, defaults.joints, strict=False)), options.joints),
        "tool": _chosen(defaults.tool, options.tool) if options.cartesian else {},
        "buttons": {name: control for name, control in buttons if name not in absent},
        "poses": _chosen(poses, options.poses),
    }


def _parts(options: GamepadOptions | SpaceMouseOptions, robot: Robot) -> tuple[Sequence[str], Sequence[str]]:
    """Names of the joints of the gripper, and of the arm."""
    gripper = robot.groups.get(options.gripper, ())
    return gripper, [name for name in robot.joint_names if name not in gripper]


def _chosen(defaults: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    return {name: control for name, control in {**defaults, **own}.items() if control.removeprefix("-") != NONE}


def _doubles(options: GamepadOptions | SpaceMouseOptions, robot: Robot) -> Iterator[OptionFault]:
    """A fault for each control to which the file assigns a second function."""
    chosen = _assigned(options, robot)
    faults: dict[OptionFault, None] = {}
    for mode in ("joints", "tool"):
        taken: dict[str, tuple[str, str]] = {}
        for option in ("buttons", "poses", mode):
            for name, control in chosen[option].items():
                plain = control.removeprefix("-")
                first, other = taken.setdefault(plain, (option, name))
                if (first, other) != (option, name):
                    message = f"{plain!r} is both {other} and {name}: assign it to one of them"
                    faults[OptionFault((option if name in getattr(options, option) else first,), message)] = None
    yield from faults
