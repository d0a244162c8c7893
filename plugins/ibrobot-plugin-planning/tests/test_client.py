"""Scripts for pymoveit2 on a robot in lockstep: the classes of `ibrobot_planning.client`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, override

import numpy as np
import pytest
from ibrobot_planning.client import GripperInterface, LocalNode, MoveIt2, MoveIt2Servo, MoveIt2State
from ibrobot_planning.client.node import BaseNode
from ibrobot_planning.client.robots import RobotNames, so101

from ibrobot_core.api import Header, JointState, NotSupported, PlanningError, Pose, PoseStamped, Quaternion, Vector3
from ibrobot_core.app import PlanCode, Runtime

from .conftest import Make
from .table_arm import ARM
from .test_motion import robot_yaml
from .test_world import STL

DOWN = (1.0, 0.0, 0.0, 0.0)
LEFT = [1.0, 0.8, 0.8, 0.5, 0.0]


@pytest.fixture
def run(start: Make, tmp_path: Path) -> Callable[..., Runtime]:
    def started(*overrides: str, **asked: Any) -> Runtime:
        return start(*overrides, text=robot_yaml(tmp_path) + f"world: {{meshes: {tmp_path}}}\n", **asked)

    return started


@pytest.fixture
def robot(run: Callable[..., Runtime]) -> Iterator[SimpleNamespace]:
    """A robot in lockstep with its clients."""
    runtime = run()
    with LocalNode(runtime) as node:
        node.wait(0.1)
        arm = MoveIt2(node=node, joint_names=list(ARM), base_link_name="base_link", end_effector_name="tip")
        gripper = GripperInterface(node, ["jaw"], [0.5], [0.0])
        yield SimpleNamespace(runtime=runtime, node=node, arm=arm, gripper=gripper)


def arm_positions(robot: SimpleNamespace) -> list[float]:
    return list(robot.runtime.session.state.position[:5])


def test_configuration_and_gripper(robot: SimpleNamespace):
    robot.arm.move_to_configuration(LEFT)
    assert robot.arm.query_state() is MoveIt2State.EXECUTING
    assert robot.arm.wait_until_executed()
    assert robot.arm.query_state() is MoveIt2State.IDLE
    assert arm_positions(robot) == pytest.approx(LEFT, abs=0.03)
    robot.gripper.open()
    assert robot.gripper.wait_until_executed()
    assert robot.gripper.is_open
    robot.gripper()
    assert robot.gripper.wait_until_executed()
    assert robot.gripper.is_closed
    robot.gripper.open(skip_if_noop=False)
    robot.gripper.wait_until_executed()
    robot.gripper.open(skip_if_noop=True)
    assert robot.gripper.wait_until_executed(), "nothing new was asked for"
    robot.gripper.move_to_position(0.2)
    assert robot.gripper.wait_until_executed()
    assert "jaw" in robot.gripper.joint_state.name
    # The joint state of the client may be a moment old.
    assert robot.runtime.session.state.position[5] == pytest.approx(0.2, abs=0.03)


def test_joints_in_another_order(robot: SimpleNamespace):
    robot.arm.move_to_configuration([0.3, -0.2], joint_names=["lift", "pan"])
    assert robot.arm.wait_until_executed()
    assert arm_positions(robot)[:2] == pytest.approx([-0.2, 0.3], abs=0.03)


def test_kinematics_agree(robot: SimpleNamespace):
    pose = robot.arm.compute_fk(LEFT)
    assert isinstance(pose, PoseStamped)
    assert pose.header.frame_id == "base_link"
    position, orientation = pose.pose.position, pose.pose.orientation
    state = robot.arm.compute_ik(position, orientation)
    assert isinstance(state, JointState)
    again = robot.arm.compute_fk(state)
    for name in "xyz":
        assert getattr(again.pose.position, name) == pytest.approx(getattr(position, name), abs=1e-3)
    tip, hand = robot.arm.compute_fk(LEFT, ["tip", "hand"])
    # The tip is 60 mm ahead of the hand.
    between = np.array([getattr(tip.pose.position, n) - getattr(hand.pose.position, n) for n in "xyz"])
    assert np.linalg.norm(between) == pytest.approx(0.06, abs=1e-6)
    assert robot.arm.compute_fk() == robot.arm.compute_fk(robot.arm.joint_state)


def test_orientation_that_five_joints_cannot_take(robot: SimpleNamespace, caplog: pytest.LogCaptureFixture):
    sideways = (0.5, 0.5, 0.5, 0.5)
    assert robot.arm.compute_ik((0.2, 0.1, 0.2), sideways) is None
    assert "NO_IK_SOLUTION: tip cannot take this orientation" in caplog.text
    assert robot.arm.get_last_execution_error_code().val is PlanCode.NO_IK_SOLUTION
    robot.arm.beyond_reach = "free"
    assert robot.arm.compute_ik((0.2, 0.1, 0.2), sideways) is not None
    assert robot.arm.compute_ik((0.2, 0.1, 0.2)) is not None, "a position alone"


def test_pose_planned_and_executed(robot: SimpleNamespace):
    robot.arm.max_velocity = robot.arm.max_acceleration = 0.5
    plan = robot.arm.plan(position=(0.2, 0.05, 0.1), quat_xyzw=None)
    assert plan is not None
    assert plan.joint_names == ARM
    robot.arm.execute(plan)
    assert robot.arm.wait_until_executed()
    assert arm_positions(robot) == pytest.approx(plan.points[-1].positions.tolist(), abs=0.03)
    fast, robot.arm.max_velocity, robot.arm.max_acceleration = None, 0.0, 0.0
    fast = robot.arm.plan(joint_positions=LEFT, start_joint_state=[0.0] * 5)
    robot.arm.max_velocity = 0.2
    slow = robot.arm.plan(joint_positions=LEFT, start_joint_state=[0.0] * 5)
    assert slow.points[-1].time_from_start_ns > 2 * fast.points[-1].time_from_start_ns


def test_plan_from_elsewhere_is_not_executed(robot: SimpleNamespace, caplog: pytest.LogCaptureFixture):
    plan = robot.arm.plan(joint_positions=LEFT, start_joint_state=[1.5, 0.0, 0.0, 0.0, 0.0])
    robot.arm.execute(plan)
    assert not robot.arm.wait_until_executed()
    assert robot.arm.get_last_execution_error_code().val is PlanCode.START_STATE_INVALID
    assert "the trajectory begins with pan at " in caplog.text
    assert "at most 0.01 rad may lie between them" in caplog.text


def test_straight_line(robot: SimpleNamespace):
    robot.arm.move_to_pose(position=(0.2, 0.0, 0.12), cartesian=False)
    assert robot.arm.wait_until_executed()
    heights = []
    robot.node._on_step = lambda: heights.append(robot.arm.compute_fk().pose.position.z)
    robot.arm.move_to_pose(position=(0.2, 0.06, 0.12), cartesian=True, cartesian_fraction_threshold=0.9)
    assert robot.arm.wait_until_executed()
    assert np.ptp(heights) < 0.015
    assert robot.arm.compute_fk().pose.position.y == pytest.approx(0.06, abs=0.01)


def test_alternatives(robot: SimpleNamespace):
    robot.arm.set_position_goal((3.0, 0.0, 0.0))
    robot.arm.create_new_goal_constraint()
    robot.arm.set_joint_goal([0.4])
    robot.arm.move_to_pose()
    assert robot.arm.wait_until_executed()
    assert arm_positions(robot)[0] == pytest.approx(0.4, abs=0.03)


def test_cancel_holds_and_a_new_motion_replaces(robot: SimpleNamespace):
    robot.arm.move_to_configuration(LEFT)
    future = robot.arm.get_execution_future()
    robot.node.wait(0.3)
    assert not future.done()
    robot.arm.cancel_execution()
    assert future.result()["outcome"] == "CANCELLED"
    assert not robot.arm.wait_until_executed()
    assert robot.arm.get_last_execution_error_code().val is PlanCode.PREEMPTED
    robot.arm.move_to_configuration(LEFT)
    robot.node.wait(0.2)
    robot.arm.move_to_configuration([-0.3, 0.0, 0.0, 0.0, 0.0])
    assert robot.arm.wait_until_executed()
    assert arm_positions(robot)[0] == pytest.approx(-0.3, abs=0.03)


def test_calls_can_be_ignored_while_executing(robot: SimpleNamespace):
    arm = MoveIt2(robot.node, list(ARM), "base", "tip", ignore_new_calls_while_executing=True)
    arm.move_to_configuration(LEFT)
    arm.move_to_configuration([0.0] * 5)
    assert arm.wait_until_executed()
    assert arm_positions(robot)[0] == pytest.approx(1.0, abs=0.03)


def test_calls_in_the_background(robot: SimpleNamespace):
    plan = robot.arm.plan_async(joint_positions=LEFT)
    assert plan.result(60) is not None
    assert robot.arm.get_trajectory(plan) is plan.result()
    assert robot.arm.get_compute_ik_result(_done(robot.arm.compute_ik_async((0.2, 0.05, 0.1)))) is not None
    assert robot.arm.get_compute_fk_result(_done(robot.arm.compute_fk_async(LEFT))) is not None


def _done(future: Any) -> Any:
    future.result(60)
    return future


def test_world(robot: SimpleNamespace, tmp_path: Path):
    mesh = tmp_path / "part.stl"
    mesh.write_text(STL)
    add = robot.arm
    add.add_collision_box("table", (0.6, 0.6, 0.02), position=(0.0, 0.0, -0.05), quat_xyzw=(0, 0, 0, 1))
    add.add_collision_sphere("ball", 0.02, position=(0.25, 0.1, 0.1), quat_xyzw=(0, 0, 0, 1))
    add.add_collision_cylinder("can", 0.1, 0.03, pose=Pose(Vector3(0.0, 0.35, 0.05), Quaternion(*DOWN)))
    add.add_collision_mesh(str(mesh), "part", position=(0.0, -0.3, 0.1), quat_xyzw=(0, 0, 0, 1), scale=0.001)
    add.update_planning_scene()
    objects = add.planning_scene["objects"]
    assert {name: each["shape"] for name, each in objects.items()} == {
        "table": "box",
        "ball": "sphere",
        "can": "cylinder",
        "part": "mesh",
    }
    assert abs(objects["can"]["pose"]["orientation"]["x"]) == pytest.approx(1.0)
    add.add_collision_box("ball", (0.02, 0.02, 0.02), position=(0.25, 0.1, 0.1))
    add.move_collision("ball", (0.0, 0.0, 0.55), (0, 0, 0, 1))
    add.attach_collision_object("ball", touch_links=["finger"])
    add.update_planning_scene()
    assert add.planning_scene["objects"]["ball"]["link"] == "hand"
    assert add.planning_scene["objects"]["ball"]["may_touch"] == ["finger", "hand"]
    add.detach_all_collision_objects()
    add.remove_collision_object("part")
    add.allow_collisions("can", True)
    add.update_planning_scene()
    assert {"table", "ball", "hand"} <= set(add.planning_scene["objects"]["can"]["may_touch"])
    add.clear_all_collision_objects()
    add.update_planning_scene()
    assert add.planning_scene["objects"] == {}


def test_object_in_the_way(robot: SimpleNamespace, caplog: pytest.LogCaptureFixture):
    goal = (0.2, 0.05, 0.1)
    assert robot.arm.compute_ik(goal) is not None
    robot.arm.add_collision_box("block", (0.1, 0.1, 0.1), position=goal)
    assert robot.arm.compute_ik(goal) is None
    assert "configurations touch something" in caplog.text
    robot.arm.move_to_pose(position=goal)
    assert not robot.arm.wait_until_executed()
    assert robot.arm.get_last_execution_error_code().val is PlanCode.GOAL_IN_COLLISION
    robot.arm.allow_collisions("block", True)
    robot.arm.move_to_pose(position=goal)
    assert robot.arm.wait_until_executed()


POSE = PoseStamped(Header(frame_id="camera"), Pose(Vector3(0.2, 0.0, 0.1)))


WRONG: list[tuple[Callable[[MoveIt2], Any], type[Exception], str]] = [
    (lambda arm: arm.move_to_pose(POSE), PlanningError, "frame 'camera' is not the base"),
    (lambda arm: arm.move_to_pose(position=(0.2, 0.1)), PlanningError, "expected x, y, z, got 2 numbers"),
    (lambda arm: arm.move_to_pose(position=(0.2, 0, 0.1), target_link="hand"), PlanningError, "'hand' is not the"),
    (
        lambda arm: arm.move_to_pose(quat_xyzw=DOWN),
        PlanningError,
        "a goal has one of pose, joints, xyz or object",
    ),
    (lambda arm: arm.move_to_pose(), PlanningError, "a request needs at least one goal"),
    (lambda arm: arm.move_to_configuration([0.0] * 6), PlanningError, "6 positions for 5 joints"),
    (lambda arm: arm.move_to_configuration([0.1], ["tilt"]), PlanningError, "no joint 'tilt'; the joints are: pan"),
    (lambda arm: arm.plan(position=(0.2, 0, 0.1), quat_xyzw=(0, 0, 0, 2)), PlanningError, "quaternion has length"),
    (lambda arm: arm.compute_ik((0.2, 0, 0.1), constraints=1), NotSupported, "takes no constraints"),
    (lambda arm: arm.add_collision_cone("c", 1, 1), NotSupported, "the world has no cones"),
    (lambda arm: arm.add_collision_mesh(None, "m", mesh=1), NotSupported, "takes a file on the robot's machine"),
    (lambda arm: arm.add_collision_mesh("m.stl", "m", scale=(1, 2, 1)), NotSupported, "takes one scale"),
    (
        lambda arm: arm.add_collision_mesh("/no.stl", "m", position=(0, 0, 0)),
        PlanningError,
        "or a mesh in the folder world.meshes",
    ),
    (lambda arm: arm.add_collision_box("b", (1, 1, 1)), PlanningError, "the object needs a place"),
    (lambda arm: arm.add_collision_box("b", (1, 1, 0), position=(0, 0, 0)), PlanningError, "three lengths above 0"),
    (lambda arm: arm.remove_collision_object("cup"), PlanningError, "no object 'cup'; the objects are: none"),
    (lambda arm: arm.attach("cup"), PlanningError, "no object 'cup'"),
    (lambda arm: arm.set_path_orientation_constraint(DOWN), NotSupported, "constraints are not supported"),
    (lambda arm: arm.reset_controller([0.0]), NotSupported, "joints do not jump"),
    (lambda arm: arm.set_workspace_parameters((0, 0, 0), (1, 1, 1)), NotSupported, "the workspace is bounded"),
]


def test_wrong_calls(robot: SimpleNamespace):
    for call, error, message in WRONG:
        with pytest.raises(error, match=message):
            call(robot.arm)


def test_names_are_checked_at_once(robot: SimpleNamespace):
    with pytest.raises(PlanningError, match=r"no joint 'tilt'; the joints are: pan, lift"):
        MoveIt2(robot.node, ["tilt"], "base_link", "tip")
    with pytest.raises(PlanningError, match=r"frame 'panda_link0' is not the base; it is called base, base_link"):
        MoveIt2(robot.node, list(ARM), "panda_link0", "tip")
    with pytest.raises(PlanningError, match=r"'panda_hand' is not the tool centre point, which is called 'tip'"):
        MoveIt2(robot.node, list(ARM), "base_link", "panda_hand")
    with pytest.raises(PlanningError, match=r"no joint 'thumb'; the joints are: pan"):
        GripperInterface(robot.node, ["thumb"], [1.0], [0.0])
    with pytest.raises(PlanningError, match=r"2 open positions for 1 gripper joints"):
        GripperInterface(robot.node, ["jaw"], [1.0, 1.0], [0.0])


SURFACE = {
    "__init__": "node joint_names base_link_name end_effector_name group_name execute_via_moveit"
    " ignore_new_calls_while_executing callback_group follow_joint_trajectory_action_name use_move_group_action",
    "query_state": "", "cancel_execution": "", "get_execution_future": "", "get_last_execution_error_code": "",
    "move_to_pose": "pose position quat_xyzw target_link frame_id tolerance_position tolerance_orientation"
    " weight_position cartesian weight_orientation cartesian_max_step cartesian_fraction_threshold",
    "move_to_configuration": "joint_positions joint_names tolerance weight",
    "plan": "pose position quat_xyzw joint_positions joint_names frame_id target_link tolerance_position"
    " tolerance_orientation tolerance_joint_position weight_position weight_orientation weight_joint_position"
    " start_joint_state cartesian max_step cartesian_fraction_threshold",
    "get_trajectory": "future cartesian cartesian_fraction_threshold",
    "execute": "joint_trajectory", "wait_until_executed": "",
    "set_pose_goal": "pose position quat_xyzw frame_id target_link tolerance_position tolerance_orientation"
    " weight_position weight_orientation",
    "set_position_goal": "position frame_id target_link tolerance weight",
    "set_orientation_goal": "quat_xyzw frame_id target_link tolerance weight parameterization",
    "set_joint_goal": "joint_positions joint_names tolerance weight",
    "clear_goal_constraints": "", "create_new_goal_constraint": "", "clear_path_constraints": "",
    "compute_fk": "joint_state fk_link_names", "get_compute_fk_result": "future fk_link_names",
    "compute_ik": "position quat_xyzw ik_link_name start_joint_state constraints wait_for_server_timeout_sec",
    "get_compute_ik_result": "future", "reset_new_joint_state_checker": "", "force_reset_executing_state": "",
    "add_collision_primitive": "id primitive_type dimensions pose position quat_xyzw frame_id",
    "add_collision_box": "id size pose position quat_xyzw frame_id",
    "add_collision_sphere": "id radius pose position quat_xyzw frame_id",
    "add_collision_cylinder": "id height radius pose position quat_xyzw frame_id",
    "add_collision_mesh": "filepath id pose position quat_xyzw frame_id scale mesh",
    "remove_collision_object": "id", "remove_collision_mesh": "id",
    "attach_collision_object": "id link_name touch_links weight", "detach_collision_object": "id",
    "detach_all_collision_objects": "", "move_collision": "id position quat_xyzw frame_id",
    "update_planning_scene": "", "allow_collisions": "id allow", "process_allow_collision_future": "future",
    "clear_all_collision_objects": "", "cancel_clear_all_collision_objects_future": "future",
    "process_clear_all_collision_objects_future": "future",
}  # fmt: skip
"""Method of pymoveit2's MoveIt2 (June 2026) -> its parameters; `operation` of collision objects is left out."""
OTHERS = (
    "plan_async", "compute_fk_async", "compute_ik_async", "add_collision_cone", "reset_controller",
    "set_path_joint_constraint", "set_path_position_constraint", "set_path_orientation_constraint",
    "create_joint_constraints", "create_position_constraint", "create_orientation_constraint",
    "set_workspace_parameters", "joint_state", "planning_scene", "new_joint_state_available", "num_planning_attempts",
    "allowed_planning_time", "pipeline_id", "planner_id", "cartesian_avoid_collisions", "cartesian_jump_threshold",
)  # fmt: skip
"""Further names."""


@pytest.mark.parametrize(("method", "parameters"), SURFACE.items(), ids=SURFACE)
def test_methods_have_the_parameters_of_pymoveit2(method: str, parameters: str):
    found = inspect.signature(getattr(MoveIt2, method)).parameters
    assert list(found)[1:] == parameters.split()


def test_no_name_of_pymoveit2_is_missing():
    assert [name for name in OTHERS if not hasattr(MoveIt2, name)] == []


def test_attributes_without_effect_say_so(robot: SimpleNamespace, caplog: pytest.LogCaptureFixture):
    assert robot.arm.allowed_planning_time == 0.5
    robot.arm.planner_id = "RRTConnectkConfigDefault"
    assert robot.arm.planner_id == "RRTConnectkConfigDefault"
    assert "planner_id has no effect: it is an option of the planner in the robot YAML" in caplog.text


def test_primitives(robot: SimpleNamespace):
    for number, sizes in ((1, (0.1, 0.1, 0.1)), (2, (0.05,)), (3, (0.1, 0.02))):
        robot.arm.add_collision_primitive(f"part{number}", number, sizes, position=(0.3, 0.3, 0.1 * number))
    robot.arm.update_planning_scene()
    shapes = [each["shape"] for each in robot.arm.planning_scene["objects"].values()]
    assert shapes == ["box", "sphere", "cylinder"]
    assert robot.arm.process_allow_collision_future(robot.arm.allow_collisions("part1", True))
    assert robot.arm.process_clear_all_collision_objects_future(robot.arm.clear_all_collision_objects())
    with pytest.raises(NotSupported, match=r"primitive type 4 is not a box \(1\), sphere \(2\) or cylinder \(3\)"):
        robot.arm.add_collision_primitive("cone", 4, (0.1, 0.1), position=(0, 0, 0))
    with pytest.raises(PlanningError, match="a cylinder has 2 dimensions, got 3"):
        robot.arm.add_collision_primitive("can", 3, (0.1, 0.1, 0.1), position=(0, 0, 0))


def test_mode_without_a_planner_has_no_services(run: Callable[..., Runtime]):
    runtime = run(mode="idle")
    with pytest.raises(PlanningError, match="nobody serves /get_planning_scene"):
        MoveIt2(LocalNode(runtime), list(ARM), "base_link", "tip")


class TwistNode(BaseNode):
    """A robot with a mode `servo`, and its calls."""

    def __init__(self) -> None:
        super().__init__("script")
        self.calls: list[tuple[str, Any]] = []

    @override
    def call(self, service: str, request: Any = None) -> Any:
        if service == "/set_mode" and request not in ("servo", "plan"):
            raise PlanningError(f"no mode {request!r}")
        self.calls.append((service, request))

    @override
    def wait(self, duration_s: float) -> None:
        pass


def test_servo_sends_scaled_twists_in_its_mode():
    node = TwistNode()
    servo = MoveIt2Servo(node, "base_link", linear_speed=0.5, angular_speed=2.0, mode_afterwards="plan")
    assert servo.is_enabled
    servo((0.1, 0.0, -0.2), angular=(0.0, 0.0, 1.0))
    assert servo.disable()
    assert not servo.is_enabled
    linear, angular = {"x": 0.05, "y": 0.0, "z": -0.1}, {"x": 0.0, "y": 0.0, "z": 2.0}
    still = dict.fromkeys("xyz", 0.0)
    topic = "/servo_node/delta_twist_cmds"
    assert node.calls == [
        ("/set_mode", "servo"),
        (topic, {"header": {"frame_id": "base_link"}, "twist": {"linear": linear, "angular": angular}}),
        (topic, {"header": {"frame_id": "base_link"}, "twist": {"linear": still, "angular": still}}),
        ("/set_mode", "plan"),
    ]
    servo.servo()
    assert servo.is_enabled, "a twist enables it"
    with pytest.raises(PlanningError, match="linear: expected x, y, z, got 2 numbers"):
        servo(linear=(0.1, 0.2))
    with pytest.raises(NotSupported, match="twists move the tool, not single joints"):
        servo.servo_jog(["pan"], [0.1])


def test_servo_of_a_robot_without_the_mode_is_not_enabled(caplog: pytest.LogCaptureFixture):
    node = TwistNode()
    servo = MoveIt2Servo(node, "base_link", mode="twists")
    assert not servo.is_enabled
    servo(linear=(0.1, 0.0, 0.0))
    servo.servo(enable_if_disabled=False)
    assert node.calls == []
    assert "mode twists: no mode 'twists'" in caplog.text
    assert "the twist is not sent: the servo is not enabled" in caplog.text


SERVO = {
    "__init__": "node frame_id namespace linear_speed angular_speed enable_at_init callback_group",
    "__call__": "linear angular",
    "servo": "linear angular enable_if_disabled",
    "servo_jog": "joint_names velocities enable_if_disabled",
    "enable": "wait_for_server_timeout_sec sync",
    "disable": "wait_for_server_timeout_sec sync",
}
"""Method of pymoveit2's MoveIt2Servo (June 2026) -> its parameters."""


@pytest.mark.parametrize(("method", "parameters"), SERVO.items(), ids=SERVO)
def test_servo_has_the_parameters_of_pymoveit2(method: str, parameters: str):
    found = inspect.signature(getattr(MoveIt2Servo, method)).parameters.values()
    assert [each.name for each in found if each.kind is not each.KEYWORD_ONLY][1:] == parameters.split()


def test_names_of_the_so101():
    assert isinstance(so101, RobotNames)
    assert len(so101.joint_names()) == 5
    assert (so101.base_link_name(), so101.end_effector_name()) == ("base_link", "gripperframe")
    assert so101.gripper_joint_names() == ["gripper"]
