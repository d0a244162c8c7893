"""Switching modes at run time: new parts first, ownership within a tick, and a mode that fails changes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from ibrobot_core.control.commands import Command, SwitchMode
from ibrobot_core.errors import ComponentFailed, HardwareError, NotSupported
from ibrobot_core.launch.runtime import SET_MODE, Runtime

if TYPE_CHECKING:
    from fake_runs import Runs


def seconds(runtime: Runtime, duration: float) -> None:
    for _ in range(round(duration * runtime.session.config.control.rate_hz)):
        runtime.step()


def position(runtime: Runtime) -> list[float]:
    assert runtime.session.state is not None
    return runtime.session.state.position.tolist()


def names(runtime: Runtime) -> list[str]:
    """What runs, in starting order."""
    return [component.name for component in runtime._started]


def test_from_mode_to_mode_and_back(runs: Runs):
    runtime = runs.start(mode="teleop")
    seconds(runtime, 0.5)
    pan, grip = position(runtime)
    runtime.session.bus.call(SET_MODE, "plan")
    assert runtime.session.mode == "plan"
    seconds(runtime, 1.0)
    assert position(runtime)[0] == pytest.approx(pan, abs=0.05), "it holds where it was"
    assert position(runtime)[1] == pytest.approx(grip, abs=0.05), "no executor of this mode owns it"
    runtime.switch_mode("teleop")
    seconds(runtime, 1.0)
    assert position(runtime)[0] > pan + 0.1
    assert runtime.summary()["mode"] == "teleop"
    assert [event for event in runs.parts.EVENTS if event[0] == "mode"] == [
        ("mode", "teleop", "plan"),
        ("mode", "plan", "teleop"),
    ]


def test_a_mode_without_a_policy_refuses_a_prompt(runs: Runs):
    runtime = runs.start(mode="teleop")
    for mode in ("teleop", "plan"):
        with pytest.raises(NotSupported, match=f"mode {mode}: takes no prompt, since it has no policy"):
            runtime.session.bus.call(SET_MODE, {"mode": mode, "prompt": "pick up the cube"})
    assert runtime.session.mode == "teleop"


def test_new_parts_are_ready_before_ownership_changes_and_old_ones_go_after(
    runs: Runs, monkeypatch: pytest.MonkeyPatch
):
    runtime = runs.start(mode="teleop")
    calls: list[str] = runs.parts.CALLS
    calls.clear()
    control = runtime.session.control
    real = control.call

    def call(command: Command) -> Any:
        calls.append(type(command).__name__)
        return real(command)

    monkeypatch.setattr(control, "call", call)
    runtime.switch_mode("policy")
    assert calls == ["load net", "SwitchMode", "disconnect stick"]
    calls.clear()
    runtime.switch_mode("teleop")
    assert calls == ["connect stick", "SwitchMode", "close net"]


def test_what_runs_is_what_the_mode_needs(runs: Runs):
    runtime = runs.start(mode="policy")
    fixed = ["control", "sensor:top", "sensor:side", "status"]
    assert sorted(names(runtime)) == sorted([*fixed, "model:net", "mode:policy", "episodes"])
    runtime.switch_mode("teleop")
    assert sorted(names(runtime)) == sorted([*fixed, "mode:teleop"])
    runtime.switch_mode("idle")
    assert sorted(names(runtime)) == sorted(fixed)
    runtime.switch_mode("policy")
    assert sorted(names(runtime)) == sorted([*fixed, "model:net", "mode:policy"])
    seconds(runtime, 1.0)
    assert runtime.session.acting is not None
    assert runtime.session.acting.dispatch.chunks > 0


def test_a_mode_that_cannot_start_leaves_the_old_one_running(runs: Runs):
    runtime = runs.start(mode="teleop")
    seconds(runtime, 0.2)
    before, running = position(runtime)[0], names(runtime)
    with pytest.raises(ComponentFailed, match=r"^model:lost: no such checkpoint$"):
        runtime.switch_mode("lost")
    assert (runtime.session.mode, names(runtime)) == ("teleop", running)
    seconds(runtime, 0.5)
    assert position(runtime)[0] > before + 0.05
    assert not any(event[0] == "mode" for event in runs.parts.EVENTS)


def test_simulated_episodes_go_on_when_another_mode_cannot_start(runs: Runs):
    runtime = runs.start(mode="policy", episodes=2)
    seconds(runtime, 0.2)
    with pytest.raises(ComponentFailed):
        runtime.switch_mode("lost")
    while not runtime.step():
        pass
    assert runtime.summary()["successes"] == 2


def test_control_that_refuses_leaves_the_old_mode_which_a_reset_revives(runs: Runs):
    runtime = runs.start(mode="teleop")
    seconds(runtime, 0.2)
    running = names(runtime)
    runtime.session.emergency_stop()
    with pytest.raises(HardwareError, match="refused before a reset: emergency stop"):
        runtime.switch_mode("policy")
    assert (runtime.session.mode, names(runtime)) == ("teleop", running)
    assert runs.parts.CALLS[-1] == "close net"
    seconds(runtime, 0.5)
    before = position(runtime)[0]
    runtime.reset()
    seconds(runtime, 0.5)
    assert position(runtime)[0] > before + 0.05


def test_the_old_mode_goes_on_when_control_refuses_the_new_one(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    runtime = runs.start(mode="policy", episodes=3)
    seconds(runtime, 0.2)
    control = runtime.session.control
    real = control.call

    def call(command: Command) -> Any:
        if isinstance(command, SwitchMode):
            raise HardwareError("not now")
        return real(command)

    monkeypatch.setattr(control, "call", call)
    with pytest.raises(HardwareError, match="not now"):
        runtime.switch_mode("teleop")
    assert runtime.session.acting is not None
    chunks = runtime.session.acting.dispatch.chunks
    seconds(runtime, 0.2)
    assert runtime.session.acting.dispatch.chunks > chunks, "the policy goes on within the episode"
    while not runtime.step():
        pass
    assert runtime.summary()["successes"] == 3
    assert runs.parts.CALLS[-1] == "disconnect stick"


def test_an_unknown_mode_is_refused_with_the_available_ones(runs: Runs):
    runtime = runs.start(mode="teleop")
    with pytest.raises(NotSupported, match="no mode 'tele'; the modes are: policy, lost, teleop, plan, replan, idle"):
        runtime.switch_mode("tele")


def test_entering_the_present_mode_changes_nothing(runs: Runs):
    runtime = runs.start(mode="teleop")
    runs.parts.CALLS.clear()
    runtime.switch_mode("teleop")
    assert runs.parts.CALLS == []
    assert runs.parts.EVENTS == [("started", 1, "teleop")]


def test_real_time_chunking_with_a_policy_that_cannot_is_refused_before_anything_moves(runs: Runs):
    runtime = runs.make("control_modes.policy.dispatch.strategy=rtc")
    with pytest.raises(ComponentFailed, match=r"mini.yaml: control_modes.policy.dispatch.strategy: rtc needs a policy"):
        runtime.start()
    assert not runtime.session.has_control
    assert "load net" not in runs.parts.CALLS
