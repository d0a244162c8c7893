"""What a run says of its guard at the start."""

from __future__ import annotations

from typing import override

from ibrobot_core.api import MissingDependency
from ibrobot_core.app import Component, RobotConfig, RunView
from ibrobot_planning.guard.options import ClearanceGuardOptions
from ibrobot_planning.world.engines import find_engines


class GuardNotice(Component):
    """Says at the start of a run what its commands are guarded against."""

    def __init__(self, session: RunView) -> None:
        super().__init__("guard", notice(session.config))
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
