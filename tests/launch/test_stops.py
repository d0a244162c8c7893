"""Emergency stops of a run: they reach control at any time, and no request made before them undoes them."""

from __future__ import annotations

import queue
import threading
import time
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np
import pytest

from ibrobot_core.control.commands import Command, EmergencyStop, ResetEpisode
from ibrobot_core.errors import ComponentFailed, HardwareError, NotSupported, TeleopError, TransportError
from ibrobot_core.launch.runtime import CHECK_ESTOP, ESTOP, RESET, SET_MODE, Runtime

if TYPE_CHECKING:
    from collections.abc import Callable

    from fake_runs import Runs

PATIENCE_S = 30.0
AFTER = "refused, an emergency stop came after it was requested"


def steps(run: Runtime, count: int = 30) -> None:
    for _ in range(count):
        run.step()


def stop(run: Runtime) -> None:
    """Stop the robot, and wait until it has braked."""
    run.session.bus.call(ESTOP, None)
    steps(run)


def is_stopped(run: Runtime) -> bool:
    run.step()
    assert run.session.state is not None
    return run.session.state.estop


@pytest.fixture
def teleop(runs: Runs) -> Runtime:
    """A robot that its operator moves."""
    runtime = runs.start("control_modes.teleop.teleop=lever", mode="teleop")
    lever = runs.parts.MADE["lever"]
    lever.velocity = 0.5
    lever.press()
    steps(runtime)
    return runtime


class TestReset:
    def test_knows_of_all_stops_at_the_time_of_the_request(self, teleop: Runtime):
        stop(teleop)
        teleop.reset()
        assert not is_stopped(teleop)

    def test_of_a_sender_that_did_not_know_of_the_last_stop_is_refused(self, teleop: Runtime):
        stop(teleop)
        with pytest.raises(HardwareError, match=f"reset: {AFTER}"):
            teleop.session.bus.call(RESET, {"stops": 0})
        assert is_stopped(teleop)
        teleop.session.bus.call(RESET, {"stops": teleop.session.stops})
        assert not is_stopped(teleop)

    def test_does_not_erase_a_stop_that_comes_while_a_device_recovers(self, teleop: Runtime, monkeypatch):
        stop(teleop)
        monkeypatch.setattr(teleop.session.command_source, "recover", teleop.session.emergency_stop)
        with pytest.raises(HardwareError, match=f"reset: {AFTER}"):
            teleop.reset()
        assert is_stopped(teleop)

    def test_after_which_the_mode_cannot_begin_leaves_the_robot_stopped(self, teleop: Runtime, monkeypatch):
        stop(teleop)

        def begin(seed: int) -> None:
            raise TeleopError("the lever is gone")

        with monkeypatch.context() as patched:
            patched.setattr(teleop.session.command_source, "begin", begin)
            with pytest.raises(TeleopError):
                teleop.reset()
        steps(teleop)
        assert teleop.session.faults == ("mode teleop does not start over: the lever is gone",)
        teleop.reset()
        assert not teleop.session.faults

    def test_that_control_refuses_does_not_end_a_mode_that_moves(self, teleop: Runtime, monkeypatch):
        monkeypatch.setattr(teleop.session, "command", lambda do, **_: (_ for _ in ()).throw(HardwareError("not now")))
        with pytest.raises(HardwareError, match="not now"):
            teleop.reset()
        source: Any = teleop.session.command_source
        assert source.active


class TestSending:
    def test_a_stop_that_cannot_be_sent_makes_the_robot_hold_and_ends_the_run(self, teleop: Runtime, monkeypatch):
        call = teleop.session.control.call

        def short_of_memory(command: Command) -> Any:
            if isinstance(command, EmergencyStop):
                raise MemoryError
            return call(command)

        monkeypatch.setattr(teleop.session.control, "call", short_of_memory)
        with pytest.raises(MemoryError):
            teleop.session.bus.call(ESTOP, None)
        assert teleop.session.finished.is_set()
        assert teleop.session.failure is not None
        assert teleop.session.failure[0] == "emergency stop"
        steps(teleop, 1)
        assert "an emergency stop could not be sent" in teleop.session.faults[-1]

    def test_a_refusal_of_control_does_not_end_the_run(self, teleop: Runtime, monkeypatch):
        monkeypatch.setattr(teleop.session.control, "call", lambda do: (_ for _ in ()).throw(HardwareError("no")))
        with pytest.raises(HardwareError):
            teleop.session.emergency_stop()
        assert not teleop.session.finished.is_set()

    def test_the_check_goes_to_control_and_stops_nothing(self, teleop: Runtime, monkeypatch):
        teleop.session.bus.call(CHECK_ESTOP, None)
        assert not is_stopped(teleop)
        assert teleop.session.stops == 0
        monkeypatch.setattr(teleop.session.control, "call", lambda do: (_ for _ in ()).throw(ComponentFailed("gone")))
        with pytest.raises(ComponentFailed):
            teleop.session.bus.call(CHECK_ESTOP, None)


class TestModes:
    def test_are_refused_while_the_robot_is_stopped(self, teleop: Runtime):
        stop(teleop)
        with pytest.raises(HardwareError, match="mode idle: refused before a reset: emergency stop"):
            teleop.session.bus.call(SET_MODE, "idle")

    def test_that_load_while_a_stop_comes_are_not_entered(self, runs: Runs, monkeypatch):
        runtime = runs.start(mode="teleop")
        monkeypatch.setattr(runs.parts.Net, "load", lambda net: runtime.session.emergency_stop())
        with pytest.raises(HardwareError, match="refused before a reset: emergency stop"):
            runtime.switch_mode("policy")
        assert runtime.session.mode == "teleop"


class Turns:
    """The lock of a run, which counts those who have asked for it."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self.asked = 0
        self.acquire, self.release = self._lock.acquire, self._lock.release

    def __enter__(self) -> None:
        self.asked += 1
        self._lock.acquire()

    def __exit__(self, *error: object) -> None:
        self._lock.release()


@attrs.define
class Slow:
    """A run whose policy loads until a test lets it go on."""

    run: Runtime
    turns: Turns = attrs.field(factory=Turns)
    loaded: threading.Event = attrs.field(factory=threading.Event)
    raised: queue.SimpleQueue[str] = attrs.field(factory=queue.SimpleQueue)

    def concurrently(self, *acts: Callable[[], object], meanwhile: Callable[[], object] = lambda: None) -> list[str]:
        """Let threads act, each after the one before has asked for its turn; returns what was raised."""
        session: Any = self.run.session
        session.changing = self.turns
        threads = [threading.Thread(target=self._act, args=(each,)) for each in acts]
        deadline_s = time.monotonic() + PATIENCE_S
        for number, thread in enumerate(threads, 1):
            thread.start()
            while self.turns.asked < number:
                assert time.monotonic() < deadline_s
                time.sleep(0.001)
        meanwhile()
        self.loaded.set()
        for thread in threads:
            thread.join(PATIENCE_S)
            assert not thread.is_alive()
        found = []
        while not self.raised.empty():
            found.append(self.raised.get())
        return found

    def _act(self, act: Callable[[], object]) -> None:
        try:
            act()
        except Exception as error:  # noqa: BLE001 - the test compares all that was raised
            self.raised.put(str(error))


class TestOneAtATime:
    @pytest.fixture
    def slow(self, runs: Runs, monkeypatch) -> Slow:
        slow = Slow(runs.start(mode="teleop"))
        monkeypatch.setattr(runs.parts.Net, "load", lambda net: slow.loaded.wait(PATIENCE_S))
        return slow

    def test_mode_switches_wait_for_one_another(self, slow: Slow):
        run = slow.run
        assert slow.concurrently(lambda: run.switch_mode("policy"), lambda: run.switch_mode("plan")) == []
        assert run.session.mode == "plan"
        control: Any = run.session.control
        assert control._core.mode == "plan"
        run.switch_mode("teleop")
        assert run.session.mode == "teleop"
        run.reset()

    def test_two_switches_to_the_same_mode_are_one(self, slow: Slow, runs: Runs):
        run = slow.run
        assert slow.concurrently(lambda: run.switch_mode("policy"), lambda: run.switch_mode("policy")) == []
        assert run.session.mode == "policy"
        assert [event for event in runs.parts.EVENTS if event[0] == "mode"] == [("mode", "teleop", "policy")]

    def test_a_reset_waits_for_a_mode_switch(self, slow: Slow):
        assert slow.concurrently(lambda: slow.run.switch_mode("policy"), slow.run.reset) == []
        assert slow.run.session.mode == "policy"

    def test_what_waits_when_a_stop_comes_is_refused(self, slow: Slow):
        run = slow.run
        raised = slow.concurrently(
            lambda: run.switch_mode("policy"),
            run.reset,
            lambda: run.switch_mode("plan"),
            meanwhile=run.session.emergency_stop,
        )
        assert sorted(raised) == [
            f"mode plan: {AFTER}",
            "refused before a reset: emergency stop",
            f"reset: {AFTER}",
        ]
        assert is_stopped(run)
        assert run.session.mode == "teleop"

    def test_what_waits_when_the_run_ends_is_refused(self, slow: Slow):
        run = slow.run
        raised = slow.concurrently(lambda: run.switch_mode("policy"), run.reset, meanwhile=run.session.finish)
        assert raised == ["reset: refused, the run ends"]

    def test_an_emergency_stop_waits_for_nobody(self, teleop: Runtime):
        with teleop.session.changing:
            thread = threading.Thread(target=lambda: teleop.session.bus.call(ESTOP, None))
            thread.start()
            thread.join(PATIENCE_S)
            assert teleop.session.stops == 1


class TestEpisodes:
    def test_the_next_one_does_not_clear_a_stop_that_comes_just_before(self, runs: Runs, monkeypatch):
        runtime = runs.start(episodes=3)
        steps(runtime, 10)
        session = runtime.session
        real = session.control.call

        def call(command: Command) -> Any:
            if isinstance(command, ResetEpisode) and not session.stops:
                real(EmergencyStop())  # after the check of the host
            return real(command)

        monkeypatch.setattr(session.control, "call", call)
        steps(runtime, 60)  # the first ends

        assert session.stops == 1
        assert is_stopped(runtime)
        assert [event[0] for event in runs.parts.EVENTS] == ["started", "ended", "fault"]
        assert not session.finished.is_set()

    def test_none_begins_while_the_state_of_the_run_changes(self, runs: Runs):
        runtime = runs.start(episodes=3)
        changes, done = threading.Event(), threading.Event()

        def change() -> None:
            with runtime.session.changing:
                changes.set()
                done.wait(PATIENCE_S)

        thread = threading.Thread(target=change)
        thread.start()
        changes.wait(PATIENCE_S)
        steps(runtime, 10)
        assert runs.parts.EVENTS == []
        done.set()
        thread.join()
        steps(runtime, 10)
        assert [event[0] for event in runs.parts.EVENTS] == ["started"]


class TestDevices:
    def test_a_stop_pressed_on_one_counts_when_another_fails(self, runs: Runs):
        runtime = runs.start("control_modes.teleop.teleop={arm: lever, gripper: stick}", mode="teleop")
        lever, stick = runs.parts.MADE["lever"], runs.parts.MADE["stick"]
        read = lever.read

        def gone(measured: object) -> None:
            raise TeleopError("the stick is gone")

        lever.read = lambda measured: pressed(read(measured))
        stick.read = gone
        steps(runtime, 2)
        assert runtime.session.stops >= 1
        assert is_stopped(runtime)

    @pytest.mark.parametrize("mode", ["teleop", "policy"])
    def test_one_can_stop_the_robot_on_its_way_to_the_stop_pose(self, runs: Runs, mode: str):
        runtime = runs.start(
            "control_modes.teleop.teleop=lever",
            "control_modes.policy.inference={model: net, intervene: lever}",
            "control.stop=pose up",
            mode=mode,
        )
        lever = runs.parts.MADE["lever"]
        source: Any = runtime.session.command_source
        control: Any = runtime.session.control
        steps(runtime, 3)
        read = lever.read
        lever.read = lambda measured: pressed(read(measured))
        # The robot moves to its pose after what cannot send a stop has ended, and before the rest.
        runtime.session.on_state.append(lambda state: source.step(runtime.session.clock.now_ns()))
        runtime.stop()

        assert control.stops >= 1

    @pytest.mark.parametrize("mode", ["teleop", "policy"])
    def test_one_that_blocks_is_noticed(self, runs: Runs, mode: str):
        runtime = runs.start(
            "control_modes.teleop.teleop=lever",
            "control_modes.policy.inference={model: net, intervene: lever}",
            mode=mode,
        )
        (pulse,) = runtime.session.pulses
        assert pulse.name == "teleop lever (lever)"
        steps(runtime)
        assert not pulse.is_late(0.1)
        assert any(pulse.is_late(0.1) for _ in range(70))
        runtime.switch_mode("idle")
        assert not runtime.session.pulses


def pressed(command: Any) -> Any:
    """A command with its emergency stop pressed."""
    return attrs.evolve(command, estop=True)


class TestServed:
    def test_from_before_control_runs_and_then_the_run_ends(self, runs: Runs, caplog):
        runtime = runs.make(mode="policy")

        def load(net: object) -> None:
            runtime.session.bus.call(ESTOP, None)

        runs.parts.Net.load, real = load, runs.parts.Net.load
        try:
            runtime.start()
        finally:
            runs.parts.Net.load = real
        assert runtime.session.finished.is_set()
        assert "emergency stop while nothing commands the robot: the run ends" in caplog.text

    def test_while_other_components_start(self, runs: Runs, monkeypatch):
        runtime = runs.make(mode="policy")
        monkeypatch.setattr(runs.parts.Camera, "open", lambda camera: runtime.session.bus.call(ESTOP, None))
        runtime.start()
        assert is_stopped(runtime)
        assert runtime.session.stops == 2
        assert runs.parts.EVENTS[0] == ("fault", "emergency stop")

    def test_on_the_way_to_the_startup_pose_which_brakes_and_ends_the_start(self, runs: Runs):
        runtime = runs.make("control.startup=pose up", mode="teleop")
        commands = recorded(runtime, stop_at=10)
        with pytest.raises(ComponentFailed, match=r"^control: control\.startup: pose up: emergency stop$"):
            runtime.start()
        assert_braked(commands)

    def test_on_the_way_to_the_stop_pose_which_brakes(self, runs: Runs, caplog):
        runtime = runs.start("control.stop=pose up", mode="teleop")
        steps(runtime, 5)
        commands = recorded(runtime, stop_at=10)
        runtime.stop()
        assert_braked(commands)
        assert "emergency stop: the robot holds where it is, and the run ends" in caplog.text
        with pytest.raises(TransportError):
            runtime.session.bus.call(ESTOP, None)

    def test_no_other_request_is_taken_at_the_end(self, runs: Runs):
        runtime = runs.start(mode="teleop")
        runtime.session.finish()
        for act in (runtime.reset, lambda: runtime.switch_mode("idle")):
            with pytest.raises(NotSupported, match="the run ends"):
                act()


def recorded(runtime: Runtime, stop_at: int) -> list[Any]:
    """The commands from now on; at one of them, the emergency stop is pressed."""
    commands: list[Any] = []

    def take(state: Any) -> None:
        commands.append(state.command)
        if len(commands) == stop_at:
            runtime.session.bus.call(ESTOP, None)

    runtime.session.on_state.append(take)
    return commands


def assert_braked(commands: list[Any]) -> None:
    """The commands end at rest, before the pose, and stay within the limits of the robot at 50 Hz."""
    steps = np.diff(commands, axis=0)
    assert np.abs(steps[8]).max() > 0.004
    np.testing.assert_array_equal(steps[-1], 0.0)
    assert np.abs(np.diff(steps, axis=0)).max() <= 10.0 * 0.02**2 * (1 + 1e-9)
    assert np.abs(commands[-1] - [0.4, 0.2]).max() > 0.05
