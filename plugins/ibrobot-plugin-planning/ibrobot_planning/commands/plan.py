"""`ibrobot plan`: plan a motion without a run, and print or plot it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from ibrobot_core.api import (
    FollowTrajectory,
    JointTrajectory,
    MissingDependency,
    NotSupported,
    PlanCode,
    PlanningError,
    Robot,
    Vector,
    how_to_install,
    option,
)
from ibrobot_core.app import (
    ConfigOptions,
    ControlMode,
    LaunchRequest,
    RobotConfig,
    Session,
    Unsuccessful,
    echo,
    installed_plugins,
    wrong_input,
)
from ibrobot_planning.execution.plans import GoalPlans, arm_joints
from ibrobot_planning.goals.grammar import Target, target
from ibrobot_planning.planner import ConstrainedGoal, PoseGoal, PositionGoal
from ibrobot_planning.planners.search import length
from ibrobot_planning.planners.timing import motion_of
from ibrobot_planning.world.objects import world_of
from ibrobot_planning.world.options import WorldOptions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STEP_S = 0.01
"""Time between the samples of a plan."""
_NO_PLAN = 3
"""Exit code if there is no plan."""


@attrs.frozen(eq=False)
class Plan:
    """A plan, sampled."""

    trajectory: JointTrajectory
    times: Vector
    """[s], shape (N,)."""
    positions: Vector
    """[rad], shape (N, J)."""
    velocities: Vector
    """[rad/s], shape (N, J)."""
    tool: Vector | None
    """Positions of the tool [m], shape (N, 3); None without a model of the arm."""


@attrs.frozen(kw_only=True)
class PlanMotion(ConfigOptions):
    """Plan a motion of the robot in CONFIG, without moving it.

    The planner and the world are those of the robot YAML. Prints the joints at the goal, path length,
    duration, clearance, and the peak velocity of each joint.

    Exits with 0 if there is a plan, 3 if there is none, 2 for a wrong command line, YAML or goal.
    """

    start: str = option(typed="--from START", help="a pose, or joint=rad,… (others at 0)")
    goal: str = option(typed="--goal GOAL", help="a pose, joint=rad,…, or xyz=X,Y,Z with axis, rpy or quaternion")
    speed: float = option(1.0, gt=0, le=1, help="fraction of the velocity limits")
    plot: Path | None = option(None, help="also draw the plan: .png, .svg or .pdf")
    seed: int = option(0, help="seed of the planner")
    mode: str | None = option(None, typed="--mode MODE", help="the mode whose planner plans")

    def __call__(self) -> dict[str, Any]:
        with wrong_input():
            if self.plot is not None:
                _check_plot(self.plot)
            loaded, mode = self._loaded()
            robot = loaded.robot
            joints = arm_joints(loaded, mode)
            from_ = _positions(self.start, robot)
            aim = target(self.goal, robot, self.speed)
        report: dict[str, Any] = {
            "robot": robot.name,
            "mode": mode.name,
            "planner": mode.planner.type if mode.planner else "",
            "from": self.start,
            "goal": self.goal,
            "kind": _kind(aim),
        }
        try:
            sampled = _planned(loaded, mode, self.seed, joints, from_, aim, report)
        except PlanningError as error:
            report |= {"success": False, "code": error.code.name, "message": str(error)}
            raise Unsuccessful(report, _NO_PLAN) from None
        if self.plot is not None:
            _figure(sampled, robot, self.goal).savefig(self.plot)
        return report

    def show(self, report: dict[str, Any]) -> None:
        """Print the figures of the plan, or why there is none."""
        if report["success"]:
            echo(_text(report))
        else:
            echo(f"error: no plan: {report['code']}: {report['message']}", err=True)

    def _loaded(self) -> tuple[RobotConfig, ControlMode]:
        """The robot, and its mode with a planner.

        Raises:
            NotSupported: if the mode has no planner, or several modes have one and none is named.
        """
        loaded = self.load(self.mode)
        planning = [name for name, mode in loaded.control_modes.items() if mode.planner is not None]
        name = loaded.default_control_mode
        if name not in planning:
            if self.mode is not None or not planning:
                there = f"--mode {' or --mode '.join(planning)}" if planning else "this robot has none"
                raise NotSupported(f"mode {name} has no planner: {there}")
            if len(planning) > 1:
                raise NotSupported(f"several modes have a planner: --mode {' or --mode '.join(planning)}")
            name = planning[0]
        return loaded, loaded.control_modes[name]


def _positions(text: str, robot: Robot) -> Vector:
    """Positions of all joints [rad], shape (J,)."""
    parsed = target(text, robot)
    if parsed.tool is not None:
        raise PlanningError(f"--from {text!r}: a start is a pose or joints, not a position of the tool")
    if parsed.constraints is not None:
        raise PlanningError(f"--from {text!r}: a start has no path constraints; --goal takes {parsed.constraints.text}")
    return np.array([parsed.joints.get(name, 0.0) for name in robot.joint_names])


def _kind(aim: Target) -> str:
    tool, constraints = aim.tool, aim.constraints
    if isinstance(tool, ConstrainedGoal):
        constraints = tool.constraints
        tool = tool.goal
    kept = "" if constraints is None else f", {constraints.text} on the whole way"
    if isinstance(tool, PositionGoal):
        return ("position" if tool.axis is None else "position with axis") + kept
    if isinstance(tool, PoseGoal):
        return f"pose{kept}"
    return ("joints" if "=" in aim.text.partition(" ")[0] else "named pose") + kept


def _planned(
    config: RobotConfig, mode: ControlMode, seed: int, joints: tuple[str, ...], start: Vector, aim: Target,
    report: dict[str, Any],
) -> Plan:  # fmt: skip
    """The plan; adds its figures to `report`.

    Raises:
        PlanningError: if there is none.
    """
    robot = config.robot
    with _session(config, seed) as session:
        plans = GoalPlans(session, mode)
        planner = plans.make()
        planner.load()
        begun = time.monotonic()
        plans.check(aim)
        goals, result = plans.plan(aim, start)
        elapsed_s = time.monotonic() - begun
        planner.close()
        if result is None:
            raise PlanningError(f"goal {aim.text!r} moves no joint of the arm: {', '.join(joints)}")
        trajectory = next(each.trajectory for each in goals.values() if isinstance(each, FollowTrajectory))
        sampled = _sampled(trajectory, robot, start)
        clearance = _clearance(session, joints, start, sampled)
    limits = robot.max_velocity[robot.indices(joints)]
    peaks = np.abs(sampled.velocities).max(axis=0)
    report |= {
        "success": True,
        "code": PlanCode.SUCCESS.name,
        "message": "",
        "goal_joints": dict(zip(joints, sampled.positions[-1].tolist(), strict=True)),
        "position_error_m": result.position_error,
        "orientation_error_rad": result.orientation_error,
        "length_rad": length(sampled.positions),
        "tool_path_m": None if sampled.tool is None else length(sampled.tool),
        "duration_s": float(sampled.times[-1]),
        "clearance": clearance,
        "peak_velocity": {
            name: {"rad_s": float(peak), "share_of_limit": float(peak / limit)}
            for name, peak, limit in zip(joints, peaks, limits, strict=True)
        },
        "planning_time_s": elapsed_s,
    }
    return sampled


@contextmanager
def _session(config: RobotConfig, seed: int) -> Iterator[Session]:
    """A run that is not started, except for its world."""
    session = Session(config, installed_plugins(), LaunchRequest(seed=seed))
    with ExitStack() as stack:
        for descriptor, options in session.registry.sections(config):
            if descriptor.type == "world":
                assert isinstance(options, WorldOptions)
                if options.clouds:
                    session.log.warning("planned without clouds, which only a run sees: %s", ", ".join(options.clouds))
                world = descriptor.make(options.without_ages(), session)
                stack.callback(world.stop)
                world.start()
        yield session


def _sampled(trajectory: JointTrajectory, robot: Robot, start: Vector) -> Plan:
    motion = motion_of(trajectory)
    assert motion is not None, "GoalPlans completes trajectories"
    times = np.append(np.arange(0.0, motion.duration, _STEP_S), motion.duration)
    positions, velocities, _ = motion.sampled(_STEP_S)
    tool = None
    if robot.description.mjcf is not None:
        from ibrobot_kinematics import robot_model

        whole = np.repeat(start[None], len(times), axis=0)
        whole[:, robot.indices(trajectory.joint_names)] = positions
        tool = robot_model(robot).forward(whole).position
    return Plan(trajectory, times, positions, velocities, tool)


def _clearance(session: Session, joints: tuple[str, ...], start: Vector, sampled: Plan) -> dict[str, Any] | None:
    """The least distance of the arm, and of what it carries, from objects; None without objects."""
    world, robot = world_of(session.bus), session.config.robot
    if all(thing.link is not None for thing in world.objects.values()):
        return None
    from ibrobot_planning.world.arm import robot_arm
    from ibrobot_planning.world.collision import Clearance

    clearance = Clearance(robot_arm(robot), world)
    whole = np.repeat(start[None], len(sampled.times), axis=0)
    whole[:, robot.indices(joints)] = sampled.positions
    (distance, between), moment = min(zip(map(clearance, whole), sampled.times.tolist(), strict=True))
    return {"distance_m": distance, "between": list(between), "at_s": moment}


def _text(report: dict[str, Any]) -> str:
    rows = [
        ("planner", f"{report['planner']}, mode {report['mode']}"),
        ("goal", f"{report['goal']} ({report['kind']})"),
        ("joints at the goal", ", ".join(f"{name} {value:.3f}" for name, value in report["goal_joints"].items())),
        ("off the goal", f"{1e3 * report['position_error_m']:.2f} mm, {report['orientation_error_rad']:.4f} rad"),
        ("path", f"{report['length_rad']:.3f} rad"),
        ("duration", f"{report['duration_s']:.3f} s"),
    ]
    if report["tool_path_m"] is not None:
        rows.append(("path of the tool", f"{report['tool_path_m']:.3f} m"))
    if (nearest := report["clearance"]) is not None:
        between = " and ".join(nearest["between"])
        rows.append(
            ("clearance", f"{1e3 * nearest['distance_m']:.1f} mm between {between}, at {nearest['at_s']:.2f} s")
        )
    peaks = (
        f"{name} {peak['rad_s']:.2f} rad/s ({100 * peak['share_of_limit']:.0f} %)"
        for name, peak in report["peak_velocity"].items()
    )
    rows += [("peak velocities", ", ".join(peaks)), ("planned in", f"{1e3 * report['planning_time_s']:.0f} ms")]
    return "\n".join(f"{name:18}  {value}" for name, value in rows)


def _check_plot(path: Path) -> None:
    """Check that a plot can be written.

    Raises:
        MissingDependency: without matplotlib.
        NotSupported: for an unknown format, or a folder that does not exist.
    """
    if find_spec("matplotlib") is None:
        raise MissingDependency("--plot needs matplotlib", remedy=how_to_install("ibrobot-plugin-planning[plot]"))
    if path.suffix not in (".png", ".svg", ".pdf"):
        raise NotSupported(f"--plot {path}: the format is .png, .svg or .pdf, got {path.suffix or 'no suffix'}")
    if not path.absolute().parent.is_dir():
        raise NotSupported(f"--plot {path}: no folder {path.parent}")


def _figure(sampled: Plan, robot: Robot, title: str) -> Figure:
    """Positions and velocities over time, and the path of the tool from above and from the side."""
    from matplotlib.figure import Figure

    columns = 1 if sampled.tool is None else 2
    figure = Figure(figsize=(5.5 * columns, 6), layout="constrained")
    axes = figure.subplots(2, columns, squeeze=False)
    limits = robot.max_velocity[robot.indices(sampled.trajectory.joint_names)]
    for number, name in enumerate(sampled.trajectory.joint_names):
        axes[0][0].plot(sampled.times, sampled.positions[:, number], label=name)
        axes[1][0].plot(sampled.times, 100 * sampled.velocities[:, number] / limits[number], label=name)
    axes[0][0].set(title=title, ylabel="position [rad]")
    axes[0][0].legend(fontsize="small")
    axes[1][0].set(xlabel="time [s]", ylabel="velocity [% of the limit]")
    if sampled.tool is not None:
        for row, (across, up, view) in enumerate(((0, 1, "from above"), (0, 2, "from the side"))):
            path = axes[row][1]
            path.plot(sampled.tool[:, across], sampled.tool[:, up])
            path.plot(*sampled.tool[0, [across, up]], "o", label="start")
            path.plot(*sampled.tool[-1, [across, up]], "s", label="goal")
            path.set(
                title=f"tool, {view}", xlabel="x [m]", ylabel=f"{'xyz'[up]} [m]", aspect="equal", adjustable="datalim"
            )
            path.legend(fontsize="small")
    return figure
