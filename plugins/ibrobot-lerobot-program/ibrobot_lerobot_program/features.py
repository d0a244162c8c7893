"""LeRobot's features of a robot YAML: names, units and pictures, as LeRobot's own robot of that kind has them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Self

import attrs
import numpy as np
from ibrobot_calibration import JointCalibration, load_calibration

from ibrobot_core.api import Contract, Vector
from ibrobot_core.app import ComponentFailed, RobotConfig

_IMAGES = "observation.images."
_TURN = JointCalibration.TICKS_PER_TURN


@attrs.frozen(eq=False)
class RobotFeatures:
    """The joints, in the order of the action, and the pictures of a robot.

    LeRobot's value of a joint is `(radians - offset) / factor`.
    """

    joints: tuple[str, ...]
    factor: Vector
    offset: Vector
    pictures: Mapping[str, tuple[int, int, int]]
    """Name -> height, width [px] and channels."""
    rate_hz: float
    """Rate of the contract [Hz]."""

    @classmethod
    def of_config(cls, config: RobotConfig, *, use_degrees: bool, calibration: str = "") -> Self:
        """The features of a robot YAML.

        Args:
            config: the robot.
            use_degrees: whether joints are in degrees, from the middle of their range; otherwise from -100 to 100. A
                joint with a closed end, such as a gripper, is from 0 to 100.
            calibration: name or path of a calibration; by default that of the hardware. Without any, as in a
                simulation, the ranges are the limits of the joints.

        Raises:
            CalibrationError: if a calibration cannot be read.
        """
        contract, robot = Contract.from_config(config), config.robot
        joints = contract.action_joints
        names = [calibration] if calibration else [each.options.calibration for each in config.hardware.values()]
        known: dict[str, JointCalibration] = {}
        for name in names if calibration or not config.simulated else []:
            if name is not None:
                known |= load_calibration(name).joints
        limits = dict(zip(robot.joint_names, zip(robot.lower, robot.upper, strict=True), strict=True))
        # A simulation without hardware in its YAML says nothing about closed ends.
        closed = {name: lower for name, lower, grips in zip(limits, robot.lower, robot.grips, strict=True) if grips}
        closed = {**closed, **config.closed_ends}
        scales = [
            _scale(known.get(joint), limits[joint], closed.get(joint), use_degrees=use_degrees) for joint in joints
        ]
        pictures = {}
        for part in contract.observation_parts:
            if part.key.startswith(_IMAGES):
                height, width, channels = part.feature.shape
                pictures[part.key.removeprefix(_IMAGES)] = (height, width, channels)
        factor, offset = np.transpose(scales)
        return cls(joints, factor, offset, pictures, contract.rate_hz)

    def values(self, radians: Vector) -> dict[str, float]:
        """Positions [rad], shape (J,), as LeRobot's features."""
        values = (radians - self.offset) / self.factor
        return {f"{joint}.pos": float(value) for joint, value in zip(self.joints, values, strict=True)}

    def numbers(self, values: Mapping[str, object]) -> dict[str, float]:
        """LeRobot's features as plain numbers.

        Raises:
            ComponentFailed: for a feature that is not one of its joints, or a value that is no finite number.
        """
        known = [f"{joint}.pos" for joint in self.joints]
        numbers = {}
        for name, value in values.items():
            if name not in known:
                raise ComponentFailed(f"action: no feature {name!r}; the features are: {', '.join(known)}")
            try:
                numbers[name] = float(value)  # type: ignore[arg-type]  # also of arrays and tensors
            except (TypeError, ValueError, OverflowError):
                numbers[name] = math.nan
            if isinstance(value, str | bool) or not math.isfinite(numbers[name]):
                raise ComponentFailed(f"action: {name} is {value!r}: give a finite number, as observations have")
        return numbers

    def radians(self, values: Mapping[str, object]) -> dict[str, float]:
        """LeRobot's features as positions of joints [rad]; the errors are those of `numbers`."""
        indices = {f"{joint}.pos": i for i, joint in enumerate(self.joints)}
        return {
            self.joints[i]: float(value * self.factor[i] + self.offset[i])
            for name, value in self.numbers(values).items()
            for i in [indices[name]]
        }


def _scale(
    calibration: JointCalibration | None, limits: tuple[float, float], closed_at: float | None, *, use_degrees: bool
) -> tuple[float, float]:
    """Factor and offset of a joint, as `ibrobot_calibration.joint_units` converts datasets."""
    lower, upper = limits if calibration is None else calibration.ends(closed_at)
    if closed_at is not None:
        return (upper - lower) / 100, lower
    if not use_degrees:
        return (upper - lower) / 200, (upper + lower) / 2
    # LeRobot: 4095 ticks per turn. Without a calibration there are no ticks.
    degree = math.radians(1.0) if calibration is None else 2 * math.pi / _TURN * (_TURN - 1) / 360
    turned = calibration is not None and calibration.inverted
    return (-degree if turned else degree), (upper + lower) / 2
