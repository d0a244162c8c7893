"""The formats that can be imported, recognised by what a file contains."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import attrs

_ROBOT = re.compile(r"\w+_(follower|leader|client)|lekiwi|reachy2|hope_jr|stretch3|unitree_g1")
"""Types of robots in LeRobot."""


@attrs.frozen
class Format:
    """A format."""

    name: str
    """Name of the format, for messages."""
    program: str
    """The program whose format it is."""
    reads: Callable[[Mapping[str, Any]], bool]
    """Whether the plain values of a file have this format."""


def _is_ib_robot(root: Mapping[str, Any]) -> bool:
    robot = root.get("robot")
    if isinstance(robot, Mapping):
        sections = {"ros2_control", "contract", "peripherals", "control_modes", "teleoperation"}
        return "executors" not in root and bool(sections & set(robot))
    return {"version", "observations", "actions"} <= set(root) and isinstance(root["observations"], list)


def _is_rosetta(root: Mapping[str, Any]) -> bool:
    sections = (root.get("observations"), root.get("actions"))
    return "robot_interface" in root or ("robot_type" in root and any(isinstance(each, Mapping) for each in sections))


def _is_lerobot(root: Mapping[str, Any]) -> bool:
    robot = root.get("robot", root)
    kind = robot.get("type") if isinstance(robot, Mapping) else None
    return isinstance(kind, str) and bool(_ROBOT.fullmatch(kind)) and "executors" not in root


def _is_calibration(root: Mapping[str, Any]) -> bool:
    return bool(root) and all(
        isinstance(each, Mapping) and {"range_min", "range_max"} <= set(each) for each in root.values()
    )


IB_ROBOT = Format("a YAML of IB-Robot", "IB-Robot", _is_ib_robot)
ROSETTA = Format("a contract of Rosetta", "Rosetta", _is_rosetta)
LEROBOT = Format("a config of LeRobot", "LeRobot", _is_lerobot)
CALIBRATION = Format("a calibration of LeRobot or IB-Robot", "LeRobot", _is_calibration)
FORMATS = (IB_ROBOT, ROSETTA, LEROBOT, CALIBRATION)
