"""Generated requests to every service of an arm in motion; `benchmarks/service_requests.py` sends thousands."""

from __future__ import annotations

from pathlib import Path

import pytest
from ibrobot_ros2.services import Answer, Call, decode_answer, decode_call, encode_answer, encode_call
from plain_requests import SECRET, Requests

from ibrobot_core.config.load import load_config
from ibrobot_core.errors import IbrobotError
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import LaunchRequest, Session
from ibrobot_core.plugins import installed_plugins

CONFIG = Path(__file__).parents[2] / "configs" / "so101_blind.yaml"
REQUESTS = 400
WAITING = ("/moveit_gateway/move_to_pose", "/moveit_gateway/move_to_configuration")
"""They answer when the motion has ended, for which a run in lockstep would have to be stepped."""


@pytest.mark.integration
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of numpy: a plane that a link carries has no finite size
def test_no_request_ends_the_run_or_shows_its_inside(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(SECRET, "hunter2")
    registry = installed_plugins()
    overrides = ["default_control_mode=moveit_planning", "simulation.default_control_mode=moveit_planning"]
    config = load_config(CONFIG, overrides=[*overrides, "world={scene: true}"], sim=True, registry=registry)
    runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, by_operator=True)))
    runtime.start()
    requests, bus = Requests(0), runtime.session.bus
    try:
        runtime.session.bus.call("/planning/go_to", "shoulder_pan=1.0")
        for i in range(REQUESTS):
            served = [each for each in bus.services().values() if each.name not in WAITING]
            service = served[i % len(served)]
            call = decode_call(encode_call(Call(service.name, requests.request(service))))
            told = ""
            try:
                answer = Answer(bus.call(call.service, call.request))
            except IbrobotError as error:
                told = str(error)
                answer = Answer(told, result=False)
            shown = str(decode_answer(encode_answer(answer)).values)
            assert "hunter2" not in shown
            assert "Error: " not in shown, f"{service.name}: {call.request}"
            assert len(told) < 10_000
            assert not runtime.step(), "the run goes on"
    finally:
        runtime.stop()
    runtime.raise_failure()
