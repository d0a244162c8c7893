"""What the electronics and gears of servos make of commands: limited speed, backlash and bias."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np

from ibrobot_core.api import Vector
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.parameters import ArmParameters, JointParameters


class Servos:
    """The setpoints of servos at each step of the physics.

    With backlash, the setpoint of a joint stays until the command has moved by the lost motion.

    Args:
        stride: longest motion of the setpoint in a step [rad].
        backlash: lost motion of each joint when the command reverses [rad], shape (J,).
        bias: how far from its command each servo rests [rad], shape (J,).
    """

    def __init__(self, stride: float, backlash: Vector, bias: Vector) -> None:
        self._stride, self._half, self._bias = stride, backlash / 2, bias
        self._is_plain = not (backlash.any() or bias.any())
        self.restart(np.zeros_like(bias))

    @classmethod
    def of(cls, parameters: ArmParameters | None, joints: Sequence[str], options: MujocoOptions) -> Self:
        """The servos of some joints; without parameters, with neither backlash nor bias."""
        default = JointParameters(1.0, 0.0, 0.0, 0.0)
        each = [parameters.joints[joint] if parameters is not None else default for joint in joints]
        backlash, bias = np.array([one.backlash for one in each]), np.array([one.bias for one in each])
        return cls(options.velocity_limit * options.timestep, backlash, bias)

    def restart(self, position: Vector) -> None:
        """Begin at rest, with the setpoint at a position [rad], shape (J,)."""
        self._setpoint, self._held = position.copy(), position.copy()

    def step(self, command: Vector) -> Vector:
        """The setpoint of the next step [rad], shape (J,); valid until the next call."""
        # This runs at every timestep, and takes half the time of np.clip.
        self._setpoint += np.minimum(np.maximum(command - self._setpoint, -self._stride), self._stride)
        if self._is_plain:
            return self._setpoint
        self._held = np.minimum(np.maximum(self._held, self._setpoint - self._half), self._setpoint + self._half)
        result: Vector = self._held + self._bias
        return result

    def steps(self, commands: Vector) -> Vector:
        """The setpoints of many steps [rad], shape (N, J), from rest at the first command."""
        self.restart(commands[0])
        return np.stack([self.step(command).copy() for command in commands])
