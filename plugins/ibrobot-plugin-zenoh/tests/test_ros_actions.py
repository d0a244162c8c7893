"""Actions of a run over Zenoh, from a client on another machine: goals, feedback, results, cancels."""

from __future__ import annotations

import queue
import threading
import time
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

import attrs
import pytest
from ibrobot_ros2.interfaces import action_type, service_type
from ibrobot_zenoh import ros_calls
from ibrobot_zenoh.ros2 import actions_of, attachment
from ibrobot_zenoh.ros_goals import SentGoal, Status

from ibrobot_core.api import NS_PER_S, NotSupported, TransportError
from ibrobot_core.app import NoRequest, Service

from .pair import WAIT_S, client, free_endpoint, wait_for

if TYPE_CHECKING:
    from fake_runs import Runs

pytest.importorskip("ibrobot_planning", reason="its executors take goals")
pytestmark = pytest.mark.integration

FOLLOW, GRIP = (action_type(f"control_msgs/action/{name}") for name in ("FollowJointTrajectory", "GripperCommand"))
ARM, HAND = "/arm_trajectory/follow_joint_trajectory", "/grip_action/gripper_cmd"
ROBOT = (
    "executors.arm_trajectory={type: trajectory, group: arm}",
    "executors.grip_action={type: gripper, group: gripper}",
    "control_modes.goals={executors: [arm_trajectory, grip_action]}",
    "control.peer_timeout=2",
)


def to(*positions: float, at: int = 1) -> dict[str, Any]:
    point = {"positions": list(positions), "velocities": [0.0] * len(positions), "time_from_start": {"sec": at}}
    return {"trajectory": {"joint_names": ["pan"], "points": [point]}}


@pytest.fixture
def installed(runs: Runs) -> Runs:
    """Runs with the executors that take goals, and with Zenoh."""
    runs.installed += [each for each in entry_points(group="ibrobot") if each.name in ("planning", "zenoh")]
    return runs


def start(installed: Runs, *overrides: str) -> Any:
    """A run that takes goals, and its client."""
    endpoint = free_endpoint()
    transport = (
        f"transport={{type: zenoh, mode: router, listen: [{endpoint}], shared_memory: false, "
        "share: {actions: [arm_trajectory, grip_action], services: [/estop, /set_mode, /reset]}}"
    )
    runtime = installed.start(*ROBOT, transport, *overrides, mode="goals", lockstep=False)
    return runtime, client(endpoint)


@pytest.fixture
def robot(installed: Runs) -> Any:
    runtime, near = start(installed)
    wait_for(lambda: {"/estop", "/set_mode/idle", "/reset"} <= {each.name for each in near.shared_services(WAIT_S)})
    wait_for(lambda: len(actions_of(near.shared_services(WAIT_S))) == 2)
    return runtime, near


def test_goals_end_with_feedback_and_result(robot: Any):
    runtime, near = robot
    feedback: list[dict[str, Any]] = []
    goal = SentGoal(near, ARM, FOLLOW, to(0.4), feedback.append)
    ended = goal.result(WAIT_S)
    assert (ended.status, ended.result["error_code"]) == (Status.SUCCEEDED, 0)
    assert runtime.session.measured().position[0] == pytest.approx(0.4, abs=0.02)
    assert len(feedback) >= 5
    assert feedback[-1]["joint_names"] == ["pan"]
    assert feedback[-1]["actual"]["positions"][0] == pytest.approx(0.4, abs=0.1)
    assert SentGoal(near, HAND, GRIP, {"command": {"position": 0.3}}).result(WAIT_S).result["reached_goal"]


def test_a_gripper_as_parallel_gripper_command(installed: Runs, caplog: pytest.LogCaptureFixture):
    _, near = start(installed, "transport.share.gripper_action=ParallelGripperCommand")
    kind = action_type("control_msgs/action/ParallelGripperCommand")
    wait_for(lambda: (HAND, kind.name) in actions_of(near.shared_services(WAIT_S)))
    feedback: list[dict[str, Any]] = []
    goal = {"command": {"name": ["grip"], "position": [0.3]}}
    ended = SentGoal(near, HAND, kind, goal, feedback.append).result(WAIT_S)
    assert (ended.status, ended.result["reached_goal"], ended.result["stalled"]) == (Status.SUCCEEDED, True, False)
    assert ended.result["state"]["name"] == feedback[-1]["state"]["name"] == ["grip"]
    assert ended.result["state"]["position"] == pytest.approx([0.3], abs=0.02)
    for wrong, why in (({"name": ["pan"], "position": [0.3]}, "names must be grip"), ({}, "needs one position")):
        with pytest.raises(TransportError, match="rejected the goal"):
            SentGoal(near, HAND, kind, {"command": wrong})
        assert why in caplog.text


def test_goals_are_canceled_and_replaced(robot: Any):
    _, near = robot
    first = SentGoal(near, ARM, FOLLOW, to(0.9, at=20))
    assert first.cancel()
    assert first.result(WAIT_S).status is Status.CANCELED
    assert not first.cancel(), "it has ended"
    old = SentGoal(near, ARM, FOLLOW, to(0.9, at=20))
    new = SentGoal(near, ARM, FOLLOW, to(0.2))
    ended = old.result(WAIT_S)
    assert (ended.status, ended.result["error_code"]) == (Status.ABORTED, -1)
    assert "replaced" in ended.result["error_string"]
    assert new.result(WAIT_S).status is Status.SUCCEEDED
    assert old.result(WAIT_S) == ended, "a result can be asked for again"


def test_all_goals_are_canceled_at_once(robot: Any):
    _, near = robot
    goals = [SentGoal(near, ARM, FOLLOW, to(0.9, at=20)), SentGoal(near, HAND, GRIP, {"command": {"position": 0.9}})]
    cancel = service_type("action_msgs/srv/CancelGoal")
    answer = near.call_ros(f"{ARM}/_action/cancel_goal", cancel, {}, WAIT_S)
    assert (answer["return_code"], len(answer["goals_canceling"])) == (0, 1)
    assert goals[0].result(WAIT_S).status is Status.CANCELED
    assert goals[1].result(WAIT_S).status is Status.SUCCEEDED
    unknown = {"goal_info": {"goal_id": {"uuid": [7] * 16}}}
    assert near.call_ros(f"{ARM}/_action/cancel_goal", cancel, unknown, WAIT_S)["return_code"] == 2
    result = near.call_ros(f"{ARM}/_action/get_result", FOLLOW.get_result, {"goal_id": {"uuid": [7] * 16}}, WAIT_S)
    assert result["status"] == Status.UNKNOWN


def test_result_of_a_refused_goal_says_why(robot: Any):
    runtime, near = robot
    before = runtime.session.state.command.copy()
    nan = {"path_tolerance": [{"name": "pan", "position": float("nan")}]}
    old = to(0.2)
    old["trajectory"] = {**old["trajectory"], "header": {"stamp": {"sec": 1}}}
    for goal, code, why in (
        (to(9.0), -1, "outside its limits"),
        ({"trajectory": {"joint_names": ["x"]}}, -2, "joint_names must be"),
        (to(0.9, at=0), -1, "leaves no time"),
        ({**to(0.2), **nan}, -1, "path_tolerance: pan: position is nan"),
        (old, -3, "it was to begin"),
    ):
        ended = SentGoal(near, ARM, FOLLOW, goal).result(WAIT_S)
        assert (ended.status, ended.result["error_code"]) == (Status.ABORTED, code)
        assert why in ended.result["error_string"]
    assert (runtime.session.state.command == before).all()


def test_a_stop_by_service_ends_a_goal(robot: Any):
    runtime, near = robot
    trigger = service_type("std_srvs/srv/Trigger")
    goal = SentGoal(near, ARM, FOLLOW, to(0.9, at=20))
    assert near.call_ros("/estop", trigger, {}, WAIT_S)["success"]
    ended = goal.result(WAIT_S)
    assert (ended.status, ended.result["error_code"]) == (Status.ABORTED, -1)
    refused = near.call_ros("/set_mode/idle", trigger, {}, WAIT_S)
    assert (refused["success"], "refused before a reset" in refused["message"]) == (False, True)
    assert near.call_ros("/reset", trigger, {}, WAIT_S)["success"]
    assert not runtime.session.faults


@pytest.mark.parametrize("stall_s", [0.1, *(pytest.param(each, marks=pytest.mark.long) for each in (0.7, 1.6)), 5.0])
def test_a_goal_from_before_a_stop_moves_nothing_after_its_reset(
    robot: Any, stall_s: float, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    runtime, near = robot
    sent_ns = time.time_ns() - round(stall_s * NS_PER_S)
    runtime.session.emergency_stop()
    wait_for(lambda: runtime.session.stopped_by)
    runtime.reset()
    before = runtime.session.state.command.copy()
    with monkeypatch.context() as patch:
        patch.setattr(ros_calls, "sent_now", lambda: attachment(1, sent_ns, bytes(16)))
        with pytest.raises(TransportError, match="rejected the goal"):
            SentGoal(near, HAND, GRIP, {"command": {"position": 0.3}})
        ended = SentGoal(near, ARM, FOLLOW, to(0.4)).result(WAIT_S)
    assert (ended.status, ended.result["error_code"]) == (Status.ABORTED, -1)
    assert "the goal: refused, it was sent before the robot was last stopped or reset" in ended.result["error_string"]
    assert "goal for grip_action refused: INVALID_GOAL: the goal: refused, it was sent before" in caplog.text
    assert (runtime.session.state.command == before).all()
    assert SentGoal(near, ARM, FOLLOW, to(0.4)).result(WAIT_S).status is Status.SUCCEEDED


@attrs.frozen
class Task:
    prompt: str = ""


@attrs.frozen
class Ending:
    success: bool
    message: str


@attrs.frozen
class Left:
    seconds_remaining: int
    feedback_message: str


def test_services_that_take_their_time_are_actions(installed: Runs):
    runtime, near = start(installed, "transport.share.services=[/record_episode, /record_episode/]")
    ended, bus = threading.Event(), runtime.session.bus
    progress = Service("/record_episode/progress", NoRequest, Left)
    cancel = Service("/record_episode/cancel", NoRequest, type(None))
    name, kind = "/record_episode", action_type("ibrobot_msgs/action/RecordEpisode")
    service = Service(name, Task, Ending, ros_type=kind.name, progress=progress, cancel=cancel)
    bus.serve(progress, lambda _: Left(7, "going on"))
    bus.serve(cancel, lambda _: ended.set())
    bus.serve(service, lambda task: Ending(ended.wait(WAIT_S), task.prompt))
    wait_for(lambda: (name, kind.name) in actions_of(near.shared_services(WAIT_S)))
    assert not [each for each in near.shared_services(WAIT_S) if each.name == name], "not a service as well"
    fed = queue.SimpleQueue[dict[str, Any]]()
    goal = SentGoal(near, name, kind, {"prompt": "pick"}, fed.put)
    assert fed.get(timeout=WAIT_S) == {"seconds_remaining": 7, "feedback_message": "going on"}
    assert goal.cancel()
    outcome = goal.result(WAIT_S)
    assert (outcome.status, outcome.result) == (Status.CANCELED, {"success": True, "message": "pick"})
    outcome = SentGoal(near, name, kind, {"prompt": "place"}).result(WAIT_S)
    assert (outcome.status, outcome.result["message"]) == (Status.SUCCEEDED, "place")


def test_the_status_is_latched(robot: Any):
    _, near = robot
    SentGoal(near, ARM, FOLLOW, to(0.1)).result(WAIT_S)
    arrived = threading.Event()
    near.subscribe_messages(f"{ARM}/_action/status", lambda message: arrived.set())
    assert arrived.wait(WAIT_S)


def test_executors_that_take_no_goals_are_refused(installed: Runs):
    transport = "transport={type: zenoh, mode: router, share: {actions: [%s]}}"
    with pytest.raises(NotSupported, match="arm_positoin is no executor that takes goals"):
        installed.make(*ROBOT, transport % "arm_positoin", mode="goals", lockstep=False)
    with pytest.raises(NotSupported, match=r"transport\.share\.actions: a lockstep run cannot take goals"):
        installed.make(*ROBOT, transport % "arm_trajectory", mode="goals")
