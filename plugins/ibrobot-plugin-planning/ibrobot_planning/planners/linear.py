"""Straight-line paths of the tool as configurations."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from ibrobot_kinematics import KinematicModel, Target, ToolConstraints, UnreachableError, solve
from ibrobot_kinematics.rotations import between, cross, exp, log

from ibrobot_core.api import Vector
from ibrobot_planning.goals.tool import HELD_BACK, Tool, pose_matrix, turned, unit, vector
from ibrobot_planning.planner import PoseGoal, PositionGoal, invalid_goal

_STEP_M = 0.004
_STEP_RAD = 0.05
"""Maximum distances between configurations on the path."""
_STEPS, _CONVERGED = 8, 1e-7
_EXACT_M = 1e-4
"""Allowed distance of the tool from the line at a configuration."""
_TURN_M = 0.1
"""Distance that corresponds to a rotation of one radian."""
_LARGEST_JUMP = 0.35
"""A joint that moves further [rad] between two configurations would take the tool off the line."""


@attrs.frozen(eq=False)
class LinearPath:
    """Configurations along the possible part of a path."""

    joints: Vector
    """All joints [rad], shape (N, J)."""
    fractions: Vector
    """Fraction of the path up to each, shape (N,)."""
    errors: Vector
    """Angle between the actual and the requested orientation at each [rad], shape (N,)."""
    reason: str
    """Why it ends early; empty if it is complete."""


def linear_path(
    tool: Tool, waypoints: Sequence[PositionGoal | PoseGoal], start: Vector, constraints: ToolConstraints | None = None
) -> LinearPath:
    """Configurations along straight lines through waypoints; orientations and directions turn evenly.

    Args:
        tool: inverse kinematics.
        waypoints: ends of the lines; if one leaves direction or orientation free, they are free along its line.
        start: all joints at the start [rad], shape (J,).
        constraints: where an orientation is free, it keeps these if it can; the caller checks them.

    Raises:
        PlanningError: without waypoints, or for an invalid one.
    """
    if not waypoints:
        raise invalid_goal("a straight path needs at least one waypoint")
    targets = _targets(tool, waypoints, start)
    total = sum(length for *_, length in targets)
    joints, fractions, errors, reason, covered = [start], [0.0], [0.0], "", 0.0
    for target, tolerance, axis_tolerance, length in targets:
        q = _followed(tool.model, target, joints[-1], tolerance, axis_tolerance)
        if q is None:
            try:
                q = solve(
                    tool.model, target, joints[-1], position_tolerance=tolerance, rotation_tolerance=axis_tolerance
                )
            except UnreachableError as error:
                reason = str(error)
                break
        if constraints is not None and target.rotation is None and not constraints.kept(q, -HELD_BACK):
            near, done = constraints.projected(q[None], target)
            q = near[0] if done[0] else q
        ways = np.abs(q - joints[-1])
        if ways.max() > _LARGEST_JUMP:
            joint = tool.model.joint_names[int(ways.argmax())]
            reason = f"joint {joint} would have to jump by {ways.max():.2f} rad"
            break
        covered += length
        joints.append(q)
        fractions.append(min(covered / total, 1.0) if total > 0 else 1.0)
        errors.append(turned(tool.model.forward(q), target.rotation, target.axis))
    return LinearPath(np.array(joints), np.array(fractions), np.array(errors), reason)


def _followed(
    model: KinematicModel, target: Target, start: Vector, tolerance: float, axis_tolerance: float
) -> Vector | None:
    """The configuration nearest to `start` at a target close by, by Gauss-Newton steps; None if they fail."""
    moving = model.moving
    q = start.copy()
    weight = _TURN_M if axis_tolerance < 1 else 0.01 * _TURN_M
    for _ in range(_STEPS):
        tip, jacobian = model.forward_and_jacobian(q)
        error, rows = [target.position - tip.position], [jacobian[:3, moving]]
        if target.rotation is not None:
            error.append(weight * log(target.rotation @ tip.rotation.T))
            rows.append(weight * jacobian[3:, moving])
        elif target.axis is not None:
            axis = tip.rotation[:, 2]
            error.append(weight * cross(axis, target.axis))
            rows.append(weight * (jacobian[3:, moving] - np.outer(axis, axis @ jacobian[3:, moving])))
        step = np.linalg.lstsq(np.concatenate(rows), np.concatenate(error), rcond=1e-3)[0]
        q[moving] = np.clip(q[moving] + step, model.lower[moving], model.upper[moving])
        if np.abs(step).max() < _CONVERGED:
            break
    tip = model.forward(q)
    close = np.linalg.norm(tip.position - target.position) <= min(tolerance, _EXACT_M)
    return q if close and turned(tip, target.rotation, target.axis) <= axis_tolerance else None


def _targets(
    tool: Tool, waypoints: Sequence[PositionGoal | PoseGoal], start: Vector
) -> list[tuple[Target, float, float, float]]:
    """Targets along the lines, each with its tolerances and the length of the path from the previous one."""
    tip = tool.model.forward(start)
    position, rotation = tip.position, tip.rotation
    targets = []
    for waypoint in waypoints:
        end, end_rotation, axis, angle_tolerance = _end(waypoint)
        tool.check_reach(end, start)
        away = float(np.linalg.norm(end - position))
        turn = np.zeros(3)
        if end_rotation is not None:
            turn = log(rotation.T @ end_rotation)
        elif axis is not None:
            turn = between(rotation[:, 2], axis)
        angle = float(np.linalg.norm(turn))
        number = max(int(np.ceil(away / _STEP_M)), int(np.ceil(angle / _STEP_RAD)), 1)
        for share in np.arange(1, number + 1) / number:
            rotated = None if end_rotation is None else rotation @ exp(share * turn)
            pointed = None if axis is None else exp(share * turn) @ rotation[:, 2]
            target = Target(position + share * (end - position), rotated, pointed)
            targets.append((target, waypoint.position_tolerance, angle_tolerance, away / number))
        position = end
        if end_rotation is not None:
            rotation = end_rotation
        elif axis is not None:
            rotation = exp(turn) @ rotation
    return targets


def _end(waypoint: PositionGoal | PoseGoal) -> tuple[Vector, Vector | None, Vector | None, float]:
    if isinstance(waypoint, PoseGoal):
        placed = pose_matrix(waypoint)
        if waypoint.orientation_tolerance is None or waypoint.beyond_reach == "free":
            return placed[:3, 3], None, None, 0.01
        if waypoint.beyond_reach in ("keep_axis", "arm_plane"):
            return placed[:3, 3], None, placed[:3, 2], waypoint.orientation_tolerance
        tolerance = waypoint.orientation_tolerance if waypoint.beyond_reach == "refuse" else np.pi
        return placed[:3, 3], placed[:3, :3], None, tolerance
    place = vector(waypoint.position, "the position")
    if waypoint.axis is None:
        return place, None, None, waypoint.axis_tolerance
    return place, None, unit(waypoint.axis), waypoint.axis_tolerance
