"""A run as a whole: the order of its plan, starting and stopping, what dies, services, emergency stop and reset."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import attrs
import pytest

from ibrobot_core.errors import ComponentFailed, NotSupported, TeleopError
from ibrobot_core.interfaces.hardware import Condition, Severity
from ibrobot_core.launch.runtime import ESTOP, RESET, Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.messages import DiagnosticArray, DiagnosticStatus, KeyValue
from ibrobot_core.schema import ObservationSpec

if TYPE_CHECKING:
    from fake_runs import Runs


def steps(runtime: Runtime, count: int) -> None:
    for _ in range(count):
        runtime.step()


def seconds(runtime: Runtime, duration: float) -> None:
    steps(runtime, round(duration * runtime.session.config.control.rate_hz))


def position(runtime: Runtime) -> float:
    assert runtime.session.state is not None
    return float(runtime.session.state.position[0])


def watch(runtime: Runtime, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What starts and stops, as it happens."""
    happened: list[str] = []

    def note(what: str, real: Callable[[], None]) -> None:
        happened.append(what)
        real()

    for component in runtime.plan.components:
        for name in ("start", "stop"):
            call = partial(note, f"{name} {component.name}", getattr(component, name))
            monkeypatch.setattr(component, name, call)
    return happened


@pytest.mark.parametrize("mode", ["policy", "teleop", "plan", "idle"])
def test_nothing_stands_in_the_plan_before_what_it_needs(runs: Runs, mode: str):
    runtime = runs.make(mode=mode)
    begun: set[str] = set()
    for component in runtime.plan.components:
        assert set(component.needs) <= begun, component.name
        begun.add(component.name)
    assert {"control", "sensor:top", "sensor:side", "status"} <= begun
    assert (f"mode:{mode}" in begun) == (mode != "idle")
    assert ("model:net" in begun) == ("episodes" in begun) == (mode == "policy")


def test_the_plan_in_words(runs: Runs):
    runtime = runs.make(episodes=2, seed=5)
    assert [line.strip() for line in runtime.plan.lines()] == [
        "1. model:net    policy net, in the host process",
        "2. control      scene at 50 Hz, in this process, in lockstep  (needs model:net)",
        "3. sensor:top   camera drawn  (needs control)",
        "4. sensor:side  camera drawn  (needs control)",
        "5. mode:policy  net through the dispatcher at 25 Hz  (needs control, sensor:top, sensor:side, model:net)",
        "6. status       /robot_status and /diagnostics  (needs control)",
        "7. episodes     2, from seed 5  (needs mode:policy)",
        "stops in reverse order",
    ]
    assert runs.parts.MADE == {}, "a plan makes nothing"


def test_all_start_in_order_and_stop_in_reverse(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    runtime = runs.make()
    names = [component.name for component in runtime.plan.components]
    happened = watch(runtime, monkeypatch)
    runtime.start()
    assert happened == [f"start {name}" for name in names]
    happened.clear()
    runtime.stop()
    assert happened == [f"stop {name}" for name in reversed(names)]
    happened.clear()
    runtime.stop()
    assert happened == []


@pytest.mark.parametrize(
    ("trouble", "expected"),
    [
        ("missing", "sensor:side: no such device"),
        ("bug", "sensor:side: ZeroDivisionError: one over nothing"),
    ],
)
@pytest.mark.parametrize("lockstep", [True, False], ids=["lockstep", "real"])
def test_one_that_cannot_start_is_named_and_those_before_it_stop(
    runs: Runs, trouble: str, expected: str, lockstep: bool, monkeypatch: pytest.MonkeyPatch
):
    runtime = runs.make(lockstep=lockstep, sim=lockstep, mode="teleop")
    runs.parts.TROUBLE["side"] = trouble
    happened = watch(runtime, monkeypatch)
    with pytest.raises(ComponentFailed) as failure:
        runtime.start()
    assert str(failure.value).partition(" (a bug at ")[0] == expected
    assert failure.value.exit_code == 1
    assert happened == [
        "start control",
        "start sensor:top",
        "start sensor:side",
        "stop sensor:side",
        "stop sensor:top",
        "stop control",
    ]
    assert runs.parts.CALLS == ["open top", "close side", "close top"]


def test_a_start_that_fails_after_control_leaves_no_torque_on(runs: Runs):
    runtime = runs.make()
    runs.parts.TROUBLE["side"] = "missing"
    with pytest.raises(ComponentFailed, match="no such device"):
        runtime.start()

    assert runs.parts.MADE["simulation"].relaxed
    assert runtime.summary()["holding"] == []


def test_what_holds_torque_after_a_run_is_in_its_summary(runs: Runs):
    runtime = runs.start()
    runtime.stop()

    assert runtime.summary()["holding"] == ["the scene holds torque; to take it off: `scene torque off`"]


def test_a_missing_model_is_reported_before_anything_is_powered(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    runtime = runs.make(mode="lost")
    happened = watch(runtime, monkeypatch)
    with pytest.raises(ComponentFailed, match=r"^model:lost: no such checkpoint$"):
        runtime.start()
    assert happened == ["start model:lost", "stop model:lost"]


def test_one_that_dies_ends_the_run_with_its_cause(runs: Runs):
    runtime = runs.start(mode="teleop")
    runs.parts.TROUBLE["top"] = "unplugged"
    done = [runtime.step() for _ in range(6)]
    assert done[0] is False
    assert done[-1] is True
    runtime.stop()
    with pytest.raises(ComponentFailed, match=r"^sensor:top: unplugged$"):
        runtime.raise_failure()
    assert "close top" in runs.parts.CALLS
    assert "disconnect stick" in runs.parts.CALLS


def test_only_the_first_cause_is_reported(runs: Runs):
    runtime = runs.start(mode="teleop")
    runtime.session.fail("sensor:top", ComponentFailed("first\nand foremost"))
    runtime.session.fail("sensor:side", ComponentFailed("second"))
    with pytest.raises(ComponentFailed, match=r"^sensor:top: first; and foremost$"):
        runtime.raise_failure()


def test_one_that_does_not_stop_well_keeps_no_other_from_stopping(runs: Runs, caplog: pytest.LogCaptureFixture):
    runtime = runs.start(mode="teleop")
    runs.parts.TROUBLE["side"] = "stays open"
    runtime.stop()
    assert "sensor:side did not stop cleanly: OSError: the port is gone" in caplog.text
    assert "close top" in runs.parts.CALLS
    runtime.raise_failure()


def test_the_duration_ends_the_run(runs: Runs):
    runtime = runs.start(mode="teleop", duration_s=0.5)
    count = 0
    while not runtime.step():
        count += 1
    assert count == 24
    assert runtime.summary()["duration_s"] == 0.5


def test_emergency_stop_holds_until_the_reset(runs: Runs):
    runtime = runs.start(mode="teleop")
    bus = runtime.session.bus
    seconds(runtime, 0.4)
    before = position(runtime)
    bus.call(ESTOP, None)
    seconds(runtime, 0.6)
    stopped = position(runtime)
    assert stopped - before < 0.06
    seconds(runtime, 1.0)
    assert position(runtime) == pytest.approx(stopped, abs=1e-3)
    assert runtime.session.state is not None
    assert runtime.session.state.estop
    assert runtime.summary()["faults"] == ["emergency stop"]
    assert ("fault", "emergency stop") in runs.parts.EVENTS
    bus.call(RESET, None)
    seconds(runtime, 0.5)
    assert not runtime.session.state.estop
    assert 0.03 < position(runtime) - stopped < 0.15, "it goes on from where it stood, with no jump"


def test_hardware_that_falls_silent_is_a_fault_and_a_reset_goes_on(runs: Runs):
    runtime = runs.start(mode="teleop")
    seconds(runtime, 0.2)
    runs.parts.MADE["simulation"].broken = True
    seconds(runtime, 0.4)
    (fault,) = runtime.summary()["faults"]
    assert fault == "the bus is silent"
    assert ("fault", fault) in runs.parts.EVENTS
    stuck = position(runtime)
    runtime.reset()
    seconds(runtime, 0.5)
    assert position(runtime) > stuck + 0.03
    assert runtime.summary()["faults"] == [fault], "what happened is not forgotten"


def test_a_teleop_device_that_is_lost_is_a_fault_and_a_reset_connects_it_again(
    runs: Runs, monkeypatch: pytest.MonkeyPatch
):
    runtime = runs.start(mode="teleop")
    stick = runs.parts.MADE["stick"]
    seconds(runtime, 0.4)
    stick.disconnect()
    seconds(runtime, 0.4)
    assert not runtime.session.finished.is_set()
    (fault,) = runtime.summary()["faults"]
    assert "not connected" in fault
    stopped = position(runtime)
    seconds(runtime, 0.5)
    assert position(runtime) == pytest.approx(stopped, abs=1e-3)

    with monkeypatch.context() as patched:
        patched.setattr(stick, "connect", lambda: (_ for _ in ()).throw(TeleopError("still gone")))
        with pytest.raises(TeleopError, match="still gone"):
            runtime.reset()
    seconds(runtime, 0.5)
    assert position(runtime) == pytest.approx(stopped, abs=1e-3)

    runtime.reset()
    seconds(runtime, 0.5)
    assert 0.03 < position(runtime) - stopped < 0.15, "it goes on from where it stood, with no jump"
    assert runtime.summary()["faults"] == [fault]
    assert runs.parts.CALLS.count("connect stick") == 2


def test_services_end_with_the_run(runs: Runs):
    runtime = runs.start(mode="teleop")
    runtime.stop()
    with pytest.raises(Exception, match="nobody serves /reset"):
        runtime.session.bus.call(RESET, None)


def test_goals_need_a_mode_with_a_planner(runs: Runs):
    with pytest.raises(NotSupported, match=r"^--goal needs a mode with a planner: --mode plan or --mode replan$"):
        runs.make(mode="teleop", goals=("home",))


def test_an_observation_that_only_bags_have_is_refused(runs: Runs):
    session = runs.make().session
    touch = ObservationSpec(
        "observation.touch", topic="/touch", type="lamp_msgs/msg/Touch", foreign=True, select=("pressure.0",)
    )
    contract = attrs.evolve(session.config.contract, observations=(touch,))
    with pytest.raises(NotSupported, match=r"contract: observation\.touch: /touch is foreign"):
        Runtime(Session(attrs.evolve(session.config, contract=contract), session.registry, session.request))


def test_diagnostics_have_each_sensors_rate_and_age_and_what_the_hardware_counts(
    runs: Runs, monkeypatch: pytest.MonkeyPatch
):
    runtime = runs.start(mode="teleop")
    monkeypatch.setattr(runs.parts.MADE["simulation"], "counters", lambda: {"retries": 3}, raising=False)
    diagnostics = runtime.session.bus.subscribe("/diagnostics", 1)
    seconds(runtime, 3.0)
    received = diagnostics.get()
    assert received is not None
    assert isinstance(received.message, DiagnosticArray)
    found = {status.name: {pair.key: pair.value for pair in status.values} for status in received.message.status}
    assert float(found["sensor top"]["rate_hz"]) > 1
    assert 0 <= float(found["sensor top"]["age_ms"]) < 1000
    assert found["hardware simulation"] == {"retries": "3"}


def test_diagnostics_have_the_conditions_of_joints_the_leads_and_the_following_errors(
    runs: Runs, monkeypatch: pytest.MonkeyPatch
):
    runtime = runs.start(mode="teleop")
    hot = Condition("pan", "temperature", 58.04, "deg C", Severity.WARNING, "pan is at 58 deg C: let it rest")
    weak = Condition("grip", "voltage", 4.0, "V", Severity.FAULT, "grip has 4 V: check the supply")
    monkeypatch.setattr(runs.parts.MADE["simulation"], "health", lambda: (hot, weak))
    diagnostics = runtime.session.bus.subscribe("/diagnostics", 1)
    seconds(runtime, 3.0)
    received = diagnostics.get()
    assert received is not None
    assert isinstance(received.message, DiagnosticArray)
    status = {each.name: each for each in received.message.status}
    assert (status["joint pan"].level, status["joint grip"].level) == (DiagnosticStatus.WARN, DiagnosticStatus.ERROR)
    assert status["joint pan"].message == hot.message
    assert status["joint pan"].values == (KeyValue("temperature", "58.04 deg C"),)
    assert {"lead"} <= {pair.key for pair in status["safety"].values}
    assert {"following_errors"} <= {pair.key for pair in status["loop"].values}
    assert {"pan", "grip"} == {pair.key for pair in status["interventions"].values}
    assert runtime.session.outcome.faults == [weak.message]
