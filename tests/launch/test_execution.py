"""A policy in a run: its prompt, what is published of its plan, and what its execution mode needs."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import attrs
import pytest

from ibrobot_core.errors import ComponentFailed, ConfigError
from ibrobot_core.messages import MODEL_ANSWERS, DiagnosticArray, ModelAnswer, RobotStatus

if TYPE_CHECKING:
    from fake_runs import Runs
    from ibrobot_testing.site import Site

MODE = "control_modes.policy.inference.execution_mode={}"


def test_a_prompt_is_there_where_the_policy_wants_one(
    runs: Runs, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    prompt = "control_modes.policy.inference.prompt=pick up the cube"
    runs.start(prompt).stop()
    assert "control_modes.policy.inference.prompt: model 'net' takes no prompt" in caplog.text
    make = runs.parts.Net.__init__

    def wants_a_prompt(self: Any, *arguments: Any, **options: Any) -> None:
        make(self, *arguments, **options)
        self.spec = attrs.evolve(self.spec, prompt=True)

    monkeypatch.setattr(runs.parts.Net, "__init__", wants_a_prompt)
    with pytest.raises(
        ComponentFailed, match=r"control_modes\.policy\.inference\.prompt: is missing; model 'net' needs"
    ):
        runs.start()
    caplog.clear()
    runs.start(prompt).stop()
    assert "takes no prompt" not in caplog.text


def need_prompts(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the policy take a prompt."""
    runs.start().stop()
    make = runs.parts.Net.__init__

    def wants_a_prompt(self: Any, *arguments: Any, **options: Any) -> None:
        make(self, *arguments, **options)
        self.spec = attrs.evolve(self.spec, prompt=True)

    monkeypatch.setattr(runs.parts.Net, "__init__", wants_a_prompt)


def test_prompt_of_a_request_stands_in_for_that_of_the_yaml(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    need_prompts(runs, monkeypatch)
    runtime = runs.start(mode="teleop")
    with pytest.raises(ComponentFailed, match=r"control_modes\.policy\.inference\.prompt: is missing"):
        runtime.switch_mode("policy")
    assert runtime.session.mode == "teleop"
    runtime.switch_mode("policy", prompt="pick")
    assert runtime.session.mode == "policy"


def test_prompt_of_a_request_to_a_policy_that_takes_none_is_said(runs: Runs, caplog: pytest.LogCaptureFixture):
    runtime = runs.start(mode="teleop")
    assert "takes no prompt" not in caplog.text
    runtime.switch_mode("policy", prompt="pick")
    assert "control_modes.policy.inference.prompt: model 'net' takes no prompt" in caplog.text


def test_policy_mode_is_entered_with_another_prompt(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    need_prompts(runs, monkeypatch)
    runtime = runs.start("control_modes.policy.inference.prompt=pick", "contract.max_duration_s=100", seed=13)
    bus = runtime.session.bus
    answers = bus.subscribe(MODEL_ANSWERS, 100)

    def prompts() -> set[str]:
        answers.drain()
        for _ in range(40):
            runtime.step()
        return {each.message.prompt for each in answers.drain() if isinstance(each.message, ModelAnswer)}

    assert prompts() == {"pick"}
    bus.call("/set_mode", {"mode": "policy", "prompt": "put it down"})
    assert prompts() == {"put it down"}
    bus.call("/set_mode", "policy")
    assert prompts() == {"put it down"}, "the mode just goes on"
    for request, expected in (("policy", "pick"), ({"mode": "policy", "prompt": "push"}, "push")):
        bus.call("/set_mode", "idle")
        bus.call("/set_mode", request)
        assert prompts() == {expected}
    answers.close()
    runtime.raise_failure()


def test_the_status_and_the_diagnostics_tell_how_the_plan_is_kept_filled(runs: Runs):
    runtime = runs.start(duration_s=1.0)
    bus = runtime.session.bus
    received = [bus.subscribe("/robot_status", 1), bus.subscribe("/diagnostics", 1)]
    while not runtime.step():
        pass
    runtime.raise_failure()
    messages = [subscription.get() for subscription in received]
    status, diagnostics = (message and message.message for message in messages)
    assert isinstance(status, RobotStatus)
    assert isinstance(diagnostics, DiagnosticArray)
    for subscription in received:
        subscription.close()
    (dispatch,) = (each for each in diagnostics.status if each.name == "dispatch")
    values = {pair.key: pair.value for pair in dispatch.values}
    expected = {
        "plan_length", "latency_ms", "strategy", "smoothing", "latency_p50_ms", "latency_p99_ms", "requests", "holds",
        "failures", "timeouts", "late_chunks",
    }  # fmt: skip
    assert {name: str(getattr(status, name)) for name in expected} == {name: values[name] for name in expected}
    assert (status.strategy, status.smoothing, values["watermark"]) == ("ensemble", True, "5")
    assert status.requests > 1


@pytest.mark.parametrize("transport", [(), ("transport={type: local}",)])
def test_engine_that_uses_the_transport_needs_one_to_other_machines(runs: Runs, transport: tuple[str, ...]):
    with pytest.raises(ConfigError, match="far needs a transport to the server"):
        runs.make(MODE.format("far"), *transport)


def test_engine_is_given_the_model_and_an_open_transport(runs: Runs, site: Site):
    site.add("shared-network", "shared_network.py")
    server = "control_modes.policy.inference.server=big"
    runtime = runs.start(MODE.format("far"), server, "transport={type: shared}", seed=5)
    engine, model = runs.parts.MADE["far"], runs.parts.MADE["far"].model
    assert (engine.name, engine.options.server, engine.stats.alive) == ("net", "big", True)
    assert (model.config, model.policy, model.timeout_s) == (runtime.session.config, runs.parts.MADE["net"], 5.0)
    assert model.transport is sys.modules["shared_network"].NETWORK
    assert not model.ending.is_set()
    assert [line.strip() for line in runtime.plan.lines()][:2] == [
        "1. transport    transport shared",
        "2. model:net    policy net, far away  (needs transport)",
    ]
    runtime.stop()
    assert model.ending.is_set()
