"""Scripted experts: policies that solve scenes by inverse kinematics and the scene's ground truth."""

from __future__ import annotations

from typing import override

import attrs
import numpy as np
from ibrobot_kinematics import KinematicModel, KinematicsError, UnreachableError, robot_model
from ibrobot_kinematics.tool_features import rotation_6d
from numpy.typing import NDArray

from ibrobot_core.api import NS_PER_S, Context, Frame, Policy, PolicyError, PolicySpec, Tensors, Vector, seconds
from ibrobot_mujoco.experts.options import ExpertOptions
from ibrobot_mujoco.experts.task import Task
from ibrobot_mujoco.experts.trajectory import Limits, Segment, Trajectory
from ibrobot_mujoco.experts.way import Hand, Way

STATE = "observation.state"
SCENE = "observation.environment_state"
TOOL_NAMES = ("ee.x", "ee.y", "ee.z", "ee.r11", "ee.r21", "ee.r31", "ee.r12", "ee.r22", "ee.r32")
STAMP = "stamp_ns"
ACTION = "action"

LIMIT_MARGIN_RAD = 1e-3
"""Distance of plans from the joint limits, so that rounding never causes an intervention of the safety layer [rad]."""
LEAD_IN_S = 0.2
"""Pause before the first motion, so that a late chunk still begins at rest [s]."""


@attrs.define(eq=False)
class _Episode:
    """The plans of an episode. Times are relative to its first frame."""

    start_ns: int
    home: Vector
    trajectory: Trajectory
    first: int
    """Index of the first segment of the latest plan."""
    issued_s: float = 0.0
    """Time of the last action returned."""


class ScriptedExpert(Policy):
    """Plans the whole motion at an episode's first frame. Chunks are time windows of it, so they agree exactly.

    If the scene deviates from the plan (e.g. an object was pushed away, dropped, or misplaced), it replans from the
    next waypoint that is clear of all objects and not yet part of a chunk.

    Args:
        task: makes the plans.
        name: the type of the policy, for errors.
        options: gripper positions, heights, speed and the shape of chunks.
        ctx: `ctx.robot` has joints, limits and the model; its group `gripper` contains the gripper's joint, or for two
            arms the groups `left_gripper` and `right_gripper`, beside the arms' groups `left` and `right`.
        observed: number of values of the scene's ground truth.

    Raises:
        PolicyError: if the robot has no such group.
    """

    def __init__(self, task: type[Task], name: str, options: ExpertOptions, ctx: Context, observed: int) -> None:
        self._kind = task
        self._name = name
        self._options = options
        self._robot = ctx.robot
        for side in task.sides:
            gripper = ctx.robot.groups.get(f"{side}gripper", ())
            if len(gripper) != 1:
                raise PolicyError(f"{name} needs one joint in robot.groups.{side}gripper, got {list(gripper)}")
        # Setpoints are interpolated linearly up to the control rate, so that a change of velocity over a whole action
        # period can fall into one control period.
        ticks = max(1.0, NS_PER_S / (options.rate_hz * ctx.period_ns))
        self._limits = Limits(
            velocity=options.speed * ctx.robot.max_velocity,
            acceleration=options.speed / ticks * ctx.robot.max_acceleration,
        )
        size = len(ctx.robot.joints)
        self._arm: KinematicModel | None = None
        """The arm whose tool's poses are the actions; None for positions of joints."""
        gripper = ctx.robot.groups.get("gripper", ())
        names = ctx.robot.joint_names if options.actions == "joints" else (*TOOL_NAMES, *gripper)
        self.spec = PolicySpec(
            observations={STATE: (size,), SCENE: (observed,)},
            actions=names,
            action_size=len(names),
            chunk_size=options.chunk_size,
            rate_hz=options.rate_hz,
            stateful=True,
        )
        self._task: Task | None = None
        self._episode: _Episode | None = None

    @override
    def load(self) -> None:
        try:
            hands = tuple(self._hand(side) for side in self._kind.sides)
        except KinematicsError as error:
            raise PolicyError(f"{self._name} cannot be loaded: {error}") from error
        self._task = self._kind(hands, self._options)
        self._arm = hands[0].arm if self._options.actions == "tool" else None

    def _hand(self, side: str) -> Hand:
        robot = self._robot
        joints = robot.groups[side.removesuffix("_")] if side else robot.joint_names
        arm = robot_model(robot, joints)
        arm = attrs.evolve(arm, lower=arm.lower + LIMIT_MARGIN_RAD, upper=arm.upper - LIMIT_MARGIN_RAD)
        gripper = int(robot.indices(robot.groups[f"{side}gripper"])[0])
        base = robot.description.arms.get(side, (0.0, 0.0, 0.0, 0.0))
        return Hand(arm, robot.indices(joints), gripper, base)

    @override
    def reset(self, seed: int) -> None:
        self._episode = None

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        tensors: dict[str, NDArray[np.generic]] = {STAMP: np.array([frame.stamp_ns], dtype=np.int64)}
        known = (key for key in self.spec.observations if key in frame.values)
        tensors |= {key: np.asarray(frame.values[key], dtype=np.float64) for key in known}
        self.check(tensors)
        return tensors

    @override
    def check(self, tensors: Tensors) -> None:
        for name, shape in {STAMP: (1,), **self.spec.observations}.items():
            array = tensors.get(name)
            if array is None or array.shape != shape or not np.isfinite(array).all():
                got = "nothing" if array is None else array.tolist()
                raise PolicyError(f"{self._name} needs {name} with {shape[0]} finite numbers, got {got!s:.200}")

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        if self._task is None:
            raise PolicyError(f"{self._name} is not loaded: call load() first")
        self.check(tensors)
        now_ns = int(tensors[STAMP][0])
        state, scene = tensors[STATE].astype(np.float64), tensors[SCENE].astype(np.float64)
        if self._episode is None:
            home = np.clip(state, self._robot.lower, self._robot.upper)
            way = Way(home, self._limits)
            way.rest("return", LEAD_IN_S)
            self._episode = _Episode(now_ns, home, *self._extended(way.segments, scene, home))
        episode = self._episode
        now_s = seconds(now_ns - episode.start_ns)
        if self._failed(episode, now_s, state, scene):
            kept = _kept(episode.trajectory, episode.issued_s)
            episode.trajectory, episode.first = self._extended(kept, scene, episode.home)
        # The time grid of actions begins with the episode, so that jitter of the observations' stamps does not shift
        # chunks relative to one another.
        tick = round(now_s * self._options.rate_hz)
        times_s = (tick + np.arange(self._options.chunk_size)) / self._options.rate_hz
        episode.issued_s = float(times_s[-1])
        return {ACTION: episode.trajectory.at(times_s)}

    @override
    def postprocess(self, tensors: Tensors) -> NDArray[np.float64]:
        positions = np.array(tensors[ACTION], dtype=np.float64)
        if self._options.actions == "joints":
            return positions
        if self._arm is None:
            self._arm = self._hand("").arm
        gripper = self._robot.indices(self._robot.groups["gripper"])
        tip = self._arm.forward(positions)
        return np.concatenate([tip.position, rotation_6d(tip.rotation), positions[:, gripper]], axis=1)

    def _extended(self, kept: list[Segment], scene: Vector, home: Vector) -> tuple[Trajectory, int]:
        """The trajectory of `kept` followed by a new plan, and the plan's first segment."""
        assert self._task is not None
        way = Way(kept[-1].end, self._limits, list(kept))
        try:
            self._task.plan(way, scene, home)
        except UnreachableError as error:
            raise PolicyError(f"{self._name} cannot plan its task: {error}") from error
        return Trajectory(way.segments), len(kept)

    @staticmethod
    def _failed(episode: _Episode, now_s: float, state: Vector, scene: Vector) -> bool:
        """Whether the scene deviates from the plan at this time."""
        index = max(int(episode.trajectory.index(np.array([now_s]))[0]), episode.first)
        return not episode.trajectory.segments[index].expects(state, scene)


def _kept(trajectory: Trajectory, issued_s: float) -> list[Segment]:
    """The segments up to the first clear waypoint at or after `issued_s` [s], or a pause if there is none."""
    for i, segment in enumerate(trajectory.segments):
        if segment.clear and trajectory.ends_s[i] >= issued_s:
            return list(trajectory.segments[: i + 1])
    last = trajectory.segments[-1]
    waited = Segment(last.name, last.end, last.end, issued_s - float(trajectory.ends_s[-1]), last.clear, last.expects)
    return [*trajectory.segments, waited]
