"""Trajectory goals: checked, and in the executor's order of joints."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import GoalRejected, Vector, ns
from ibrobot_planning.executors.options import TrajectoryOptions

_LONGEST_S = 1e9
"""Largest `goal_time` [s]: 30 years, in nanoseconds still an int64."""


@attrs.frozen
class Takeover:
    """When a trajectory takes over from the running one."""

    goal: str
    """Name of the running goal."""
    time_ns: int
    """Time along its trajectory [ns]."""


@attrs.frozen(eq=False)
class TrajectoryGoal:
    """A goal in the executor's joint order: N points of J joints."""

    times_ns: NDArray[np.int64]
    """[ns] from the start, strictly increasing, shape (N,)."""
    positions: Vector
    """[rad], shape (N, J)."""
    velocities: Vector | None
    """[rad/s], shape (N, J)."""
    accelerations: Vector | None
    """[rad/s^2], shape (N, J)."""
    path_tolerance: Vector
    """[rad], shape (J,); 0: not checked."""
    goal_tolerance: Vector
    """[rad], shape (J,); 0: not checked."""
    goal_time_ns: int
    """[ns]; 0: no limit."""
    takes_over: Takeover | None = None


def parse_goal(goal: Mapping[str, Any], joints: Sequence[str], options: TrajectoryOptions) -> TrajectoryGoal:
    """Check a goal for the executor's `joints`.

    Raises:
        GoalRejected: for the first fault.
    """
    _keys(goal, ("trajectory",), ("path_tolerance", "goal_tolerance", "goal_time", "takes_over"), "the goal")
    trajectory = goal["trajectory"]
    _keys(trajectory, ("joint_names", "points"), (), "the trajectory")
    order = _order(trajectory["joint_names"], joints)
    points = trajectory["points"]
    if not isinstance(points, list | tuple) or not points:
        raise GoalRejected("the trajectory has no points; it needs at least one")
    for index, point in enumerate(points):
        _keys(point, ("time_from_start_ns", "positions"), ("velocities", "accelerations"), f"point {index}")
    times_ns = _times(points)
    positions = _field(points, "positions", order)
    velocities, accelerations = _field(points, "velocities", order), _field(points, "accelerations", order)
    if positions is None:
        raise GoalRejected("the points have no positions; every point needs them")
    if accelerations is not None and velocities is None:
        raise GoalRejected("the points have accelerations but no velocities; give both, or positions alone")
    if velocities is not None and velocities[-1].any():
        joint = int(np.abs(velocities[-1]).argmax())
        raise GoalRejected(
            f"the last point has {joints[joint]} at {velocities[-1, joint]:.6g} rad/s; it must be at rest"
        )
    return TrajectoryGoal(
        times_ns,
        positions,
        velocities,
        accelerations,
        path_tolerance=_tolerance(goal, "path_tolerance", options.path_tolerance, joints),
        goal_tolerance=_tolerance(goal, "goal_tolerance", options.goal_tolerance, joints),
        goal_time_ns=ns(_setting(goal.get("goal_time", 0), options.goal_time, "goal_time", _LONGEST_S)),
        takes_over=_takeover(goal["takes_over"]) if "takes_over" in goal else None,
    )


def _takeover(value: Any) -> Takeover:
    _keys(value, ("goal", "time_ns"), (), "takes_over")
    if not isinstance(value["goal"], str):
        raise GoalRejected(f"takes_over has goal {value['goal']!r}; it must be the name of the running goal")
    return Takeover(value["goal"], _time_ns(value["time_ns"], "takes_over"))


def _keys(value: Any, required: Sequence[str], optional: Sequence[str], what: str) -> None:
    if not isinstance(value, Mapping):
        raise GoalRejected(f"{what} must be a mapping with {', '.join(required)}, got {value!r}")
    for key in required:
        if key not in value:
            raise GoalRejected(f"{what} has no {key}")
    for key in value:
        if key not in required and key not in optional:
            raise GoalRejected(f"{what} has an unknown key {key!r}; known: {', '.join((*required, *optional))}")


def _order(names: Any, joints: Sequence[str]) -> list[int]:
    """Index in `names` of each of `joints`."""
    if not isinstance(names, list | tuple) or sorted(map(str, names)) != sorted(joints):
        raise GoalRejected(f"joint_names must be, in any order, {', '.join(joints)}; got {names!r}")
    return [names.index(joint) for joint in joints]


def _times(points: Sequence[Mapping[str, Any]]) -> NDArray[np.int64]:
    previous = -1
    for index, point in enumerate(points):
        time_ns = _time_ns(point["time_from_start_ns"], f"point {index}", "time_from_start_ns")
        if time_ns <= previous:
            raise GoalRejected(f"point {index} is at {time_ns} ns, not after the point before it at {previous} ns")
        previous = time_ns
    if previous == 0:
        raise GoalRejected("the last point is at time 0, which leaves no time to reach it")
    return np.array([point["time_from_start_ns"] for point in points], dtype=np.int64)


def _time_ns(value: Any, what: str, key: str = "time_ns") -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**62:
        raise GoalRejected(f"{what} has {key} {value!r}; it must be an integer from 0 on")
    return value


def _field(points: Sequence[Mapping[str, Any]], name: str, order: Sequence[int]) -> Vector | None:
    """Field `name` of all points in the executor's order, shape (N, J); None if no point has it."""
    rows = [point.get(name, ()) for point in points]
    # In ROS, an empty list means that the field is missing.
    present = [not (isinstance(row, list | tuple) and not row) for row in rows]
    if not any(present):
        return None
    if not all(present):
        raise GoalRejected(
            f"point {present.index(False)} has no {name} but point {present.index(True)} has; all or none must"
        )
    for index, row in enumerate(rows):
        if not isinstance(row, list | tuple) or len(row) != len(order):
            raise GoalRejected(f"point {index} has {name} {row!r}; it must be a list of {len(order)} numbers")
        for value in row:
            if not _is_finite(value):
                raise GoalRejected(f"point {index} has {value!r} among its {name}; each must be a finite number")
    return np.array(rows, dtype=np.float64)[:, order]


def _tolerance(goal: Mapping[str, Any], name: str, default: float, joints: Sequence[str]) -> Vector:
    """Tolerance of each joint [rad], shape (J,); 0: not checked."""
    value = goal.get(name, 0)
    by_joint = value if isinstance(value, Mapping) else dict.fromkeys(joints, value)
    for joint in by_joint:
        if joint not in joints:
            raise GoalRejected(f"{name} names {joint!r}, which is not a joint here; the joints are {', '.join(joints)}")
    return np.array([_setting(by_joint.get(joint, 0), default, name) for joint in joints], dtype=np.float64)


def _setting(value: Any, default: float, name: str, highest: float = sys.float_info.max) -> float:
    """A setting; 0 means the default, -1 none (returned as 0)."""
    if not _is_finite(value) or (value < 0 and value != -1):
        raise GoalRejected(f"{name} is {value!r}; it must be above 0, or 0 for the default, or -1 for none")
    if value > highest:
        raise GoalRejected(f"{name} is {value!r}; it must be at most {highest:g}")
    return default if value == 0 else max(float(value), 0.0)


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
