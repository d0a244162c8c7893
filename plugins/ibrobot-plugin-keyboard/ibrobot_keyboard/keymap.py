"""The key bindings: defaults, and changes from the YAML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Literal

import attrs

from ibrobot_core.api import TeleopError

Mode = Literal["joints", "cartesian"]

_JOINT_KEYS = (("w", "s"), ("e", "d"), ("r", "f"), ("t", "g"), ("y", "h"), ("u", "j"), ("i", "k"))
"""The keys of each joint: up and down in a column of the keyboard."""
_CARTESIAN_KEYS = {"x": ("w", "s"), "y": ("a", "d"), "z": ("r", "f"), "pitch": ("g", "t"), "roll": ("y", "h")}
"""Pitch is positive downwards, so the lower key is its plus."""
CARTESIAN_AXES = tuple(_CARTESIAN_KEYS)
_GRIPPER_KEYS = {"gripper_open": "o", "gripper_close": "c"}
_COMMON_KEYS = {"faster": "+", "slower": "-"}


@attrs.frozen
class Keymap:
    """Actions and their keys. A motion along an axis is the action `AXIS+` or `AXIS-`."""

    joints: Mapping[str, str]
    """Action -> key, in joint jog."""
    cartesian: Mapping[str, str]
    """Action -> key, in Cartesian jog; empty if it is not available."""
    common: Mapping[str, str]
    """Action -> key, in both."""
    keyless: tuple[str, ...] = ()
    """The joints that no key moves: there are default keys for seven, and the options give none."""

    def action(self, mode: Mode, key: str) -> str | None:
        """The action of `key` in `mode`."""
        actions = {**(self.joints if mode == "joints" else self.cartesian), **self.common}
        return next((action for action, its_key in actions.items() if its_key == key), None)

    def help(self, mode: str = "joints") -> str:
        """A compact table; keys that do not act in the mode, `joints` or `cartesian`, say what to press first."""
        after = f"  (after {self.common['toggle']})" if self.cartesian else ""
        lines = [f"joints     {_pairs(self.joints)}{after if mode != 'joints' else ''}"]
        if self.cartesian:
            lines.append(f"Cartesian  {_pairs(self.cartesian)}{after if mode == 'joints' else ''}")
        if self.keyless:
            joint = self.keyless[0]
            lines.append(
                f"no keys    {', '.join(self.keyless)}: set them under keys, e.g. {joint}+: '1', {joint}-: '2'"
            )
        lines.append("always     " + "  ".join(f"{key} {action}" for action, key in self.common.items()))
        return "\n".join(lines)


def _pairs(actions: Mapping[str, str]) -> str:
    axes = [action[:-1] for action in actions if action.endswith("+")]
    return "  ".join(f"{actions[axis + '+']}/{actions[axis + '-']} {axis}" for axis in axes)


def make_keymap(
    joints: Sequence[str], *, cartesian: bool, gripper: bool, home: bool, overrides: Mapping[str, str]
) -> Keymap:
    """Make the key bindings of a robot.

    Args:
        joints: the joints to jog one by one.
        cartesian: whether the tool can be jogged.
        gripper: whether the robot has a gripper.
        home: whether the robot has a home pose.
        overrides: action -> key, instead of the default.

    Raises:
        TeleopError: if an action is unknown, a joint has a key for one direction alone, or a key has two actions.
    """
    defaults = dict(zip(joints, _JOINT_KEYS, strict=False))
    motions: dict[str, str] = {}
    keyless: list[str] = []
    for joint in joints:
        default = defaults.get(joint, ("", ""))
        keys = {joint + sign: overrides.get(joint + sign, key) for sign, key in zip("+-", default, strict=True)}
        if any(keys.values()):
            for action, key in keys.items():
                if not key:
                    raise TeleopError(f"no default key is left for {action}: set one under keys, e.g. {action}: '1'")
            motions |= keys
        else:
            keyless.append(joint)
    tool = (
        {a + s: k for a, pair in _CARTESIAN_KEYS.items() for s, k in zip("+-", pair, strict=True)} if cartesian else {}
    )
    common = {
        **(_GRIPPER_KEYS if gripper else {}),
        **({"home": "0"} if home else {}),
        **({"toggle": "m"} if cartesian else {}),
        **_COMMON_KEYS,
    }
    known = {*motions, *(joint + sign for joint in keyless for sign in "+-"), *tool, *common}
    for action in overrides:
        if action not in known:
            close = get_close_matches(action, known, 1)
            hint = f"did you mean {close[0]!r}?" if close else f"the actions are: {', '.join(sorted(known))}"
            raise TeleopError(f"keys: no action {action!r}, {hint}")
    groups = [
        {action: overrides.get(action, key) for action, key in group.items()} for group in (motions, tool, common)
    ]
    keymap = Keymap(groups[0], groups[1], groups[2], tuple(keyless))
    for group in (keymap.joints, keymap.cartesian):
        _check_single({**group, **keymap.common})
    return keymap


def _check_single(actions: Mapping[str, str]) -> None:
    taken: dict[str, str] = {}
    for action, key in actions.items():
        if key in taken:
            raise TeleopError(f"keys: {key!r} is assigned to both {taken[key]} and {action}")
        taken[key] = action
