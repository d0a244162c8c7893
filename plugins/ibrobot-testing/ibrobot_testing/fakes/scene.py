"""A scene in a made-up simulation: a ball on a line has to get to the end."""

from __future__ import annotations

from typing import override

import attrs
import numpy as np

from ibrobot_core.api import Scene, Vector


@attrs.define(eq=False)
class FakeWorld:
    """A ball on a table, and a lamp."""

    x: float = 0.0
    z: float = 0.0
    light: float = 1.0

    def advance(self, duration_s: float) -> None:
        """The ball falls onto the table."""
        self.z = max(0.0, self.z - 9.81 * duration_s**2 / 2)


class FakeScene(Scene[list[str], FakeWorld]):
    """A ball, which begins at random in [0.1, 0.5], and light in [0.5, 1.5]."""

    values = ("ball.x", "ball.y", "ball.z", "ball.qw", "ball.qx", "ball.qy", "ball.qz")
    factors = ("ball_x", "light")
    poses = {"ball": 0}  # noqa: RUF012 - as the interface declares it

    def __init__(self, light: tuple[float, float] = (0.5, 1.5)) -> None:
        self._light = light

    @override
    def build(self, spec: list[str]) -> None:
        spec.append("ball")

    @override
    def begin(self, world: FakeWorld, rng: np.random.Generator) -> Vector:
        x, light = rng.uniform(0.1, 0.5), rng.uniform(*self._light)
        world.x, world.z = x, 0.0
        factors = np.array([x, light])
        self.show(world, factors)
        return factors

    @override
    def show(self, world: FakeWorld, factors: Vector) -> None:
        world.light = float(factors[1])

    @override
    def observe(self, world: FakeWorld, out: Vector) -> None:
        out[:] = world.x, 0.0, world.z, 1.0, 0.0, 0.0, 0.0

    @override
    def success(self, world: FakeWorld) -> bool | None:
        return world.x > 1.0
