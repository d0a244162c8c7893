"""The SO-101 as ibrobot ships it: names of its joints and links, one arm or two, and its own configs."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import attrs

from ibrobot_core.app import find_config, installed_plugins, parse_yaml
from ibrobot_import.source import From

ARM, GRIPPER = "arm", "gripper"
SERVOS = {
    str(number): name
    for number, name in enumerate(
        ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"), start=1
    )
}
"""Id of a servo -> the name of its joint."""
SYNONYMS = {"elbow": "elbow_flex", "wrist_pitch": "wrist_flex"} | SERVOS
"""Other names of its joints."""
LINKS = {
    "base": "base_link", "shoulder": "shoulder_link", "upper_arm": "upper_arm_link", "lower_arm": "lower_arm_link",
    "wrist": "wrist_link", "gripper": "gripper_link", "jaw": "moving_jaw_so101_v1_link",
}  # fmt: skip
"""Other names of its links."""


@attrs.frozen
class Body:
    """One SO-101, or two side by side."""

    config: str
    """The config that ibrobot ships."""
    prefixes: tuple[str, ...]
    """Prefix of the joints' names of each arm."""

    @property
    def origin(self) -> str:
        """The comment of a value of ibrobot's own config."""
        return f"{self.config} of ibrobot"

    def own(self, value: Any) -> From:
        """A value of ibrobot's own config."""
        return From(value, self.origin)

    @property
    def joints(self) -> tuple[str, ...]:
        """All joints, in order."""
        return tuple(f"{prefix}{name}" for prefix in self.prefixes for name in SERVOS.values())

    @property
    def groups(self) -> dict[str, list[str]]:
        """The joint groups that executors own."""
        if len(self.prefixes) == 1:
            return {ARM: list(self.joints[:-1]), GRIPPER: [self.joints[-1]]}
        return {prefix.rstrip("_"): [f"{prefix}{name}" for name in SERVOS.values()] for prefix in self.prefixes}

    @property
    def grippers(self) -> dict[str, list[str]]:
        """Further groups, for devices."""
        return {} if len(self.prefixes) == 1 else {f"{each}{GRIPPER}": [f"{each}{GRIPPER}"] for each in self.prefixes}


SINGLE = Body("so101", ("",))
DOUBLE = Body("bi_so101", ("left_", "right_"))


@cache
def shipped(config: str) -> Mapping[str, Any]:
    """The plain values of a config that ibrobot ships."""
    path = find_config(config, installed_plugins())
    root: Mapping[str, Any] = parse_yaml(path.read_text(encoding="utf-8"), str(path), expands=False).root
    return root
