"""Messages of the page, as JSON text. Browsers are not trusted: everything they send is checked here.

The frame of a pose is that of WebXR: x to the right, y up, z towards the operator; [m], and quaternions (x, y, z, w).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, get_args

import attrs

from ibrobot_core.api import OperatorEvent
from ibrobot_webxr.options import HANDS

LONGEST = 4096
"""Size of the longest message [bytes]."""
_FARTHEST_M = 100.0
_UNIT = 1e-2
"""Tolerance of the length of a quaternion."""
_EVENTS: tuple[OperatorEvent, ...] = get_args(OperatorEvent)
_HAND_KEYS = {"position", "orientation", "clutch", "gripper", "open", "move"}


@attrs.frozen
class HandPose:
    """A hand, controller or phone at one instant."""

    orientation: tuple[float, ...]
    """Quaternion (x, y, z, w) of length 1."""
    position: tuple[float, ...] | None
    """Position [m]; None for a phone that measures only its orientation."""
    clutch: bool
    """Whether the operator holds the clutch."""
    gripper: float | None = None
    """Trigger, from 0 for open to 1 for closed; None without one."""
    open: float = 0.0
    """Buttons of the gripper: 1 opens, -1 closes."""
    move: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Sticks of a phone: right, up and back, each from -1 to 1."""


@attrs.frozen
class Hands:
    """The poses of one frame of the page."""

    number: int
    time_s: float
    """The page's clock [s]."""
    heading: float
    """Direction in which the operator looks, about the y axis [rad]; 0 is -z, positive to the left."""
    hands: Mapping[str, HandPose]
    """Hand -> its pose; a hand that is not tracked is missing."""


@attrs.frozen
class Press:
    """A button of the page for the run."""

    event: OperatorEvent


@attrs.frozen
class Stop:
    """The page's emergency stop."""


@attrs.frozen
class Claim:
    """A page that watches asks for control."""


@attrs.frozen
class Shown:
    """The page has shown a camera's image, and can take the next."""

    camera: int


PageMessage = Hands | Press | Stop | Claim | Shown


def decode(text: str) -> PageMessage:
    """A message of the page.

    Raises:
        ValueError: saying what is wrong with it.
    """
    if len(text) > LONGEST:
        raise ValueError(f"longer than {LONGEST} characters")
    try:
        message = json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError):
        raise ValueError("not JSON") from None
    if not isinstance(message, dict):
        raise ValueError("not a JSON object")
    match message.pop("type", None):
        case "hands":
            return _hands(message)
        case "press":
            _keys(message, {"event"})
            if (event := message["event"]) not in _EVENTS:
                raise ValueError(f"event: must be one of {', '.join(_EVENTS)}")
            return Press(event)
        case "stop":
            _keys(message, set())
            return Stop()
        case "claim":
            _keys(message, set())
            return Claim()
        case "shown":
            _keys(message, {"camera"})
            return Shown(_whole("camera", message["camera"]))
        case _:
            raise ValueError("type: must be hands, press, stop, claim or shown")


def _no_constant(name: str) -> float:
    raise ValueError(name)


def _hands(message: dict[str, Any]) -> Hands:
    _keys(message, {"n", "t", "heading", "hands"})
    hands = message["hands"]
    if not isinstance(hands, dict) or not set(hands) <= set(HANDS):
        raise ValueError(f"hands: must be an object with the keys {' and '.join(HANDS)}, or fewer")
    return Hands(
        _whole("n", message["n"]),
        _number("t", message["t"], 0, 1e12),
        _number("heading", message["heading"], -7, 7),
        {name: _hand(f"hands.{name}", hand) for name, hand in hands.items()},
    )


def _hand(where: str, hand: Any) -> HandPose:
    if not isinstance(hand, dict):
        raise ValueError(f"{where}: must be an object")
    _keys(hand, _HAND_KEYS, where)
    orientation = _numbers(f"{where}.orientation", hand["orientation"], 4, 1 + _UNIT)
    length = math.hypot(*orientation)
    if abs(length - 1) > _UNIT:
        raise ValueError(f"{where}.orientation: must be a unit quaternion")
    position, gripper, clutch = hand["position"], hand["gripper"], hand["clutch"]
    if not isinstance(clutch, bool):
        raise ValueError(f"{where}.clutch: must be true or false")
    return HandPose(
        tuple(value / length for value in orientation),
        None if position is None else _numbers(f"{where}.position", position, 3, _FARTHEST_M),
        clutch,
        None if gripper is None else _number(f"{where}.gripper", gripper, 0, 1),
        _number(f"{where}.open", hand["open"], -1, 1),
        _numbers(f"{where}.move", hand["move"], 3, 1),
    )


def _keys(message: Mapping[str, Any], known: set[str], where: str = "") -> None:
    at = f"{where}: " if where else ""
    if missing := sorted(known - set(message)):
        raise ValueError(f"{at}{missing[0]} is missing")
    if set(message) - known:  # not named: they are untrusted
        raise ValueError(f"{at}unknown keys; must have {', '.join(sorted(known)) or 'none'}")


def _whole(where: str, value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**53:
        raise ValueError(f"{where}: must be a whole number, at least 0")
    return value


def _number(where: str, value: Any, least: float, most: float) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not least <= value <= most:
        raise ValueError(f"{where}: must be a number from {least:g} to {most:g}")
    return float(value)


def _numbers(where: str, values: Any, count: int, most: float) -> tuple[float, ...]:
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f"{where}: must be a list of {count} numbers")
    return tuple(_number(where, value, -most, most) for value in values)
