"""What a run says of its guard at the start."""

from __future__ import annotations

from collections.abc import Iterator
from typing import override

from ibrobot_core.api import MissingDependency, did_you_mean
from ibrobot_core.app import Component, RobotConfig, RunView
from ibrobot_planning.guard.options import ClearanceGuardOptions
from ibrobot_planning.world.engines import find_engines
from ibrobot_planning.world.objects import FLOOR
from ibrobot_planning.world.options import WorldOptions, link_names


class GuardNotice(Component):
    """Says at the start of a run what its commands are guarded against."""

    def __init__(self, session: RunView) -> None:
        super().__init__("guard", notice(session.config))
        self._session = session

    @override
    def start(self) -> None:
        say(self._session)

    @override
    def stop(self) -> None:
        say_whether_it_acted(self._session)


def say(session: RunView) -> None:
    """Log what the commands of a run are guarded against, and names that permit nothing."""
    session.log.info("%s", notice(session.config))
    for line in unknown_names(session.config):
        session.log.warning("%s", line)


def say_whether_it_acted(session: RunView) -> None:
    """Log that the guard held the arm back: nothing else says so of a run without page and panel."""
    if "/guard" in session.bus.latched():
        session.log.info("the guard held the arm back during this run; the topic /guard says when, and from what")


def unknown_names(config: RobotConfig) -> Iterator[str]:
    """Names in `may_touch` and `free` of the guard that nothing has, e.g. of a link that was renamed."""
    guard, section = config.control.guard, config.plugin_sections.get("world")
    world = WorldOptions() if section is None else section.options
    links = link_names(config.robot)
    if guard is None or not isinstance(guard.options, ClearanceGuardOptions) or not links:
        return
    if world.scene:  # its objects are known only when it runs
        return
    known = [*links, FLOOR, *world.objects, *world.clouds]
    for key, permitted in (("may_touch", guard.options.may_touch), ("free", guard.options.free)):
        for name, others in (permitted or {}).items():
            for other in (name, *others):
                if other not in known:
                    hint = did_you_mean(other, known, "known")
                    yield f"control.guard.{key}.{name}: there is no link or object {other!r}{hint}"


def notice(config: RobotConfig) -> str:
    """What the commands of a robot are guarded against."""
    guard = config.control.guard
    if guard is not None:
        if not isinstance(guard.options, ClearanceGuardOptions):
            return f"the guard {guard.type} checks all commands"
        options = guard.options
        if options.base is not None:
            around = "the section world" if "world" in config.plugin_sections else "nothing, without a section world"
            return f"the base keeps {1e3 * options.base.margin:g} mm from {around} (off by control.guard: null)"
        floor = config.robot.description.floor if options.floor is None else options.floor
        things = [] if floor is None else [f"the table at {floor:g} m"]
        things += ["the section world"] if "world" in config.plugin_sections else []
        around = f"{1e3 * options.margin:g} mm from {' and '.join(things)}, " if things else ""
        return f"all commands keep {around}{1e3 * options.self_margin:g} mm between links (off by control.guard: null)"
    why = "control.guard is null"
    if "guard" not in (config.document.get("control") or {}):
        why = "set robot.description.floor to the height of the table"
        try:
            find_engines()
        except MissingDependency as error:
            why = str(error)
    return f"no guard: commands of programs and devices may lead into the arm itself or the table: {why}"
