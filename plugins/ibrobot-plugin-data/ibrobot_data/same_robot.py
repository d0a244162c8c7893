"""Identity of the robot that recorded an episode, compared before a replay or a merge."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Self

import attrs
from ibrobot_calibration.joint_units import calibrations

from ibrobot_core.app import RobotConfig
from ibrobot_data.episode import Unit


@attrs.frozen
class Identity:
    """A robot's name, type and calibration; what is unknown is empty."""

    name: str = ""
    robot_type: str = ""
    calibration: Mapping[str, Mapping[str, Any]] = attrs.field(factory=dict)
    """Joint -> fields of `JointCalibration`; none for a simulation."""

    @classmethod
    def of_robot(cls, config: RobotConfig) -> Self:
        """The identity of a robot YAML."""
        return cls(config.robot.name, config.robot.robot_type, _joined(calibrations(config)))

    @classmethod
    def of_episode(cls, metadata: Mapping[str, str]) -> Self:
        """The identity in an episode's metadata."""
        try:
            calibration = _joined(json.loads(metadata.get("calibration", "{}")))
        except (ValueError, AttributeError):
            calibration = {}  # a foreign key of the same name
        return cls(metadata.get("robot", ""), metadata.get("robot_type", ""), calibration)

    @classmethod
    def of_unit(cls, unit: Unit) -> Self:
        """The identity of a converted episode, with the calibration that was used."""
        return cls(unit.recorded.get("robot", ""), unit.robot_type, unit.calibration)

    @classmethod
    def of_dataset(cls, metadata: Mapping[str, Any], units: Sequence[Unit]) -> Self:
        """The identity of a dataset's robot: the first known name, type and calibration of each joint.

        Args:
            metadata: of the existing dataset; empty without one.
            units: the converted episodes.
        """
        kept, type_ = metadata.get("calibrations", {}), metadata.get("robot_type", "")
        known = [
            cls(each.get("recorded", {}).get("robot", ""), type_, kept.get(each.get("calibration", ""), {}))
            for each in metadata.get("episodes", ())
        ]
        known += map(cls.of_unit, units)
        return cls(
            next((each.name for each in known if each.name), ""),
            next((each.robot_type for each in known if each.robot_type), ""),
            {joint: numbers for each in reversed(known) for joint, numbers in each.calibration.items()},
        )

    def difference(self, other: Identity, this_name: str) -> str:
        """Describe how another robot differs, where both are known; empty if it does not.

        Args:
            other: the other robot.
            this_name: name of this one, for the message.
        """
        for what, this, that in (
            ("robot", self.name, other.name),
            ("robot_type", self.robot_type, other.robot_type),
        ):
            if this and that and this != that:
                return f"its {what} is {that!r}, that of {this_name} is {this!r}"
        joints = [
            joint
            for joint in self.calibration
            if joint in other.calibration and _numbers(self.calibration[joint]) != _numbers(other.calibration[joint])
        ]
        if not joints:
            return ""
        first = joints[0]
        return (
            f"its calibration of {', '.join(joints)} is not that of {this_name}: "
            f"{first} has {_text(other.calibration[first])}, {this_name} has {_text(self.calibration[first])}"
        )


def _joined(by_hardware: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> dict[str, Mapping[str, Any]]:
    return {joint: numbers for each in by_hardware.values() for joint, numbers in each.items()}


def _numbers(calibration: Mapping[str, Any]) -> dict[str, Any]:
    """The numbers of a joint's calibration; `closed_at` is of the hardware."""
    return {name: value for name, value in calibration.items() if name != "closed_at"}


def _text(calibration: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in _numbers(calibration).items())
