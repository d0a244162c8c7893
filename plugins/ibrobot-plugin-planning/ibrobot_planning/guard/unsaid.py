"""The guard of robots whose YAML does not mention one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from ibrobot_core.api import MissingDependency
from ibrobot_planning.world.engines import find_engines

_TYPE = "clearance"


def unsaid(document: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """`control.guard` for a robot YAML with a model and a table, by its plain values; None: no guard.

    The table is `floor` of `robot.description`, or else the lowest of planners and of `goals`, or in the section
    `world`. `control: {guard: null}` switches the guard off.
    """
    control = document.get("control", {})
    if not isinstance(control, Mapping) or "guard" in control or _at(document, "robot", "description", "mjcf") is None:
        return None
    table = list(_floors(document))
    if not table and not document.get("world"):
        return None
    try:
        find_engines()
    except MissingDependency:
        return None  # the run says so
    known = _at(document, "robot", "description", "floor") is not None
    return {"type": _TYPE} if known or not table else {"type": _TYPE, "floor": min(table)}


def _floors(document: Mapping[str, Any]) -> Iterator[float]:
    """Heights of the table that a robot YAML states [m]."""
    modes = document.get("control_modes")
    named = [_at(document, "robot", "description"), document.get("goals")]
    named += [_at(mode, "planner") for mode in modes.values()] if isinstance(modes, Mapping) else []
    for each in named:
        floor = _at(each, "floor")
        if isinstance(floor, int | float) and math.isfinite(floor):
            yield floor


def _at(value: Any, *keys: str) -> Any:
    """The value below keys; None if there is none."""
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value
