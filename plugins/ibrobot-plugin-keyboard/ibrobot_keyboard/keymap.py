"""Which key does what: the defaults, and what the YAML changes of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import Literal

import attrs

from ibrobot_core.api import OptionFault, Robot, TeleopError
from ibrobot_keyboard.options import KeyboardOptions

Mode = Literal["joints", "cartesian"]

_JOINT_KEYS = (("w", "s"), ("e", "d"), ("r", "f"), ("t", "g"), ("y", "h"), ("u", "j"), ("i", "k"))
"""Of each joint: up and down the column of keys."""
_CARTESIAN_KEYS = {"x": ("w", "s"), "y": ("a", "d"), "z": ("r", "f"), "pitch": ("g", "t"), "roll": ("y", "h")}
"""Pitch is positive downwards, so the lower key is its plus."""
CARTESIAN_AXES = tuple(_CARTESIAN_KEYS)
_GRIPPER_KEYS = {"gripper_open": "o", "gripper_close": "c"}
_COMMON_KEYS = {"faster": "+", "slower": "-", "estop": "space"}


@attrs.frozen
class Keymap:
    """Actions and their keys. A motion along an axis is the action `AXIS+` or `AXIS-`."""

    joints: Mapping[str, str]
    """Action -> key, while joints are jogged."""
    cartesian: Mapping[str, str]
    """Action -> key, while the tool is jogged; empty where that is not possible."""
    common: Mapping[str, str]
    """Action -> key, always."""

    def action(self, mode: Mode, key: str) -> str | None:
        """What `key` does in `mode`."""
        actions = {**(self.joints if mode == "joints" else self.cartesian), **self.common}
        return next((action for action, its_key in actions.items() if its_key == key), None)

    def help(self) -> str:
        """A compact table."""
        lines = [f"joints     {_pairs(self.joints)}"]
        if self.cartesian:
            lines.append(f"Cartesian  {_pairs(self.cartesian)}")
        lines.append("always     " + "  ".join(f"{key} {action}" for action, key in self.common.items()))
        return "\n".join(lines)


def _pairs(actions: Mapping[str, str]) -> str:
    axes = [action[:-1] for action in actions if action.endswith("+")]
    return "  ".join(f"{actions[axis + '+']}/{actions[axis + '-']} {axis}" for axis in axes)


def make_keymap(
    joints: Sequence[str], *, cartesian: bool, gripper: bool, home: bool, overrides: Mapping[str, str]
) -> Keymap:
    """The keys of a robot.

    Args:
        joints: the joints to jog one by one.
        cartesian: whether the tool can be jogged.
        gripper: whether there is a gripper.
        home: whether there is a pose to go home to.
        overrides: action -> key, in place of the default.

    Raises:
        TeleopError: for an unknown action, a joint left without keys, or a key that does two things at once.
    """
    defaults = dict(zip(joints, _JOINT_KEYS, strict=False))
    motions: dict[str, str] = {}
    for joint in joints:
        for sign, default in zip("+-", defaults.get(joint, (None, None)), strict=True):
            key = overrides.get(joint + sign, default)
            if key is None:
                raise TeleopError(f"no key is left for {joint}{sign}: give it one under keys, e.g. {joint}{sign}: '1'")
            motions[joint + sign] = key
    tool = (
        {a + s: k for a, pair in _CARTESIAN_KEYS.items() for s, k in zip("+-", pair, strict=True)} if cartesian else {}
    )
    common = {
        **(_GRIPPER_KEYS if gripper else {}),
        **({"home": "0"} if home else {}),
        **({"toggle": "m"} if cartesian else {}),
        **_COMMON_KEYS,
    }
    known = {*motions, *tool, *common}
    for action in overrides:
        if action not in known:
            close = get_close_matches(action, known, 1)
            hint = f"did you mean {close[0]!r}?" if close else f"the actions are: {', '.join(sorted(known))}"
            raise TeleopError(f"keys: no action {action!r}, {hint}")
    keymap = Keymap(
        *({action: overrides.get(action, key) for action, key in group.items()} for group in (motions, tool, common))
    )
    for group in (keymap.joints, keymap.cartesian):
        _check_single({**group, **keymap.common})
    return keymap


def keymap_of(options: KeyboardOptions, robot: Robot) -> Keymap:
    """The keys that options give a robot.

    Raises:
        TeleopError: as `make_keymap`.
    """
    gripper = robot.groups.get(options.gripper, ())
    return make_keymap(
        [name for name in robot.joint_names if name not in gripper],
        cartesian=options.cartesian,
        gripper=bool(gripper),
        home="home" in robot.description.poses,
        overrides=options.keys,
    )


def check_keys(options: KeyboardOptions, robot: Robot) -> Iterator[OptionFault]:
    """Each joint has its keys, each key one meaning, and Cartesian jog a model."""
    if options.cartesian and robot.description.mjcf is None:
        yield OptionFault(("cartesian",), "Cartesian jog needs robot.description.mjcf: set it, or cartesian: false")
    try:
        keymap_of(options, robot)
    except TeleopError as error:
        yield OptionFault(("keys",), str(error).removeprefix("keys: "))


def _check_single(actions: Mapping[str, str]) -> None:
    taken: dict[str, str] = {}
    for action, key in actions.items():
        if key in taken:
            raise TeleopError(f"keys: {key!r} is both {taken[key]} and {action}, must be one of them")
        taken[key] = action
