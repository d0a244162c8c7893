"""A replay: the commands of an episode, played once, through executors and the safety layer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_data.playback import Playback, Track
from ibrobot_data.replay_source import ReplaySource
from ibrobot_testing.site import made_up_site

from ibrobot_core.api import Vector
from ibrobot_core.app import LaunchRequest, Runtime, Session, StreamingRun, installed_plugins, load_config

ROBOT = """\
robot:
  name: mini
  joints:
    - {name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
    - {name: grip, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
  groups: {arm: [pan], gripper: [grip]}
hardware: {type: arm}
simulation: {type: scene}
executors:
  arm_position: {type: position, group: arm}
  grip_position: {type: position, group: gripper}
control_modes:
  replay: {executors: [arm_position, grip_position]}
  idle: {executors: [arm_position]}
default_control_mode: replay
control: {rate_hz: 50, stop: hold}
"""
TIMES: Vector = np.linspace(0.0, 1.0, 51)
WAVE = Playback(
    ("pan", "grip"), Track(TIMES, np.stack([0.2 * np.cos(3 * TIMES), 0.1 * TIMES], axis=1)), None, "success", 7
)
Make = Callable[..., Runtime]


@pytest.fixture
def replay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Makes runs that replay something; stops those that a test leaves running."""
    made: list[Runtime] = []
    path = tmp_path / "mini.yaml"
    path.write_text(ROBOT)

    def make(playback: Playback = WAVE, *, speed: float = 1.0, simulated: bool = True) -> Runtime:
        def source(session: StreamingRun, mode: Any) -> ReplaySource:
            return ReplaySource(session, mode, "wave", playback, speed)

        registry = installed_plugins()
        config = load_config(path, sim=simulated, registry=registry)
        made.append(Runtime(Session(config, registry, LaunchRequest(lockstep=simulated, source=source))))
        return made[-1]

    with made_up_site(tmp_path / "site", Path(__file__).parent, monkeypatch) as site:
        site.add("arms", "arms.py")
        yield make
        for runtime in made:
            runtime.stop()


def source_of(runtime: Runtime) -> ReplaySource:
    source = runtime.session.command_source
    assert isinstance(source, ReplaySource)
    return source


def commands(runtime: Runtime) -> np.ndarray:
    """The setpoints of the joints at every tick of the run, shape (ticks, 2)."""
    runtime.start()
    found: list[Vector] = []
    ended = False
    while not ended:
        assert len(found) < 1000
        ended = runtime.step()
        assert runtime.session.state is not None
        found.append(runtime.session.state.command)
    return np.array(found)


def report(runtime: Runtime) -> dict[str, Any]:
    found: dict[str, Any] = runtime.summary()["replay"]
    return found


def test_commands_follow_a_slow_approach_to_the_first(replay: Make):
    commanded = commands(replay())
    first = next(
        i for i, command in enumerate(commanded) if np.allclose(command, WAVE.commands.positions[0], atol=1e-9)
    )
    np.testing.assert_allclose(commanded[first : first + 51], WAVE.commands.positions, atol=1e-9)
    assert np.abs(np.diff(commanded[: first + 1], axis=0)).max() < 0.5 / 50 + 1e-9
    assert len(commanded) - first <= 52, "it ends by itself"


def test_steps_are_followed_at_every_tick(replay: Make):
    ticks = np.arange(51)
    pan = 0.003 * (ticks // 10)  # steps that the limits allow
    grip = 0.003 * (ticks >= 35)
    commanded = commands(replay(attrs.evolve(WAVE, commands=Track(TIMES, np.stack([pan, grip], axis=1)))))
    np.testing.assert_allclose(commanded[-51:], np.stack([pan, grip], axis=1), atol=1e-9)


@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_speed_scales_the_times(replay: Make, speed: float):
    commanded = commands(replay(speed=speed))
    first = next(
        i for i, command in enumerate(commanded) if np.allclose(command, WAVE.commands.positions[0], atol=1e-9)
    )
    assert len(commanded) - first == pytest.approx(50 / speed, abs=2)
    np.testing.assert_allclose(commanded[-1], WAVE.commands.positions[-1], atol=0.01)


def test_the_safety_layer_limits_the_replay(replay: Make):
    far = attrs.evolve(WAVE, commands=Track(TIMES, np.stack([0.4 + 3 * TIMES, 0 * TIMES], axis=1)))
    commanded = commands(replay(far))
    assert commanded.max() <= 1.0
    assert np.abs(np.diff(commanded, axis=0)).max() <= 2.0 / 50 + 1e-9


def test_the_scene_is_set_up_by_the_recorded_seed_and_judged(replay: Make):
    runtime = replay()
    commands(runtime)
    assert (report(runtime)["success"], runtime.summary()["successes"]) == (True, 1)


def test_a_scene_that_does_not_succeed_again_is_reported(replay: Make):
    runtime = replay(attrs.evolve(WAVE, seed=13))
    commands(runtime)
    summary = runtime.summary()
    assert (report(runtime)["success"], summary["episodes"], summary["successes"]) == (False, 1, 0)


def test_tracking_is_the_difference_to_the_recorded_states(replay: Make):
    first = replay()
    commands(first)
    stamps: Any
    stamps, positions = zip(*source_of(first)._measured, strict=True)
    states = Track(np.array(stamps) * 1e-9, np.array(positions))
    again = replay(attrs.evolve(WAVE, states=states))
    commands(again)
    assert max(each["max_rad"] for each in report(again)["tracking"].values()) < 1e-6
    shifted = Track(states.times, states.positions + np.array([0.25, np.nan]))
    other = replay(attrs.evolve(WAVE, states=shifted))
    commands(other)
    assert report(other)["tracking"] == {"pan": pytest.approx({"rms_rad": 0.25, "max_rad": 0.25}, abs=1e-6)}


def test_a_fault_ends_the_replay(replay: Make):
    runtime = replay()
    runtime.start()
    for _ in range(20):
        runtime.step()
    runtime.session.bus.call("/estop", None)
    steps = 0
    while not runtime.step():
        steps += 1
        assert steps < 5
    assert runtime.summary()["episodes"] == 0


def test_a_delayed_host_skips_no_setpoints(replay: Make, monkeypatch: pytest.MonkeyPatch):
    runtime = replay(attrs.evolve(WAVE, commands=Track(TIMES * 4, WAVE.commands.positions)))
    source = source_of(runtime)
    work, units = source.work, iter(range(1000))

    def held_up(timeout_s: float) -> None:
        if not 100 <= next(units) < 250:
            work(timeout_s)

    monkeypatch.setattr(source, "work", held_up)
    commanded = commands(runtime)
    first = next(
        i for i, command in enumerate(commanded) if np.allclose(command, WAVE.commands.positions[0], atol=1e-9)
    )
    assert first < 100
    way = np.abs(np.diff(WAVE.commands.positions, axis=0)).max(axis=0) / 4
    assert (np.abs(np.diff(commanded[first:], axis=0)) <= 1.5 * way).all(), (
        "it goes on from where it stood, with no jump"
    )
    assert 200 + 80 < len(commanded) - first < 200 + 150
    np.testing.assert_allclose(commanded[-1], WAVE.commands.positions[-1], atol=1e-9)


def test_motion_longer_than_one_plan_is_played_in_full(replay: Make):
    # It ends with seconds at rest: a process that is held up on the way has the time to catch up.
    times: Vector = np.append(TIMES * 1.5, 6.0)
    positions = WAVE.commands.positions[[*range(len(TIMES)), -1]]
    long = attrs.evolve(WAVE, commands=Track(times, positions))
    runtime = replay(long, simulated=False)
    runtime.start()
    assert runtime.session.finished.wait(60)
    runtime.stop()
    runtime.raise_failure()
    assert runtime.session.state is not None
    np.testing.assert_allclose(runtime.session.state.command, WAVE.commands.positions[-1], atol=0.02)
