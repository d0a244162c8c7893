"""The search in a plane with walls."""

from __future__ import annotations

from itertools import pairwise

import attrs
import numpy as np
import pytest
from ibrobot_planning.planners.search import Pace, Space, connect, length, shortened
from ibrobot_planning.planners.timing import timed

from ibrobot_core.api import Vector


@attrs.frozen(eq=False)
class Walls:
    """Rectangles (x0, y0, x1, y1) that a point may not enter."""

    rectangles: tuple[tuple[float, float, float, float], ...]
    reach: Vector = attrs.field(factory=lambda: np.ones(2))

    def first_hit(self, configurations: Vector) -> int:
        for number, (x, y) in enumerate(configurations):
            if any(x0 < x < x1 and y0 < y < y1 for x0, y0, x1, y1 in self.rectangles):
                return number
        return len(configurations)

    def line_free(self, a: Vector, b: Vector, resolution: float) -> bool:
        number = int(np.ceil(np.abs(b - a).sum() / resolution))
        return self.first_hit(np.linspace(a, b, number + 1)[1:]) == number


PACE = Pace(np.full(2, 3.0), np.full(2, 10.0), 0.5)
SLALOM = Walls(((-0.5, -2.0, -0.3, 1.0), (0.3, -1.0, 0.5, 2.0)))
START, GOAL = np.array([-1.0, -1.0]), np.array([1.0, 1.0])


def space(walls: Walls = SLALOM) -> Space:
    return Space(walls, np.full(2, -2.0), np.full(2, 2.0), 0.02)


def never() -> bool:
    return False


def found(goals=(GOAL,), seed: int = 0, walls: Walls = SLALOM) -> list[Vector]:
    path = connect(space(walls), START, goals, np.random.default_rng(seed), never)
    assert path is not None
    return path


@pytest.mark.parametrize("seed", range(5))
def test_paths_are_free_and_get_shorter(seed):
    path = found(seed=seed)
    short = shortened(space(), path, np.random.default_rng(seed), PACE)
    for each in (path, short):
        np.testing.assert_array_equal(each[0], START)
        np.testing.assert_array_equal(each[-1], GOAL)
        for a, b in pairwise(each):
            assert space().free(a, b)
    # Around both corners: (-0.5, 1) to (-0.3, 1), (0.3, -1) to (0.5, -1).
    shortest = 2.0616 + 0.2 + 2.0881 + 0.2 + 2.0616
    assert shortest - 0.01 < length(np.array(short)) < 1.6 * shortest
    assert PACE.time(np.array(short)) < 0.9 * PACE.time(np.array(path))


def test_equal_seeds_give_equal_paths():
    np.testing.assert_array_equal(found(seed=3), found(seed=3))


def test_what_the_memory_held_before_does_not_matter(monkeypatch):
    expected = found()
    signaling_nan = np.array(0x7FF0_0000_0000_0001, np.uint64).view(np.float64)
    monkeypatch.setattr(np, "empty", lambda shape, dtype=float: np.full(shape, signaling_nan, dtype))
    np.testing.assert_array_equal(found(), expected)


def test_a_free_line_is_the_path():
    assert len(found(walls=Walls(()))) == 2


def test_one_of_several_goals_is_reached():
    walled_in = np.array([0.0, 0.0])
    room = Walls(((-0.3, -0.3, 0.3, -0.2), (-0.3, 0.2, 0.3, 0.3), (-0.3, -0.3, -0.2, 0.3), (0.2, -0.3, 0.3, 0.3)))
    path = found((walled_in, GOAL), walls=room)
    np.testing.assert_array_equal(path[-1], GOAL)


def test_an_expired_search_gives_up():
    wall = Walls(((-0.1, -3.0, 0.1, 3.0),))
    calls = iter(range(100))
    assert connect(space(wall), START, [GOAL], np.random.default_rng(0), lambda: next(calls) > 50) is None


@pytest.mark.parametrize("path", [[START, GOAL], [START, [0.0, 1.0], GOAL], [START, [0.0, 1.0], [0.5, -1.0], GOAL]])
def test_the_estimated_time_is_about_that_of_the_motion(path):
    way = np.array(path)
    blends = np.minimum(
        np.minimum(*(np.linalg.norm(np.diff(way, axis=0), axis=1)[i:][: len(way) - 2] for i in (0, 1))) / 2, 0.5
    )
    motion = timed(way, PACE.velocity, PACE.acceleration, blends=blends, window=0.01, step=0.01)
    assert PACE.time(way) == pytest.approx(motion.duration, rel=0.12)


def test_time_of_a_path_with_a_point_twice_is_that_without_it() -> None:
    once, twice = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    assert PACE.time(twice) == pytest.approx(PACE.time(once), abs=1e-5)
    assert PACE.time(np.zeros((2, 2))) == pytest.approx(0.0, abs=1e-6)
