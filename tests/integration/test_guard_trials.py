"""`tests/shared/guarded_commands.py` in miniature: commands for an SO-101, judged by MuJoCo's collision detection."""

from __future__ import annotations

import contextlib
from pathlib import Path

import attrs
import guard_trials
import numpy as np
import pytest
from guard_trials import SIZES, Commanders, Judge, Station
from ibrobot_planning.guard.changes import WorldChange
from ibrobot_planning.world.objects import Box, WorldObject

from ibrobot_core.api import JointReading, Pose, Vector3
from ibrobot_core.control.commands import CancelGoals, ClearFaults, Command, EmergencyStop, RaiseFault, SwitchMode
from ibrobot_core.errors import IbrobotError

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Station, Judge]:
    folder: Path = tmp_path_factory.mktemp("arms")
    station = guard_trials.stations(folder)["so101"]
    return station, Judge(station)


def test_no_command_leads_into_contact(judged) -> None:
    station, judge = judged
    result = guard_trials.commanded(station, judge, 0, 120, guarded=True)
    assert (result.commands, result.touched) == (120, 0)
    assert result.kept > -0.001, result.worst


def test_an_operator_gets_out(judged) -> None:
    station, judge = judged
    assert guard_trials.backs_out(station, judge, 0) == ""


def test_while_the_host_is_silent_the_world_stays_known_and_then_the_arm_rests(judged) -> None:
    """As a run's process that hangs: no world, no plan and no state comes; control goes on."""
    station, _ = judged
    loop = guard_trials.ControlLoop(station)
    core = loop._control._core
    loop.world(WorldChange({"wall": WorldObject(Box((0.6, 0.02, 0.4)), Pose(Vector3(0.2, -0.15, 0.2)))}))
    goal = loop.position.copy()
    goal[0] = 1.5
    moved = [loop.tick(goal)[0] for _ in range(20)]
    assert moved[-1] > 0.1
    silent_s, ticks = 0.0, 0
    while not core.fault and ticks < 100:
        loop.tick(goal)  # an executor may have a plan that goes on
        silent_s, ticks = silent_s + 0.01, ticks + 1
        core.note_silence(silent_s, "the host has been silent")
    assert core.fault.startswith("the host has been silent")
    assert ticks <= 30, "peer_timeout is 0.3 s"
    for _ in range(20):
        loop.tick(goal)
    before = loop.position
    assert np.array_equal(loop.tick(goal), before), "it rests until a reset"
    core.handle(ClearFaults())
    loop._generation = core.generation
    at = [loop.tick(goal)[0] for _ in range(150)]
    loop.close()
    assert at[-1] < 1.2, "the wall is still known"


INTERRUPTIONS: tuple[Command, ...] = (
    EmergencyStop(), RaiseFault("a test"), SwitchMode("teleop"), SwitchMode("model_inference"), CancelGoals(),
    ClearFaults(),
)  # fmt: skip


def deepest(station: Station, judge: Judge, seed: int, *, guarded: bool) -> float:
    """How near pairs come beyond what they must keep [m] while stops, modes, resets and bad readings interrupt motions.

    A reset begins where the joints are: from there on, what is too near may come no nearer.
    """
    rng = np.random.default_rng(seed)
    places = {"post": (0.15, 0.2, 0.2), "cube": (0.2, -0.2, 0.03), "wall": (-0.25, 0.0, 0.2)}
    objects = {name: WorldObject(Box(SIZES[name]), Pose(Vector3(*place))) for name, place in places.items()}
    judge.put(objects)
    loop = guard_trials.ControlLoop(station, guarded=guarded)
    core = loop._control._core
    loop.world(WorldChange(objects))
    read, least, begun = core._hardware.read, np.inf, 0.0

    def spoiled() -> JointReading:
        reading = read()
        if rng.random() < 0.03:
            lost = reading.position.copy()
            lost[rng.integers(len(lost))] = rng.choice([np.nan, np.inf, 1e9])
            return attrs.evolve(reading, position=lost)
        return reading

    core._hardware.read = spoiled  # type: ignore[method-assign]
    commanders = Commanders(station, judge, rng)
    for tick in range(400):
        if tick % 100 == 0:
            stream = commanders.stream("leader", loop.position)
        if rng.random() < (0.1 if core.fault else 0.02):
            act = ClearFaults() if core.fault else INTERRUPTIONS[rng.integers(len(INTERRUPTIONS))]
            with contextlib.suppress(IbrobotError):
                loop._control.call(act)
            loop._generation = core.generation
        before = core._safety.current
        if not np.array_equal(before, loop.position):  # a reset
            begun = min(judge.room(before)[1], 0.0)
        least = min(least, judge.along(before, loop.tick(next(stream)))[1] - begun)
    loop.close()
    return float(least)


@pytest.mark.parametrize("seed", range(2))
def test_what_interrupts_a_motion_leads_into_nothing(judged, seed: int) -> None:
    station, judge = judged
    assert deepest(station, judge, seed, guarded=True) > -0.001


def test_without_the_guard_the_same_motion_touches(judged) -> None:
    station, judge = judged
    assert deepest(station, judge, 0, guarded=False) < -0.003
