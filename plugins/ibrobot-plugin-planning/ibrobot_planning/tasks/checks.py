"""Checks of a whole task before anything moves."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from ibrobot_core.api import IbrobotError, PlanningError, Vector
from ibrobot_core.app import ControlMode, RobotConfig, check_models, installed_plugins
from ibrobot_planning.execution.plans import tool_planners
from ibrobot_planning.goals.grammar import GoalOptions, named_pose, pose_names
from ibrobot_planning.planner import AnyGoal, ConstrainedGoal, Goal, LinearGoal, PoseGoal, PositionGoal
from ibrobot_planning.tasks.format import (
    Alternatives,
    GripperStep,
    LookStep,
    MoveStep,
    PolicyStep,
    RecordStep,
    Step,
)
from ibrobot_planning.tasks.reading import TaskFile
from ibrobot_planning.world.objects import FLOOR, World

if TYPE_CHECKING:
    from ibrobot_planning.goals.tool import Tool

type Key = tuple[str | int, ...]


@attrs.frozen(eq=False)
class Situation:
    """The robot and the situation for which a task is checked."""

    config: RobotConfig
    world: World | None
    """The objects; None for a robot without a section `world`."""
    movable: Collection[str] = ()
    """Objects that a policy may move."""
    start: Vector | None = None
    """All joints [rad], shape (J,); None if they are not known."""
    no_recording: str = ""
    """Why no episode can be recorded; empty if one can."""
    elsewhere: Collection[str] = ()
    """Objects whose poses are not known yet."""
    held: str | None = None
    """What the gripper holds at the beginning."""
    registry: Any = attrs.field(factory=installed_plugins, kw_only=True)
    """The plugins; by default, those that are installed."""


@attrs.frozen(eq=False)
class CheckedTask:
    """A task that is valid for a robot."""

    file: TaskFile
    mode: ControlMode
    """The planning mode."""
    arm: tuple[str, ...]
    """Joints of the mode's executors of trajectories."""
    grippers: tuple[str, ...]
    """The mode's executors of positions."""


def check_task(file: TaskFile, situation: Situation) -> CheckedTask:
    """Check a task for a robot: names, limits, order of the steps, models, and reach where positions are known.

    Raises:
        ConfigError: with all faults.
    """
    return _Checks(file, situation).run()


class _Checks:
    def __init__(self, file: TaskFile, situation: Situation) -> None:
        self._file, self._document, self._situation = file, file.document, situation
        self._tool_planners = tool_planners(situation.registry.of_kind("planner"))
        self._moved = set(situation.elsewhere)
        """Objects that have left the poses that the world has for them."""
        self._held = situation.held
        self._recording: Key | None = None
        """A step that records the next policy."""
        self._records_task = False
        self._out_of_reach: list[tuple[Key, str]] = []

    def run(self) -> CheckedTask:
        mode = self._mode()
        self._document.raise_problems()
        assert mode is not None
        executors = {name: self._situation.config.executors[name] for name in mode.executors}
        self._mode_name, self._planner = mode.name, mode.planner.type if mode.planner is not None else ""
        self._trajectories = [name for name, each in executors.items() if each.goals == "trajectory"]
        arm = tuple(joint for name in self._trajectories for joint in executors[name].joints)
        grippers = tuple(name for name, each in executors.items() if each.goals == "position")
        self._arm, self._grippers = arm, grippers
        for i, step in enumerate(self._file.task.steps):
            self._step(("steps", i), step)
            for key, message in self._out_of_reach:
                self._document.add(key, message)
            self._out_of_reach.clear()
        self._nothing_to_record()
        if self._file.task.steps[-1].record is not None and self._records_task:
            last = len(self._file.task.steps) - 1
            self._document.add(("steps", last, "record"), "no step after it is left to record")
        self._document.raise_problems()
        return CheckedTask(self._file, mode, arm, grippers)

    def _step(self, key: Key, step: Step) -> None:
        kinds: dict[str, Callable[[Key, Any], None]] = {
            "move": self._move,
            "gripper": self._gripper,
            "run_policy": self._policy,
            "look": self._look,
            "record": self._record,
            "alternatives": self._alternatives,
        }
        if step.kind in kinds:
            kinds[step.kind]((*key, step.kind), step.action)

    def _alternatives(self, key: Key, lists: Alternatives) -> None:
        """Check each list of steps from the same beginning; one of them must be within reach."""
        before, moved, held = self._moved, set(self._moved), self._held
        ends: set[str | None] = set()
        unreachable: list[list[tuple[Key, str]]] = []
        if self._recording is not None:
            self._document.add(self._recording, "the step after it must be a run_policy, or in the same list")
            self._recording = None
        for i, steps in enumerate(lists):
            self._moved, self._held = set(before), held
            for j, each in enumerate(steps):
                self._step((*key, i, j), each)
            self._nothing_to_record()
            moved |= self._moved
            ends.add(self._held)
            unreachable.append(self._out_of_reach)
            self._out_of_reach = []
        self._moved = moved
        if len(ends) > 1:
            held_objects = ", ".join(sorted("nothing" if each is None else repr(each) for each in ends))
            self._document.add(key, f"the alternatives end with different objects in the gripper: {held_objects}")
        if all(unreachable):
            self._out_of_reach = [each[0] for each in unreachable]

    def _nothing_to_record(self) -> None:
        if self._recording is not None:
            self._document.add(
                self._recording, "no step after it runs a policy, whose episode it would record; or set `of: task`"
            )
        self._recording = None

    def _mode(self) -> ControlMode | None:
        config, name = self._situation.config, self._file.task.mode
        planning = [each for each, mode in config.control_modes.items() if mode.planner is not None]
        if name is None:
            first = config.default_control_mode
            if first not in planning and len(planning) != 1:
                which = f"name one of {', '.join(planning)}" if planning else "and this robot has none"
                self._document.add(
                    (), f"a task needs a mode with a planner: {which}" + (", e.g. `mode: NAME`" if planning else "")
                )
                return None
            name = first if first in planning else planning[0]
        elif not self._document.refer(("mode",), name, list(config.control_modes), "mode"):
            return None
        elif name not in planning:
            self._document.add(
                ("mode",), f"mode {name!r} has no planner; modes with one: {', '.join(planning) or 'none'}"
            )
            return None
        self._available(("mode",), name)
        return config.control_modes[name]

    def _available(self, key: Key, mode: str) -> None:
        if (reason := self._situation.config.unavailable.get(mode)) is not None:
            self._document.add(key, f"mode {mode!r} is unavailable: {reason}")

    def _object(self, key: Key, name: str) -> bool:
        """Whether an object exists; adds a fault if not."""
        if self._situation.world is None:
            self._document.add(key, "objects need a section `world` in the robot YAML, e.g. `world: {scene: true}`")
            return False
        return self._document.refer(key, name, list(self._situation.world.objects), "object")

    def _move(self, key: Key, step: MoveStep) -> None:
        before = len(self._document.problems)
        known = True
        for at, goal in _goals(key, step):
            known &= self._goal(at, goal)
        for i, name in enumerate(step.touch):
            if name != FLOOR:
                self._object((*key, "touch", i), name)
        if known and len(self._document.problems) == before:
            self._reach(key, step)

    def _goal(self, key: Key, goal: GoalOptions) -> bool:
        """Check the names and limits of a goal; returns whether its position is known."""
        robot = self._situation.config.robot
        if goal.pose is not None:
            self._pose((*key, "pose"), goal.pose)
        for joint, value in goal.joints.items():
            at = (*key, "joints", joint)
            if not self._document.refer(at, joint, robot.joint_names, "joint"):
                continue
            limits = robot.joints[robot.joint_names.index(joint)]
            if joint not in self._arm:
                self._document.add(at, f"no executor of trajectories of mode {self._mode_name!r} has joint {joint!r}")
            # Written so that NaN fails it.
            elif not limits.lower <= value <= limits.upper:
                self._document.add(at, f"{value} rad is outside the limits {limits.lower} .. {limits.upper} rad")
        constrained = goal.path_constraints is not None
        if (goal.of_tool or constrained) and self._planner not in self._tool_planners:
            types = ", ".join(self._tool_planners) or "none is installed"
            self._document.add(
                key, f"planner type {self._planner!r} takes joint positions only; types that take others: {types}"
            )
        elif goal.of_tool and len(self._trajectories) != 1:
            number = len(self._trajectories)
            self._document.add(
                key, f"mode {self._mode_name!r} has {number} executors of trajectories; a position needs one"
            )
        if goal.object is None:
            return not goal.relative
        if self._held == goal.object:
            self._document.add(
                (*key, "object"), f"{goal.object!r} is in the gripper; goals cannot refer to it until its release"
            )
        return self._object((*key, "object"), goal.object) and goal.object not in self._moved

    def _pose(self, key: Key, name: str) -> None:
        robot = self._situation.config.robot
        try:
            if self._document.refer(key, name, pose_names(robot), "pose"):
                named_pose(robot, name)
        except PlanningError as error:
            self._document.add(key, str(error))

    def _reach(self, key: Key, step: MoveStep) -> None:
        """Check by inverse kinematics that the tool can reach the goal of a step."""
        try:
            world = self._situation.world or World()
            goal = step.target(self._situation.config.robot, self._arm, world).tool
            if goal is not None:
                self._within_reach(goal)
        except IbrobotError as error:
            code = f"{error.code.name}: " if isinstance(error, PlanningError) else ""
            self._out_of_reach.append((key, f"{code}{error}"))

    def _within_reach(self, goal: Goal) -> None:
        """Check that all waypoints of a goal, or one of its alternatives, can be reached.

        Raises:
            PlanningError: if not.
            KinematicsError: without a model of the robot.
        """
        if isinstance(goal, ConstrainedGoal):
            self._within_reach(goal.goal)
        elif isinstance(goal, LinearGoal):
            for waypoint in goal.waypoints:
                self._within_reach(waypoint)
        elif isinstance(goal, AnyGoal):
            errors = []
            for each in goal.goals:
                try:
                    self._within_reach(each)
                except PlanningError as error:
                    errors.append(error)
            if len(errors) == len(goal.goals):
                raise errors[0]
        elif isinstance(goal, PositionGoal | PoseGoal):
            model, start = self._tool.model, self._situation.start
            self._tool.candidates(goal, np.clip(0.0, model.lower, model.upper) if start is None else start)

    @cached_property
    def _tool(self) -> Tool:
        """Inverse kinematics, from the robot's model, which only goals of the tool need."""
        from ibrobot_kinematics import robot_model

        from ibrobot_planning.goals.tool import Tool

        return Tool(robot_model(self._situation.config.robot))

    def _gripper(self, key: Key, step: GripperStep) -> None:
        config = self._situation.config
        fits = len(self._grippers) == 1
        if step.executor is not None:
            fits = self._document.refer((*key, "executor"), step.executor, self._grippers, "gripper")
        elif not fits:
            which = f"name its executor: {', '.join(self._grippers)}" if self._grippers else "use another mode"
            self._document.add(key, f"mode {self._mode_name!r} has {len(self._grippers)} grippers; {which}")
        if fits:
            joint = config.robot.joint_names.index(config.executors[step.executor or self._grippers[0]].joints[0])
            limits = config.robot.joints[joint]
            if not limits.lower <= step.position <= limits.upper:
                self._document.add(
                    (*key, "position"),
                    f"{step.position} rad is outside the limits {limits.lower} .. {limits.upper} rad",
                )
        if step.grasp is not None and self._object((*key, "grasp"), step.grasp):
            if self._held is not None:
                self._document.add((*key, "grasp"), f"the gripper has {self._held!r} already")
            self._held = step.grasp
        if step.release is not None and self._object((*key, "release"), step.release):
            if self._held != step.release:
                self._document.add((*key, "release"), f"no step before grasps {step.release!r}")
            self._held = None
            self._moved.add(step.release)

    def _policy(self, key: Key, step: PolicyStep) -> None:
        config, key = self._situation.config, (*key, "mode")
        self._moved.update(self._situation.movable)
        self._recording = None
        if self._records_task:
            self._document.add(
                key, "a policy ends the episode that a step before it records of the task; record the policy instead"
            )
        if not self._document.refer(key, step.mode, list(config.control_modes), "mode"):
            return
        if config.control_modes[step.mode].inference is None:
            policies = [name for name, mode in config.control_modes.items() if mode.inference is not None]
            self._document.add(
                key, f"mode {step.mode!r} runs no policy; modes that do: {', '.join(policies) or 'none'}"
            )
        elif step.mode in config.unavailable:
            self._available(key, step.mode)
        else:
            try:
                check_models(config, self._situation.registry, [step.mode], step.prompt)
            except IbrobotError as error:
                self._document.add(key, str(error))

    def _look(self, key: Key, step: LookStep) -> None:
        for name, value in (("object", step.object), ("near", step.near)):
            if value is not None:
                self._object((*key, name), value)
        if step.camera is not None:
            cameras = [name for name, each in self._situation.config.peripherals.items() if each.kind == "camera"]
            self._document.refer((*key, "camera"), step.camera, cameras, "camera")

    def _record(self, key: Key, step: RecordStep) -> None:
        if self._situation.no_recording:
            self._document.add(key, self._situation.no_recording)
        elif self._records_task:
            self._document.add(key, "a step before it records the whole task already")
        elif self._recording is not None:
            self._document.add(key, "the step before it records the next policy already")
        elif step.of == "policy":
            self._recording = key
        elif len(key) > len(("steps", 0, "record")):
            self._document.add(key, "a task is recorded by a step of its own, not by one of an alternative")
        else:
            self._records_task = True


def _goals(key: Key, step: MoveStep) -> Iterator[tuple[Key, GoalOptions]]:
    """Each goal of a step, with its key."""
    for name, goals in (("any", step.any), ("line", step.line)):
        for i, goal in enumerate(goals):
            yield (*key, name, i), goal
    if not (step.any or step.line):
        yield key, step
