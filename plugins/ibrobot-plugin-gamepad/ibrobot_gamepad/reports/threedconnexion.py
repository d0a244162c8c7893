"""SpaceMouse and related devices, as the drivers of spacenavd read them."""

from __future__ import annotations

import struct

from ibrobot_gamepad.controls import MOUSE_AXES, MOUSE_BUTTONS, Controls

_FULL_SCALE = 350
"""Counts at full deflection of the cap."""
_THREE, _SIX = struct.Struct("<3h"), struct.Struct("<6h")
_TRANSLATION, _ROTATION, _BUTTONS = 1, 2, 3


class SpaceMouse:
    """Puts the state together from reports 1 (translation, in newer ones rotation, too), 2 (rotation) and 3 (buttons).

    The device counts right, towards the operator and down as positive, and turns about these.
    """

    def __init__(self) -> None:
        self._counts = [0] * 6
        self._buttons: frozenset[str] | None = None
        """None until the first report of buttons: they may be held since before the device was connected."""

    def __call__(self, report: bytes) -> Controls | None:
        """The state, or None for a report of another kind."""
        number, rest = report[0] if report else 0, report[1:]
        if number == _TRANSLATION and len(rest) == _SIX.size:
            self._counts = list(_SIX.unpack(rest))
        elif number in (_TRANSLATION, _ROTATION) and len(rest) == _THREE.size:
            start = 0 if number == _TRANSLATION else 3
            self._counts[start : start + 3] = _THREE.unpack(rest)
        elif number == _BUTTONS and 1 <= len(rest) <= 8:
            pressed = int.from_bytes(rest, "little")
            self._buttons = frozenset(name for i, name in enumerate(MOUSE_BUTTONS) if pressed >> i & 1)
        else:
            return None
        right, towards, down, about_right, about_towards, about_down = (
            min(1.0, max(-1.0, count / _FULL_SCALE)) for count in self._counts
        )
        axes = (-towards, -right, -down, -about_towards, -about_right, -about_down)
        known = self._buttons is not None
        return Controls(dict(zip(MOUSE_AXES, axes, strict=True)), self._buttons or frozenset(), complete=known)
