"""Sensors that cannot run on this machine, and what else a robot lacks here.

A run continues without the sensors, but refuses parts that need their messages.
"""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.config import RobotConfig
from ibrobot_core.config.missing import absent_models, unavailable_modes
from ibrobot_core.errors import MissingDependency
from ibrobot_core.interfaces.run_state import AbsentSensor
from ibrobot_core.plugins import Registry


def notes_of(config: RobotConfig, registry: Registry) -> list[str]:
    """What a valid robot lacks on this machine: plugins, sensors and system libraries, with the remedies.

    Raises:
        MissingDependency: as `Registry.absent_sensors`.
    """
    notes = [*unavailable_modes(config.unavailable), *absent_models(config.absent_models)]
    if absent := describe_absent(registry.absent_sensors(config)):
        notes.append(f"runs start without {absent}")
    modes = [mode for name, mode in config.control_modes.items() if name not in config.unavailable]
    planners = [("planner", mode.planner.type) for mode in modes if mode.planner is not None]
    used = [*(("section", each.type) for each, _ in registry.sections(config)), *planners]
    return notes + list(dict.fromkeys(str(lack) for each in used if (lack := registry.missing(*each)) is not None))


def describe_absent(absent: Iterable[AbsentSensor]) -> str:
    """The absent sensors, their missing dependencies and the remedies, on one line; empty if none are absent."""
    return "; and ".join(f"{labels}: {missing}" for missing, labels in by_cause(absent))


def by_cause(absent: Iterable[AbsentSensor]) -> list[tuple[MissingDependency, str]]:
    """Each missing dependency with the sensors that lack it."""
    causes: dict[str, list[AbsentSensor]] = {}
    for sensor in absent:
        causes.setdefault(str(sensor.missing), []).append(sensor)
    return [(group[0].missing, ", ".join(sensor.label for sensor in group)) for group in causes.values()]
