"""The keys of a task file."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal, override

import attrs

from ibrobot_core.api import Robot, Vector, documented, option
from ibrobot_planning.goals.grammar import GoalOptions, Target, check_waypoints, exactly_one, line_goal, named_pose
from ibrobot_planning.planner import LEAST_SCALING, AnyGoal, Goal
from ibrobot_planning.world.objects import World

MOST_STEPS = 200


@documented
@attrs.frozen
class MoveStep(GoalOptions):
    """`move`: the arm moves to a goal."""

    any: tuple[GoalOptions, ...] = option((), help="alternatives: the first that can be reached")
    line: tuple[GoalOptions, ...] = option((), help="straight lines of the tool through these positions")
    least_fraction: float = option(1.0, gt=0, le=1, help="fraction of the straight lines that must be possible")
    speed: float = option(1.0, ge=LEAST_SCALING, le=1, help="fraction of the velocity limits")
    touch: tuple[str, ...] = option((), help="objects that the gripper, and what it carries, may touch on the way")

    def __attrs_post_init__(self) -> None:
        several = next((name for name, goals in (("any", self.any), ("line", self.line)) if goals), "")
        values = attrs.asdict(self, recurse=False)
        # Keys of a goal belong to the goals in `any` or `line`.
        for field in attrs.fields(GoalOptions) if several else ():
            of_line = self.line and field.name == "path_constraints"
            if values[field.name] not in (field.default, {}) and not self.kinds().get(field.name) and not of_line:
                raise ValueError(f"{field.name} belongs to the goals in {several}")
        super().__attrs_post_init__()
        if self.least_fraction != 1 and not self.line:
            raise ValueError("least_fraction belongs to line")
        check_waypoints("line", self.line)

    @override
    def kinds(self) -> dict[str, bool]:
        return {**super().kinds(), "any": bool(self.any), "line": bool(self.line)}

    def target(self, robot: Robot, arm: Collection[str], world: World, tool: Vector | None = None) -> Target:
        """The goal of the step.

        Args:
            robot: the robot.
            arm: the joints that a motion may move; a named pose applies to these only.
            world: the objects that goals refer to.
            tool: present position of the tool [m], shape (3,), for relative goals.

        Raises:
            PlanningError: for an unknown pose or object.
        """
        text, joints = self.text, dict(self.joints)
        goal: Goal | None = None
        if self.any:
            text = f"{self.any[0].text} or {len(self.any) - 1} others"
            goal = AnyGoal(tuple(each.goal(world, tool) for each in self.any))
        elif self.line:
            text = f"line to {self.line[-1].text}"
            goal = line_goal(self.line, self.least_fraction, self.path_constraints, world, tool)
        elif self.pose is not None:
            joints = {joint: value for joint, value in named_pose(robot, self.pose).items() if joint in arm}
        elif self.of_tool or self.joint_tolerance:
            goal, joints = self.goal(world, tool), {}
        return Target(text, goal, joints, self.speed, constraints=None if goal is not None else self.path_constraints)


@documented
@attrs.frozen
class GripperStep:
    """`gripper`: the gripper opens or closes."""

    position: float = option(unit="rad", help="position of its joint")
    executor: str | None = option(None, help="its executor, if the mode has several grippers")
    grasp: str | None = option(
        None, help="object that must stop the gripper; from then on it moves with the hand. Without one, the step fails"
    )
    release: str | None = option(None, help="object that no longer moves with the hand")

    def __attrs_post_init__(self) -> None:
        if self.grasp is not None and self.release is not None:
            raise ValueError("grasp and release exclude each other")


@documented
@attrs.frozen
class WaitStep:
    """`wait`: the robot holds."""

    seconds: float = option(unit="s", ge=0, le=86_400, help="how long")


@documented
@attrs.frozen
class PolicyStep:
    """`run_policy`: a policy moves the robot."""

    mode: str = option(help="a control mode with inference")
    seconds: float = option(unit="s", gt=0, le=86_400, help="how long at most")
    until: Literal["time", "success"] = option(
        "time", help="success: ends when the scene is solved, and fails if that takes longer than `seconds`"
    )
    prompt: str = option("", help="the policy's task, in place of that of the mode, if it takes one")


@documented
@attrs.frozen
class LookStep:
    """`look`: find an object, or wait for a new image of a camera."""

    object: str | None = option(None, help="object of the world; the result has its position")
    near: str | None = option(None, help="object from whose centre it must be no further than `within`")
    within: float | None = option(None, unit="m", gt=0, help="largest distance from `near`; beyond it the step fails")
    camera: str | None = option(None, help="camera among `peripherals`: waits for an image that begins after this step")
    timeout: float = option(5.0, unit="s", gt=0, le=600, help="longest wait for the image")

    def __attrs_post_init__(self) -> None:
        exactly_one("a look", {"object": self.object is not None, "camera": self.camera is not None})
        if (self.near is None) != (self.within is None):
            raise ValueError("near and within go together: the object, and the distance from it")
        if self.near is not None and self.object is None:
            raise ValueError("near needs an object")


@documented
@attrs.frozen
class RecordStep:
    """`record`: an episode of the section `recording`."""

    prompt: str | None = option(None, help="description of the episode; None repeats the last one")
    of: Literal["policy", "task"] = option(
        "policy", help="policy: the next run_policy; task: all steps from here on, motions and grasps included"
    )
    outcome: Literal["success", "failure", "unknown"] = option(
        "unknown", help="outcome of a policy's episode that ends with its time; `until: success` decides otherwise"
    )

    def __attrs_post_init__(self) -> None:
        if self.of == "task" and self.outcome != "unknown":
            raise ValueError("outcome belongs to the episode of a policy; that of a task is how the task ends")


type Alternatives = tuple[tuple[Step, ...], ...]
"""Lists of steps."""
type Action = MoveStep | GripperStep | WaitStep | PolicyStep | LookStep | RecordStep | Alternatives


@documented
@attrs.frozen
class Step:
    """One step: a name, and one of the kinds of steps."""

    name: str = option("", help="for feedback and results")
    move: MoveStep | None = option(None, help="the arm moves to a goal")
    gripper: GripperStep | None = option(None, help="the gripper opens or closes")
    wait: WaitStep | None = option(None, help="the robot holds")
    run_policy: PolicyStep | None = option(None, help="a policy moves the robot")
    look: LookStep | None = option(None, help="where an object is, or a new image of a camera")
    record: RecordStep | None = option(None, help="what follows is recorded as an episode")

    def __attrs_post_init__(self) -> None:
        exactly_one("a step", {kind: action is not None for kind, action in self._actions().items()})

    @property
    def kind(self) -> str:
        """Its kind, e.g. `move`."""
        return next(kind for kind, action in self._actions().items() if action is not None)

    @property
    def action(self) -> Action:
        """What it does."""
        return next(action for action in self._actions().values() if action is not None)

    def _actions(self) -> dict[str, Action | None]:
        return attrs.asdict(self, recurse=False, filter=lambda field, _: field.name != "name")


def _some(instance: object, attribute: attrs.Attribute[Any], value: Sequence[object]) -> None:
    if not 0 < len(value) <= MOST_STEPS:
        raise ValueError(f"a task has 1 to {MOST_STEPS} steps, got {len(value)}")


def _some_lists(instance: object, attribute: attrs.Attribute[Any], value: Sequence[Sequence[object]] | None) -> None:
    if value is not None and not (value and all(value)):
        raise ValueError("alternatives are lists of steps, each with at least one step")


@documented
@attrs.frozen
class TaskStep(Step):
    """A step of a task: one that alternatives may have, or alternatives."""

    alternatives: tuple[tuple[Step, ...], ...] | None = option(
        None, validator=_some_lists, help="lists of steps: the first one whose motions can be planned and that succeeds"
    )


@documented
@attrs.frozen
class Task:
    """A task: steps, one after another."""

    steps: tuple[TaskStep, ...] = option(validator=_some, help="the steps")
    name: str = option("", help="for feedback and results")
    mode: str | None = option(None, help="planning mode that moves the robot; None: the only one, or the first mode")
    parameters: Mapping[str, str | float | bool] = option(
        factory=dict, help="name -> value, which replaces $name in the steps"
    )
