"""States of control in which the joints did not answer: no message on /joint_states, but a tick for all who act."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np
import pytest
from ibrobot_testing.fakes import FakeHardware

from ibrobot_core.interfaces import JointReading, TeleopCommand
from ibrobot_core.interfaces.run_state import ControlState

if TYPE_CHECKING:
    from fake_runs import Runs


@pytest.fixture
def mute(runs: Runs):
    """Call it to let the joints of the scene repeat one state from now on, or no more."""

    def muted(on: bool) -> None:
        last: list[JointReading] = []

        def read(scene) -> JointReading:
            last[:] = last or [FakeHardware.read(scene)]
            return attrs.evolve(last[0], stale=True)

        runs.parts.Scene.read = read if on else FakeHardware.read

    return muted


def test_a_state_that_was_not_read_is_no_message(runs: Runs, mute) -> None:
    run = runs.start("control.state_timeout=10", mode="idle")
    states = run.session.bus.subscribe("/joint_states", 1000)
    commands = run.session.bus.subscribe("/arm/commands", 1000)
    signals = run.session.bus.subscribe("/fake/command", 1000)
    run.step()
    mute(True)
    for _ in range(20):
        run.step()
    assert (len(states.drain()), len(signals.drain())) == (1, 1), "nor is a signal"
    assert len(commands.drain()) == 21, "what the robot is told is published all the same"
    mute(False)
    run.step()
    messages: list[Any] = [item.message for item in states.drain()]
    stamps = [message.header.stamp_ns for message in messages]
    assert stamps == [run.session.clock.now_ns()]


def test_a_frame_lacks_a_state_older_than_the_contract_allows(runs: Runs, mute) -> None:
    """The policy is not asked with a frozen state; with a longer limit it is."""
    for max_age, asks in ((0.1, False), (5.0, True)):
        run = runs.start(
            "control.state_timeout=10", f"contract.max_age={max_age}", "contract.max_duration_s=9", seed=13
        )
        for _ in range(10):
            run.step()
        mute(True)
        for _ in range(10):
            run.step()
        acting: Any = run.session.acting
        before = acting.dispatch.requests
        for _ in range(60):
            run.step()
        assert (acting.dispatch.requests > before) is asks
        mute(False)
        run.stop()


def test_a_device_can_stop_a_robot_whose_joints_do_not_answer(runs: Runs, mute) -> None:
    run = runs.start("control.state_timeout=10", mode="teleop")
    run.step()
    mute(True)
    for _ in range(5):
        run.step()
    runs.parts.Stick.read = lambda stick, measured: TeleopCommand(None, estop=True)
    run.step()
    run.step()
    assert run.session.state is not None
    assert run.session.state.estop


def state(tick: int) -> ControlState:
    none = np.zeros(2)
    return ControlState(tick, tick, 0, 0, False, False, None, none, none, none, none, none)


def test_watching_gives_the_newest_state_once(runs: Runs) -> None:
    session = runs.make(mode="idle").session
    session.take_state(state(1))
    watch = session.watch_states()
    assert watch.get() is None, "it came before"
    session.take_state(state(2))
    session.take_state(state(3))
    newest = watch.get(5.0)
    assert newest is not None
    assert newest.tick == 3
    assert watch.get() is None


def test_a_new_state_wakes_who_waits(runs: Runs) -> None:
    session = runs.make(mode="idle").session
    got: list[Any]
    watch, got = session.watch_states(), []
    waiting = threading.Thread(target=lambda: got.append(watch.get(30.0)))
    waiting.start()
    session.take_state(state(1))
    waiting.join(30.0)
    assert [each.tick for each in got] == [1]
