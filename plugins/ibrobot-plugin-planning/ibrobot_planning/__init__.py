"""The plugin's hooks: planners, their command source, executors, sections, commands."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import ExecutorDescriptor, Late, OptionFault, did_you_mean, hookimpl
from ibrobot_core.app import Command, Kind, SectionDescriptor, SourceDescriptor
from ibrobot_planning.executors.options import GripperOptions, TrajectoryOptions
from ibrobot_planning.guard.descriptor import GuardDescriptor
from ibrobot_planning.guard.options import ClearanceGuardOptions
from ibrobot_planning.planner import PlannerDescriptor
from ibrobot_planning.planners.options import GoalCheckOptions, JointPlannerOptions, RrtConnectOptions
from ibrobot_planning.world.engines import find_engines
from ibrobot_planning.world.options import WorldOptions

if TYPE_CHECKING:
    from ibrobot_core.api import Robot
    from ibrobot_core.app import Component, RobotConfig, RunView


@hookimpl
def ibrobot_kinds() -> Iterable[Kind]:
    """Planners and guards."""
    yield Kind("planner", "ibrobot_planners", PlannerDescriptor)
    yield Kind("guard", "ibrobot_guards", GuardDescriptor)


@hookimpl
def ibrobot_planners() -> Iterable[PlannerDescriptor]:
    """The planners `joint` and `rrt_connect`."""
    yield PlannerDescriptor(
        type="joint",
        options=JointPlannerOptions,
        make=Late("ibrobot_planning.planners.joint:JointPlanner"),
        tool_goals=False,
        summary="straight line in joint space, time-optimal within velocity, acceleration and jerk limits",
    )
    yield PlannerDescriptor(
        type="rrt_connect",
        options=RrtConnectOptions,
        make=Late("ibrobot_planning.planners.rrt:RrtConnectPlanner"),
        check=find_engines,
        check_options=_needs_model,
        summary="around obstacles, to joint positions or poses of the tool, checked against padding after timing",
    )


def _needs_model(options: RrtConnectOptions, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    if robot.description.mjcf is None:
        yield OptionFault((), "planning around obstacles needs robot.description.mjcf: set it", "mjcf")


@hookimpl
def ibrobot_guards() -> Iterable[GuardDescriptor]:
    """The guard `clearance`."""
    yield GuardDescriptor(
        type="clearance",
        options=ClearanceGuardOptions,
        make=Late("ibrobot_planning.guard.clearance_guard:ClearanceGuard"),
        check=find_engines,
        check_options=_check_guard,
        summary="keeps commands of every origin clear of the arm itself and of the world",
    )


def _feeds_guard(config: RobotConfig) -> bool:
    guard = config.control.guard
    return guard is not None and guard.type == "clearance" and "world" in config.plugin_sections


def _check_guard(options: ClearanceGuardOptions, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    if robot.description.mjcf is None:
        yield OptionFault((), "the guard needs robot.description.mjcf: set it, or leave control.guard out", "mjcf")


@hookimpl
def ibrobot_sources() -> Iterable[SourceDescriptor]:
    """The command source of modes with `planner:`."""
    yield SourceDescriptor(
        type="planner",
        make=Late("ibrobot_planning.execution.source:PlannerSource"),
        label="plan motions",
        summary="moves to goals that a planner of any plugin plans",
    )


@hookimpl
def ibrobot_executors() -> Iterable[ExecutorDescriptor]:
    """The executors `trajectory` and `gripper`."""
    yield ExecutorDescriptor(
        type="trajectory",
        options=TrajectoryOptions,
        make=Late("ibrobot_planning.executors.trajectory:TrajectoryExecutor"),
        summary="follows joint trajectories, with path and goal tolerances",
    )
    yield ExecutorDescriptor(
        type="gripper",
        options=GripperOptions,
        make=Late("ibrobot_planning.executors.gripper:GripperExecutor"),
        goals="position",
        summary="opens or closes a gripper; a stall counts as grasped",
    )


def _world(options: WorldOptions, session: RunView) -> Component:
    ages = [thing.max_age for thing in options.objects.values() if thing.max_age is not None]
    if options.clouds or options.scene or ages:
        from ibrobot_planning.world.clouds import SensedWorld

        return SensedWorld(options, session)
    from ibrobot_planning.world.section import WorldKeeper

    return WorldKeeper(options, session)


def _unknown_names(options: WorldOptions, robot: Robot) -> Iterable[OptionFault]:
    """Faults of names that are neither a link of the robot's model nor an object."""
    from ibrobot_kinematics.errors import KinematicsError
    from ibrobot_kinematics.mjcf_names import read_names

    from ibrobot_planning.world.objects import FLOOR

    mjcf = robot.description.mjcf
    if mjcf is None:
        return
    try:
        model = read_names(mjcf)
    except KinematicsError:
        return  # its own check reports it
    prefixes = tuple(robot.description.arms) or ("",)
    links = [prefix + name for prefix in prefixes for name in ("world", *model.bodies, *model.sites)]
    known = [*links, *options.objects, *options.clouds, FLOOR]
    for name, thing in options.objects.items():
        if name in links:
            yield OptionFault(("objects", name), f"a link of {mjcf.name} has this name already")
        if thing.link is not None and thing.link not in links:
            yield OptionFault(
                ("objects", name, "link"), f"unknown link {thing.link!r}{did_you_mean(thing.link, links, 'known')}"
            )
        for i, other in enumerate(thing.may_touch):
            if other not in known and not options.scene:  # objects of the scene are checked at the start
                message = f"unknown link or object {other!r}{did_you_mean(other, known, 'known')}"
                yield OptionFault(("objects", name, "may_touch", i), message)


def _check_world(options: WorldOptions, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    """Check that the objects have sensible sizes and that meshes can be read."""
    for name, thing in options.objects.items():
        try:
            thing.made()
        except ValueError as error:
            yield OptionFault(("objects", name), str(error))
    yield from _unknown_names(options, robot)
    for name, cloud in options.clouds.items():
        if name in options.objects:
            yield OptionFault(("clouds", name), f"there is an object {name!r} already; clouds need names of their own")
        if cloud.max_age <= 1 / cloud.rate:
            yield OptionFault(
                ("clouds", name, "max_age"),
                f"{cloud.max_age:g} s is too small for rate {cloud.rate:g} Hz: the cells would be too old before the"
                f" next update; set it above {1 / cloud.rate:g} s, or rate above {1 / cloud.max_age:g} Hz",
            )


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """The sections `world`, `goals` and `tasks`, and what tells the guard of the world."""
    yield SectionDescriptor(
        type="world",
        options=WorldOptions,
        make=_world,
        check=find_engines,
        check_options=_check_world,
        summary="what planners avoid: boxes, spheres, cylinders, meshes, planes, point clouds; services change it",
    )
    yield SectionDescriptor(
        type="goals",
        options=GoalCheckOptions,
        make=lambda options, session: Late("ibrobot_planning.execution.door:GoalDoor")(
            options or GoalCheckOptions(), session
        ),
        without_section=lambda config: any(each.goals == "trajectory" for each in config.executors.values()),
        summary="checks trajectories of all clients against limits, the arm and the world before control gets them",
    )
    yield SectionDescriptor(
        type="guard_feed",
        make=lambda options, session: Late("ibrobot_planning.guard.feed:GuardFeed")(session),
        without_section=_feeds_guard,
        summary="tells the guard of changes of the world; runs by itself with `control.guard` and `world`",
    )
    yield SectionDescriptor(
        type="tasks",
        make=lambda options, session: Late("ibrobot_planning.tasks.runner:TaskRunner")(session),
        summary="services of a run that perform tasks, with a mode with a planner",
    )


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot plan`, `ibrobot description …` and `ibrobot task …`."""
    yield Command(
        "plan", Late("ibrobot_planning.commands.plan:PlanMotion"), "Plan a motion without moving, and print or plot it."
    )
    yield Command("description", summary="Make files that describe a robot, e.g. an SRDF.")
    yield Command("description srdf", Late("ibrobot_planning.commands.description:Srdf"))
    yield Command("task", summary="Perform tasks: files of motions, grasps, policies and other steps.")
    yield Command("task check", Late("ibrobot_planning.tasks.command:CheckTask"))
    yield Command("task run", Late("ibrobot_planning.tasks.command:RunTask"))
