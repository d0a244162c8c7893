"""The arm, with the surface of pymoveit2's `MoveIt2`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from typing import Any, overload

from ibrobot_core.api import JointState, JointTrajectory, NotSupported, PlanningError, PoseStamped
from ibrobot_core.app import PlanCode
from ibrobot_planning.client.collision_objects import AnyPose, CollisionObjects, Orientation, Position, numbers
from ibrobot_planning.client.motion import (
    ExecutionFuture,
    JointStates,
    Motions,
    MoveIt2State,
    MoveItErrorCodes,
    background,
    joint_state_from,
    pose_stamped_from,
    positions_of,
)
from ibrobot_planning.client.node import BaseNode
from ibrobot_planning.execution.source import EXECUTE
from ibrobot_planning.goals.grammar import check_frame

__all__ = ["MoveIt2", "MoveIt2State", "MoveItErrorCodes"]

type JointPositions = JointState | Sequence[float]

_LEAST = 1e-6
"""Sent in place of the fraction 0, which accepts any part of a straight path."""


class _WithoutEffect:
    """An attribute of pymoveit2 that has no effect here; setting it is logged."""

    def __init__(self, default: Any, why: str) -> None:
        self._default = default
        self._why = why

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, client: MoveIt2 | None, owner: type) -> Any:
        return self._default if client is None else client.__dict__.get(self._name, self._default)

    def __set__(self, client: MoveIt2, value: Any) -> None:
        client.__dict__[self._name] = value
        client.warn("%s has no effect: %s", self._name, self._why)


_BY_YAML = "it is an option of the planner in the robot YAML"


class MoveIt2(CollisionObjects):
    """Plans and moves an arm that `ibrobot launch` runs in a mode with a planner.

    Methods, arguments and defaults are those of pymoveit2. If planning or moving fails, they log
    why and return None or False, as in pymoveit2. `weight_…`, `cartesian_max_step`, `group_name`, `callback_group` and
    the names of actions have no effect.

    Args:
        node: the connection to the robot.
        joint_names: joints of the arm.
        base_link_name: the base frame: `base_link` or `base`.
        end_effector_name: the tool centre point, `robot.description.tip` of the robot YAML.
        group_name: no effect.
        execute_via_moveit: no effect.
        ignore_new_calls_while_executing: whether calls during a motion are ignored; otherwise a new motion replaces the
            present one.
        callback_group: no effect.
        follow_joint_trajectory_action_name: no effect.
        use_move_group_action: no effect.

    Attributes:
        max_velocity: fraction of the velocity limits, in (0, 1]; 0 means 1.
        max_acceleration: fraction of the acceleration limits, in (0, 1]; 0 means 1.
        beyond_reach: how to treat an orientation that the arm cannot take, e.g. with five joints: `refuse`, `nearest`,
            `keep_axis`, `arm_plane`, `current` or `free`. Not in pymoveit2.

    Raises:
        PlanningError: for unknown joints, frames and links.
    """

    def __init__(
        self, node: BaseNode, joint_names: Sequence[str], base_link_name: str, end_effector_name: str,
        group_name: str = "arm", execute_via_moveit: bool = False, ignore_new_calls_while_executing: bool = False,
        callback_group: Any = None, follow_joint_trajectory_action_name: str = "", use_move_group_action: bool = False,
    ) -> None:  # fmt: skip
        super().__init__(node)
        self._states = JointStates(node)
        self._motions = Motions(node, ignore_new_calls_while_executing=ignore_new_calls_while_executing)
        self.joint_names = list(joint_names)
        self.base_link_name = base_link_name
        self.end_effector_name = end_effector_name
        self.max_velocity = 0.0
        self.max_acceleration = 0.0
        self.beyond_reach = "refuse"
        self._goals: list[dict[str, Any]] = [{}]
        known = self._scene["joint_state"]["name"]
        if unknown := [name for name in self.joint_names if name not in known]:
            raise PlanningError(f"no joint {unknown[0]!r}; the joints are: {', '.join(known)}")
        check_frame(base_link_name)
        self._check_link(end_effector_name)

    num_planning_attempts = _WithoutEffect(5, _BY_YAML)
    allowed_planning_time = _WithoutEffect(0.5, _BY_YAML)
    pipeline_id = _WithoutEffect("", _BY_YAML)
    planner_id = _WithoutEffect("", _BY_YAML)
    cartesian_avoid_collisions = _WithoutEffect(True, "straight paths always avoid collisions")
    cartesian_jump_threshold = _WithoutEffect(0.0, "straight paths have no jumps")
    cartesian_prismatic_jump_threshold = _WithoutEffect(0.0, "straight paths have no jumps")
    cartesian_revolute_jump_threshold = _WithoutEffect(0.0, "straight paths have no jumps")

    def warn(self, message: str, *arguments: Any) -> None:
        """Log a warning."""
        self._node.get_logger().warning(message, *arguments)

    # Motions.

    def move_to_pose(
        self, pose: AnyPose | None = None, position: Position | None = None, quat_xyzw: Orientation | None = None,
        target_link: str | None = None, frame_id: str | None = None, tolerance_position: float = 0.001,
        tolerance_orientation: float | Sequence[float] = 0.001, weight_position: float = 1.0, cartesian: bool = False,
        weight_orientation: float = 1.0, cartesian_max_step: float = 0.0025, cartesian_fraction_threshold: float = 0.0,
    ) -> None:  # fmt: skip
        """Plan and move to a pose, or to a position with any orientation; returns at once.

        Raises:
            PlanningError: for an invalid goal.
        """
        self.set_pose_goal(pose, position, quat_xyzw, frame_id, target_link, tolerance_position, tolerance_orientation)
        if not cartesian:
            self._motions.ask("/move_action", {"goals": self._taken_goals(), **self._scalings()})
        elif (trajectory := self._straight(cartesian_fraction_threshold, {})) is not None:
            self.execute(trajectory)

    def move_to_configuration(
        self,
        joint_positions: Sequence[float],
        joint_names: Sequence[str] | None = None,
        tolerance: float = 0.001,
        weight: float = 1.0,
    ) -> None:
        """Plan and move to joint positions [rad]; returns at once.

        Raises:
            PlanningError: for an invalid goal.
        """
        self.set_joint_goal(joint_positions, joint_names, tolerance)
        self._motions.ask("/move_action", {"goals": self._taken_goals(), **self._scalings()})

    def plan(
        self, pose: AnyPose | None = None, position: Position | None = None, quat_xyzw: Orientation | None = None,
        joint_positions: Sequence[float] | None = None, joint_names: Sequence[str] | None = None,
        frame_id: str | None = None, target_link: str | None = None, tolerance_position: float = 0.001,
        tolerance_orientation: float | Sequence[float] = 0.001, tolerance_joint_position: float = 0.001,
        weight_position: float = 1.0, weight_orientation: float = 1.0, weight_joint_position: float = 1.0,
        start_joint_state: JointPositions | None = None, cartesian: bool = False, max_step: float = 0.0025,
        cartesian_fraction_threshold: float = 0.0,
    ) -> JointTrajectory | None:  # fmt: skip
        """Plan without moving; None if there is no plan.

        Raises:
            PlanningError: for an invalid goal.
        """
        self.set_pose_goal(pose, position, quat_xyzw, frame_id, target_link, tolerance_position, tolerance_orientation)
        if joint_positions is not None:
            self.set_joint_goal(joint_positions, joint_names, tolerance_joint_position)
        start = positions_of(start_joint_state, self.joint_names)
        if cartesian:
            return self._straight(cartesian_fraction_threshold, start)
        request = {"goals": self._taken_goals(), "start": start, **self._scalings()}
        return self._trajectory(self._node.call("/plan_kinematic_path", request))

    def plan_async(self, *arguments: Any, **options: Any) -> Future[JointTrajectory | None]:
        """`plan` in another thread."""
        return background(self.plan, *arguments, **options)

    def get_trajectory(
        self, future: Future[JointTrajectory | None], cartesian: bool = False, cartesian_fraction_threshold: float = 0.0
    ) -> JointTrajectory | None:
        """The plan of `plan_async`; None if it is not done or there is none."""
        return future.result() if future.done() else None

    def execute(self, joint_trajectory: JointTrajectory) -> None:
        """Follow a trajectory that begins where the robot is; returns at once.

        Raises:
            PlanningError: for a trajectory that no executor can follow.
        """
        self._motions.ask("/execute_trajectory", joint_trajectory)

    def wait_until_executed(self) -> bool:
        """Wait for the end of the motion; returns whether it succeeded."""
        return self._motions.wait()

    def cancel_execution(self) -> None:
        """Slow down and hold."""
        self._motions.cancel()

    cancel = cancel_execution

    def query_state(self) -> MoveIt2State:
        """Whether the robot executes the newest motion."""
        return self._motions.state

    def get_execution_future(self) -> ExecutionFuture | None:
        """The end of the newest motion; None if it did not begin."""
        return self._motions.future

    def get_last_execution_error_code(self) -> MoveItErrorCodes | None:
        """How the newest motion ended; None while it is under way."""
        return self._motions.error

    # Goals.

    def set_pose_goal(
        self, pose: AnyPose | None = None, position: Position | None = None, quat_xyzw: Orientation | None = None,
        frame_id: str | None = None, target_link: str | None = None, tolerance_position: float = 0.001,
        tolerance_orientation: float | Sequence[float] = 0.001, weight_position: float = 1.0,
        weight_orientation: float = 1.0,
    ) -> None:  # fmt: skip
        """Set position and orientation of the next goal."""
        if pose is not None:
            if isinstance(pose, PoseStamped):
                frame_id, pose = frame_id or pose.header.frame_id, pose.pose
            position, quat_xyzw = pose.position, pose.orientation
        if position is not None:
            self.set_position_goal(position, frame_id, target_link, tolerance_position)
        if quat_xyzw is not None:
            self.set_orientation_goal(quat_xyzw, frame_id, target_link, tolerance_orientation)

    def set_position_goal(
        self,
        position: Position,
        frame_id: str | None = None,
        target_link: str | None = None,
        tolerance: float = 0.001,
        weight: float = 1.0,
    ) -> None:
        """Set the position of the next goal [m]."""
        check_frame(frame_id or "")
        self._check_link(target_link)
        self._goals[-1] |= {"xyz": numbers(position, "xyz"), "position_tolerance": float(tolerance)}

    def set_orientation_goal(
        self, quat_xyzw: Orientation, frame_id: str | None = None, target_link: str | None = None,
        tolerance: float | Sequence[float] = 0.001, weight: float = 1.0, parameterization: int = 0,
    ) -> None:  # fmt: skip
        """Set the orientation of the next goal; of three tolerances [rad] the least counts."""
        check_frame(frame_id or "")
        self._check_link(target_link)
        least = tolerance if isinstance(tolerance, int | float) else min(tolerance)
        self._goals[-1] |= {"quaternion": numbers(quat_xyzw, "xyzw"), "angle_tolerance": float(least)}

    def set_joint_goal(
        self,
        joint_positions: Sequence[float],
        joint_names: Sequence[str] | None = None,
        tolerance: float = 0.001,
        weight: float = 1.0,
    ) -> None:
        """Set joint positions of the next goal [rad]; without names, of the first joints of the arm."""
        positions = positions_of(joint_positions, joint_names or self.joint_names)
        self._goals[-1] |= {"joints": positions, "joint_tolerance": float(tolerance)}

    def create_new_goal_constraint(self) -> None:
        """Begin an alternative goal: the first one that can be reached counts."""
        self._goals.append({})

    def clear_goal_constraints(self) -> None:
        """Forget the goals that were set."""
        self._goals = [{}]

    # Kinematics.

    @overload
    def compute_fk(
        self, joint_state: JointPositions | None = None, fk_link_names: None = None
    ) -> PoseStamped | None: ...

    @overload
    def compute_fk(
        self, joint_state: JointPositions | None, fk_link_names: Sequence[str]
    ) -> list[PoseStamped] | None: ...

    def compute_fk(
        self, joint_state: JointPositions | None = None, fk_link_names: Sequence[str] | None = None
    ) -> PoseStamped | list[PoseStamped] | None:
        """Pose of the tool, or poses of links, at present or given joint positions; None if it fails."""
        request = {"joints": positions_of(joint_state, self.joint_names), "links": list(fk_link_names or ())}
        answer = self._node.call("/compute_fk", request)
        if self._failed(answer):
            return None
        poses = [pose_stamped_from(each) for each in answer["poses"]]
        return poses[0] if fk_link_names is None else poses

    def compute_fk_async(self, *arguments: Any, **options: Any) -> Future[PoseStamped | list[PoseStamped] | None]:
        """`compute_fk` in another thread."""
        return background(self.compute_fk, *arguments, **options)

    def get_compute_fk_result(
        self, future: Future[PoseStamped | list[PoseStamped] | None], fk_link_names: Sequence[str] | None = None
    ) -> PoseStamped | list[PoseStamped] | None:
        """The result of `compute_fk_async`; None if it is not done."""
        return future.result() if future.done() else None

    def compute_ik(
        self,
        position: Position,
        quat_xyzw: Orientation | None = None,
        ik_link_name: str | None = None,
        start_joint_state: JointPositions | None = None,
        constraints: Any = None,
        wait_for_server_timeout_sec: float | None = 1.0,
    ) -> JointState | None:
        """Joint positions without contacts for a pose, or for a position with any orientation; None if there are none.

        Raises:
            NotSupported: for constraints.
            PlanningError: for an invalid goal.
        """
        if constraints is not None:
            raise NotSupported("compute_ik takes no constraints")
        self._check_link(ik_link_name)
        goal: dict[str, Any] = {"xyz": numbers(position, "xyz")}
        if quat_xyzw is not None:
            goal |= {"quaternion": numbers(quat_xyzw, "xyzw"), "beyond_reach": self.beyond_reach}
        request = {"goal": goal, "start": positions_of(start_joint_state, self.joint_names)}
        answer = self._node.call("/compute_ik", request)
        return None if self._failed(answer) else joint_state_from(answer["joint_state"])

    def compute_ik_async(self, *arguments: Any, **options: Any) -> Future[JointState | None]:
        """`compute_ik` in another thread."""
        return background(self.compute_ik, *arguments, **options)

    def get_compute_ik_result(self, future: Future[JointState | None]) -> JointState | None:
        """The result of `compute_ik_async`; None if it is not done."""
        return future.result() if future.done() else None

    # The robot.

    @property
    def joint_state(self) -> JointState:
        """The present joint state of the robot."""
        return self._states.read()

    @property
    def new_joint_state_available(self) -> bool:
        """Always True: joint states are requested when they are read."""
        return True

    def reset_new_joint_state_checker(self) -> None:
        """Do nothing: joint states are requested when they are read."""

    def force_reset_executing_state(self) -> None:
        """Do nothing: the robot knows whether it executes a motion."""

    # Not supported.

    def reset_controller(self, *arguments: Any, **options: Any) -> None:
        """Raise NotSupported."""
        raise NotSupported("joints do not jump: move to the configuration, or reset the simulation's episode")

    def set_path_joint_constraint(self, *arguments: Any, **options: Any) -> None:
        """Raise NotSupported."""
        raise NotSupported("constraints are not supported; a straight path keeps the orientation: cartesian=True")

    set_path_position_constraint = set_path_orientation_constraint = set_path_joint_constraint
    create_joint_constraints = create_position_constraint = set_path_joint_constraint
    create_orientation_constraint = set_path_joint_constraint

    def clear_path_constraints(self) -> None:
        """Do nothing: there are no path constraints."""

    def set_workspace_parameters(self, *arguments: Any, **options: Any) -> None:
        """Raise NotSupported."""
        raise NotSupported("the workspace is bounded by objects of the world: add planes or boxes")

    def _taken_goals(self) -> list[dict[str, Any]]:
        """Return the goals, and clear them."""
        goals = [goal for goal in self._goals if goal]
        self.clear_goal_constraints()
        turned = {"beyond_reach": self.beyond_reach}
        return [goal | turned if "quaternion" in goal else goal for goal in goals]

    def _scalings(self) -> dict[str, float]:
        return {"velocity_scaling": self.max_velocity or 1.0, "acceleration_scaling": self.max_acceleration or 1.0}

    def _straight(self, least_fraction: float, start: Mapping[str, float]) -> JointTrajectory | None:
        request = {
            "waypoints": self._taken_goals(),
            "least_fraction": max(least_fraction, _LEAST),
            "start": start,
            **self._scalings(),
        }
        return self._trajectory(self._node.call("/compute_cartesian_path", request))

    def _trajectory(self, answer: Mapping[str, Any]) -> JointTrajectory | None:
        return None if self._failed(answer) else EXECUTE.read(answer["trajectory"]).trajectory()

    def _failed(self, answer: Mapping[str, Any]) -> bool:
        code = PlanCode[answer["code"]]
        if code is not PlanCode.SUCCESS:
            self._motions.refuse(code, answer["message"])
        return code is not PlanCode.SUCCESS

    def _check_link(self, link: str | None) -> None:
        tip = self._scene["tip"]
        if link is not None and tip and link != tip:
            raise PlanningError(
                f"{link!r} is not the tool centre point, which is called {tip!r}", PlanCode.INVALID_LINK_NAME
            )
