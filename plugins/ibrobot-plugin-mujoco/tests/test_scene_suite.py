"""The scene suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

from typing import Any, override

import numpy as np
import pytest
from ibrobot_mujoco.scene_suite import FakeScene, FakeWorld, SceneSuite
from ibrobot_testing import checks, failed_checks


class Subject(SceneSuite[Any, Any]):
    kind = FakeScene

    @override
    def make(self, ctx):
        return self.kind()

    @override
    def world(self, scene, ctx):
        spec: list[str] = []
        scene.build(spec)
        assert spec == ["ball"]
        return FakeWorld()

    @override
    def state(self, world):
        return np.array([world.x, world.z])

    @override
    def looks(self, world):
        return np.array([world.light])

    @override
    def advance(self, world, duration_s):
        world.advance(duration_s)

    @override
    def ranges(self, scene):
        return {"ball_x": (0.1, 0.5), "light": (0.5, 1.5)}

    @override
    def fixed(self, ctx):
        return "light", self.kind(light=(1.0, 1.0))


class TestFakeScene(Subject):
    pass


class TwoOfOneName(FakeScene):
    values = ("ball.x", "ball.x", "ball.z", "ball.qw", "ball.qx", "ball.qy", "ball.qz")


class LeavesAValueOut(FakeScene):
    def observe(self, world, out):
        out[:2] = world.x, 0.0
        out[3:] = 1.0, 0.0, 0.0, 0.0


class ForgetsAFactor(FakeScene):
    def begin(self, world, rng):
        return super().begin(world, rng)[:1]


class NotAUnitQuaternion(FakeScene):
    def observe(self, world, out):
        super().observe(world, out)
        out[3] = 0.5


class PoseBeyondTheValues(FakeScene):
    poses = {"ball": 3}  # noqa: RUF012


class RandomOfItsOwn(FakeScene):
    def __init__(self, light=(0.5, 1.5)):
        super().__init__(light)
        self._rng = np.random.default_rng()

    def begin(self, world, rng):
        return super().begin(world, self._rng)


class DrawsBeyondItsRange(FakeScene):
    def begin(self, world, rng):
        factors = super().begin(world, rng)
        factors[0] = world.x = 1.5 * world.x
        return factors


class AlwaysTheSamePlace(FakeScene):
    def begin(self, world, rng):
        factors = super().begin(world, rng)
        factors[0] = world.x = 0.3
        return factors


class DrawsOnlyWhatIsFree(FakeScene):
    def begin(self, world, rng):
        if self._light[0] < self._light[1]:
            rng.random()
        return super().begin(world, rng)


class ShowsNothing(FakeScene):
    def begin(self, world, rng):
        factors = super().begin(world, rng)
        world.light = float(factors[1])
        return factors

    def show(self, world, factors):
        pass


class BrightensEachTime(FakeScene):
    def show(self, world, factors):
        world.light = world.light / 2 + float(factors[1])


class FallsAtTheStart(FakeScene):
    def begin(self, world, rng):
        factors = super().begin(world, rng)
        world.z = 0.2
        return factors


class DoneAtTheStart(FakeScene):
    def success(self, world):
        return world.x > 0.45


class HasNoVerdict(FakeScene):
    def success(self, world):
        return None


WRONG: list[tuple[Any, set[str]]] = [
    (TwoOfOneName, {"names_are_unique"}),
    (LeavesAValueOut, {"factors_and_values_are_complete"}),
    (ForgetsAFactor, {"factors_and_values_are_complete"}),
    (NotAUnitQuaternion, {"poses_are_poses"}),
    (PoseBeyondTheValues, {"poses_are_poses"}),
    (RandomOfItsOwn, {"equal_seeds_give_equal_episodes"}),
    (DrawsBeyondItsRange, {"factors_stay_within_their_ranges"}),
    (AlwaysTheSamePlace, {"factors_cover_their_ranges"}),
    (DrawsOnlyWhatIsFree, {"fixed_factor_leaves_the_others"}),
    (ShowsNothing, {"show_needs_only_the_factors"}),
    (BrightensEachTime, {"show_needs_only_the_factors"}),
    (FallsAtTheStart, {"objects_rest_at_the_start"}),
    (DoneAtTheStart, {"task_is_not_done_at_the_start"}),
    (HasNoVerdict, {"task_is_not_done_at_the_start"}),
]


@pytest.mark.parametrize(("wrong", "caught"), WRONG, ids=lambda value: getattr(value, "__name__", ""))
def test_each_mistake_is_caught(wrong: Any, caught: set[str], tmp_path: Any) -> None:
    class Wrong(Subject):
        kind = wrong

    assert caught <= failed_checks(Wrong, tmp_path)


def test_every_check_catches_something() -> None:
    assert set().union(*(caught for _, caught in WRONG)) == checks(Subject)
