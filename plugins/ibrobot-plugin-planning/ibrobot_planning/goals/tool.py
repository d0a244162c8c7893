"""Joint positions that reach positions and poses of the tool."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress

import attrs
import numpy as np
from ibrobot_kinematics import (
    KinematicModel,
    Target,
    TipPose,
    ToolConstraints,
    UnreachableError,
    solve,
    solve_all,
)
from ibrobot_kinematics.poses import matrix
from ibrobot_kinematics.rotations import between, cross, log
from ibrobot_kinematics.search import TABLE_LEVER_M, search, starts_from_table

from ibrobot_core.api import PlanCode, PlanningError, Vector, Vector3
from ibrobot_planning.planner import Goal, PoseGoal, PositionGoal, invalid_goal

_PITCHES = np.linspace(-np.pi / 2, np.pi / 2, 7)
"""Directions of the tool that are tried if a goal has none: from straight down to straight up."""
_SAME = 1e-3
"""Solutions that differ less [rad] count as one."""
_AS_NEAR = 0.02
"""Orientations whose errors differ less [rad] count as equally near."""
_POSITION_WEIGHT = 100.0
"""A centimetre weighs as much as a radian."""
_TURNS = 40
"""Most steps of a search for the nearest orientation."""
_FAR = 10.0
"""Positions farther than this many times the arm's reach are refused at once."""
_WIDEST = 100.0
"""Larger tolerances [m or rad] are refused."""
HELD_BACK = 1e-6
"""What checks hold back from every tolerance of a path constraint [rad or m]: another engine may round otherwise."""
_NEAR_POSITION, _SEEDS = 400, 60
"""Configurations near a position, and how many of them, the nearest to constraints, are projected onto these."""
_NEARLY_ONE = 1e-3
"""How far from 1 the length of a quaternion may be."""


@attrs.frozen(eq=False)
class Candidate:
    """A configuration that reaches a goal."""

    joints: Vector
    """All joints of the model [rad], shape (J,)."""
    position_error: float = 0.0
    """[m]."""
    orientation_error: float = 0.0
    """[rad]."""


def _unreachable(message: str) -> PlanningError:
    """The error for a goal that the arm cannot reach."""
    return PlanningError(message, PlanCode.NO_IK_SOLUTION)


def vector(value: Vector3, what: str) -> Vector:
    """A vector of a goal, shape (3,).

    Raises:
        PlanningError: for one that is not finite.
    """
    numbers = np.array([value.x, value.y, value.z], dtype=float)
    if not np.isfinite(numbers).all():
        raise invalid_goal(f"{what} of the goal is {numbers.tolist()}, must be finite")
    return numbers


def _tolerances(**values: float) -> None:
    for name, value in values.items():
        if not 0 < value <= _WIDEST:
            raise invalid_goal(f"{name} of the goal is {value}, must be above 0 and at most {_WIDEST:g}")


def unit(value: Vector3) -> Vector:
    """A direction as a unit vector, shape (3,).

    Raises:
        PlanningError: for one that is not finite or has no length.
    """
    direction = vector(value, "the axis")
    largest = float(np.abs(direction).max())
    if largest < 1e-9:
        raise invalid_goal("the axis of the goal has no length; give a direction, e.g. (0, 0, -1) for down")
    direction /= largest  # the squares of large numbers would overflow
    return np.asarray(direction / np.linalg.norm(direction))


def pose_matrix(goal: PoseGoal) -> Vector:
    """The pose of a goal, shape (4, 4).

    Raises:
        PlanningError: for a pose that is not finite or whose quaternion is not of length 1.
    """
    vector(goal.pose.position, "the position")
    q = goal.pose.orientation
    quaternion = np.array([q.x, q.y, q.z, q.w], dtype=float)
    length = math.hypot(*quaternion)  # which does not overflow
    # Written so that NaN fails it.
    if not abs(length - 1) <= _NEARLY_ONE:
        raise invalid_goal(f"the orientation of the goal is a quaternion of length {length:.3g}, must be 1")
    return matrix(goal.pose)


@attrs.frozen(eq=False)
class Tool:
    """Inverse kinematics of goals for the tool centre point."""

    model: KinematicModel

    def candidates(self, goal: PositionGoal | PoseGoal, start: Vector) -> list[Candidate]:
        """Configurations that reach a goal, the preferred ones first.

        Args:
            goal: the goal.
            start: positions of all joints of the model [rad], shape (J,); joints that do not move the tip stay.

        Raises:
            PlanningError: for an invalid goal, or one that the arm cannot reach, with the distance that remains.
        """
        if isinstance(goal, PositionGoal):
            position = vector(goal.position, "the position")
            _tolerances(position_tolerance=goal.position_tolerance, axis_tolerance=goal.axis_tolerance)
            axis = None if goal.axis is None else unit(goal.axis)
            self.check_reach(position, start)
            return self._at(position, axis, start, goal.position_tolerance, goal.axis_tolerance)
        placed = pose_matrix(goal)
        position, rotation = placed[:3, 3], placed[:3, :3]
        _tolerances(position_tolerance=goal.position_tolerance)
        self.check_reach(position, start)
        if goal.orientation_tolerance is None:
            return self._at(position, None, start, goal.position_tolerance, 0.01)
        _tolerances(orientation_tolerance=goal.orientation_tolerance)
        candidates = self._posed(position, rotation, start, goal.position_tolerance)
        met = [each for each in candidates if each.orientation_error <= goal.orientation_tolerance]
        return met or self._beyond(goal, position, rotation, start, candidates)

    def kept(
        self, goal: Goal, candidates: Sequence[Candidate], constraints: ToolConstraints, start: Vector
    ) -> list[Candidate]:
        """The configurations that keep path constraints; for a position, also others that do.

        Args:
            goal: the goal.
            candidates: configurations that reach it.
            constraints: the constraints.
            start: positions of all joints of the model [rad], shape (J,).

        Raises:
            PlanningError: if there are none, with the least excess.
        """
        nowhere = ""
        if isinstance(goal, PositionGoal | PoseGoal):
            candidates = [*candidates, *self._keeping(goal, candidates, constraints, start)]
            nowhere = "; no configuration at the position keeps it"
        kept = [each for each in candidates if constraints.kept(each.joints, -HELD_BACK)]
        if kept:
            return kept
        least = min(candidates, key=lambda each: float(constraints.excess(each.joints).max()))
        raise PlanningError(
            f"the goal breaks {constraints.broken(least.joints, -HELD_BACK)}{nowhere}",
            PlanCode.GOAL_VIOLATES_PATH_CONSTRAINTS,
        )

    def _keeping(
        self, goal: PositionGoal | PoseGoal, near: Sequence[Candidate], constraints: ToolConstraints, start: Vector
    ) -> list[Candidate]:
        """Configurations at the position of a goal that keep path constraints, the nearest to `start` first.

        Args:
            goal: the goal; one with an orientation has none besides `near`.
            near: configurations that reach it.
            constraints: the constraints.
            start: positions of all joints of the model [rad], shape (J,).
        """
        if isinstance(goal, PositionGoal):
            position, axis = vector(goal.position, "the position"), None if goal.axis is None else unit(goal.axis)
        elif goal.orientation_tolerance is None or goal.beyond_reach == "free":
            position, axis = pose_matrix(goal)[:3, 3], None
        else:
            return []
        target = Target(position, axis=axis)
        lever = 0.0 if axis is None else TABLE_LEVER_M
        table = starts_from_table(self.model, target, start, _NEAR_POSITION, lever=lever)
        nearest = np.argsort(constraints.excess(table).max(axis=1), kind="stable")[:_SEEDS]
        seeds = np.concatenate([np.array([each.joints for each in near]), table[nearest]])
        reached, done = constraints.projected(np.clip(seeds, self.model.lower, self.model.upper), target)
        reached = reached[done]
        ranked = reached[np.argsort(((reached - start) ** 2).sum(axis=1), kind="stable")]
        return [self._compared(q, position, None, axis) for q in _distinct(list(ranked))]

    def check_reach(self, position: Vector, start: Vector) -> None:
        """Refuse a position [m], shape (3,), so far away that numbers would overflow or lines never end.

        Raises:
            PlanningError: with the nearest position that the arm reaches.
        """
        if np.abs(position).max() > _FAR * self.model.reach:
            try:
                solve(self.model, Target(position), start)
            except UnreachableError as error:
                raise _unreachable(str(error)) from error

    def _beyond(
        self, goal: PoseGoal, position: Vector, rotation: Vector, start: Vector, nearest: list[Candidate]
    ) -> list[Candidate]:
        """Handle an unreachable orientation by the goal's policy."""
        tolerance = goal.position_tolerance
        policy = goal.beyond_reach
        if policy in ("refuse", "nearest") or not nearest:
            if not nearest:
                self._at(position, None, start, tolerance, 0.01)  # its error tells how far off the position is
            if policy == "refuse" or not nearest:
                off = np.degrees(nearest[0].orientation_error) if nearest else 180.0
                raise _unreachable(
                    f"{self.model.tip} cannot take this orientation at {_text(position)};"
                    f" the nearest found is {off:.1f} degrees off (beyond_reach chooses what to do then)"
                )
            return nearest
        if policy == "free":
            taken = self._at(position, None, start, tolerance, 0.01)
        elif policy == "keep_axis":
            taken = self._at(position, rotation[:, 2], start, tolerance, goal.orientation_tolerance or 0.01)
        elif policy == "arm_plane":
            axis = self._in_plane(position, rotation[:, 2])
            taken = self._at(position, axis, start, tolerance, goal.orientation_tolerance or 0.01)
        else:
            taken = self._posed(position, self.model.forward(start).rotation, start, tolerance)
            if not taken:
                raise _unreachable(f"{self.model.tip} cannot keep its orientation at {_text(position)}")
        return [self._compared(each.joints, position, rotation) for each in taken]

    def _in_plane(self, position: Vector, axis: Vector) -> Vector:
        """The direction nearest to `axis` in the plane through the first joint's axis and `position`."""
        _, points, axes = self.model.screws(np.zeros(len(self.model.joint_names)))
        normal = cross(axes[0], position - points[0])
        length = float(np.linalg.norm(normal))
        if length < 1e-6:
            return axis
        normal = normal / length
        flat = axis - (axis @ normal) * normal
        across = float(np.linalg.norm(flat))
        return axis if across < 1e-6 else np.asarray(flat / across)

    def _at(
        self, position: Vector, axis: Vector | None, start: Vector, tolerance: float, axis_tolerance: float
    ) -> list[Candidate]:
        """Configurations at a position; all branches if there is a closed form."""
        solutions: list[Vector] = []
        error: UnreachableError | None = None
        tolerances = {"position_tolerance": tolerance, "rotation_tolerance": axis_tolerance}
        axes = [axis] if axis is not None else [None, *self._pitched(position)]
        for direction in axes:
            target = Target(position, axis=direction)
            try:
                solutions += solve_all(self.model, target, start, **tolerances)
            except UnreachableError as failure:
                error = error or failure
                if direction is None:
                    break
        distinct = _distinct(solutions)
        if not distinct:
            assert error is not None
            raise _unreachable(str(error)) from error
        return [self._compared(q, position, None, axis) for q in distinct]

    def _pitched(self, position: Vector) -> Iterator[Vector]:
        """Directions of the tool in the plane through the first joint's axis and `position`."""
        _, points, axes = self.model.screws(np.zeros(len(self.model.joint_names)))
        up = axes[0] if axes[0][2] >= 0 else -axes[0]
        out = position - points[0]
        out = out - (out @ up) * up
        length = float(np.linalg.norm(out))
        if length > 1e-6:
            yield from (np.cos(pitch) * out / length + np.sin(pitch) * up for pitch in _PITCHES)

    def _posed(self, position: Vector, rotation: Vector, start: Vector, tolerance: float) -> list[Candidate]:
        """Configurations at a position, with orientations near `rotation`, the nearest first."""
        target, seeds = Target(position, rotation), [np.clip(start, self.model.lower, self.model.upper)]
        tool_axis, in_plane = rotation[:, 2], self._in_plane(position, rotation[:, 2])
        # If a branch of the tool's axis has the orientation, no other is nearer.
        for axes in ((tool_axis,), (in_plane, None, *self._pitched(position))):
            for axis in axes:
                with suppress(UnreachableError):
                    seeds += solve_all(self.model, Target(position, axis=axis), start, position_tolerance=tolerance)
            begin = np.array(_distinct(seeds))
            result = search(self.model, target, begin, position_weight=_POSITION_WEIGHT, iterations=_TURNS)
            if result.within(tolerance, _SAME).any():
                break
        candidates = map(Candidate, result.joints, result.off.tolist(), result.turned.tolist())
        placed = sorted(
            (each for each in candidates if each.position_error <= tolerance), key=lambda each: each.orientation_error
        )
        best = [each for each in placed if each.orientation_error <= placed[0].orientation_error + _AS_NEAR]
        kept = _distinct([each.joints for each in best])
        return [each for each in best if any(each.joints is q for q in kept)]

    def _compared(self, q: Vector, position: Vector, rotation: Vector | None, axis: Vector | None = None) -> Candidate:
        tip = self.model.forward(q)
        return Candidate(q, float(np.linalg.norm(tip.position - position)), turned(tip, rotation, axis))


def turned(tip: TipPose, rotation: Vector | None, axis: Vector | None = None) -> float:
    """Angle between a tip and an orientation or a direction of its z axis [rad]; 0 for neither."""
    if rotation is not None:
        return float(np.linalg.norm(log(rotation.T @ tip.rotation)))
    if axis is not None:
        return float(np.linalg.norm(between(axis, tip.rotation[:, 2])))
    return 0.0


def _distinct(solutions: Sequence[Vector]) -> list[Vector]:
    kept: list[Vector] = []
    for q in solutions:
        if all(np.abs(q - other).max() > _SAME for other in kept):
            kept.append(q)
    return kept


def _text(position: Vector) -> str:
    x, y, z = position
    return f"({x:.3f}, {y:.3f}, {z:.3f}) m"
