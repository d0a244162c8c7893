"""The planner around obstacles: inverse kinematics, search, shortening, timing, check of the timed motion."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import override

import attrs
import numpy as np
from ibrobot_kinematics import ToolConstraints, robot_model

from ibrobot_core.api import Context, PlanCode, PlanningError, Vector
from ibrobot_planning.goals.grammar import without_names
from ibrobot_planning.goals.tool import Candidate, Tool
from ibrobot_planning.planner import (
    AnyGoal,
    ConstrainedGoal,
    Goal,
    JointGoal,
    LinearGoal,
    Planner,
    PlanRequest,
    PlanResult,
    PoseGoal,
    PositionGoal,
    checked_start,
    invalid_goal,
    joint_target,
)
from ibrobot_planning.planners.constrained import ConstrainedChecks, ConstrainedSpace
from ibrobot_planning.planners.linear import linear_path
from ibrobot_planning.planners.options import RrtConnectOptions
from ibrobot_planning.planners.search import Pace, Space, connect, shortened
from ibrobot_planning.planners.timing import CHECK_S, Motion, resting, timed, trajectory_of
from ibrobot_planning.world.arm import Arm
from ibrobot_planning.world.checked_arm import checked_arm
from ibrobot_planning.world.collision import Collisions, outwards, sentence
from ibrobot_planning.world.objects import World, with_floor, world_of

_RESOLUTIONS_M = (0.05, 0.02, 0.005)
"""Maximum motion of the arm between checks of the search; finer ones follow if the timed motion touches."""
_FINEST_M = 0.0015
"""The same for a whole path before it is timed."""
_REPAIRS = 12
"""Attempts to time a path, each with smaller blends at the contacts of the previous one."""
_LEAST_BLEND = 0.01
"""Smaller blends [rad] become stops."""
_WIDEST_WINDOW_S, _LINEAR_WINDOW_S = 0.1, 0.03
"""Widths of the moving average of free motions and of straight lines; a wider one leaves the path further."""
_ROUNDING = 1e-6
"""Allowed excess of positions beyond a limit [rad]."""
_EXITS = 60
"""Number of directions tried at each distance to leave a contact."""


class RrtConnectPlanner(Planner):
    """Plans around the objects of a world, with padding.

    Attributes:
        world: the objects, if the run has no section `world`; may be replaced at any time.
    """

    def __init__(self, options: RrtConnectOptions, ctx: Context) -> None:
        self.world = World()
        self._options = options
        self._ctx = ctx
        self._arm: Arm | None = None
        self._tool: Tool | None = None
        self._floor = ctx.robot.description.floor if options.floor is None else options.floor

    @override
    def load(self) -> None:
        self._arm = checked_arm(self._ctx.robot, self._ctx.log)
        self._tool = Tool(robot_model(self._ctx.robot))

    @property
    def arm(self) -> Arm:
        """The collision model, once loaded."""
        if self._arm is None:
            raise PlanningError("the planner is not loaded", PlanCode.COLLISION_CHECKING_UNAVAILABLE)
        return self._arm

    @override
    def plan(self, request: PlanRequest) -> PlanResult:
        begun = time.monotonic()
        start = self._check_start(request)
        world = with_floor(world_of(self._ctx.bus, lambda: self.world), self._floor)
        margins = {"padding": self._options.padding, "self_padding": self._options.self_padding}
        checks = Collisions(self.arm, world, request.joints, request.others, **margins)
        checks.before = request.check_wanted  # whatever takes time in a search checks for contacts
        deadline = begun + self._options.planning_time
        assert self._tool is not None
        return _Plan(self._ctx, self._options, self._tool, request, start, checks, deadline).solve()

    def _check_start(self, request: PlanRequest) -> Vector:
        robot = self._ctx.robot
        start = checked_start(request, robot)
        for name, value in zip(request.joints, start.tolist(), strict=True):
            joint = robot.joints[robot.joint_names.index(name)]
            beyond = max(joint.lower - value, value - joint.upper)
            if beyond > self._options.start_beyond_limits:
                raise PlanningError(
                    f"start of joint {name} is {value:.4f} rad, {beyond:.4f} rad outside its limits {joint.lower} .."
                    f" {joint.upper} rad; at most {self._options.start_beyond_limits} rad is let pass",
                    PlanCode.START_STATE_INVALID,
                )
        return start


@attrs.define(eq=False)
class _Plan:
    """One request in progress."""

    ctx: Context
    options: RrtConnectOptions
    tool: Tool
    request: PlanRequest
    start: Vector
    checks: Collisions | ConstrainedChecks
    deadline: float
    refused: Motion | None = None
    """The last motion that broke a path constraint."""

    def solve(self) -> PlanResult:
        goal = self.request.goal
        if isinstance(goal, ConstrainedGoal):
            return self._constrained(goal).solve()
        if isinstance(goal, LinearGoal):
            return self._linear(goal)
        way_out = self._way_out()
        alternatives = goal.goals if isinstance(goal, AnyGoal) else (goal,)
        if not alternatives:
            raise invalid_goal("the goal has no alternatives")
        failures: list[PlanningError] = []
        for number, alternative in enumerate(alternatives):
            try:
                # Divide the remaining time, so that a hard alternative leaves some for the next.
                share = (self.deadline - time.monotonic()) / (len(alternatives) - number)
                return self._reach(alternative, number, way_out, time.monotonic() + share)
            except PlanningError as failure:
                if failure.code is PlanCode.PREEMPTED:
                    raise
                failures.append(failure)
        if len(failures) == 1:
            raise failures[0]
        reasons = "; ".join(f"alternative {number}: {failure}" for number, failure in enumerate(failures))
        raise PlanningError(f"no alternative of the goal can be reached: {reasons}", failures[0].code)

    @property
    def _order(self) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
        return self.ctx.robot.indices(self.request.joints)

    @property
    def _limits(self) -> tuple[Vector, Vector]:
        return self.ctx.robot.lower[self._order], self.ctx.robot.upper[self._order]

    def _whole(self) -> Vector:
        """All joints at the start, shape (J,)."""
        robot = self.ctx.robot
        whole = np.array([self.request.others.get(name, 0.0) for name in robot.joint_names])
        whole[self._order] = self.start
        return whole

    @property
    def _constraints(self) -> ToolConstraints | None:
        return self.checks.constraints if isinstance(self.checks, ConstrainedChecks) else None

    def _constrained(self, goal: ConstrainedGoal) -> _Plan:
        """The same request, with checks of path constraints.

        Raises:
            PlanningError: if the start breaks them.
        """
        self._check_chain()
        if isinstance(self.checks, ConstrainedChecks):
            raise invalid_goal("the goal has path constraints within path constraints: give all of them in one")
        constraints = ToolConstraints(goal.constraints, self.tool.model, self._whole())
        checks = ConstrainedChecks(self.checks, constraints, self._whole(), self._order)
        if broken := checks.broken(self.start):
            raise PlanningError(f"the start breaks {broken}", PlanCode.START_STATE_VIOLATES_PATH_CONSTRAINTS)
        return attrs.evolve(self, request=attrs.evolve(self.request, goal=goal.goal), checks=checks)

    def _space(self, resolution: float) -> Space:
        if isinstance(self.checks, ConstrainedChecks):
            return ConstrainedSpace(self.checks, *self._limits, resolution, constrained=self.checks)
        return Space(self.checks, *self._limits, resolution)

    def _why(self, q: Vector) -> str:
        """What a configuration that is not free breaks or touches, in words."""
        broken = self.checks.broken(q) if isinstance(self.checks, ConstrainedChecks) else ""
        return broken or sentence(self.checks.contacts(q))

    def _broken(self, positions: Vector) -> bool:
        """Whether one of the positions, shape (N, J), breaks a path constraint."""
        checks = self.checks
        return isinstance(checks, ConstrainedChecks) and checks.first_broken(positions) < len(positions)

    def _reach(self, goal: Goal, number: int, way_out: list[Vector], deadline: float) -> PlanResult:
        if isinstance(goal, ConstrainedGoal):
            return self._constrained(goal)._reach(goal.goal, number, way_out, deadline)
        candidates = self._free_goals(self._candidates(goal), goal)
        if np.abs(candidates[0].joints[self._order] - self.start).max() < _ROUNDING and len(way_out) == 1:
            return self._result(resting(self.start, self.options.step), candidates[0], number)
        goals = [candidate.joints[self._order] for candidate in candidates]
        for path in self._paths(way_out[-1], goals, deadline):
            motion = self._checked([*way_out[:-1], *path])
            if motion is not None:
                reached = next(i for i, each in enumerate(goals) if np.array_equal(each, path[-1]))
                return self._result(motion, candidates[reached], number)
        if self.refused is not None:
            raise PlanningError(self._breach(self.refused), PlanCode.INVALID_MOTION_PLAN)
        raise PlanningError(self._stuck(way_out[-1], goals[0]), PlanCode.TIMED_OUT)

    def _breach(self, motion: Motion) -> str:
        """Where a motion breaks a path constraint."""
        assert isinstance(self.checks, ConstrainedChecks)
        positions, velocities, _ = motion.sampled(CHECK_S)
        at = min(self.checks.first_broken(positions), len(positions) - 1)
        whole, velocity = self.checks.whole(positions[at]), np.zeros(len(self.ctx.robot.joints))
        velocity[self._order] = velocities[at]
        joint = self.checks.constraints.moved_by(whole, velocity)
        return (
            f"every timed motion breaks a path constraint; the last at {at * CHECK_S:.3f} s, mostly by joint {joint}:"
            f" {self.checks.broken(positions[at])}"
        )

    def _paths(self, start: Vector, goals: list[Vector], deadline: float) -> Iterator[list[Vector]]:
        """Short paths with increasingly fine checks; the caller takes the next if the timed motion touches."""
        rng = np.random.default_rng(self.ctx.seed)
        for resolution in _RESOLUTIONS_M:
            space = self._space(resolution)
            path = connect(space, start, goals, rng, lambda: time.monotonic() > deadline)
            if path is None:
                return
            for closely in _RESOLUTIONS_M[1:]:
                yield shortened(self._space(closely), path, rng, self._pace)

    def _candidates(self, goal: Goal) -> list[Candidate]:
        robot = self.ctx.robot
        goal = without_names(goal, robot, self.request.joints)
        if isinstance(goal, JointGoal):
            whole = self._whole()
            whole[self._order] = joint_target(goal, robot, self.request.joints, self.start)
            return [Candidate(whole)]
        if isinstance(goal, PositionGoal | PoseGoal):
            self._check_chain()
            return self.tool.candidates(goal, self._whole())
        raise PlanningError(
            f"a goal of type {type(goal).__name__} is not known; known are JointGoal, NamedGoal, PositionGoal,"
            " PoseGoal, AnyGoal and LinearGoal",
            PlanCode.UNRECOGNIZED_GOAL_TYPE,
        )

    def _check_chain(self) -> None:
        model = self.tool.model
        missing = [model.joint_names[i] for i in model.moving if model.joint_names[i] not in self.request.joints]
        if missing:
            raise PlanningError(
                f"a goal of the tool needs all joints that move it; not planned: {', '.join(missing)}",
                PlanCode.INVALID_GROUP_NAME,
            )

    def _free_goals(self, candidates: list[Candidate], goal: Goal) -> list[Candidate]:
        """The configurations without contacts.

        Raises:
            PlanningError: if all of them touch something.
        """
        tolerant = isinstance(goal, JointGoal) and goal.tolerance > 0
        if self._constraints is not None and not tolerant:
            candidates = self.tool.kept(goal, candidates, self._constraints, self._whole())
        free = [candidate for candidate in candidates if self.checks.free(candidate.joints[self._order])]
        if not free and isinstance(goal, JointGoal) and goal.tolerance > 0:
            free = self._nearby(candidates[0].joints, goal)
        if free:
            return free
        if self._constraints is not None:
            candidates = self.tool.kept(goal, candidates, self._constraints, self._whole())
        least = min(
            (self.checks.contacts(candidate.joints[self._order]) for candidate in candidates),
            key=lambda contacts: contacts[0].padding - contacts[0].distance,
        )
        at_all = f" in all of its {len(candidates)} configurations" if len(candidates) > 1 else ""
        raise PlanningError(f"the goal is in collision{at_all}: {sentence(least)}", PlanCode.GOAL_IN_COLLISION)

    def _nearby(self, whole: Vector, goal: JointGoal) -> list[Candidate]:
        """The nearest of random free configurations within the goal's tolerance."""
        rng = np.random.default_rng(self.ctx.seed)
        robot = self.ctx.robot
        free = []
        indices = robot.indices(goal.joints)
        for share in np.linspace(0.1, 1.0, 100):
            near = whole.copy()
            near[indices] += share * goal.tolerance * rng.uniform(-1, 1, len(indices))
            near = np.clip(near, robot.lower, robot.upper)
            if self.checks.free(near[self._order]):
                free.append(Candidate(near))
        return sorted(free, key=lambda each: float(np.abs(each.joints - whole).max()))[:1]

    def _way_out(self) -> list[Vector]:
        """Waypoints from the start to one within limits and without contacts; only the start if it is such a one.

        Raises:
            PlanningError: if the start overlaps too deeply, or no short motion leads out.
        """
        inside = np.clip(self.start, *self._limits)
        way = [self.start] if np.array_equal(inside, self.start) else [self.start, inside]
        touching = [contact for q in way if not self.checks.free(q) for contact in self.checks.contacts(q)]
        if not touching and self._space(_FINEST_M).free(way[0], way[-1]):
            return way
        deepest = min(touching, key=lambda contact: contact.distance, default=None)
        if deepest is None or deepest.distance < -self.options.start_overlap:
            if not touching and (broken := self._why(inside)):
                raise PlanningError(
                    f"the way back within the joints' limits is blocked: {broken}", PlanCode.START_STATE_INVALID
                )
            raise PlanningError(f"the start is in collision: {sentence(touching)}", PlanCode.START_STATE_IN_COLLISION)
        rng = np.random.default_rng(self.ctx.seed)
        for distance in (0.03, 0.06, 0.1, 0.2, 0.4):
            for _ in range(_EXITS):
                direction = rng.normal(size=len(inside))
                end = np.clip(inside + distance * direction / np.linalg.norm(direction), *self._limits)
                if self.checks.free(end) and self._leaves(self.start, end):
                    return [self.start, end]
        within = "" if self._constraints is None else " within the path constraints"
        raise PlanningError(
            f"the start is in collision, and no short motion leads out{within}: {sentence(touching)}",
            PlanCode.START_STATE_IN_COLLISION,
        )

    def _leaves(self, start: Vector, end: Vector) -> bool:
        """Whether contacts at the start only open on the line to a free end, and no other contact occurs."""
        line = self._space(_FINEST_M).line(start, end)
        if self._broken(line):
            return False
        return outwards(self.checks, np.concatenate([start[None], line])) is not None

    def _linear(self, goal: LinearGoal) -> PlanResult:
        self._check_chain()
        if not 0 < goal.least_fraction <= 1:
            raise invalid_goal(f"least_fraction is {goal.least_fraction}, must be above 0 and at most 1")
        touching = self.checks.contacts(self.start)
        if touching:
            raise PlanningError(f"the start is in collision: {sentence(touching)}", PlanCode.START_STATE_IN_COLLISION)
        line = linear_path(self.tool, goal.waypoints, self._whole(), self._constraints)
        path = line.joints[:, self._order]
        space = self._space(_FINEST_M)
        possible, reason = len(path), line.reason
        for number in range(1, len(path)):
            if not space.free(path[number - 1], path[number]):
                possible, reason = number, self._why(path[number])
                break
        motion = None
        while possible > 1:
            motion = self._checked(list(path[:possible]), linear=True)
            if motion is not None:
                break
            possible -= max(1, possible // 10)
        fraction = float(line.fractions[possible - 1])
        if possible == 1 or fraction < goal.least_fraction - 1e-9:
            raise PlanningError(
                f"the tool can follow {100 * fraction:.0f} % of the straight path, {100 * goal.least_fraction:.0f} %"
                f" asked: {reason}",
                PlanCode.PLANNING_FAILED,
            )
        assert motion is not None
        end = Candidate(line.joints[possible - 1], 0.0, float(line.errors[possible - 1]))
        return self._result(motion, end, 0, fraction)

    @property
    def _pace(self) -> Pace:
        """Limits of the motion, for estimates of its time."""
        return Pace(*self._scaled_limits(_WIDEST_WINDOW_S), self.options.blend)

    def _scaled_limits(self, window_s: float) -> tuple[Vector, Vector]:
        """Velocity and acceleration; the average over `window_s` [s] then keeps the jerk limit."""
        robot, options, request = self.ctx.robot, self.options, self.request
        velocity = robot.max_velocity[self._order] * options.velocity_scaling * request.velocity_scaling
        limit = robot.max_acceleration[self._order] * options.acceleration_scaling * request.acceleration_scaling
        return velocity, np.minimum(limit, options.max_jerk * window_s / 2)

    def _checked(self, path: Sequence[Vector], *, linear: bool = False) -> Motion | None:
        """The fastest motion along a path without contacts; None if it touches even when it stops at corners."""
        options, way = self.options, np.array(path)
        velocity, acceleration = self._scaled_limits(_LINEAR_WINDOW_S if linear else _WIDEST_WINDOW_S)
        window = 2 * float(acceleration.max()) / options.max_jerk
        blends = self._blends(way)
        for number in range(_REPAIRS):
            motion = timed(way, velocity, acceleration, blends=blends, window=window, step=options.step)
            touching = self._touching(motion)
            if not len(touching):
                return motion
            if not blends.any() or (number == 0 and not self._free_closely(way)):
                return None
            corners = np.linalg.norm(touching[:, None] - way[None, 1:-1], axis=2)
            nearest = np.unique(np.where(blends > 0, corners, np.inf).argmin(axis=1))
            blends[nearest] /= 2
            blends[blends < _LEAST_BLEND] = 0.0
        blends[:] = 0.0
        motion = timed(way, velocity, acceleration, blends=blends, window=window, step=options.step)
        return None if len(self._touching(motion)) else motion

    def _free_closely(self, way: Vector) -> bool:
        """Whether the path itself is free; if not, no blend helps."""
        begin = 0 if self.checks.free(way[0]) else 1
        finest = self._space(_FINEST_M)
        return all(finest.free(a, b) for a, b in pairwise(way[begin:]))

    def _blends(self, way: Vector) -> Vector:
        """Maximum blend of each corner without contacts."""
        lengths = np.linalg.norm(np.diff(way, axis=0), axis=1)
        blends = np.minimum(np.minimum(lengths[:-1], lengths[1:]) / 2, self.options.blend)
        shares = np.linspace(0, 1, 9)[:, None]
        for i, corner in enumerate(way[1:-1]):
            while blends[i] >= _LEAST_BLEND:
                before = corner - blends[i] * (corner - way[i]) / max(lengths[i], 1e-12)
                after = corner + blends[i] * (way[i + 2] - corner) / max(lengths[i + 1], 1e-12)
                curve = (1 - shares) ** 2 * before + 2 * shares * (1 - shares) * corner + shares**2 * after
                if self.checks.first_hit(curve) == len(curve):
                    break
                blends[i] /= 2
            else:
                # Lines of many points have short segments, whose blends hardly leave the path.
                blends[i] = blends[i] if lengths[i : i + 2].max() < 4 * _LEAST_BLEND else 0.0
        return blends

    def _touching(self, motion: Motion) -> Vector:
        """Where a motion touches or leaves the limits, shape (N, J)."""
        positions = motion.positions_within(CHECK_S)
        if self._broken(positions):
            self.refused = motion
        lower, upper = self._limits
        # A joint outside its limits may only move inwards.
        lower, upper = np.minimum(lower, self.start), np.maximum(upper, self.start)
        outside = ((positions < lower - _ROUNDING) | (positions > upper + _ROUNDING)).any(axis=1)
        bad = [positions[outside]]
        checked = 0
        if not self.checks.free(self.start):
            out = outwards(self.checks, positions)
            if out is None or self._broken(positions[:out]):
                return np.asarray(positions[:1])
            checked = out
        while checked < len(positions):
            checked += self.checks.first_hit_on_path(positions[checked:])
            if checked < len(positions):
                bad.append(positions[checked : checked + 1])
                # Continue past this contact, by the least duration of a corner.
                checked += 10
        return np.asarray(np.concatenate(bad))

    def _stuck(self, start: Vector, goal: Vector) -> str:
        line = self._space(_RESOLUTIONS_M[0]).line(start, goal)
        hit = self.checks.first_hit(line)
        message = f"no path found within {self.options.planning_time:g} s"
        if hit == len(line):
            return message
        return f"{message}; on the straight way {self._why(line[hit])}"

    def _result(self, motion: Motion, end: Candidate, number: int, fraction: float = 1.0) -> PlanResult:
        # Executors refuse positions outside the limits, even if only by rounding.
        lower, upper = self._limits
        positions = np.clip(motion.positions, np.minimum(lower, self.start), np.maximum(upper, self.start))
        inside = attrs.evolve(motion, positions=positions)
        trajectory = trajectory_of(inside, self.request.joints, self.ctx.clock.now_ns())
        return PlanResult(trajectory, fraction, number, end.position_error, end.orientation_error)
