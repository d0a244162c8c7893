"""The keys of a task file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, override

import attrs

from ibrobot_core.api import OrientationPolicy, documented, option
from ibrobot_planning.goals.text import LEAST_SCALING

if TYPE_CHECKING:
    from collections.abc import Sequence

Vec3 = tuple[float, float, float]
MOST_STEPS = 200
_NEARLY_ONE = 1e-3
"""Allowed deviation of a quaternion's length from 1."""


def _exactly_one(what: str, names: Sequence[str], given: Sequence[str]) -> None:
    if len(given) != 1:
        found = f"{' and '.join(given)} exclude each other" if given else "there is none"
        raise ValueError(f"{what} has one of {', '.join(names)}; {found}")


@documented
@attrs.frozen
class GoalOptions:
    """A goal of the arm: a named pose, joints, or a position of the tool."""

    pose: str | None = option(None, help="a pose of `robot.description.poses`; joints outside the arm stay")
    joints: Mapping[str, float] = option(factory=dict, unit="rad", help="joint -> position; the others stay")
    xyz: Vec3 | None = option(None, unit="m", help="position of the tool, in the base frame or relative to `object`")
    object: str | None = option(
        None, help="object of the world: position, axis and orientation are relative to its centre and its turn about z"
    )
    relative: bool = option(False, help="whether `xyz` is added to the tool's present position, in the base frame")
    axis: Vec3 | Literal["down", "up"] | None = option(None, help="direction of the tool's z axis")
    rpy: Vec3 | None = option(None, unit="rad", help="orientation of the tool: roll, pitch, yaw")
    quat: tuple[float, float, float, float] | None = option(None, help="orientation of the tool: x, y, z, w")
    beyond_reach: OrientationPolicy = option("refuse", help="what to do about an orientation that the arm cannot take")
    position_tolerance: float = option(0.001, unit="m", gt=0, help="allowed distance from the position")
    angle_tolerance: float = option(0.01, unit="rad", gt=0, help="allowed angle from the axis or orientation")

    def __attrs_post_init__(self) -> None:
        self.check_kind(("pose", "joints", "xyz or object"), [])
        turned = [name for name, value in self._turns().items() if value is not None]
        if len(turned) > 1:
            raise ValueError(f"{' and '.join(turned)} exclude each other")
        if turned and not self.of_tool:
            raise ValueError(f"{turned[0]} needs a position: xyz or object")
        if self.relative and (self.xyz is None or self.object is not None):
            raise ValueError("relative needs xyz, and no object")
        if self.beyond_reach != "refuse" and (not turned or turned == ["axis"]):
            raise ValueError("beyond_reach needs an orientation: rpy or quat")
        if isinstance(self.axis, tuple) and not any(self.axis):
            raise ValueError("axis has no length; give a direction, e.g. [0, 0, -1], or down")
        if self.quat is not None and abs(math.hypot(*self.quat) - 1) > _NEARLY_ONE:
            raise ValueError(f"quat has length {math.hypot(*self.quat):.3g}, must be 1; the order is x, y, z, w")

    @property
    def of_tool(self) -> bool:
        """Whether it is a position of the tool."""
        return self.xyz is not None or self.object is not None

    def check_kind(self, names: Sequence[str], more: Sequence[str]) -> None:
        """Check that exactly one kind of goal is given; `more` has those of a subclass."""
        given = [*(["pose"] if self.pose is not None else []), *(["joints"] if self.joints else [])]
        given += [*(["xyz or object"] if self.of_tool else []), *more]
        _exactly_one("a goal", names, given)

    def given(self) -> Mapping[str, Any]:
        """Key -> value."""
        return attrs.asdict(self, recurse=False)

    def _turns(self) -> dict[str, Any]:
        return {"axis": self.axis, "rpy": self.rpy, "quat": self.quat}


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
        several = [name for name, goals in (("any", self.any), ("line", self.line)) if goals]
        self.check_kind(("pose", "joints", "xyz or object", "any", "line"), several)
        if not several:
            super().__attrs_post_init__()
        for field in attrs.fields(GoalOptions) if several else ():
            if field.name != "joints" and self.given()[field.name] != field.default:
                raise ValueError(f"{field.name} belongs to the goals in {several[0]}")
        if self.least_fraction != 1 and not self.line:
            raise ValueError("least_fraction belongs to line")
        for i, each in enumerate(self.line):
            if not each.of_tool:
                raise ValueError(f"line.{i}: a straight line goes to a position: xyz or object")


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


@documented
@attrs.frozen
class LookStep:
    """`look`: where an object is, or a new image of a camera."""

    object: str | None = option(None, help="object of the world; the result has its position")
    near: str | None = option(None, help="object from whose centre it must be no further than `within`")
    within: float | None = option(None, unit="m", gt=0, help="the largest distance from `near`, else the step fails")
    camera: str | None = option(None, help="camera among `peripherals`: waits for an image that begins after this step")
    timeout: float = option(5.0, unit="s", gt=0, le=600, help="longest wait for the image")

    def __attrs_post_init__(self) -> None:
        _exactly_one("a look", ("object", "camera"), [name for name in ("object", "camera") if self._has(name)])
        if (self.near is None) != (self.within is None):
            raise ValueError("near and within go together: the object, and the distance from it")
        if self.near is not None and self.object is None:
            raise ValueError("near needs an object")

    def _has(self, name: str) -> bool:
        return (self.object if name == "object" else self.camera) is not None


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


type Action = MoveStep | GripperStep | WaitStep | PolicyStep | LookStep | RecordStep | AlternativesStep


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
        actions = self._actions()
        _exactly_one("a step", list(actions), [kind for kind, action in actions.items() if action is not None])

    @property
    def kind(self) -> str:
        """Its kind, e.g. `move`."""
        return next(kind for kind, action in self._actions().items() if action is not None)

    @property
    def action(self) -> Action:
        """What it does."""
        return next(action for action in self._actions().values() if action is not None)

    def _actions(self) -> dict[str, Action | None]:
        return {
            "move": self.move, "gripper": self.gripper, "wait": self.wait, "run_policy": self.run_policy,
            "look": self.look, "record": self.record,
        }  # fmt: skip


def _some(instance: object, attribute: attrs.Attribute[Any], value: Sequence[object]) -> None:
    if not 0 < len(value) <= MOST_STEPS:
        raise ValueError(f"a task has 1 to {MOST_STEPS} steps, got {len(value)}")


def _some_lists(instance: object, attribute: attrs.Attribute[Any], value: Sequence[Sequence[object]] | None) -> None:
    if value is not None and not (value and all(value)):
        raise ValueError("alternatives are lists of steps, each with at least one step")


@attrs.frozen
class AlternativesStep:
    """`alternatives`: the first list of steps that succeeds."""

    lists: tuple[tuple[Step, ...], ...]


@documented
@attrs.frozen
class TaskStep(Step):
    """A step of a task: as within alternatives, or alternatives."""

    alternatives: tuple[tuple[Step, ...], ...] | None = option(
        None, validator=_some_lists, help="lists of steps: the first one whose motions can be planned and that succeeds"
    )

    @override
    def _actions(self) -> dict[str, Action | None]:
        lists = self.alternatives
        return {**super()._actions(), "alternatives": None if lists is None else AlternativesStep(lists)}


@documented
@attrs.frozen
class Task:
    """A task: steps, one after another."""

    steps: tuple[TaskStep, ...] = option(validator=_some, help="the steps")
    name: str = option("", help="for feedback and results")
    mode: str | None = option(None, help="planning mode that moves the robot; None: the only one, or the first mode")
    parameters: Mapping[str, str | float | bool] = option(
        factory=dict, help="name -> value, for which $name stands in the steps"
    )
