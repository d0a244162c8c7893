"""Options of the section `episodes`, and the words for who commands a robot."""

from __future__ import annotations

import attrs

from ibrobot_core.api import RobotConfig, documented, option

COMMANDER = "/commander"
"""std_msgs/msg/String: who commands the robot at a state of control, in modes with `intervene`."""
POLICY, OPERATOR, HANDOVER = "policy", "operator", "handover"
"""The words on `COMMANDER`; in a handover nobody commands, and the arm holds."""


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
    takeover_key: str = option("enter", help="key that takes the robot from a policy, and gives it back")


def options_of(config: RobotConfig) -> EpisodesOptions:
    """The options of a robot YAML, or the defaults if it lacks the section."""
    section = config.plugin_sections.get("episodes")
    if section is None:
        return EpisodesOptions()
    assert isinstance(section.options, EpisodesOptions)
    return section.options
