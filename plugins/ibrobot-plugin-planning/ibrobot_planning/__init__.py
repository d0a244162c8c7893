"""The plugin's hooks: planners, their command source, executors, sections, commands."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import Context, Descriptor, ExecutorDescriptor, Late, hookimpl
from ibrobot_core.app import Command, Kind, SectionDescriptor, SourceDescriptor
from ibrobot_planning.executors.options import GripperOptions, TrajectoryOptions
from ibrobot_planning.guard.descriptor import GuardDescriptor
from ibrobot_planning.guard.options import ClearanceGuardOptions
from ibrobot_planning.guard.unsaid import unsaid
from ibrobot_planning.planner import Planner, PlannerDescriptor
from ibrobot_planning.planners.options import GoalCheckOptions, JointPlannerOptions, RrtConnectOptions
from ibrobot_planning.world.engines import find_engines
from ibrobot_planning.world.options import WorldOptions

if TYPE_CHECKING:
    from ibrobot_core.app import Component, RobotConfig, RunView


@hookimpl
def ibrobot_kinds() -> Iterable[Kind]:
    """Planners and guards."""
    yield Kind("planner", "ibrobot_planners", PlannerDescriptor)
    yield Kind("guard", "ibrobot_guards", GuardDescriptor)


@hookimpl(optionalhook=True)
def ibrobot_samples() -> Iterable[Descriptor[Any]]:
    """What `ibrobot plugins new` begins with."""
    yield Descriptor("planner", Late("ibrobot_planning.suite:FakePlanner"), "a planner with joint goals")
    yield Descriptor("guard", Late("ibrobot_planning.suite:FakeGuard"), "a guard with one number for a world")


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
        make=_rrt_connect,
        check=find_engines,
        summary="around obstacles, to joint positions or poses of the tool, checked against padding after timing",
    )


def _rrt_connect(options: RrtConnectOptions, ctx: Context) -> Planner:
    find_engines()  # with the remedy, before they are imported
    planner: Planner = Late("ibrobot_planning.planners.rrt:RrtConnectPlanner")(options, ctx)
    return planner


@hookimpl
def ibrobot_guards() -> Iterable[GuardDescriptor]:
    """The guard `clearance`."""
    yield GuardDescriptor(
        type="clearance",
        options=ClearanceGuardOptions,
        make=Late("ibrobot_planning.guard.clearance_guard:ClearanceGuard"),
        check=find_engines,
        unsaid=unsaid,
        summary="keeps commands of every origin clear of the arm itself and of the world",
    )


def _feed(config: RobotConfig) -> str:
    guard = config.control.guard
    fed = guard is not None and guard.type == "clearance" and "world" in config.plugin_sections
    return "ibrobot_planning.guard.feed:GuardFeed" if fed else "ibrobot_planning.guard.notice:GuardNotice"


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
        find_engines()
        from ibrobot_planning.world.clouds import SensedWorld

        return SensedWorld(options, session)
    from ibrobot_planning.world.section import WorldKeeper

    return WorldKeeper(options, session)


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """The sections `world`, `goals` and `tasks`, and what tells the guard of the world."""
    yield SectionDescriptor(
        type="world",
        options=WorldOptions,
        make=_world,
        check=find_engines,
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
        make=lambda options, session: Late(_feed(session.config))(session),
        without_section=lambda config: config.robot.description.mjcf is not None or config.control.guard is not None,
        check=find_engines,
        check_config=Late("ibrobot_planning.guard.check:faults"),
        summary="says at the start what commands are guarded against, and tells the guard of changes of the world; runs"
        " by itself for robots with an MJCF or a guard",
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
