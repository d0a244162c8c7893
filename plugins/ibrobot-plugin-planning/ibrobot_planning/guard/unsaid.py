"""The guard of robots whose YAML does not mention one, and what a run says of its guard at the start."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, override

from ibrobot_core.api import MissingDependency
from ibrobot_core.app import Component, RobotConfig, RunView
from ibrobot_planning.guard.options import ClearanceGuardOptions
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


class GuardNotice(Component):
    """Says at the start of a run what its commands are guarded against."""

    def __init__(self, session: RunView) -> None:
        super().__init__("guarded", notice(session.config))
        self._session = session

    @override
    def start(self) -> None:
        self._session.log.info("%s", self.summary)

    @override
    def stop(self) -> None:
        pass


def notice(config: RobotConfig) -> str:
    """What the commands of a robot are guarded against."""
    guard = config.control.guard
    if guard is not None:
        if not isinstance(guard.options, ClearanceGuardOptions):
            return f"the guard {guard.type} checks all commands"
        options = guard.options
        floor = config.robot.description.floor if options.floor is None else options.floor
        things = [] if floor is None else [f"the table at {floor:g} m"]
        things += ["the section world"] if "world" in config.plugin_sections else []
        around = f"{1e3 * options.margin:g} mm from {' and '.join(things)}, " if things else ""
        return f"all commands keep {around}{1e3 * options.self_margin:g} mm between links (control.guard: null: off)"
    why = "control.guard is null"
    if "guard" not in (config.document.get("control") or {}):
        why = "set robot.description.floor to the height of the table"
        try:
            find_engines()
        except MissingDependency as error:
            why = str(error)
    return f"no guard: commands of programs and devices may lead into the arm itself or the table: {why}"
