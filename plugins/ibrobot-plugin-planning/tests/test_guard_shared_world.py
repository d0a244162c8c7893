"""Another run's arm on the same table, as an object that the other run adds, moves and takes away by services."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ibrobot_planning.guard.feed import GuardFeed
from ibrobot_planning.world.options import WorldOptions
from ibrobot_planning.world.section import WorldKeeper
from ibrobot_testing import make_session

from ibrobot_core.api import PlanningError, SteppedClock, Vector, ns

from .table_arm import make_robot
from .test_guard import ACROSS, LEFT, Loop

SIZE = (0.4, 0.02, 0.3)
MAX_AGE_S = 0.2
ON_THE_WAY, ASIDE = (0.35, 0.0, 0.15), (0.35, -0.5, 0.15)


class Table:
    """This run's arm, guarded, and the services by which the other run says where its arm is."""

    def __init__(self, folder: Path) -> None:
        self.loop = Loop(folder, LEFT)
        session = make_session(robot=make_robot(folder))
        clock = session.clock
        assert isinstance(clock, SteppedClock)
        self.clock, self.call = clock, session.bus.call
        self.keeper = WorldKeeper(WorldOptions(), session)
        self.keeper.start()
        told = SimpleNamespace(bus=session.bus, change_world=self.loop.guard.world)
        self.feed = GuardFeed(told)

    def add(self, position: tuple[float, ...] = ASIDE, **more: Any) -> None:
        thing = {"shape": "box", "size": SIZE, "position": position, "max_age": MAX_AGE_S}
        self.call("/world/add", {"name": "neighbour", "object": thing, **more})

    def move(self, position: tuple[float, ...]) -> None:
        self.call("/world/move", {"name": "neighbour", "position": position})

    def tick(self, wanted: Vector) -> Vector:
        self.clock.advance(ns(0.01))
        self.feed._update()
        return self.loop.tick(wanted)

    def go(self, wanted: Vector, ticks: int, neighbour: tuple[float, ...] | None = None) -> Vector:
        """Ticks, in each of which the other run says where its arm is, unless it is gone."""
        for _ in range(ticks):
            if neighbour is not None:
                self.move(neighbour)
            at = self.tick(wanted)
        return at


@pytest.fixture
def table(tmp_path) -> Iterator[Table]:
    made = Table(tmp_path)
    yield made
    made.keeper.stop()


def test_where_the_other_arm_is_counts_from_the_next_tick_on(table) -> None:
    table.add()
    for place, blocks in ((ASIDE, False), (ON_THE_WAY, True), (ASIDE, False)):
        table.go(LEFT, 200, ASIDE)
        table.move(place)
        table.tick(LEFT)
        guard = table.loop.guard
        (part,) = (each for each in guard._pairs.parts if "neighbour" in each.objects)
        assert (
            part.geometry.geometryObjects[len(part.geometry.geometryObjects) - 1].placement.translation[1] == place[1]
        )
        assert bool(table.go(ACROSS, 120, place)[0] > 0) is blocks


def test_another_run_that_crashes_holds_this_arm_until_it_comes_back(table) -> None:
    table.add(ON_THE_WAY)
    table.go(ACROSS, 10, ON_THE_WAY)
    held = table.go(ACROSS, 60)
    np.testing.assert_array_equal(table.go(LEFT, 30), held)
    assert "'neighbour' is 0." in table.loop.guard.overruled
    assert table.go(LEFT, 120, ON_THE_WAY) == pytest.approx(LEFT)
    assert table.go(ACROSS, 120, ON_THE_WAY)[0] > 0, "and its arm is avoided as before"


def test_another_run_that_ends_in_order_frees_the_way(table) -> None:
    table.add(ON_THE_WAY)
    assert table.go(ACROSS, 120, ON_THE_WAY)[0] > 0
    table.call("/world/remove", {"name": "neighbour"})
    assert table.go(ACROSS, 120) == pytest.approx(ACROSS)


def test_another_run_that_starts_again_finds_its_arm_there_and_replaces_it(table) -> None:
    table.add(ON_THE_WAY)
    table.go(ACROSS, 60)
    with pytest.raises(PlanningError, match="there is an object 'neighbour' already"):
        table.add(ASIDE)
    table.add(ON_THE_WAY, replace=True)
    assert table.go(ACROSS, 120, ON_THE_WAY)[0] > 0
    assert table.go(ACROSS, 200, ASIDE) == pytest.approx(ACROSS)
