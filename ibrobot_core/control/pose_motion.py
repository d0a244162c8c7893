"""The slow motion to a pose at the start, at the stop, and before a load is shed."""

from __future__ import annotations

import numpy as np

from ibrobot_core.clock import Clock
from ibrobot_core.control.safety import SafetyLayer
from ibrobot_core.robot import Vector
from ibrobot_core.units import ns

TIMEOUT_S = 10.0
"""Time for a motion to a pose [s]."""
_SPEED = 0.25
"""Speed as a fraction of the velocity limits."""


class PoseMotion:
    """Moves all joints to a pose, within the limits of the safety layer and `TIMEOUT_S`.

    Args:
        safety: the safety layer, which knows where the joints are commanded.
        clock: for the time-out.

    Attributes:
        target: the pose [rad], shape (J,); None without a motion.
        held: what the guard kept it from last, as `Guard.overruled`.
    """

    def __init__(self, safety: SafetyLayer, clock: Clock) -> None:
        self._safety, self._clock, self._deadline_ns = safety, clock, 0
        self.target: Vector | None = None
        self.held = ""

    def begin(self, target: Vector) -> None:
        """Begin the motion to `target` [rad], shape (J,)."""
        self.target = target
        self._deadline_ns = self._clock.now_ns() + ns(TIMEOUT_S)

    def end(self) -> None:
        """End the motion; the joints brake and hold."""
        self.target = None

    @property
    def late(self) -> bool:
        """Whether a motion has taken too long."""
        return self.target is not None and self._clock.now_ns() >= self._deadline_ns

    @property
    def reached(self) -> bool:
        """Whether the joints are commanded to rest at the target."""
        at_rest, target = self._safety.at_rest, self.target
        return at_rest and target is not None and np.allclose(self._safety.current, target, atol=1e-4)

    def desired(self) -> Vector | None:
        """The desired positions of this tick [rad], shape (J,); None to brake, without a motion or if it is late."""
        return None if self.target is None or self.late else self._safety.towards(self.target, _SPEED)
