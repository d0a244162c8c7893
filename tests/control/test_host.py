"""The host's side of control: in a process of its own, and within the caller's thread."""

from __future__ import annotations

import os
import queue
import re
import signal
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np
import pytest
import yaml
from logged_run import wait_for

from ibrobot_core.clock import RealClock, SteppedClock
from ibrobot_core.config import from_document
from ibrobot_core.control.commands import BeginStartup, ClearFaults, EmergencyStop, GetCounters, RaiseFault, SwitchMode
from ibrobot_core.control.host import ControlClient, ControlHost, InlineControl
from ibrobot_core.errors import ComponentFailed, HardwareError
from ibrobot_core.interfaces.run_state import ControlState, PlanRecord
from ibrobot_core.plugins import installed_plugins

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

PATIENCE_S = 30.0
DOCUMENT = """
robot:
  name: mini
  joints:
    - {name: pan, lower: -1.0, upper: 1.0, max_velocity: 3.0, max_acceleration: 40.0}
    - {name: grip, lower: 0.0, upper: 1.0, max_velocity: 3.0, max_acceleration: 40.0}
  groups: {arm: [pan, grip]}
  description: {poses: {out: [0.4, 0.8]}}
simulation: {type: arm}
executors:
  position: {type: position, group: arm}
  trajectory: {type: waypoints, group: arm}
control_modes:
  stream: {executors: [position]}
  plan: {executors: [trajectory]}
default_control_mode: stream
"""


@attrs.define
class Reports:
    """What control reported to its host."""

    states: queue.SimpleQueue[ControlState] = attrs.field(factory=queue.SimpleQueue)
    events: queue.SimpleQueue[Mapping[str, Any]] = attrs.field(factory=queue.SimpleQueue)
    deaths: queue.SimpleQueue[ComponentFailed] = attrs.field(factory=queue.SimpleQueue)

    def state(self, wanted: Callable[[ControlState], bool]) -> ControlState:
        """The next state that is as `wanted`."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not wanted(found := self.states.get(timeout=PATIENCE_S)):
            assert time.monotonic() < deadline_s, f"the last state was {found}"
        return found


def list_of(waiting: queue.SimpleQueue[Any]) -> list[Any]:
    """All that is in a queue."""
    found = []
    while not waiting.empty():
        found.append(waiting.get())
    return found


@pytest.fixture(params=["process", "inline"])
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def reports() -> Reports:
    return Reports()


@pytest.fixture
def make(site: Site, reports: Reports) -> Iterator[Callable[..., ControlHost]]:
    site.add("ibrobot-plugin-arm", "control_arm.py")
    made: list[ControlHost] = []

    def make_host(
        kind: str = "process",
        startup: str = "hold",
        given_up: threading.Event | None = None,
        stop: str = "hold",
        mode: str = "stream",
        **options: Any,
    ) -> ControlHost:
        document = yaml.safe_load(DOCUMENT)
        document["simulation"] |= options
        document["control"] = {"startup": startup, "stop": stop}
        document["default_control_mode"] = mode
        config = from_document(document, source=Path("mini.yaml"), sim=True)
        host: ControlHost
        if kind == "process":
            host = ControlClient(
                config, RealClock(), 0, reports.states.put, reports.events.put, reports.deaths.put, given_up=given_up
            )
        else:
            host = InlineControl(config, installed_plugins(), SteppedClock(), 0, reports.states.put, reports.events.put)
        made.append(host)
        return host

    yield make_host
    for host in made:
        host.stop()


def move(host: ControlHost, reports: Reports) -> None:
    """Have the joints move for a minute, and wait until they do."""
    first = reports.state(lambda state: True)
    ramp = np.linspace(first.command, [1.0, 1.0], 2000)
    host.write_plan(PlanRecord(first.generation, first.stamp_ns, 30_000_000, np.ones(2, dtype=bool), ramp))
    reports.state(lambda state: not np.array_equal(state.command, first.command))


def beats_of(host: ControlClient) -> Generator[None]:
    """The heartbeat of a host, which ends once it is closed."""
    while True:
        memory = host._memory
        assert memory is not None
        memory._beat[0] += 1
        yield


class TestBoth:
    def test_start_tells_signals_and_stop_releases_the_hardware(self, make, kind, tmp_path):
        host = make(kind, closed=str(tmp_path / "closed"))
        host.start()
        assert host.signals == [("/fake/command", 1)]
        host.stop()

        assert (tmp_path / "closed").exists()
        host.stop()

    @pytest.mark.parametrize(("unmoved", "lines"), [(False, 1), (True, 0)])
    def test_what_holds_torque_after_a_stop_is_reported(self, make, kind, unmoved, lines):
        host = make(kind, holds=True)
        host.start()
        host.stop(unmoved=unmoved)

        assert host.holding == ["/dev/ttyARM holds torque; to take it off: `arm torque off`"] * lines

    def test_what_holds_torque_after_a_failed_start_is_reported(self, make, kind):
        host = make(kind, holds=True, trouble="connect")
        with pytest.raises(HardwareError):
            host.start()

        assert host.holding == ["/dev/ttyARM holds torque; to take it off: `arm torque off`"]

    @pytest.mark.parametrize("trouble", ["connect", "read"])
    def test_hardware_that_does_not_answer_is_reported_and_released(self, make, kind, tmp_path, trouble):
        host = make(kind, trouble=trouble, closed=str(tmp_path / "closed"))
        with pytest.raises(HardwareError, match="servo 3 does not answer: check its cable"):
            host.start()

        assert (tmp_path / "closed").exists()

    def test_the_mode_begins_at_the_startup_pose(self, make, kind, reports):
        host = make(kind, startup="pose out")
        host.start()
        host.arrive()
        assert host.call(GetCounters())["generation"] == host.generation
        if isinstance(host, InlineControl):
            host.step()
        np.testing.assert_allclose(
            reports.state(lambda state: state.generation == host.generation).command, [0.4, 0.8], atol=0.01
        )

    def test_commands_are_answered_with_the_generation_and_refused_with_the_reason(self, make, kind):
        host = make(kind)
        host.start()
        first = host.call(SwitchMode(mode="plan"))["generation"]

        assert host.call(SwitchMode(mode="stream"))["generation"] > first
        with pytest.raises(HardwareError, match="no mode 'dance'; the modes are: stream, plan"):
            host.call(SwitchMode(mode="dance"))


class TestProcess:
    def test_states_come_in_order_and_plans_are_followed(self, make, reports):
        host = make()
        host.start()
        first = reports.state(lambda state: True)
        end = np.array([0.3, 0.9])
        # It ends with seconds at rest, so that it is no matter when it comes.
        positions = np.vstack([np.linspace(first.command, end, 50), np.full((1500, 2), end)])
        host.write_plan(PlanRecord(first.generation, first.stamp_ns, 10_000_000, np.ones(2, dtype=bool), positions))

        ticks = [first.tick]

        def arrived(state: ControlState) -> bool:
            ticks.append(state.tick)
            return np.allclose(state.command, end)

        reports.state(arrived)
        assert ticks == sorted(set(ticks))
        # A host that was stopped for seconds comes too late for some, and says so.
        assert ticks[-1] - first.tick + 1 - len(ticks) <= host._memory.lost

    @pytest.mark.parametrize("when", ["before it runs", "on the way"])
    def test_a_start_that_is_given_up_stops_the_robot(self, make, tmp_path, when):
        given_up = threading.Event()
        host = make(startup="pose out", given_up=given_up, closed=str(tmp_path / "closed"))
        if when == "on the way":
            host.start()
        given_up.set()
        with pytest.raises(ComponentFailed, match="given up"):
            host.start() if when == "before it runs" else host.arrive()

        host.stop()
        assert (tmp_path / "closed").exists()

    def test_an_emergency_stop_while_it_starts_is_not_lost(self, make, reports):
        host = make(startup="pose out")
        real = host._await_ready

        def call() -> None:
            with suppress(ComponentFailed):  # it may end before it answers
                host.call(EmergencyStop())

        calling = threading.Thread(target=call)

        def await_ready(child: Any) -> None:
            calling.start()
            real(child)

        host._await_ready = await_ready
        try:
            host.start()
            told = str(reports.deaths.get(timeout=PATIENCE_S))
        except HardwareError as error:  # it has ended before it was seen to be ready
            told = str(error)
        calling.join()

        assert told == "control.startup: pose out: emergency stop"
        commands = [state.command for state in list_of(reports.states)]
        assert all(np.array_equal(each, commands[0]) for each in commands), commands

    def test_an_emergency_stop_on_the_way_to_the_startup_pose_brakes_and_ends_it(self, make, reports):
        host = make(startup="pose out")
        host.start()
        host.call(BeginStartup())
        reports.state(lambda state: abs(state.command - state.position).max() > 1e-3)
        host.call(EmergencyStop())

        assert str(reports.deaths.get(timeout=PATIENCE_S)) == "control.startup: pose out: emergency stop"
        commands = [state.command for state in list_of(reports.states)]
        np.testing.assert_array_equal(commands[-1], commands[-2])
        assert np.abs(commands[-1] - [0.4, 0.8]).max() > 0.01

    @pytest.mark.parametrize("how", ["command", "SIGTERM", "end of the host"])
    def test_an_emergency_stop_on_the_way_to_the_stop_pose_brakes(self, make, reports, how):
        host = make(stop="pose out")
        host.start()
        reports.state(lambda state: True)

        def halt() -> None:
            with suppress(ComponentFailed):  # it may end before it answers
                host.halt()

        halting = threading.Thread(target=halt)
        halting.start()
        reports.state(lambda state: abs(state.command - state.position).max() > 1e-3)
        if how == "command":
            assert host.call(EmergencyStop())["stops"] == 1
        elif how == "SIGTERM":
            os.kill(host.pid, signal.SIGTERM)
        else:
            host._child.channel._socket.shutdown(socket.SHUT_WR)
            host._child._process.wait(PATIENCE_S)
            for state in host._memory.read_states():
                reports.states.put(state)
        halting.join()
        host.stop()

        commands = [state.command for state in list_of(reports.states)]
        np.testing.assert_array_equal(commands[-1], commands[-2])
        assert np.abs(commands[-1] - [0.4, 0.8]).max() > 0.01

    def test_a_stop_during_a_slow_reset_wins(self, make, reports, tmp_path):
        host = make(resetting=str(file := tmp_path / "resetting"))
        host.start()
        host.call(RaiseFault(fault="a cable is loose"))
        answers: queue.SimpleQueue[str] = queue.SimpleQueue()

        def reset() -> None:
            with pytest.raises(HardwareError) as refused:
                host.call(ClearFaults(stops=0))
            answers.put(str(refused.value))

        resetting = threading.Thread(target=reset)
        resetting.start()
        wait_for(file.exists, "the hardware clears its faults")
        host._child.channel.send({"id": 0, "do": "EmergencyStop"})
        file.unlink()
        resetting.join()

        assert answers.get(timeout=PATIENCE_S) == "reset: refused, an emergency stop came after it was requested"
        assert reports.state(lambda state: state.stops == 1).estop
        assert host.stops == 1

    def test_a_stop_overtakes_commands_that_wait(self, make, reports):
        host = make(mode="plan")
        host.start()
        tick = reports.state(lambda state: True).tick
        os.kill(host.pid, signal.SIGSTOP)
        goal = {"executor": "trajectory", "goal_id": "1", "goal": {"stop": True}}
        waiting = [host._replies.setdefault(number, queue.SimpleQueue()) for number in (101, 102)]
        for command in (
            {"id": 101, "do": "SendGoal", **goal},
            {"id": 102, "do": "ClearFaults", "stops": 0},
            {"do": "EmergencyStop"},
        ):
            host._child.channel.send(command)
        os.kill(host.pid, signal.SIGCONT)

        refused = [each.get(timeout=PATIENCE_S)["error"] for each in waiting]
        assert refused[0].startswith("refused before a reset: emergency stop")
        assert refused[1] == "reset: refused, an emergency stop came after it was requested"
        reports.state(lambda state: state.stops == 1)
        host.call(GetCounters())
        reports.state(lambda state: state.tick > tick + 20)
        assert reports.state(lambda state: True).estop
        assert [event["event"] for event in list_of(reports.events)] == ["fault"]

    def test_messages_that_are_no_commands_end_nothing_and_stop_works(self, make, reports):
        host = make()
        host.start()
        for message in (
            {},
            {"do": 1},
            {"do": "stop it"},
            {"do": "SendGoal", "id": []},
            {"do": "ClearFaults", "id": 1, "x": 2},
        ):
            host._child.channel.send(message)
        host._child.channel.send({"do": "EmergencyStop", "id": {}, "event": "log"})
        assert reports.state(lambda state: state.stops == 1).estop
        assert host.call(EmergencyStop())["stops"] == 2

    def test_a_fault_is_reported_and_reset(self, make, reports):
        host = make()
        host.start()
        host.call(EmergencyStop())
        assert reports.events.get(timeout=PATIENCE_S)["fault"] == "emergency stop"
        assert reports.state(lambda state: state.estop)

        resting = reports.state(lambda state: state.estop)
        assert host.call(ClearFaults())["generation"] > resting.generation
        assert reports.state(lambda state: not state.estop)

    def test_its_report_has_the_whole_run_at_the_end(self, make, reports):
        host = make()
        host.start()
        reports.state(lambda state: state.tick >= 5)
        host.stop()

        assert host.report["loop"]["ticks"] >= 5
        assert host.report["counters"]["loop"]["read_errors"] == 0

    def test_its_death_is_reported_and_commands_fail_from_then_on(self, make, reports):
        host = make()
        host.start()
        os.kill(host.pid, signal.SIGKILL)

        assert str(reports.deaths.get(timeout=PATIENCE_S)) == "the control process died (killed by SIGKILL)"
        with pytest.raises(ComponentFailed, match="control process is gone"):
            host.call(EmergencyStop())

    def test_one_that_ignores_its_end_is_killed_and_reported(self, make, reports, monkeypatch, caplog):
        monkeypatch.setattr("ibrobot_core.control.host._STOP_TIMEOUT_S", 0.2)
        host = make(trouble="disconnect")
        host.start()
        reports.state(lambda state: state.tick >= 1)
        pid = host.pid
        host.stop()

        assert "the control process did not end within 0.2 s: killed" in caplog.text
        assert not Path(f"/proc/{pid}").exists()

    def test_its_death_is_noticed_while_a_process_forked_by_it_holds_its_socket(self, make, reports):
        host = make(fork=True)
        host.start()
        helpers = [int(pid) for pid in Path(f"/proc/{host.pid}/task/{host.pid}/children").read_text().split()]
        try:
            os.kill(host.pid, signal.SIGKILL)

            assert str(reports.deaths.get(timeout=PATIENCE_S)) == "the control process died (killed by SIGKILL)"
            assert Path(f"/proc/{helpers[0]}").exists()
        finally:
            for pid in helpers:
                os.kill(pid, signal.SIGKILL)

    def test_one_that_is_stopped_is_named_and_stop_says_how_else_to_stop(self, make, reports):
        host = make()
        host.start()
        move(host, reports)
        os.kill(host.pid, signal.SIGSTOP)
        named = (
            f"the control process {host.pid} is stopped, and STOP does not reach the robot: Ctrl-C ends the run, "
            f"or `kill -CONT {host.pid}` continues the process"
        )

        assert reports.events.get(timeout=PATIENCE_S)["fault"] == named
        for command in (EmergencyStop(), ClearFaults()):
            with pytest.raises(ComponentFailed, match=f"^{re.escape(named)}$"):
                host.call(command)

    def test_one_that_runs_again_holds_until_a_reset(self, make, reports):
        host = make()
        host.start()
        move(host, reports)
        os.kill(host.pid, signal.SIGSTOP)
        named = reports.events.get(timeout=PATIENCE_S)
        os.kill(host.pid, signal.SIGCONT)

        fault = reports.events.get(timeout=PATIENCE_S)
        assert "is stopped" in named["fault"]
        assert "the control loop has not run for" in fault["fault"]
        assert fault["then"] == "holds"
        held = [reports.state(lambda state: state.generation >= fault["generation"]).command]
        while len(held) < 50:
            held.append(reports.state(lambda state: True).command)
        np.testing.assert_array_equal(held[-1], held[-2])
        assert host.call(ClearFaults())["cleared"] == fault["fault"]

    def test_one_that_is_stopped_ends_in_order_when_the_run_ends(self, make, reports, tmp_path):
        host = make(closed=str(tmp_path / "closed"))
        host.start()
        os.kill(host.pid, signal.SIGSTOP)
        reports.events.get(timeout=PATIENCE_S)
        host.stop()

        assert (tmp_path / "closed").exists()

    def test_a_call_that_waits_when_it_is_stopped_is_let_go(self, make, reports):
        host = make()
        host.start()
        os.kill(host.pid, signal.SIGSTOP)

        with pytest.raises(ComponentFailed, match=r"is stopped, and STOP does not reach the robot"):
            host.call(EmergencyStop())

    def test_without_the_hosts_signs_of_life_it_holds(self, make, reports, monkeypatch):
        beats: Any
        monkeypatch.setattr("ibrobot_core.control.link.SharedMemory.beat", lambda memory: next(beats, None))
        host = make()
        beats = beats_of(host)
        host.start()
        move(host, reports)
        beats.close()

        fault = reports.events.get(timeout=PATIENCE_S)
        assert re.fullmatch(
            rf"the host process {os.getpid()} has been silent for \d+ ms; .*--lockstep.*", fault["fault"]
        )

    def test_sigterm_stops_it_in_order(self, make, reports, tmp_path):
        host = make(closed=str(tmp_path / "closed"))
        host.start()
        os.kill(host.pid, signal.SIGTERM)

        assert str(reports.deaths.get(timeout=PATIENCE_S)) == "the control process died (exit status 0)"
        assert (tmp_path / "closed").exists()

    def test_a_host_that_cannot_take_states_is_reported(self, make, reports):
        host = make()
        host._on_state = lambda state: 1 / 0
        host.start()

        assert "division by zero" in str(reports.deaths.get(timeout=PATIENCE_S))


class TestInline:
    def test_a_step_is_a_tick_at_the_clocks_time(self, make, reports):
        host = make("inline")
        host.start()
        for _ in range(3):
            host._clock.advance(10_000_000)
            host.step()

        states = [reports.states.get_nowait() for _ in range(3)]
        assert [state.tick for state in states] == [1, 2, 3]
        assert [state.stamp_ns for state in states] == [10_000_000, 20_000_000, 30_000_000]

    def test_stopping_takes_as_many_ticks_as_braking(self, make, reports):
        host = make("inline")
        host.start()
        host.step()
        state = reports.states.get_nowait()
        far = np.linspace(state.command, state.command + 0.5, 20)
        host.write_plan(PlanRecord(state.generation, 0, 10_000_000, np.ones(2, dtype=bool), far))
        for _ in range(10):
            host._clock.advance(10_000_000)
            host.step()
        host.stop()

        commands = []
        while not reports.states.empty():
            commands.append(reports.states.get_nowait().command)
        assert len(commands) > 12
        np.testing.assert_array_equal(commands[-1], commands[-2])
