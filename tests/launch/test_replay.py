"""Mode `replay`: the commands of an episode, played once, through executors and the safety layer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import attrs
import numpy as np
import pytest

from ibrobot_core.launch.runtime import ESTOP, Runtime
from ibrobot_core.launch.sources.replay import MODE, Replay, ReplaySource
from ibrobot_core.recording.playback import Playback, Track

if TYPE_CHECKING:
    from conftest import Runs

ADDED = f"control_modes.{MODE}={{executors: [arm_position, grip_position]}}"
TIMES = np.arange(51) * 0.02
WAVE = Playback(
    ("pan", "grip"), Track(TIMES, np.stack([0.2 * np.cos(3 * TIMES), 0.1 * TIMES], axis=1)), None, "success", 7
)


def replay(runs: Runs, playback: Playback = WAVE, *, speed: float = 1.0, **asked: Any) -> Runtime:
    return runs.make(ADDED, mode=MODE, replay=Replay("wave", playback, speed), **asked)


def commands(runtime: Runtime) -> np.ndarray:
    """What the joints were told at every tick of the run, shape (ticks, 2)."""
    runtime.start()
    found = []
    ended = False
    while not ended:
        assert len(found) < 1000
        ended = runtime.step()
        assert runtime.session.state is not None
        found.append(runtime.session.state.command)
    return np.array(found)


def report(runtime: Runtime) -> dict[str, Any]:
    source = runtime.plan.mode.source
    assert isinstance(source, ReplaySource)
    return source.report()


def test_the_commands_are_those_of_the_episode_after_a_slow_way_to_the_first(runs: Runs):
    told = commands(replay(runs))
    first = next(i for i, command in enumerate(told) if np.allclose(command, WAVE.commands.positions[0], atol=1e-9))
    np.testing.assert_allclose(told[first : first + 51], WAVE.commands.positions, atol=1e-9)
    assert np.abs(np.diff(told[: first + 1], axis=0)).max() < 0.5 / 50 + 1e-9
    assert len(told) - first <= 52, "it ends by itself"


@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_speed_scales_the_times(runs: Runs, speed: float):
    told = commands(replay(runs, speed=speed))
    first = next(i for i, command in enumerate(told) if np.allclose(command, WAVE.commands.positions[0], atol=1e-9))
    assert len(told) - first == pytest.approx(50 / speed, abs=2)
    np.testing.assert_allclose(told[-1], WAVE.commands.positions[-1], atol=0.01)


def test_the_safety_layer_bounds_it(runs: Runs):
    far = attrs.evolve(WAVE, commands=Track(TIMES, np.stack([0.4 + 3 * TIMES, 0 * TIMES], axis=1)))
    told = commands(replay(runs, far))
    assert told.max() <= 1.0
    assert np.abs(np.diff(told, axis=0)).max() <= 2.0 / 50 + 1e-9


def test_the_scene_is_set_up_by_the_recorded_seed_and_judged(runs: Runs):
    runtime = replay(runs)
    commands(runtime)
    assert runs.parts.MADE["simulation"].seed == 7
    assert (report(runtime)["success"], runtime.summary()["successes"]) == (True, 1)


def test_a_scene_that_does_not_succeed_again_is_reported(runs: Runs):
    runtime = replay(runs, attrs.evolve(WAVE, seed=13))
    commands(runtime)
    summary = runtime.summary()
    assert (report(runtime)["success"], summary["episodes"], summary["successes"]) == (False, 1, 0)


def test_tracking_is_the_difference_to_the_recorded_states(runs: Runs):
    first = replay(runs)
    commands(first)
    source = first.plan.mode.source
    assert isinstance(source, ReplaySource)
    stamps, positions = zip(*source._measured, strict=True)
    states = Track(np.array(stamps) * 1e-9, np.array(positions))
    again = replay(runs, attrs.evolve(WAVE, states=states))
    commands(again)
    assert max(each["max_rad"] for each in report(again)["tracking"].values()) < 1e-6
    shifted = Track(states.times, states.positions + np.array([0.25, np.nan]))
    other = replay(runs, attrs.evolve(WAVE, states=shifted))
    commands(other)
    assert report(other)["tracking"] == {"pan": pytest.approx({"rms_rad": 0.25, "max_rad": 0.25}, abs=1e-6)}


def test_a_fault_ends_it(runs: Runs):
    runtime = replay(runs)
    runtime.start()
    for _ in range(20):
        runtime.step()
    runtime.session.bus.call(ESTOP, None)
    steps = 0
    while not runtime.step():
        steps += 1
        assert steps < 5
    assert runtime.summary()["episodes"] == 0


def test_a_host_that_is_held_up_cuts_nothing_out(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    runtime = replay(runs, attrs.evolve(WAVE, commands=Track(TIMES * 4, WAVE.commands.positions)))
    source = runtime.plan.mode.source
    work, units = source.work, iter(range(1000))

    def held_up(timeout_s: float) -> None:
        if not 100 <= next(units) < 250:
            work(timeout_s)

    monkeypatch.setattr(source, "work", held_up)
    told = commands(runtime)
    first = next(i for i, command in enumerate(told) if np.allclose(command, WAVE.commands.positions[0], atol=1e-9))
    assert first < 100
    way = np.abs(np.diff(WAVE.commands.positions, axis=0)).max(axis=0) / 4
    assert (np.abs(np.diff(told[first:], axis=0)) <= 1.5 * way).all(), "it goes on from where it stood, with no jump"
    assert 200 + 80 < len(told) - first < 200 + 150
    np.testing.assert_allclose(told[-1], WAVE.commands.positions[-1], atol=1e-9)


def test_in_real_time_a_motion_longer_than_what_control_is_given_at_once_is_played_whole(runs: Runs):
    # It ends with seconds at rest: a process that is held up on the way has the time to catch up.
    times, positions = np.append(TIMES * 1.5, 6.0), WAVE.commands.positions[[*range(len(TIMES)), -1]]
    long = attrs.evolve(WAVE, commands=Track(times, positions))
    runtime = replay(runs, long, lockstep=False, sim=False)
    runtime.start()
    assert runtime.session.finished.wait(60)
    runtime.stop()
    runtime.raise_failure()
    assert runtime.session.state is not None
    np.testing.assert_allclose(runtime.session.state.command, WAVE.commands.positions[-1], atol=0.02)
