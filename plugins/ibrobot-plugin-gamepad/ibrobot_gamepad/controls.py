"""The state of a device: axes and buttons by name, with the same names for every make."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import attrs

STICKS = ("left_x", "left_y", "right_x", "right_y")
"""-1 to 1: right and up are positive."""
TRIGGERS = ("left_trigger", "right_trigger")
"""0 released, 1 pulled."""
DPAD = ("dpad_x", "dpad_y")
"""-1, 0 or 1: right and up are positive."""
PAD_AXES = (*STICKS, *TRIGGERS, *DPAD)
PAD_BUTTONS = (
    "south", "east", "west", "north", "left_shoulder", "right_shoulder", "left_stick", "right_stick",
    "back", "start", "guide", "touchpad", "misc",
)  # fmt: skip
"""The four on the right are named by position: `south` is A on Xbox, B on Nintendo, the cross on PlayStation pads."""
MOUSE_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""-1 to 1: forward, left, up, and rotations about these axes (right-hand rule)."""
MOUSE_BUTTONS = ("left", "right", *(f"button{n}" for n in range(3, 49)))

_PULLED = 0.5
"""Deflection beyond which an axis counts as a pressed button."""


@attrs.frozen
class Controls:
    """The state of all axes and buttons."""

    axes: Mapping[str, float]
    """Name -> deflection, -1 to 1, triggers 0 to 1."""
    buttons: frozenset[str]
    """The pressed ones."""
    complete: bool = True
    """Whether the device has reported the state of its buttons since it was connected."""

    def value(self, control: str) -> float:
        """Deflection of an axis; 1 for a pressed button; 0 for a control that the device lacks."""
        return self.axes.get(control, 1.0 if control in self.buttons else 0.0)

    def pressed(self, control: str) -> bool:
        """Whether a button is pressed, or an axis more than half way."""
        return control in self.buttons or self.axes.get(control, 0.0) > _PULLED


def pad(
    sticks: Iterable[float], triggers: Iterable[float], hat: tuple[int, int], buttons: Iterable[tuple[str, int]]
) -> Controls:
    """The state of a standard pad.

    Args:
        sticks: left x, left y, right x, right y; clipped to -1 and 1.
        triggers: left, right.
        hat: the directional pad, right and up.
        buttons: name and whether it is pressed.
    """
    values = (*(min(1.0, max(-1.0, each)) for each in sticks), *triggers, *(float(each) for each in hat))
    return Controls(dict(zip(PAD_AXES, values, strict=True)), frozenset(name for name, on in buttons if on))
