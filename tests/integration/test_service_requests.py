"""Generated requests to every service of an arm in motion; `benchmarks/service_requests.py` sends thousands."""

from __future__ import annotations

from collections.abc import Iterator
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


@pytest.fixture
def runtime() -> Iterator[Runtime]:
    registry = installed_plugins()
    overrides = ["default_control_mode=moveit_planning", "simulation.default_control_mode=moveit_planning"]
    config = load_config(CONFIG, overrides=[*overrides, "world={scene: true}"], sim=True, registry=registry)
    made = Runtime(Session(config, registry, LaunchRequest(lockstep=True, by_operator=True)))
    made.start()
    yield made
    made.stop()
    made.raise_failure()


@pytest.mark.integration
def test_an_orientation_that_cannot_be_kept_is_refused(runtime: Runtime):
    goal = {"xyz": [0, 0, 0], "quaternion": [0, 0, 0, 1], "beyond_reach": "current"}
    answer = runtime.session.bus.call("/plan_kinematic_path", {"goals": [goal]})
    assert "cannot keep its orientation at" in answer.message


@pytest.mark.integration
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of numpy: a plane that a link carries has no finite size
def test_no_request_ends_the_run_or_shows_its_inside(runtime: Runtime, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(SECRET, "hunter2")
    requests, bus = Requests(0), runtime.session.bus
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
