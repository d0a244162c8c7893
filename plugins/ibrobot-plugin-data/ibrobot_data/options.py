"""Options of the section `episodes`, and the words for who commands a robot."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, override

import attrs

from ibrobot_core.api import OptionFault, Options, documented, option

if TYPE_CHECKING:
    from ibrobot_core.api import Robot
    from ibrobot_core.app import RobotConfig, RunView

PLANNER = "planner"
"""Who commands in the episodes of a mode with a planner."""


@documented
@attrs.frozen
class EpisodesOptions(Options):
    """Options of the section `episodes`: how an operator corrects a policy, and which parts of a run are kept."""

    takeover: str = option(
        "button",
        choices=("button", "deadman"),
        help="what takes the robot from a policy: the key or the device's button; deadman: also pressing the device's "
        "deadman, or moving a leader arm without one. Releasing it gives the robot back",
    )
    takeover_key: str = option("enter", help="key that takes the robot from a policy, and gives it back")
    keep: str = option(
        "all",
        choices=("all", "corrections", "highlights"),
        help="which parts of a run are recorded: whole episodes; from before each takeover until after the handback; "
        "or from before a key until it is pressed again",
    )
    before: float = option(5.0, unit="s", ge=0, le=600, help="time to keep before a correction or a highlight")
    after: float = option(1.0, unit="s", ge=0, le=600, help="time to keep after a correction")
    highlight_key: str = option("insert", help="key that begins and ends a highlight")

    @override
    def terminal_keys(self, robot: Robot) -> Mapping[str, str]:
        highlights = {self.highlight_key: "begin and end of a highlight"} if self.keep == "highlights" else {}
        return {self.takeover_key: "takeover", **highlights}


def options_of(config: RobotConfig) -> EpisodesOptions:
    """The options of a robot YAML, or the defaults if it lacks the section."""
    section = config.plugin_sections.get("episodes")
    if section is None:
        return EpisodesOptions()
    assert isinstance(section.options, EpisodesOptions)
    return section.options


def has_button(run: RunView, devices: Iterable[str], event: str) -> bool:
    """Whether one of these teleoperation devices of a run has a button for an event."""
    return any(event in run.config.teleoperation[name].options.events() for name in devices)


def check_keys(config: RobotConfig) -> Iterator[OptionFault]:
    """Check that the keys of a robot YAML's takeovers and highlights do nothing else in modes with `intervene`."""
    if config.recording is None and "episodes" not in config.plugin_sections:
        return  # the component does not run
    options = options_of(config)
    modes = [mode for mode in config.control_modes.values() if mode.inference is not None and mode.inference.devices]
    keys = {"takeover_key": (options.takeover_key, "takes the robot from the policy")} if modes else {}
    if options.keep == "highlights":
        keys["highlight_key"] = options.highlight_key, "begins a highlight"
        if modes and options.highlight_key == options.takeover_key:
            message = f"{options.highlight_key!r} is the takeover_key, too; give one of them another key"
            yield OptionFault(("episodes", "highlight_key"), message)
    for mode in modes:
        assert mode.inference is not None
        for group, name in mode.inference.devices.items():
            device = config.teleoperation.get(name)
            if device is None:
                continue
            used = device.options.terminal_keys(config.robot.part(group) if group else config.robot)
            for option_, (key, does) in keys.items():
                if key in used:
                    message = f"{key!r} is {used[key]} of {name} in mode {mode.name}, where it also {does}"
                    yield OptionFault(("episodes", option_), f"{message}; give one of them another key")
