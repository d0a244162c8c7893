"""Motions of an arm with five joints: services and topics of a planning mode, cancelling and replacing goals."""

from __future__ import annotations

import itertools
import re
import threading
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ibrobot_planning.execution.plans import GoalPlans
from ibrobot_planning.execution.requests import GoTo, MoveResult, MoveToConfiguration, MoveToPose, Numbered, Results
from ibrobot_planning.execution.services import CARTESIAN, COMPUTE_FK, COMPUTE_IK, PLAN
from ibrobot_planning.execution.source import (
    CANCEL,
    CMD_GOAL,
    CMD_POSE,
    GO_TO,
    MOTION_STATUS,
    MOVE_ACTION,
    MOVE_TO_CONFIGURATION,
    MOVE_TO_POSE,
    RESULT,
)
from ibrobot_planning.planner import PositionGoal

from ibrobot_core.api import (
    Header,
    JointState,
    NotSupported,
    PlanCode,
    PlanningError,
    Pose,
    PoseStamped,
    Quaternion,
    String,
    TransportError,
    Vector,
    Vector3,
)
from ibrobot_core.app import RequestError, Runtime

from .conftest import Make
from .table_arm import JOINTS, make_robot

RATE_HZ = 100.0
VELOCITY, ACCELERATION = 3.0, 10.0
DOWN = Quaternion(1.0, 0.0, 0.0, 0.0)


def robot_yaml(folder: Path) -> str:
    robot = make_robot(folder)
    joints = "".join(
        f"    - {{name: {j.name}, lower: {j.lower}, upper: {j.upper}, max_velocity: {VELOCITY},"
        f" max_acceleration: {ACCELERATION}}}\n"
        for j in robot.joints
    )
    poses = ", ".join(f"{name}: {list(values)}" for name, values in robot.description.poses.items())
    return f"""\
robot:
  name: tabletop
  joints:
{joints}  groups: {{arm: [pan, lift, elbow, flex, roll], gripper: [jaw]}}
  description: {{mjcf: arm.xml, tip: tip, poses: {{{poses}}}}}
hardware: {{type: arm}}
simulation: {{type: scene}}
executors:
  arm: {{type: trajectory, group: arm}}
  gripper: {{type: gripper, group: gripper}}
control_modes:
  plan: {{executors: [arm, gripper], planner: {{type: rrt_connect}}}}
  joint: {{executors: [arm, gripper], planner: {{type: joint, velocity_scaling: 0.9, acceleration_scaling: 0.9}}}}
  idle: {{executors: [arm]}}
default_control_mode: plan
control: {{rate_hz: {RATE_HZ:g}, stop: hold}}
"""


@pytest.fixture
def run(start: Make, tmp_path: Path) -> Callable[..., Runtime]:
    def started(**asked: Any) -> Runtime:
        return start(text=robot_yaml(tmp_path), **asked)

    return started


def command(runtime: Runtime) -> Vector:
    assert runtime.session.state is not None
    return runtime.session.state.command.copy()


def finish(runtime: Runtime, number: int, commands: list[Vector] | None = None) -> MoveResult:
    """Step until a goal has ended."""
    for _ in range(2000):
        runtime.step()
        if commands is not None:
            commands.append(command(runtime))
        result = runtime.session.bus.call(RESULT, number)
        if result is not None:
            assert isinstance(result, MoveResult)
            return result
    raise AssertionError("the goal does not end")


def test_of_a_flood_of_goals_the_newest_is_planned_and_a_cancel_waits_for_none(
    run: Callable[..., Runtime], monkeypatch: pytest.MonkeyPatch
):
    runtime, planned, plan = run(by_operator=True), [0], GoalPlans.plan

    def counted(self: GoalPlans, *arguments: Any, **options: Any) -> Any:
        planned[0] += 1
        return plan(self, *arguments, **options)

    monkeypatch.setattr(GoalPlans, "plan", counted)
    call = runtime.session.bus.call

    def message(number: int) -> str:
        result = call(RESULT, number)
        assert result is not None
        return result.message

    numbers = [call(GO_TO, "up") for _ in range(50)]
    call(CANCEL)
    runtime.step()
    assert set(map(message, numbers)) == {"cancelled"}
    assert planned[0] == 0
    *dropped, newest = [call(GO_TO, "up") for _ in range(50)]
    assert finish(runtime, newest).success
    assert set(map(message, dropped)) == {"replaced by goal up"}
    assert planned[0] == 1


def go(runtime: Runtime, goal: Any) -> MoveResult:
    return finish(runtime, runtime.session.bus.call(GO_TO, GoTo(goal)))


def test_position_with_an_axis_and_the_gripper(run):
    runtime = run()
    result = go(runtime, "xyz=0.2,0.05,0.1 axis=down jaw=0.5")
    assert (result.success, result.outcome, result.code, result.message) == (True, "SUCCEEDED", PlanCode.SUCCESS, "")
    assert result.execution_time_s > 0.2
    assert result.position_error_m < 1e-3
    assert runtime.session.state.position[5] == pytest.approx(0.5, abs=0.05)


def test_goal_of_the_command_line_takes_a_position(run):
    runtime = run(goals=("xyz=0.2,0.05,0.1 axis=down", "left"))
    while not runtime.step():
        pass
    assert runtime.summary()["goals_failed"] == 0
    np.testing.assert_allclose(runtime.session.state.position[:5], [1.0, 0.8, 0.8, 0.5, 0.0], atol=0.05)


def test_result_has_the_code_and_the_sentence_of_the_planner(run):
    runtime = run()
    result = go(runtime, PositionGoal(Vector3(2.0, 0.0, 0.1)))
    assert (result.success, result.outcome, result.code.name) == (False, "PLANNING_FAILED", "NO_IK_SOLUTION")
    assert "reach" in result.message
    assert result.execution_time_s == 0.0
    assert runtime.summary()["goals_failed"] == 1


NO_TOOL = (
    "goal 'xyz=0.2,0.05,0.1': planner type 'joint' of mode joint takes joint positions only; types that take other"
    " goals: cubic, rrt_connect"
)


def test_goal_that_the_planner_does_not_take_is_refused_before_anything_starts(make: Make, tmp_path: Path):
    with pytest.raises(PlanningError) as failure:
        make(text=robot_yaml(tmp_path), mode="joint", goals=("up", "xyz=0.2,0.05,0.1"))
    assert (str(failure.value), failure.value.code) == (NO_TOOL, PlanCode.UNRECOGNIZED_GOAL_TYPE)
    assert failure.value.exit_code == 2


def test_goal_of_a_service_that_the_planner_does_not_take_is_refused(run):
    runtime = run(mode="joint")
    with pytest.raises(PlanningError) as failure:
        runtime.session.bus.call(GO_TO, "xyz=0.2,0.05,0.1")
    assert str(failure.value) == NO_TOOL


def test_log_has_the_code_of_the_planner(run, caplog: pytest.LogCaptureFixture):
    go(run(), PositionGoal(Vector3(2.0, 0.0, 0.1)))
    assert "goal position 2, 0, 0.1 failed: NO_IK_SOLUTION: " in caplog.text


@pytest.mark.parametrize("stamped", [True, False], ids=["PoseStamped", "Pose"])
def test_cmd_pose_is_a_goal(run, stamped: bool):
    runtime = run()
    seen = runtime.session.bus.subscribe(MOTION_STATUS, 1000)
    pose = Pose(Vector3(0.2, 0.05, 0.1), DOWN)
    runtime.session.bus.publish(CMD_POSE, PoseStamped(Header(0, "base_link"), pose) if stamped else pose)
    for _ in range(300):
        runtime.step()
    shown = [item.message.data for item in seen.drain() if isinstance(item.message, String)]
    assert shown[0] == "idle"
    assert set(shown[1:-1]) == {"executing"}
    assert shown[-1] == "succeeded"
    assert len(shown) > 5, "it is published while the robot moves"


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (
            PoseStamped(Header(0, "camera"), Pose()),
            "FRAME_TRANSFORM_FAILURE: frame 'camera' is not the base; it is called base, base_link",
        ),
        (
            Pose(Vector3(0.2, 0.0, 0.1), Quaternion(1.0, 0.0, 0.0, 1.0)),
            "INVALID_GOAL_CONSTRAINTS: the orientation of the goal is a quaternion of length 1.41, must be 1",
        ),
    ],
)
def test_wrong_cmd_pose_moves_nothing(run, message, expected: str, caplog: pytest.LogCaptureFixture):
    runtime = run()
    before = command(runtime)
    runtime.session.bus.publish(CMD_POSE, message)
    for _ in range(20):
        runtime.step()
    assert f"/cmd_pose: {expected}" in caplog.text
    np.testing.assert_array_equal(command(runtime), before)


def test_cmd_goal_is_a_goal_in_words(run):
    runtime = run()
    runtime.session.bus.publish(CMD_GOAL, String("pan=0.3"))
    for _ in range(200):
        runtime.step()
    np.testing.assert_allclose(command(runtime)[0], 0.3, atol=1e-3)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "goal '': a goal is a pose's name, joints, e.g. "),
        ("pann=0.3", "goal 'pann=0.3': no joint 'pann'; the joints are: pan, "),
        ("pan=nan", "goal 'pan=nan': 'nan' is not an angle in radians"),
        ("pan=0.3\n" * 1_000_000, "goal has 8000000 characters, at most 1000 are read"),
    ],
)
def test_wrong_cmd_goal_moves_nothing(run, text: str, expected: str, caplog: pytest.LogCaptureFixture):
    runtime = run()
    before = command(runtime)
    runtime.session.bus.publish(CMD_GOAL, String(text))
    for _ in range(20):
        runtime.step()
    assert f"/cmd_goal: INVALID_GOAL_CONSTRAINTS: {expected}" in caplog.text
    assert len(caplog.text) < 10_000
    np.testing.assert_array_equal(command(runtime), before)


def test_a_cmd_pose_of_another_type_is_refused(run):
    with pytest.raises(TransportError, match=r"topic /cmd_pose carries geometry_msgs/msg/Pose or .*, not std_msgs/msg"):
        run().session.bus.publish(CMD_POSE, String("up"))


def call(runtime: Runtime, service: Any, request: object) -> MoveResult:
    """Call a service that waits from a thread of its own."""
    answers: list[MoveResult] = []
    thread = threading.Thread(target=lambda: answers.append(runtime.session.bus.call(service, request)))
    thread.start()
    for _ in range(20000):
        runtime.step()
        if not thread.is_alive():
            break
    thread.join(10.0)
    return answers[0]


def test_move_to_pose_waits_for_the_motion(run):
    result = call(run(), MOVE_TO_POSE, MoveToPose(Pose(Vector3(0.2, 0.05, 0.1), DOWN), 0.5))
    assert result.success
    assert result.position_error_m < 1e-3
    assert result.orientation_error_rad <= np.pi


def test_move_to_configuration_waits_for_the_motion(run):
    runtime = run()
    state = JointState(Header(0), ("pan", "jaw"), np.array([0.4, 0.3]), np.empty(0), np.empty(0))
    assert call(runtime, MOVE_TO_CONFIGURATION, MoveToConfiguration(state)).success
    assert runtime.session.state.position[[0, 5]] == pytest.approx([0.4, 0.3], abs=0.05)
    mapping = {"target_joint_state": {"name": ["pan"], "position": [0.1]}}
    assert call(runtime, MOVE_TO_CONFIGURATION, mapping).success


def test_request_that_makes_no_sense_is_rejected(run):
    runtime = run()
    state = JointState(Header(0), ("tilt",), np.array([0.4]), np.empty(0), np.empty(0))
    result = call(runtime, MOVE_TO_CONFIGURATION, MoveToConfiguration(state))
    assert (result.outcome, result.message) == ("REJECTED", f"no joint 'tilt'; the joints are: {', '.join(JOINTS)}")
    result = call(runtime, MOVE_TO_POSE, MoveToPose(Pose(), 1.5))
    assert result.message == "velocity_scaling is 1.5, must be from 0.01 to 1"
    result = call(runtime, MOVE_TO_POSE, MoveToPose(Pose(Vector3(0.2, 0.0, 0.1), Quaternion(w=0.0))))
    assert (result.outcome, result.message) == (
        "REJECTED",
        "the orientation of the goal is a quaternion of length 0, must be 1",
    )


def test_end_of_the_run_ends_a_service_that_waits(run):
    runtime = run()
    answers: list[MoveResult] = []
    request = MoveToPose(Pose(Vector3(0.2, 0.05, 0.1), DOWN))
    thread = threading.Thread(target=lambda: answers.append(runtime.session.bus.call(MOVE_TO_POSE, request)))
    runtime.step()
    thread.start()
    runtime.stop()
    thread.join(10.0)
    assert answers[0].outcome == "CANCELLED"


@pytest.mark.parametrize(
    ("service", "request_", "error", "expected"),
    [
        (GO_TO, "xyz=1", PlanningError, "goal 'xyz=1': xyz takes 3 numbers, got 1"),
        (
            GO_TO,
            "xyz=0.2,0,0.1 pan=1",
            PlanningError,
            "goal 'xyz=0.2,0,0.1 pan=1': pan moves the tool, and cannot be given beside its position",
        ),
        (RESULT, 99, PlanningError, "no goal 99; /planning/go_to answers with the number of a goal"),
        (
            MOVE_TO_POSE,
            Pose(),
            RequestError,
            "/moveit_gateway/move_to_pose: a Pose is no plain data",
        ),
        (
            MOVE_TO_CONFIGURATION,
            "up",
            RequestError,
            "/moveit_gateway/move_to_configuration: expected a mapping with target_joint_state",
        ),
        (MOVE_TO_POSE, MoveToPose(Pose()), NotSupported, "this service waits for the motion: "),
    ],
)
def test_wrong_request_is_an_error(run, service: str, request_: object, error: type[Exception], expected: str):
    runtime = run()
    runtime.step()
    with pytest.raises(error) as failure:
        runtime.session.bus.call(service, request_)
    assert str(failure.value).startswith(expected)


def assert_within_limits(runtime: Runtime, commands: list[Vector]) -> None:
    """No command of the arm steps beyond its limits, and the safety layer had nothing to correct."""
    path = np.array(commands)[:, :5]
    velocities = np.diff(path, axis=0) * RATE_HZ
    assert np.abs(velocities).max() <= VELOCITY * 1.001
    assert np.abs(np.diff(velocities, axis=0)).max() * RATE_HZ <= ACCELERATION * 1.02
    corrected = runtime.session.counts()["interventions"]
    assert {joint: corrected.get(joint, 0) for joint in JOINTS[:5]} == dict.fromkeys(JOINTS[:5], 0)


def random_goal(rng: np.random.Generator) -> str:
    return ",".join(f"{joint}={value:.3f}" for joint, value in zip(JOINTS[:5], rng.uniform(-1.2, 1.2, 5), strict=True))


def test_goals_cancelled_and_replaced_step_nowhere(run):
    runtime = run(mode="joint", seed=3)
    rng = np.random.default_rng(3)
    bus, commands = runtime.session.bus, [command(runtime)]
    outcomes, replaced = [], None
    for number in range(40):
        goal = bus.call(GO_TO, random_goal(rng))
        if replaced is not None:
            outcomes.append(finish(runtime, replaced, commands).outcome)
        for _ in range(int(rng.integers(1, 80))):
            runtime.step()
            commands.append(command(runtime))
        replaced = None if number % 2 else goal
        if replaced is None:
            bus.call(CANCEL, None)
            outcomes.append(finish(runtime, goal, commands).outcome)
            still = command(runtime)
            for _ in range(5):
                runtime.step()
                commands.append(command(runtime))
            np.testing.assert_allclose(command(runtime), still, atol=1e-9)
    assert finish(runtime, bus.call(GO_TO, random_goal(rng)), commands).success
    assert outcomes.count("CANCELLED") >= 36, outcomes
    assert_within_limits(runtime, commands)
    assert runtime.summary()["goals_failed"] == 0


def test_replaced_goal_says_by_what(run):
    runtime = run(mode="joint")
    first = runtime.session.bus.call(GO_TO, "left")
    for _ in range(20):
        runtime.step()
    assert runtime.session.bus.call(RESULT, first) is None
    runtime.session.bus.call(GO_TO, "up")
    result = finish(runtime, first)
    assert (result.outcome, result.code, result.message) == ("CANCELLED", PlanCode.PREEMPTED, "replaced by goal up")


def test_cancel_before_the_first_goal_holds(run):
    runtime = run(mode="joint")
    before = command(runtime)
    runtime.session.bus.call(CANCEL, None)
    for _ in range(5):
        runtime.step()
    np.testing.assert_array_equal(command(runtime), before)


def test_goals_of_the_request_that_are_cancelled_end_the_run(run):
    runtime = run(mode="joint", goals=("left", "up"))
    for _ in range(20):
        runtime.step()
    runtime.session.bus.call(CANCEL, None)
    for _ in range(200):
        if runtime.step():
            break
    assert runtime.session.finished.is_set()
    assert runtime.summary()["goals_failed"] == 2


def test_number_of_a_goal_means_one_goal_also_after_a_switch_of_the_mode(run):
    runtime = run(mode="joint")
    first = runtime.session.bus.call(GO_TO, "up")
    reached = finish(runtime, first)
    under_way = runtime.session.bus.call(GO_TO, "left")
    for _ in range(20):
        runtime.step()
    runtime.switch_mode("plan")
    left = runtime.session.bus.call(RESULT, Numbered(under_way))
    assert (left.outcome, left.message) == ("CANCELLED", "the mode or the run ended, or control was reset")
    third = runtime.session.bus.call(GO_TO, "up")
    assert len({first, under_way, third}) == 3
    assert finish(runtime, third).success
    assert runtime.session.bus.call(RESULT, Numbered(first)) is reached
    assert runtime.session.bus.call(RESULT, Numbered(under_way)) is left


def test_goal_that_waits_when_its_mode_ends_is_dropped(run):
    """Nothing moves later, when the mode is entered again."""
    runtime = run(mode="joint")
    number = runtime.session.bus.call(GO_TO, "left")
    runtime.switch_mode("idle")
    runtime.switch_mode("joint")
    before = command(runtime)
    for _ in range(100):
        runtime.step()
    np.testing.assert_allclose(command(runtime), before, atol=1e-3)
    assert runtime.session.bus.call(RESULT, Numbered(number)).outcome == "CANCELLED"


def test_old_result_differs_from_a_missing_goal(run):
    runtime = run(mode="joint")
    first = runtime.session.bus.call(GO_TO, "up")
    for _ in range(Results.KEPT):
        last = runtime.session.bus.call(GO_TO, "up")
    finish(runtime, last)
    with pytest.raises(PlanningError) as failure:
        runtime.session.bus.call(RESULT, Numbered(first))
    assert str(failure.value) == f"the result of goal {first} is no longer kept, only the last 100 are"
    assert runtime.session.bus.call(RESULT, Numbered(first + 1)).outcome == "CANCELLED"
    with pytest.raises(PlanningError, match=f"no goal {last + 1}; "):
        runtime.session.bus.call(RESULT, Numbered(last + 1))


SCALINGS = (1e-300, 1e-5, 0.0, -1.0, 1.0000001, 1e300)


@pytest.mark.parametrize("scaling", SCALINGS)
@pytest.mark.parametrize("name", ["velocity_scaling", "acceleration_scaling"])
def test_scalings_that_cannot_be_planned_with_are_refused_at_once(run, name: str, scaling: float):
    bus = run().session.bus
    goals = {"joints": {"pan": 0.5}}
    for service, request in (
        (MOVE_ACTION, {"goals": [goals]}),
        (PLAN, {"goals": [goals]}),
        (CARTESIAN, {"waypoints": [{"xyz": [0.2, 0, 0.1]}]}),
    ):
        with pytest.raises(RequestError, match=rf"^{service.name}: {name}: \S+ is too (small|large), must be at"):
            bus.call(service, request | {name: scaling})


def test_the_slowest_scaling_is_planned_within_bounds(run):
    bus = run().session.bus
    request = {"goals": [{"joints": {"pan": 0.2}}], "velocity_scaling": 0.01, "acceleration_scaling": 0.01}
    tracemalloc.start()
    answer = bus.call(PLAN, request)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert answer.code is PlanCode.SUCCESS, answer.message
    assert most < 200e6


@pytest.mark.parametrize("planner", ["plan", "joint"])
def test_motion_that_would_take_too_long_is_refused(make: Make, tmp_path: Path, planner: str):
    slow = robot_yaml(tmp_path).replace(f"max_velocity: {VELOCITY}", "max_velocity: 1.0e-4")
    runtime = make(text=slow, mode=planner)
    runtime.start()
    answer = runtime.session.bus.call(PLAN, {"goals": [{"joints": {"pan": 0.5}}]})
    assert answer.code is PlanCode.PLANNING_FAILED
    assert re.search(r"the motion would take \S+ s, at most 300 s are planned: raise velocity_scaling", answer.message)


def test_long_lists_are_refused(run):
    bus = run().session.bus
    goal = {"xyz": [0.2, 0.0, 0.1]}
    for service, request, told in (
        (MOVE_ACTION, {"goals": [goal] * 21}, "goals: 21 are too many, at most 20 are planned for"),
        (PLAN, {"goals": [goal] * 1000}, "the request has more than 2000 values"),
        (CARTESIAN, {"waypoints": [goal] * 101}, "waypoints: 101 are too many, at most 100 are planned for"),
        (COMPUTE_FK, {"links": ["hand"] * 101}, "links: 101 are too many, at most 100 are planned for"),
    ):
        with pytest.raises(RequestError, match=told):
            bus.call(service, request)


def test_poses_on_the_axis_of_the_base_are_planned_or_refused(run):
    bus = run().session.bus
    policies = ("refuse", "nearest", "keep_axis", "arm_plane", "current", "free")
    places = ((0.0, 0.0, 0.0), (0.0, 0.0, 1e-9), (0.0, 0.0, 0.9), (1e-12, 0.0, -0.1))
    for policy, xyz in itertools.product(policies, places):
        goal = {"xyz": list(xyz), "quaternion": [0, 0, 0, 1], "beyond_reach": policy}
        for answer in (bus.call(PLAN, {"goals": [goal]}), bus.call(COMPUTE_IK, {"goal": goal})):
            assert "Error" not in answer.message, goal


def test_inverse_kinematics_keeps_path_constraints(run):
    bus = run().session.bus
    goal = {"xyz": [0.2, 0.05, 0.1], "path_constraints": {"upright": 0.1, "upright_axis": "-z"}}
    answer = bus.call(COMPUTE_IK, {"goal": goal})
    joints = dict(zip(answer.joint_state.name, answer.joint_state.position.tolist(), strict=True))
    turned = bus.call(COMPUTE_FK, {"joints": joints}).poses[0].pose.orientation
    assert np.arccos(2 * (turned.x**2 + turned.y**2) - 1) <= 0.1
    ahead = bus.call(COMPUTE_IK, {"goal": {**goal, "xyz": [0.27, 0.0675, 0.12], "axis": [1, 0.25, 0]}})
    assert ahead.code is PlanCode.GOAL_VIOLATES_PATH_CONSTRAINTS
    assert "no configuration at the position keeps it" in ahead.message


def test_goals_of_services_have_the_keys_of_task_files(start, tmp_path):
    """One grammar: relative to an object, relative to the tool, a direction by its name."""
    cup = "world: {objects: {cup: {shape: sphere, radius: 0.02, position: [0.2, 0.1, 0.05]}}}\n"
    bus = start(text=robot_yaml(tmp_path) + cup).session.bus
    tool = bus.call(COMPUTE_FK).poses[0].pose.position
    goals = {
        (0.2, 0.1, 0.15): {"object": "cup", "xyz": [0.0, 0.0, 0.1]},
        (tool.x, tool.y, tool.z - 0.02): {"xyz": [0.0, 0.0, -0.02], "relative": True},
        (0.2, 0.05, 0.1): {"xyz": [0.2, 0.05, 0.1], "axis": "down", "angle_tolerance": 0.02},
    }
    for place, goal in goals.items():
        answer = bus.call(COMPUTE_IK, {"goal": goal})
        assert answer.code is PlanCode.SUCCESS, answer.message
        joints = dict(zip(answer.joint_state.name, answer.joint_state.position.tolist(), strict=True))
        reached = bus.call(COMPUTE_FK, {"joints": joints}).poses[0].pose.position
        assert (reached.x, reached.y, reached.z) == pytest.approx(place, abs=2e-3)
        assert bus.call(PLAN, {"goals": [goal]}).code is PlanCode.SUCCESS
    answer = bus.call(PLAN, {"goals": [{"object": "mug"}]})
    assert (answer.code, answer.message) == (PlanCode.INVALID_OBJECT_NAME, "no object 'mug'; the objects are: cup")
    with pytest.raises(RequestError, match=r"goals\.0\.quat: unknown key; known keys: .*, quaternion, "):
        bus.call(PLAN, {"goals": [{"xyz": [0.2, 0.0, 0.1], "quat": [0, 0, 0, 1]}]})


@pytest.mark.parametrize(
    ("text", "key", "joint"),
    [("jaw=0.1 upright=0.5", "upright", "jaw"), ("jaw=0.1 region=5,5,5,6,6,6", "region", "jaw")],
)
def test_constraints_are_refused_where_nothing_is_planned(run, text: str, key: str, joint: str):
    runtime = run()
    before = command(runtime)
    message = f"{key} holds on a planned way, but {joint} goes to its position without a plan: leave {key} out"
    with pytest.raises(PlanningError, match=message) as refused:
        runtime.session.bus.call(GO_TO, text)
    assert refused.value.code is PlanCode.INVALID_GOAL_CONSTRAINTS
    np.testing.assert_array_equal(command(runtime), before)


def test_constraints_are_refused_where_a_joint_of_the_tool_goes_alone(start: Make, tmp_path: Path):
    text = robot_yaml(tmp_path).replace("flex, roll], gripper: [jaw]", "flex], wrist: [roll], gripper: [jaw]")
    text = text.replace("executors:\n", "executors:\n  wrist: {type: gripper, group: wrist}\n")
    runtime = start(text=text.replace("[arm, gripper]", "[arm, wrist, gripper]"))
    for goal in ("roll=-1.5 upright=0.05", "pan=0.1,roll=0.5 upright=0.5", "left upright=0.5"):
        with pytest.raises(
            PlanningError, match="upright holds on a planned way, but roll goes to its position without"
        ):
            runtime.session.bus.call(GO_TO, goal)
