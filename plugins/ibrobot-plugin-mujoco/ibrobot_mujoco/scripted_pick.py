"""`scripted_pick`: an expert that picks the cube and puts it into the bin, by inverse kinematics and ground truth."""

from __future__ import annotations

from typing import override

import attrs
import numpy as np
from ibrobot_kinematics import KinematicsError, UnreachableError, robot_model
from numpy.typing import NDArray

from ibrobot_core.api import NS_PER_S, Context, Frame, Policy, PolicyError, PolicySpec, Tensors, Vector, seconds
from ibrobot_mujoco.pick_planner import PickPlanner, Scene
from ibrobot_mujoco.policy_options import ScriptedPickOptions
from ibrobot_mujoco.state import SCENE_SIZE
from ibrobot_mujoco.trajectory import Limits, Segment, Trajectory, rest

STATE = "observation.state"
SCENE = "observation.environment_state"
STAMP = "stamp_ns"
ACTION = "action"

LIMIT_MARGIN_RAD = 1e-3
"""Distance of plans from the joint limits, so that rounding never causes an intervention of the safety layer [rad]."""
LEAD_IN_S = 0.2
"""Pause before the first motion, so that a late chunk still begins at rest [s]."""
MOVED_M = 0.01
"""A cube further than this from its planned grasp has moved [m]."""
LOST_M = 0.03
"""A cube further than this from the tip is not held [m]."""
DELIVERED_M = 0.07
"""A cube with a smaller horizontal distance to the bin's centre is in the bin [m]."""
CLEAR = frozenset({"hover", "lift", "carry", "open", "return"})
"""Segments that end with the gripper clear of the table, so that another plan can begin there."""


@attrs.define(eq=False)
class _Episode:
    """The plans of an episode. Times are relative to its first frame."""

    start_ns: int
    home: Vector
    trajectory: Trajectory
    first: int
    """Index of the first segment of the latest plan."""
    cube: Vector
    """Position of the cube for that plan [m], shape (3,)."""
    issued_s: float = 0.0
    """Time of the last action returned."""


class ScriptedPick(Policy):
    """Plans the whole motion on an episode's first frame; chunks are time windows of it, so they agree exactly.

    If the cube is not where the plan has it (pushed away, dropped, beside the bin), it plans again, from the next
    waypoint that is clear of the table and not yet part of a chunk.

    Args:
        options: gripper positions, heights, speed and the shape of chunks.
        ctx: `ctx.robot` has joints, limits and the model; its group `gripper` contains the gripper's joint.

    Raises:
        PolicyError: if the robot has no such group.
    """

    def __init__(self, options: ScriptedPickOptions, ctx: Context) -> None:
        self._options = options
        self._robot = ctx.robot
        gripper = ctx.robot.groups.get("gripper", ())
        if len(gripper) != 1:
            raise PolicyError(f"scripted_pick needs one joint in robot.groups.gripper, got {list(gripper)}")
        self._gripper = int(ctx.robot.indices(gripper)[0])
        # Setpoints are interpolated linearly up to the control rate, so that a change of velocity over a whole action
        # period can fall into one control period.
        ticks = max(1.0, NS_PER_S / (options.rate_hz * ctx.period_ns))
        self._limits = Limits(
            velocity=options.speed * ctx.robot.max_velocity,
            acceleration=options.speed / ticks * ctx.robot.max_acceleration,
        )
        size = len(ctx.robot.joints)
        self.spec = PolicySpec(
            observations={STATE: (size,), SCENE: (SCENE_SIZE,)},
            actions=ctx.robot.joint_names,
            action_size=size,
            chunk_size=options.chunk_size,
            rate_hz=options.rate_hz,
            stateful=True,
        )
        self._planner: PickPlanner | None = None
        self._episode: _Episode | None = None

    @override
    def load(self) -> None:
        try:
            arm = robot_model(self._robot)
        except KinematicsError as error:
            raise PolicyError(f"scripted_pick cannot be loaded: {error}") from error
        arm = attrs.evolve(arm, lower=arm.lower + LIMIT_MARGIN_RAD, upper=arm.upper - LIMIT_MARGIN_RAD)
        self._planner = PickPlanner(arm, self._options, self._limits, self._gripper)

    @override
    def reset(self, seed: int) -> None:
        self._episode = None

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        tensors: dict[str, NDArray[np.generic]] = {STAMP: np.array([frame.stamp_ns], dtype=np.int64)}
        for key, shape in self.spec.observations.items():
            if key not in frame.values:
                raise PolicyError(f"scripted_pick needs {key}, which the frame at {frame.stamp_ns} ns lacks")
            value = np.asarray(frame.values[key], dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise PolicyError(f"scripted_pick needs {key} with {shape[0]} finite numbers, got {value.tolist()}")
            tensors[key] = value
        return tensors

    @override
    def check(self, tensors: Tensors) -> None:
        for name, shape in {STAMP: (1,), **self.spec.observations}.items():
            array = tensors.get(name)
            if array is None or array.shape != shape or not np.isfinite(array).all():
                got = "nothing" if array is None else f"{array.dtype} {array.shape}"
                raise PolicyError(f"scripted_pick needs {name} with {shape[0]} finite numbers, got {got}")

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        if self._planner is None:
            raise PolicyError("scripted_pick is not loaded: call load() first")
        self.check(tensors)
        now_ns = int(tensors[STAMP][0])
        state, scene = tensors[STATE].astype(np.float64), Scene.parse(tensors[SCENE].astype(np.float64))
        if self._episode is None:
            home = np.clip(state, self._robot.lower, self._robot.upper)
            lead_in = rest("return", home, LEAD_IN_S)
            self._episode = _Episode(now_ns, home, *self._extended([lead_in], scene, home))
        episode = self._episode
        now_s = seconds(now_ns - episode.start_ns)
        if self._failed(episode, now_s, state, scene):
            kept = _kept(episode.trajectory, episode.issued_s)
            episode.trajectory, episode.first, episode.cube = self._extended(kept, scene, episode.home)
        # The time grid of actions begins with the episode, so that jitter of the observations' stamps does not shift
        # chunks relative to one another.
        tick = round(now_s * self._options.rate_hz)
        times_s = (tick + np.arange(self._options.chunk_size)) / self._options.rate_hz
        episode.issued_s = float(times_s[-1])
        return {ACTION: episode.trajectory.at(times_s)}

    @override
    def postprocess(self, tensors: Tensors) -> NDArray[np.float64]:
        return np.asarray(tensors[ACTION], dtype=np.float64)

    def _extended(self, kept: list[Segment], scene: Scene, home: Vector) -> tuple[Trajectory, int, Vector]:
        """The trajectory of `kept` followed by a new plan, the plan's first segment, and its cube position."""
        assert self._planner is not None
        try:
            plan = self._planner.plan(kept[-1].end, scene, home)
        except UnreachableError as error:
            where = ", ".join(f"{value:.3f}" for value in scene.cube)
            raise PolicyError(f"scripted_pick cannot pick the cube at ({where}) m: {error}") from error
        return Trajectory([*kept, *plan]), len(kept), scene.cube

    def _failed(self, episode: _Episode, now_s: float, state: Vector, scene: Scene) -> bool:
        """Whether the cube is not where the plan expects it at this time."""
        assert self._planner is not None
        index = int(episode.trajectory.index(np.array([now_s]))[0])
        name = episode.trajectory.segments[index].name
        if index < episode.first or name in {"hover", "descend"}:
            return bool(np.linalg.norm(scene.cube - episode.cube) > MOVED_M)
        if name == "carry":
            return bool(np.linalg.norm(scene.cube - self._planner.arm.forward(state).position) > LOST_M)
        return name == "return" and bool(np.hypot(*(scene.cube - scene.bin)[:2]) > DELIVERED_M)


def _kept(trajectory: Trajectory, issued_s: float) -> list[Segment]:
    """The segments up to the first clear waypoint at or after `issued_s` [s], or a pause if there is none."""
    for i, segment in enumerate(trajectory.segments):
        if segment.name in CLEAR and trajectory.ends_s[i] >= issued_s:
            return list(trajectory.segments[: i + 1])
    last = trajectory.segments[-1]
    return [*trajectory.segments, rest(last.name, last.end, issued_s - float(trajectory.ends_s[-1]))]
