"""Episodes: counted, judged, and reported to plugins."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from fake_runs import finish, seconds

from ibrobot_core.errors import NotSupported
from ibrobot_core.launch.runtime import ESTOP, RESET

if TYPE_CHECKING:
    from fake_runs import Runs
    from ibrobot_testing.site import Site


def test_episodes_count_up_their_seeds_and_are_announced_to_plugins(runs: Runs):
    runtime = runs.start(episodes=3, seed=5)
    finish(runtime)
    summary = runtime.summary()
    assert (summary["episodes"], summary["successes"]) == (3, 3)
    assert [
        event for number in (1, 2, 3) for event in (("started", number, "policy"), ("ended", number, "success"))
    ] == runs.parts.EVENTS
    assert runs.parts.MADE["net"].seeds == (5, 6, 7)


def test_one_that_is_not_done_in_time_fails(runs: Runs):
    runtime = runs.start(episodes=3, seed=12)
    finish(runtime)
    summary = runtime.summary()
    assert (summary["episodes"], summary["successes"]) == (3, 2)
    assert [event[2] for event in runs.parts.EVENTS if event[0] == "ended"] == ["success", "failure", "success"]


def test_one_fails_in_time_though_the_hardware_is_silent(runs: Runs):
    runtime = runs.start(episodes=1)
    seconds(runtime, 0.2)
    runs.parts.MADE["simulation"].broken = True
    finish(runtime)
    assert runtime.summary()["successes"] == 0
    assert [event[0] for event in runs.parts.EVENTS] == ["started", "fault", "ended"]


def test_the_next_episode_waits_for_the_reset_of_an_emergency_stop(runs: Runs):
    runtime = runs.start(episodes=2)
    seconds(runtime, 0.2)
    runtime.session.bus.call(ESTOP, None)
    seconds(runtime, 3.0)
    assert runtime.session.state is not None
    assert runtime.session.state.estop
    assert [event for event in runs.parts.EVENTS if event[0] != "fault"] == [
        ("started", 1, "policy"),
        ("ended", 1, "failure"),
    ]
    runtime.session.bus.call(RESET, None)
    seconds(runtime, 0.5)
    assert len(runs.parts.EVENTS) == 3, "nor does the reset alone begin it"
    runtime.switch_mode("policy")
    finish(runtime)
    summary = runtime.summary()
    # The episode that was stopped is none of the two.
    assert (summary["episodes"], summary["successes"], summary["disturbed"]) == (3, 2, 1)


def test_a_success_after_a_fault_is_a_failure(runs: Runs):
    runtime = runs.start(mode="teleop")
    runtime.session.raise_fault("the gripper is stuck")
    seconds(runtime, 0.1)
    runtime.session.bus.call(RESET, None)
    runtime.session.episodes.end("success")
    assert runs.parts.EVENTS[-1] == ("ended", 1, "failure")
    summary = runtime.summary()
    assert (summary["episodes"], summary["successes"], summary["disturbed"]) == (1, 0, 1)
    runtime.session.episodes.begin()
    runtime.session.episodes.end("success")
    assert runs.parts.EVENTS[-1] == ("ended", 2, "success"), "a fault counts for its own episode"
    runtime.stop()


def test_a_mode_without_simulated_episodes_is_one_that_ends_with_the_run(runs: Runs):
    runtime = runs.start(mode="teleop", duration_s=0.2)
    assert runs.parts.EVENTS == [("started", 1, "teleop")]
    finish(runtime)
    assert runs.parts.EVENTS == [("started", 1, "teleop"), ("ended", 1, "unknown")]
    assert runtime.summary()["episodes"] == 0


def test_an_episode_that_the_end_of_the_run_cuts_short_is_unknown(runs: Runs):
    runtime = runs.start(duration_s=0.2)
    finish(runtime)
    assert runs.parts.EVENTS == [("started", 1, "policy"), ("ended", 1, "unknown")]


def test_a_mode_switch_begins_an_episode(runs: Runs):
    runtime = runs.start()
    seconds(runtime, 0.2)
    runtime.switch_mode("teleop")
    runtime.stop()
    assert runs.parts.EVENTS == [
        ("started", 1, "policy"),
        ("ended", 1, "unknown"),
        ("mode", "policy", "teleop"),
        ("started", 2, "teleop"),
        ("ended", 2, "unknown"),
    ]


def test_an_observer_that_raises_stops_nothing(runs: Runs, site: Site, caplog: pytest.LogCaptureFixture):
    site.add("angry-observer", "angry_observer.py")
    runtime = runs.start(episodes=2)
    finish(runtime)
    assert runtime.summary()["successes"] == 2
    assert len(runs.parts.EVENTS) == 4
    assert caplog.text.count("'angry_observer' failed in ibrobot_episode_started: ValueError: not again") == 2


@pytest.mark.parametrize(("mode", "sim"), [("teleop", True), (None, False)])
def test_a_count_of_episodes_is_refused_where_there_are_none(runs: Runs, mode: str | None, sim: bool):
    with pytest.raises(NotSupported, match="--episodes counts a policy's episodes in simulation"):
        runs.make(mode=mode, sim=sim, lockstep=sim, episodes=1)


def test_counters_are_reported_during_a_run_in_lockstep(runs: Runs):
    runtime = runs.start(episodes=1)
    seconds(runtime, 0.5)
    report = runtime.session.control.report
    assert report["loop"]["ticks"] > 0
    assert "safety" in report["counters"]
