"""Generated requests and messages for every service and topic of an arm in motion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ibrobot_planning.execution.door import GoalDoor
from ibrobot_planning.execution.motions import Execution
from ibrobot_planning.execution.plans import GoalPlans
from ibrobot_ros2.services import Answer, Call, decode_answer, decode_call, encode_answer, encode_call
from plain_requests import SECRET, Offered, Requests, declared, everything, offered

from ibrobot_core.api import FollowTrajectory
from ibrobot_core.errors import IbrobotError, TransportError
from ibrobot_core.launch.runtime import Runtime

REQUESTS = 180
WAITING = ("/moveit_gateway/move_to_pose", "/moveit_gateway/move_to_configuration")
"""They answer when the motion has ended, for which a run in lockstep would have to be stepped."""
BRAKING_TICKS = 30
pytestmark = [
    pytest.mark.integration,
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # of numpy: a plane that a link carries has no finite size
]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes are recorded here."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def runtime() -> Iterator[Runtime]:
    with everything() as made:
        yield made


@pytest.fixture(scope="module")
def run_offers(tmp_path_factory: pytest.TempPathFactory) -> Offered:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("offered"))
        return offered()


def test_every_declared_service_is_asked(run_offers: Offered):
    """A new service belongs into the run of `plain_requests.EVERYTHING`, if it is not in it by itself."""
    only_for_ros = {"/act_inference_node/DispatchInfer"}
    assert set(declared()) - set(run_offers.services) == only_for_ros


def test_what_ends_motion_waits_for_no_other_request(run_offers: Offered):
    ends = ("estop", "cancel", "release")
    urgent = {name for name, service in run_offers.services.items() if service.urgent}
    ending = {name for name in run_offers.services if name.rpartition("/")[2] in ends}
    # The first ends no motion; authority ends with the motion that an agent has begun.
    assert urgent == ending - {"/record_episode/cancel"} | {"/estop/check", "/agent/disarm"}


def test_an_orientation_that_cannot_be_kept_is_refused(runtime: Runtime):
    goal = {"xyz": [0.08, 0.03, -0.01], "quaternion": [0, 1, 0, 0], "position_tolerance": 1e-4}
    answer = runtime.session.bus.call("/plan_kinematic_path", {"goals": [{**goal, "beyond_reach": "current"}]})
    assert "cannot keep its orientation at" in answer.message


def test_no_request_ends_the_run_shows_its_inside_or_moves_unchecked(
    runtime: Runtime, run_offers: Offered, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setenv(SECRET, "hunter2")
    checked, begun = note_motions(monkeypatch)
    requests, bus = Requests(0), runtime.session.bus
    asked, modes = (
        Counter[str](),
        sorted(runtime.session.config.control_modes, key=lambda mode: mode != "moveit_planning"),
    )
    stopped_for, before = 0, np.zeros(6)
    for i in range(REQUESTS):
        if i % 10 == 0:
            for name, request in (
                ("/reset", None),
                ("/set_mode", modes[i // 10 % len(modes)]),
                ("/planning/go_to", ("home", "shoulder_pan=1.0")[i // 10 % 2]),
            ):
                ask(bus, name, request)
        served = [each for each in bus.services().values() if each.name not in WAITING]
        service = min(served, key=lambda each: asked[each.name])
        asked[service.name] += 1
        ask(bus, service.name, requests.request(service))
        for topic, types in run_offers.topics.items():
            with suppress(TransportError):  # a message of another type
                bus.publish(topic, requests.message(types))
        assert not runtime.step(), "the run goes on"
        assert runtime.session.state is not None
        command = runtime.session.state.command
        stopped_for = stopped_for + 1 if runtime.session.faults else 0
        if stopped_for > BRAKING_TICKS:
            np.testing.assert_allclose(command, before, atol=1e-9, err_msg="a stopped robot moves")
        before = command.copy()
    assert set(asked) == set(run_offers.services) - set(WAITING)
    assert begun
    assert [each for each in begun if not any(each is known for known in checked)] == []
    assert [record.message for record in caplog.records if record.exc_info] == []


def note_motions(monkeypatch: pytest.MonkeyPatch) -> tuple[list[Any], list[Any]]:
    """Trajectories that were completed, and then checked, and those that began."""
    completed: list[Any] = []
    checked: list[Any] = []
    begun: list[Any] = []
    complete, check, send = GoalPlans._completed, GoalDoor.check_free, Execution._send

    def note_completed(self: GoalPlans, *arguments: Any) -> Any:
        completed.append(complete(self, *arguments))
        return completed[-1]

    def note_checked(self: GoalDoor, trajectory: Any) -> None:
        check(self, trajectory)
        if any(trajectory is known for known in completed):
            checked.append(trajectory)

    def note_begun(self: Execution, name: str, goal_id: str, goal: Any) -> None:
        send(self, name, goal_id, goal)
        if isinstance(goal, FollowTrajectory) and goal.takes_over is None:  # others are parts of the running one
            begun.append(goal.trajectory)

    monkeypatch.setattr(GoalPlans, "_completed", note_completed)
    monkeypatch.setattr(GoalDoor, "check_free", note_checked)
    monkeypatch.setattr(Execution, "_send", note_begun)
    return checked, begun


def ask(bus: Any, service: str, request: Any) -> None:
    """Call a service as another machine does; check the answer."""
    call = decode_call(encode_call(Call(service, request)))
    told = ""
    try:
        answer = Answer(bus.call(call.service, call.request))
    except IbrobotError as error:
        told = str(error)
        answer = Answer(told, result=False)
    shown = str(decode_answer(encode_answer(answer)).values)
    assert "hunter2" not in shown
    assert "Error: " not in shown, f"{service}: {call.request}"
    assert len(told) < 10_000
