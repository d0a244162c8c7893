"""Options of the section `episodes`, and the words for who commands a robot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import attrs

from ibrobot_core.api import documented, option

if TYPE_CHECKING:
    from ibrobot_core.api import RobotConfig

COMMANDER = "/commander"
"""std_msgs/msg/String: who commands the robot at a state of control, in modes with `intervene`."""
POLICY, OPERATOR, HANDOVER = "policy", "operator", "handover"
"""The words on `COMMANDER`; in a handover nobody commands, and the arm holds."""
PLANNER = "planner"
"""Who commands in the episodes of a mode with a planner."""


def _check_key(_: object, __: object, key: str) -> None:
    if not key:
        raise ValueError("is empty; name a key, e.g. enter")


@documented
@attrs.frozen
class EpisodesOptions:
    """Options of the section `episodes`: how an operator corrects a policy, and which parts of a run are kept."""

    takeover: str = option(
        "button",
        choices=("button", "deadman"),
        help="what takes the robot from a policy: the key or the device's button; deadman: also pressing the device's "
        "deadman, or moving a leader arm without one. Releasing it gives the robot back",
    )
    takeover_key: str = option(
        "enter", validator=_check_key, help="key that takes the robot from a policy, and gives it back"
    )
    keep: str = option(
        "all",
        choices=("all", "corrections", "highlights"),
        help="which parts of a run are recorded: whole episodes; from before each takeover until after the handback; "
        "or from before a key until it is pressed again",
    )
    before: float = option(5.0, unit="s", ge=0, le=600, help="time to keep before a correction or a highlight")
    after: float = option(1.0, unit="s", ge=0, le=600, help="time to keep after a correction")
    highlight_key: str = option("insert", validator=_check_key, help="key that begins and ends a highlight")


def options_of(config: RobotConfig) -> EpisodesOptions:
    """The options of a robot YAML, or the defaults if it lacks the section."""
    section = config.plugin_sections.get("episodes")
    if section is None:
        return EpisodesOptions()
    assert isinstance(section.options, EpisodesOptions)
    return section.options
