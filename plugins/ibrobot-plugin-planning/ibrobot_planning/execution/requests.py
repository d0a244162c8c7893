"""Requests and answers of the services that plan and move, as attrs classes, and the results that a run keeps."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal
from weakref import WeakKeyDictionary

import attrs
from ibrobot_kinematics import PathConstraints

from ibrobot_core.api import (
    Header,
    JointState,
    JointTrajectory,
    JointTrajectoryPoint,
    PlanCode,
    PlanningError,
    Pose,
    PoseStamped,
    Vector,
    documented,
    option,
)
from ibrobot_core.app import RunView
from ibrobot_planning.goals.grammar import GoalOptions, Target, check_waypoints
from ibrobot_planning.planner import LEAST_SCALING, Goal
from ibrobot_planning.world.ages import AgeSummary

type Outcome = Literal["SUCCEEDED", "REJECTED", "PLANNING_FAILED", "EXECUTION_FAILED", "CANCELLED"]


def _few(most: int) -> Callable[[object, attrs.Attribute[Any], Sequence[object]], None]:
    """A validator that limits the number of items."""

    def check(instance: object, attribute: attrs.Attribute[Any], value: Sequence[object]) -> None:
        if len(value) > most:
            raise ValueError(f"{len(value)} are too many, at most {most} are planned for")

    return check


def _scaling(what: str) -> Any:
    return option(1.0, ge=LEAST_SCALING, le=1, help=f"fraction of the {what} limits")


@documented
@attrs.frozen
class MoveRequest:
    """A request to `/move_action`: move to the first of several goals that can be reached."""

    goals: tuple[GoalOptions, ...] = option(validator=_few(20), help="alternatives, in order of preference")
    velocity_scaling: float = _scaling("velocity")
    acceleration_scaling: float = _scaling("acceleration")


@documented
@attrs.frozen
class PlanQuery(MoveRequest):
    """A request to `/plan_kinematic_path`: plan to the first of several goals that can be reached, without moving."""

    start: Mapping[str, float] = option(factory=dict, unit="rad", help="start; other joints: the present position")


@documented
@attrs.frozen
class GoTo:
    """A request to `/planning/go_to`."""

    goal: str | Goal | Target = option(
        plain=str, help="a pose's name, joints, or a position of the tool, and path constraints, as `--goal`"
    )


@documented
@attrs.frozen
class PlanAhead:
    """A request to `/planning/plan`: plan to a goal, without moving."""

    goal: str | Goal | Target = option(plain=str, help="as `/planning/go_to` takes it")
    start: Mapping[str, float] = option(factory=dict, unit="rad", help="start; other joints: the present position")


@documented
@attrs.frozen
class MoveToPose:
    """Request of ibrobot_msgs/srv/MoveToPose."""

    target_pose: Pose = option(help="of the tool centre point, in the base frame")
    velocity_scaling: float = option(0.0, help="fraction of the velocity limits, in (0, 1]; 0 means 1")


@attrs.frozen(eq=False)
class JointTarget:
    """A sensor_msgs/msg/JointState as a goal; only names, positions and the header's time are read."""

    name: tuple[str, ...]
    position: Vector
    """One for each joint [rad]."""
    velocity: Vector | None = None
    effort: Vector | None = None
    header: Header = Header()


@documented
@attrs.frozen
class MoveToConfiguration:
    """Request of ibrobot_msgs/srv/MoveToConfiguration."""

    target_joint_state: JointState | JointTarget = option(
        plain=JointTarget, help="names and positions [rad]; all other joints stay"
    )
    velocity_scaling: float = option(0.0, help="fraction of the velocity limits, in (0, 1]; 0 means 1")


@documented
@attrs.frozen
class Numbered:
    """A request to `/planning/result`."""

    number: int = option(ge=0, help="the number that the service answered when it took the goal")


@documented
@attrs.frozen
class CartesianQuery:
    """A request to `/compute_cartesian_path`: plan straight lines of the tool through waypoints."""

    waypoints: tuple[GoalOptions, ...] = option(
        validator=_few(100), help="positions of the tool, with or without axis or orientation"
    )
    least_fraction: float = option(1.0, gt=0, le=1, help="fraction of the path that must be possible")
    start: Mapping[str, float] = option(factory=dict, unit="rad", help="start; other joints: the present position")
    velocity_scaling: float = _scaling("velocity")
    acceleration_scaling: float = _scaling("acceleration")
    path_constraints: PathConstraints | None = option(None, help="what holds on the whole line, e.g. {upright: 0.17}")

    def __attrs_post_init__(self) -> None:
        check_waypoints("waypoints", self.waypoints)


@documented
@attrs.frozen
class IkQuery:
    """A request to `/compute_ik`: joint positions for a position or pose of the tool."""

    goal: GoalOptions = option(help="position of the tool, with or without axis or orientation")
    start: Mapping[str, float] = option(factory=dict, unit="rad", help="start; other joints: the present position")
    avoid_collisions: bool = option(True, help="leave out configurations with collisions")


@documented
@attrs.frozen
class FkQuery:
    """A request to `/compute_fk`: poses of links."""

    joints: Mapping[str, float] = option(factory=dict, unit="rad", help="positions; other joints: the present position")
    links: tuple[str, ...] = option(
        (), validator=_few(100), help="links of the MJCF or the URDF, or the tip; only the tip if empty"
    )


@attrs.frozen
class MoveResult:
    """Response of ibrobot_msgs/srv/MoveToPose, with MoveIt's code."""

    success: bool
    message: str
    """The error in one sentence; empty after a success."""
    execution_time_s: float
    outcome: Outcome
    code: PlanCode
    """`code.name` is MoveIt's, e.g. NO_IK_SOLUTION."""
    position_error_m: float = 0.0
    """Distance of the planned tool position from the requested one [m]."""
    orientation_error_rad: float = 0.0
    """Angle between the planned orientation, or axis, and the requested one [rad]."""
    fraction: float = 1.0
    """Fraction of a straight path that was planned."""
    alternative: int = 0
    """Index of the chosen goal, of several."""


@attrs.frozen(eq=False)
class PlanAnswer:
    """Answer of `/plan_kinematic_path` and `/compute_cartesian_path`."""

    code: PlanCode
    message: str = ""
    """The error in one sentence; empty after a success."""
    trajectory: JointTrajectory | None = None
    """The time in its header is 0, so that it can be executed at any time."""
    fraction: float = 0.0
    """Fraction of a straight path that the trajectory covers."""
    alternative: int = 0
    """Index of the goal that it reaches."""
    position_error_m: float = 0.0
    orientation_error_rad: float = 0.0
    planning_time_s: float = 0.0


@attrs.frozen(eq=False)
class IkAnswer:
    """Answer of `/compute_ik`."""

    code: PlanCode
    message: str = ""
    joint_state: JointState | None = None
    """All joints of the robot."""
    position_error_m: float = 0.0
    orientation_error_rad: float = 0.0


@attrs.frozen
class FkAnswer:
    """Answer of `/compute_fk`."""

    code: PlanCode
    message: str = ""
    poses: tuple[PoseStamped, ...] = ()
    """One for each link."""


@attrs.frozen
class ObjectSummary:
    """An object of the world, without its shape's numbers."""

    shape: str
    pose: Pose
    """In the base frame, or in the frame of `link`."""
    link: str | None
    may_touch: tuple[str, ...]


@attrs.frozen(eq=False)
class PlanningScene:
    """Answer of `/get_planning_scene`: the robot and what is around it."""

    robot: str
    joint_state: JointState
    """Present positions."""
    groups: Mapping[str, tuple[str, ...]]
    poses: tuple[str, ...]
    """Names of poses."""
    tip: str
    """Name of the tool centre point."""
    links: tuple[str, ...]
    objects: Mapping[str, ObjectSummary]
    """As they were last seen, also while they are too old to plan with."""
    ages: Mapping[str, AgeSummary] = attrs.field(factory=dict)
    """Cloud or object -> its age; without objects that never get too old."""


@documented
@attrs.frozen(eq=False)
class Execute:
    """A request to `/execute_trajectory`: the keys of a trajectory_msgs/msg/JointTrajectory."""

    joint_names: tuple[str, ...] = option(help="the joints of the trajectory")
    points: tuple[JointTrajectoryPoint, ...] = option(help="positions, and velocities and accelerations if wanted")
    header: Header = option(
        Header(), help="its time is the present, or 0 for that; a trajectory begins when it is executed"
    )

    def __attrs_post_init__(self) -> None:
        if not self.joint_names or not self.points:
            raise ValueError("a trajectory needs joint_names and points, neither of them empty")

    def trajectory(self) -> JointTrajectory:
        """The trajectory."""
        return JointTrajectory(Header(), self.joint_names, self.points)


class Results[T]:
    """Numbers and results of the goals or tasks of a run. Methods may be called from several threads.

    Args:
        what: what the results are of, for errors: `goal` or `task`.
        service: the service that answers with their numbers.
    """

    KEPT = 100
    """Number of results kept."""

    def __init__(self, what: str, service: str) -> None:
        self._what, self._service = what, service
        self._lock = threading.Lock()
        self._newest = 0
        self._present: set[int] = set()
        self._ended: dict[int, T] = {}

    def number(self) -> int:
        """A number for a new one."""
        with self._lock:
            self._newest += 1
            self._present.add(self._newest)
            return self._newest

    def end(self, number: int, result: T) -> None:
        """Keep a result."""
        with self._lock:
            self._present.discard(number)
            self._ended[number] = result
            while len(self._ended) > self.KEPT:
                del self._ended[next(iter(self._ended))]

    def of(self, number: int) -> T | None:
        """The result of a number; None before its goal or task has ended.

        Raises:
            PlanningError: for an unknown number, or a result that is no longer kept.
        """
        with self._lock:
            if number in self._present:
                return None
            if number in self._ended:
                return self._ended[number]
            if 0 < number <= self._newest:
                raise PlanningError(
                    f"the result of {self._what} {number} is no longer kept, only the last {self.KEPT} are"
                )
            raise PlanningError(f"no {self._what} {number}; {self._service} answers with the number of a {self._what}")


_RESULTS: WeakKeyDictionary[RunView, Results[MoveResult]] = WeakKeyDictionary()


def results_of(session: RunView) -> Results[MoveResult]:
    """The results of the goals of a run. Its modes share them, so that a number stays valid when the mode changes."""
    return _RESULTS.setdefault(session, Results("goal", "/planning/go_to"))
