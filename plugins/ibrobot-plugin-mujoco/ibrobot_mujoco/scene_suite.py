"""The conformance suite of scenes, and a scene in a made-up simulation; both need `ibrobot-testing`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, override

import attrs
import numpy as np
import pytest
from ibrobot_testing.suite import Suite

from ibrobot_core.api import Context, Vector
from ibrobot_mujoco.scene import Scene

_POSE = 7
_SEEDS = 40


class SceneSuite[Spec, World](Suite[Scene[Spec, World]]):
    """Checks of every `Scene`. The subclass knows the simulation: how to build a world, read it and let time pass."""

    rest_m: ClassVar[float] = 1e-3
    """Distance by which a resting object may move in `rest_s` [m]."""
    rest_s: ClassVar[float] = 0.3
    task: ClassVar[bool] = True
    """Whether the scene has a task."""

    def world(self, scene: Scene[Spec, World], ctx: Context) -> World:
        """A new world with the scene, before an episode."""
        raise NotImplementedError(f"{type(self).__name__} must define world(self, scene, ctx)")

    def state(self, world: World) -> Vector:
        """All that moves in the world, with the robot, shape (N,)."""
        raise NotImplementedError(f"{type(self).__name__} must define state(self, world)")

    def looks(self, world: World) -> Vector:
        """All that `show` may change: sizes, colours, friction, lights and cameras, shape (M,)."""
        raise NotImplementedError(f"{type(self).__name__} must define looks(self, world)")

    def advance(self, world: World, duration_s: float) -> None:
        """Let time pass while the robot stands still."""
        raise NotImplementedError(f"{type(self).__name__} must define advance(self, world, duration_s)")

    def ranges(self, scene: Scene[Spec, World]) -> Mapping[str, tuple[float, float]]:
        """Factor -> lowest and highest value that the options allow; factors may be left out."""
        raise NotImplementedError(f"{type(self).__name__} must define ranges(self, scene)")

    def fixed(self, ctx: Context) -> tuple[str, Scene[Spec, World]] | None:
        """A factor that `make` draws, and the scene with that factor fixed; None if its options fix none."""
        return None

    def built(self) -> tuple[Scene[Spec, World], World]:
        """A new scene and its world."""
        ctx = self.context()
        scene = self.make(ctx)
        return scene, self.world(scene, ctx)

    def begin(self, scene: Scene[Spec, World], world: World, seed: int) -> Vector:
        """Begin the episode of a seed; override it if the simulation resets the robot first."""
        return scene.begin(world, np.random.default_rng(seed))

    @staticmethod
    def observed(scene: Scene[Spec, World], world: World) -> Vector:
        """The ground truth."""
        out = np.full(len(scene.values), np.nan)
        scene.observe(world, out)
        return out

    def _poses(self, scene: Scene[Spec, World], world: World) -> Iterator[tuple[str, Vector]]:
        values = self.observed(scene, world)
        for body, first in scene.poses.items():
            yield body, values[first : first + _POSE]

    def test_names_are_unique(self) -> None:
        """No value and no factor has a name twice."""
        scene, _ = self.built()
        for names in (scene.values, scene.factors):
            assert len(set(names)) == len(names), f"a name is there twice: {', '.join(names)}"

    def test_factors_and_values_are_complete(self) -> None:
        """`begin` returns a finite number for each factor, and `observe` writes one for each value."""
        scene, world = self.built()
        factors = self.begin(scene, world, 0)
        assert factors.shape == (len(scene.factors),), f"{factors.shape} for {len(scene.factors)} factors"
        assert np.isfinite(factors).all(), f"a factor is not finite: {dict(zip(scene.factors, factors, strict=True))}"
        values = self.observed(scene, world)
        assert np.isfinite(values).all(), (
            f"`observe` leaves a value out: {dict(zip(scene.values, values, strict=True))}"
        )

    def test_poses_are_poses(self) -> None:
        """Each of `poses` has seven values, the last four of which are a unit quaternion."""
        scene, world = self.built()
        self.begin(scene, world, 0)
        for body, pose in self._poses(scene, world):
            assert pose.shape == (_POSE,), f"{body}: the values end within its pose"
            assert abs(np.linalg.norm(pose[3:]) - 1) < 1e-6, f"{body}: {pose[3:]} is not a unit quaternion"

    def test_equal_seeds_give_equal_episodes(self) -> None:
        """Whatever happened before, and in whichever object, equal seeds give equal factors, states and looks."""
        scene, world = self.built()
        twin, other = self.built()
        states: list[list[Vector]] = []
        for of, there, seeds in ((scene, world, (7, 8, 7)), (twin, other, (7,))):
            for seed in seeds:
                factors = self.begin(of, there, seed)
                if seed == 7:
                    states.append([factors, self.observed(of, there), self.state(there).copy(), self.looks(there)])
                self.advance(there, 0.1)
        for again in states[1:]:
            for a, b in zip(states[0], again, strict=True):
                np.testing.assert_array_equal(a, b)

    def test_factors_stay_within_their_ranges(self) -> None:
        """No episode draws a factor outside the options' range."""
        scene, world = self.built()
        ranges = self.ranges(scene)
        for seed in range(_SEEDS):
            drawn = dict(zip(scene.factors, self.begin(scene, world, seed), strict=True))
            for name, (low, high) in ranges.items():
                assert low - 1e-9 <= drawn[name] <= high + 1e-9, f"{name} is {drawn[name]}, not in [{low}, {high}]"

    def test_factors_cover_their_ranges(self) -> None:
        """Episodes use more than half of each range."""
        scene, world = self.built()
        drawn = np.stack([self.begin(scene, world, seed) for seed in range(_SEEDS)])
        spread = dict(zip(scene.factors, np.ptp(drawn, axis=0), strict=True))
        for name, (low, high) in self.ranges(scene).items():
            assert spread[name] >= 0.5 * (high - low), f"{name} covers {spread[name]:.3g} of [{low}, {high}]"

    def test_fixed_factor_leaves_the_others(self) -> None:
        """Fixing a factor by the options changes no other factor of an episode."""
        ctx = self.context()
        fixed = self.fixed(ctx)
        if fixed is None:
            pytest.skip("its options fix no factor")
        factor, scene = fixed
        free, world = self.built()
        there = self.world(scene, ctx)
        for seed in range(5):
            usual = dict(zip(free.factors, self.begin(free, world, seed).tolist(), strict=True))
            other = dict(zip(scene.factors, self.begin(scene, there, seed).tolist(), strict=True))
            assert {**usual, factor: 0} == {**other, factor: 0}

    def test_show_needs_only_the_factors(self) -> None:
        """`show` gives a fresh world the looks of an episode, and twice gives the same."""
        scene, world = self.built()
        twin, other = self.built()
        for seed in (3, 4):
            factors = self.begin(scene, world, seed)
            for _ in range(2):
                twin.show(other, factors)
                np.testing.assert_array_equal(self.looks(other), self.looks(world))

    def test_objects_rest_at_the_start(self) -> None:
        """Objects neither fall nor are pushed away when an episode begins."""
        scene, world = self.built()
        for seed in range(5):
            self.begin(scene, world, seed)
            before = dict(self._poses(scene, world))
            self.advance(world, self.rest_s)
            for body, pose in self._poses(scene, world):
                moved = float(np.linalg.norm(pose[:3] - before[body][:3]))
                assert moved <= self.rest_m, f"{body} moved by {moved:.4f} m after the start of seed {seed}"

    def test_task_is_not_done_at_the_start(self) -> None:
        """`success` is False when an episode begins and if nobody acts; None for a scene without a task."""
        scene, world = self.built()
        expected: Any = False if self.task else None
        for seed in range(_SEEDS):
            self.begin(scene, world, seed)
            assert scene.success(world) is expected, f"seed {seed} begins with {scene.success(world)}"
        self.advance(world, self.rest_s)
        assert scene.success(world) is expected


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
