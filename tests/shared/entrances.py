# mypy: disable-error-code="func-returns-value,arg-type,assignment,attr-defined,unused-ignore"
"""The entrances to motion, used as programs, operators and pages use them, each in a run of the simulated arm.

`tests/integration/test_entrances.py` walks the table of `docs/explanation/safety.md` with them. All runs are in
lockstep, so that times are those of ticks.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import socket
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, override

import attrs
import deadman_table
import numpy as np
import pytest
import yaml
from ibrobot_data.playback import Playback, Track
from ibrobot_data.replay_source import ReplaySource
from ibrobot_gym.environment import RobotEnv
from ibrobot_lerobot_devices import teleop as lerobot_teleop
from ibrobot_lerobot_program.features import RobotFeatures
from ibrobot_lerobot_program.run import ProgramSource
from ibrobot_ros2.calls import GoalRequest
from ibrobot_ros2.goals import Actions
from ibrobot_terminal.authority import Grant, authority_of
from ibrobot_web import commands as page_commands
from ibrobot_web.messages import Sent, from_page, from_server, to_run
from ibrobot_webxr.messages import Hands, decode
from plugin_tests import of_tests

from ibrobot_core.api import Header, Pose, PoseStamped, String, Twist, TwistStamped, Vector3, ns
from ibrobot_core.channel import Channel
from ibrobot_core.config import RobotConfig, from_document, load_config
from ibrobot_core.errors import IbrobotError
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.plugins import installed_plugins

CONFIG = Path(__file__).parents[2] / "configs" / "so101_blind.yaml"
PLUGINS = Path(__file__).parent / "plugins"
"""Made-up plugins, each a module."""
WALL = "world.objects={wall: {shape: box, size: [0.06, 0.06, 0.08], position: [0.1, -0.16, 0.06]}}"
"""Where the tool is once `shoulder_pan` is at `FAR` and the other joints are where a run begins."""
CAGE = (
    "world.objects={"
    "front: {shape: box, size: [0.02, 0.3, 0.2], position: [0.29, 0.0, 0.1]}, "
    "left: {shape: box, size: [0.2, 0.02, 0.2], position: [0.25, 0.12, 0.1]}, "
    "right: {shape: box, size: [0.2, 0.02, 0.2], position: [0.25, -0.08, 0.1]}, "
    "top: {shape: box, size: [0.1, 0.1, 0.02], position: [0.26, 0.0, 0.16]}}"
)
"""Walls a few centimetres from the tool, where a run begins."""
FAR, FARTHEST = 1.2, 1.9
"""Where entrances ask for, from 0 [rad]: near enough for a second, and too far for one."""
EMPTY = "simulation.scene={type: empty}"
UNGUARDED = "control.guard=null"
_PATIENCE_S = 10.0


class Run:
    """A run in lockstep, with the commands at each tick.

    Attributes:
        commands: those so far [rad], each shape (J,).
    """

    def __init__(self, runtime: Runtime) -> None:
        self.runtime, self.session = runtime, runtime.session
        self.commands: list[np.ndarray] = []
        self.session.on_state.append(lambda state: self.commands.append(state.command.copy()))

    @property
    def period_s(self) -> float:
        """[s]."""
        return 1.0 / self.session.config.control.rate_hz

    def ticks(self, count: int, act: Callable[[], object] = lambda: None) -> None:
        """Let time pass, with an act before each tick; acts that are refused are those of a clumsy program."""
        for _ in range(count):
            if self.session.finished.is_set():
                return
            with suppress(IbrobotError, ValueError):
                act()
            self.runtime.step()

    def stop(self) -> None:
        """Press the emergency stop."""
        self.session.emergency_stop()

    def reset(self) -> None:
        """Reset, as soon as that is possible."""
        for _ in range(50):
            try:
                self.runtime.reset()
            except IbrobotError:
                self.ticks(5)
            else:
                return
        pytest.fail("the reset is refused")

    def moved(self, since: int) -> float:
        """How far the commands have moved since a number of ticks, of the joint that moved most [rad]."""
        return float(np.ptp(self.commands[max(0, since - 1) :], axis=0).max())

    def rest_s(self, since: int) -> float:
        """Time from a number of ticks until the commands rest for good [s]."""
        steps = np.abs(np.diff(self.commands[max(0, since - 1) :], axis=0)).max(axis=1)
        moving = np.flatnonzero(steps > 2e-5)
        return 0.0 if not moving.size else float(moving[-1] + 1) * self.period_s

    def check_limits(self) -> None:
        """Check that all commands are finite, and within the limits of positions and velocities."""
        robot, commands = self.session.config.robot, np.array(self.commands)
        assert np.isfinite(commands).all()
        assert (commands >= robot.lower - 1e-9).all()
        assert (commands <= robot.upper + 1e-9).all()
        speeds = np.abs(np.diff(commands, axis=0)) / self.period_s
        assert (speeds <= robot.max_velocity * 1.001).all()


class Entrance(ABC):
    """A program, a person or a page that has the robot move; `ask` once a tick, or once, if it does not stream."""

    mode: ClassVar[str] = "moveit_planning"
    overrides: ClassVar[tuple[str, ...]] = (EMPTY,)
    streams: ClassVar[bool] = False
    """Whether it asks once a tick."""
    joint: ClassVar[str] = "shoulder_pan"
    far: ClassVar[float] = FAR
    """Where it asks for [rad]."""
    ahead_s: ClassVar[float] = 0.0
    """How far ahead it commands: the time from its last message to its last command [s]."""

    run: Run

    def launch(self, *overrides: str) -> Run:
        """Start a run that has this entrance."""
        config = self.config((*self.overrides, *overrides))
        runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(lockstep=True, **self.request())))
        self.run = Run(runtime)
        runtime.start()
        self.meet()
        self.run.ticks(5)
        return self.run

    def config(self, changes: tuple[str, ...]) -> RobotConfig:
        """The robot, with changes."""
        return load_config(CONFIG, sim=True, mode=self.mode, overrides=changes, registry=installed_plugins())

    def request(self) -> dict[str, Any]:
        """More of what the run is asked for."""
        return {}

    def meet(self) -> None:
        """Find the entrance of the run."""

    def prepare(self) -> None:
        """Do what is needed before each motion, e.g. press a deadman."""

    @abstractmethod
    def ask(self) -> object:
        """Ask for the far place."""

    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        """Requests to go to the far place in which each number in turn is this one."""
        raise NotImplementedError

    def with_time(self, off_s: float) -> object:
        """Ask for the far place, by a message of which the header has the present time plus this [s]."""
        raise NotImplementedError

    def keep(self) -> Callable[[], object]:
        """A command that is made now; it arrives when it is called."""
        raise NotImplementedError

    def ask_tool(self) -> object:
        """Ask for a motion of the tool; by default as `ask`."""
        return self.ask()

    def silence(self) -> None:
        """Say nothing more from now on; by default that takes nothing."""

    def die(self) -> None:
        """Whoever asks is killed; by default the robot hears nothing more of it."""

    def again(self) -> None:
        """Do what it takes to go on after a stop and a reset; by default nothing but to ask."""

    def close(self) -> None:
        """End the run."""
        if hasattr(self, "run"):
            self.run.runtime.stop()

    def call(self, service: str, request: Any = None) -> Any:
        """Call a service of the run."""
        return self.run.session.bus.call(service, request)

    @property
    def column(self) -> int:
        """Of the joint."""
        return self.run.session.config.robot.joint_names.index(self.joint)


class GoTo(Entrance):
    """`/planning/go_to`."""

    @override
    def ask(self) -> object:
        return self.call("/planning/go_to", f"shoulder_pan={FAR}")

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self.call("/planning/go_to", f"shoulder_pan={value}")
        yield lambda: self.call("/planning/go_to", f"xyz={value},0.1,0.1")


class MoveAction(Entrance):
    """`/move_action`."""

    @override
    def ask(self) -> object:
        return self.call("/move_action", {"goals": [{"joints": {"shoulder_pan": FAR}}]})

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self.call("/move_action", {"goals": [{"joints": {"shoulder_pan": value}}]})
        yield lambda: self.call("/move_action", {"goals": [{"xyz": [0.2, value, 0.1]}]})
        goals = [{"joints": {"shoulder_pan": FAR}}]
        yield lambda: self.call("/move_action", {"goals": goals, "velocity_scaling": value})
        yield lambda: self.call("/move_action", {"goals": goals, "acceleration_scaling": value})


class _Waiting(Entrance):
    """A service that answers when the motion has ended, called in another thread."""

    def __init__(self) -> None:
        self._threads: list[threading.Thread] = []

    def aside(self, service: str, request: Any) -> None:
        """Call a service in another thread."""

        def call() -> None:
            with suppress(IbrobotError):
                self.call(service, request)

        self._threads.append(threading.Thread(target=call, daemon=True))
        self._threads[-1].start()
        self._threads[-1].join(0.05)  # it has been taken, or it waits

    @override
    def close(self) -> None:
        super().close()
        for thread in self._threads:
            thread.join(_PATIENCE_S)


def _pose(answer: Any) -> Pose:
    """The pose in an answer of `/compute_fk`."""
    pose = answer.poses[0].pose
    assert isinstance(pose, Pose)
    return pose


class MoveToPose(_Waiting):
    """`/moveit_gateway/move_to_pose`."""

    @override
    def meet(self) -> None:
        self.run.ticks(2)
        self.pose = _pose(self.call("/compute_fk", {"joints": {"shoulder_pan": FAR}}))

    def plain(self) -> dict[str, Any]:
        """The request."""
        return {"target_pose": attrs.asdict(self.pose)}

    @override
    def ask(self) -> object:
        return self.aside("/moveit_gateway/move_to_pose", self.plain())

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        for part, axis in (("position", "x"), ("position", "z"), ("orientation", "w")):
            request = self.plain()
            request["target_pose"][part][axis] = value
            yield lambda request=request: self.aside("/moveit_gateway/move_to_pose", request)  # type: ignore[misc]
        yield lambda: self.aside("/moveit_gateway/move_to_pose", {**self.plain(), "velocity_scaling": value})


class MoveToConfiguration(_Waiting):
    """`/moveit_gateway/move_to_configuration`."""

    @override
    def ask(self) -> object:
        return self._move(FAR)

    def _move(self, position: float, scaling: float = 1.0) -> object:
        state = {"name": ["shoulder_pan"], "position": [position]}
        request = {"target_joint_state": state, "velocity_scaling": scaling}
        return self.aside("/moveit_gateway/move_to_configuration", request)

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self._move(value)
        yield lambda: self._move(FAR, value)


ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")


class Execute(Entrance):
    """`/execute_trajectory`."""

    def points(self, far: float = FAR) -> list[dict[str, Any]]:
        """Two points, the second one at the far place."""
        begin = self.run.commands[-1][: len(ARM)].tolist()
        end = [far, *begin[1:]]
        zeros = [0.0] * len(ARM)
        return [
            {"time_from_start_ns": time_ns, "positions": at, "velocities": zeros.copy(), "accelerations": zeros.copy()}
            for time_ns, at in ((0, begin), (ns(2.0), end))
        ]

    def send(self, points: list[dict[str, Any]]) -> object:
        """Ask for a trajectory."""
        return self.call("/execute_trajectory", {"joint_names": list(ARM), "points": points})

    @override
    def ask(self) -> object:
        return self.send(self.points())

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        for field in ("positions", "velocities", "accelerations"):
            for point in (0, 1):
                points = self.points()
                points[point][field][0] = value
                yield lambda points=points: self.send(points)  # type: ignore[misc]


class CmdPose(MoveToPose):
    """`/cmd_pose`."""

    def publish(self, pose: Pose, stamp_ns: int = 0) -> None:
        """Publish a pose."""
        self.run.session.bus.publish("/cmd_pose", PoseStamped(Header(stamp_ns, "base_link"), pose))

    @override
    def ask(self) -> object:
        return self.publish(self.pose)

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        position, orientation = self.pose.position, self.pose.orientation
        yield lambda: self.publish(attrs.evolve(self.pose, position=attrs.evolve(position, x=value)))
        yield lambda: self.publish(attrs.evolve(self.pose, orientation=attrs.evolve(orientation, w=value)))

    @override
    def with_time(self, off_s: float) -> object:
        return self.publish(self.pose, self.run.session.clock.now_ns() + ns(off_s))


class CmdGoal(Entrance):
    """`/cmd_goal`."""

    def publish(self, value: float) -> None:
        """Publish a goal in words."""
        self.run.session.bus.publish("/cmd_goal", String(f"shoulder_pan={value}"))

    @override
    def ask(self) -> object:
        return self.publish(FAR)

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self.publish(value)


class Task(Entrance):
    """`/task/run`."""

    overrides = (EMPTY, "tasks={}")

    def _task(self, steps: str) -> object:
        return self.call("/task/run", f"name: far\nmode: moveit_planning\nsteps:\n{steps}")

    @override
    def ask(self) -> object:
        return self._task(f"  - move: {{joints: {{shoulder_pan: {FAR}}}}}\n  - move: {{pose: home}}\n")

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        text = repr(value).replace("nan", ".nan").replace("inf", ".inf")
        yield lambda: self._task(f"  - move: {{joints: {{shoulder_pan: {text}}}}}\n")
        yield lambda: self._task(f"  - move: {{xyz: [0.2, {text}, 0.1]}}\n")
        yield lambda: self._task(f"  - move: {{joints: {{shoulder_pan: {FAR}}}, speed: {text}}}\n")
        yield lambda: self._task(f"  - gripper: {{position: {text}}}\n")


class TaskStep(Entrance):
    """`/task/step`."""

    overrides = (EMPTY, "tasks={}")

    @override
    def ask(self) -> object:
        return self.call("/task/step", {"move": {"joints": {"shoulder_pan": FAR}}})

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self.call("/task/step", {"move": {"joints": {"shoulder_pan": value}}})
        yield lambda: self.call("/task/step", {"move": {"line": [{"xyz": [value, 0, 0], "relative": True}]}})
        yield lambda: self.call("/task/step", {"move": {"joints": {"shoulder_pan": FAR}, "speed": value}})
        yield lambda: self.call("/task/step", {"gripper": {"position": value}})


class Agent(GoTo):
    """An agent to which a person has granted everything that it asks for."""

    overrides = (EMPTY, "mcp={http: false}")

    @override
    def meet(self) -> None:
        self.agent = authority_of(self.run.session).join("agent")
        self.again()

    @override
    def again(self) -> None:
        self.run.session.bus.call("/agent/arm", Grant(3600.0, ("/planning/go_to",), speed=1.0, lease=120.0))

    @override
    def call(self, service: str, request: Any = None) -> Any:
        return authority_of(self.run.session).call(self.agent, service, request)

    @override
    def die(self) -> None:
        authority_of(self.run.session).leave(self.agent)


class _Wire:
    """Clients of ROS that listen to nothing."""

    def offer(self, name: str, type_name: str, *, executor: str = "", service: str = "") -> None: ...

    def feed(self, goal: int, values: Mapping[str, Any]) -> None: ...

    def end(self, goal: int, state: str, values: Mapping[str, Any]) -> None: ...


def _ros_time(time_s: float) -> dict[str, int]:
    return {"sec": math.floor(time_s), "nanosec": round((time_s % 1.0) * 1e9)}


class FollowJointTrajectory(Execute):
    """control_msgs/action/FollowJointTrajectory, as its goals come from the node of rclpy's or over Zenoh."""

    executor: ClassVar[str] = "arm_trajectory"
    gripper_action: ClassVar[str] = "GripperCommand"

    @override
    def meet(self) -> None:
        session = self.run.session
        names = (self.executor,)
        self.actions = Actions(session, names, lambda name: False, lambda name: name, "ros", self.gripper_action)
        self.wire, self._numbers = _Wire(), iter(range(1, 10_000))
        self.actions.open()
        self.actions.declare(self.wire)

    @override
    def close(self) -> None:
        super().close()
        if hasattr(self, "actions"):
            self.actions.close()

    def give(self, fields: dict[str, Any], stops: int | None = None) -> bool:
        """Send a goal, received after `stops` emergency stops; by default now."""
        stops = self.run.session.stops if stops is None else stops
        request = GoalRequest(next(self._numbers), fields, self.executor)
        return self.actions.take_goal(self.wire, request, stops)

    def fields(self, points: list[dict[str, Any]], stamp_s: float = 0.0, **tolerances: Any) -> dict[str, Any]:
        """The fields of a goal."""
        sent = [
            {
                **{key: point[key] for key in ("positions", "velocities", "accelerations")},
                "effort": [],
                "time_from_start": _ros_time(point["time_from_start_ns"] * 1e-9),
            }
            for point in points
        ]
        header = {"stamp": _ros_time(stamp_s), "frame_id": ""}
        return {
            "trajectory": {"header": header, "joint_names": list(ARM), "points": sent},
            "multi_dof_trajectory": {"header": header, "joint_names": [], "points": []},
            "path_tolerance": [],
            "goal_tolerance": [],
            "goal_time_tolerance": _ros_time(0.0),
            "component_path_tolerance": [],
            "component_goal_tolerance": [],
            **tolerances,
        }

    @override
    def send(self, points: list[dict[str, Any]]) -> object:
        return self.give(self.fields(points))

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield from super().with_number(value)
        for key in ("path_tolerance", "goal_tolerance"):
            given = {key: [{"name": "shoulder_pan", "position": value, "velocity": 0.0, "acceleration": 0.0}]}
            if value > 0 or not np.isfinite(value):  # one below 0 stands for none
                yield lambda given=given: self.give(self.fields(self.points(), **given))  # type: ignore[misc]

    @override
    def with_time(self, off_s: float) -> object:
        return self.give(self.fields(self.points(), self.run.session.clock.now_ns() * 1e-9 + off_s))

    @override
    def keep(self) -> Callable[[], object]:
        fields, stops = self.fields(self.points()), self.run.session.stops
        return lambda: self.give(fields, stops)

    @override
    def die(self) -> None:
        self.actions.abandon("the node is gone")


class GripperCommand(FollowJointTrajectory):
    """control_msgs/action/GripperCommand."""

    executor = "gripper_action"
    joint, far = "gripper", 1.5

    def command(self, position: float, effort: float = 0.0) -> dict[str, Any]:
        """The fields of a goal."""
        return {"command": {"position": position, "max_effort": effort}}

    @override
    def ask(self) -> object:
        return self.give(self.command(self.far))

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self.give(self.command(value))
        if not np.isfinite(value):
            yield lambda: self.give(self.command(self.far, value))

    @override
    def keep(self) -> Callable[[], object]:
        stops = self.run.session.stops
        return lambda: self.give(self.command(self.far), stops)


class ParallelGripperCommand(GripperCommand):
    """control_msgs/action/ParallelGripperCommand."""

    gripper_action = "ParallelGripperCommand"

    @override
    def command(self, position: float, effort: float = 0.0) -> dict[str, Any]:
        return {"command": {"name": ["gripper"], "position": [position], "velocity": [], "effort": [effort]}}


class _Stream(Entrance):
    """An entrance that sends setpoints, with the executors of the contract's actions."""

    streams = True
    far = FARTHEST


class Program(_Stream):
    """A program of LeRobot's, at the other end of its channel."""

    mode = "lerobot"
    overrides = (EMPTY, "control_modes.lerobot={executors: [arm_position, gripper_position]}")

    def __init__(self) -> None:
        ends = socket.socketpair()
        self._channel, self._program = Channel(ends[0]), Channel(ends[1])

    @override
    def request(self) -> dict[str, Any]:
        def source(session: Any, mode: Any) -> ProgramSource:
            self._features = RobotFeatures.of_config(session.config, use_degrees=True)
            return ProgramSource(session, mode, self._channel, self._features)

        return {"source": source}

    def act(self, degrees: float) -> None:
        """Send an action, in LeRobot's units."""
        action = {**self._features.values(self.run.commands[-1]), "shoulder_pan.pos": degrees}
        self._program.send({"do": "act", "action": action})

    @override
    def ask(self) -> object:
        return self.act(math.degrees(self.far))

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self.act(value)

    @override
    def die(self) -> None:
        self._program.close()

    @override
    def again(self) -> None:
        self.run.runtime.switch_mode(self.run.session.mode)

    @override
    def close(self) -> None:
        super().close()
        for channel in (self._channel, self._program):
            channel.close()


class Gym(_Stream):
    """A program that steps an environment."""

    @override
    def launch(self, *overrides: str) -> Run:
        self._environment = RobotEnv(str(CONFIG), scene="empty", overrides=overrides)
        self._environment.reset(seed=1)
        self.run = Run(self._environment._runtime)
        self._still = self._environment._session.state.command.copy()  # type: ignore[union-attr]
        return self.run

    def step(self, value: float) -> None:
        """Take a step with an action."""
        action = self._still.copy()
        action[0] = value
        if not self.run.session.stopped_by:  # the loop of a program ends with the episode
            self._environment.step(action)

    @override
    def ask(self) -> object:
        return self.step(self.far)

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self.step(value)

    @override
    def again(self) -> None:
        self._environment.reset(seed=2)
        self.run.commands.clear()  # the arm of another episode begins elsewhere

    @override
    def close(self) -> None:
        self._environment.close()


class Policy(_Stream):
    """A policy in the process of the run, which answers one chunk to each request."""

    mode = "model_inference"
    overrides = (EMPTY, "models.far={type: far}", "control_modes.model_inference.inference={model: far}")
    ahead_s = 0.1

    @override
    def meet(self) -> None:
        self.answers: list[np.ndarray] = sys.modules["far_policy"].answers
        self.answers.clear()

    def answer(self, value: float) -> None:
        """Answer the next request by a chunk of three actions, of which the first one is for the present."""
        chunk = np.tile(self.run.commands[-1], (3, 1))
        chunk[:, 0] = value
        self.answers[:] = [chunk]

    @override
    def ask(self) -> object:
        return self.answer(self.far)

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self.answer(value)

    @override
    def again(self) -> None:
        self.run.runtime.switch_mode(self.run.session.mode)


class PolicyInProcess(Policy):
    """A policy in a process of its own, whose last answer may be under way when it dies."""

    ahead_s = Policy.ahead_s + 1 / 30
    overrides = (*Policy.overrides, "control_modes.model_inference.inference.execution_mode=process")

    @override
    def launch(self, *overrides: str) -> Run:
        before = _children()
        run = super().launch(*overrides)
        self._model = _children() - before
        return run

    @override
    def die(self) -> None:
        assert self._model, "the model has no process"
        for pid in self._model:
            os.kill(pid, signal.SIGKILL)


def _children() -> set[int]:
    """The processes that this one has started."""
    return {int(pid) for path in Path("/proc/self/task").glob("*/children") for pid in path.read_text().split()}


class Replay(_Stream):
    """`ibrobot replay`, of an episode that jumps to and fro."""

    mode = "replay"
    ahead_s = 1.0
    overrides = (EMPTY, "control_modes.replay={executors: [arm_position, gripper_position]}")

    @override
    def request(self) -> dict[str, Any]:
        rows = np.zeros((2000, 6))
        rows[:, 1:4] = [-1.57, 1.57, 0.79]
        rows[:, 0] = np.where(np.arange(2000) // 150 % 2, self.far, 0.0)

        def source(session: Any, mode: Any) -> ReplaySource:
            joints = session.config.robot.joint_names
            playback = Playback(joints, Track(np.arange(2000) * 0.01, rows), None, "unknown", None)
            return ReplaySource(session, mode, "far", playback, 1.0)

        return {"source": source}

    @override
    def prepare(self) -> None:
        for _ in range(400):
            self.run.ticks(1)
            if len(self.run.commands) > 10 and self.run.moved(len(self.run.commands) - 5) > 0.1:
                return

    @override
    def ask(self) -> object:
        return None

    @override
    def silence(self) -> None:
        """Have the thread hang that sends the commands."""
        source = self.run.session.command_source
        source.work = lambda timeout_s: None  # type: ignore[attr-defined]


class Operated(_Stream):
    """A teleoperation device, and the person who uses it; see `deadman_table`."""

    mode = "teleop"

    def __init__(self, person: deadman_table.Person) -> None:
        self.person = person

    @override
    def request(self) -> dict[str, Any]:
        return {"keys": self.person.subscribe}

    @override
    def launch(self, *overrides: str) -> Run:
        device = (f"teleoperation.it={self.person.device}", "control_modes.teleop.teleop=it")
        return super().launch(*device, *overrides)

    @override
    def meet(self) -> None:
        self.person.meet(self.run.runtime)
        self.run.ticks(80, self.person.rest)

    @override
    def prepare(self) -> None:
        for i in range(self.person.presses):
            if i:
                self.run.ticks(5, self.person.hold)
            self.person.release()
            self.run.ticks(30, self.person.rest)
            self.person.press()

    @override
    def ask(self) -> object:
        return self.person.hold()

    @override
    def silence(self) -> None:
        self.person.freeze()

    @override
    def die(self) -> None:
        self.person.unplug()

    @override
    def close(self) -> None:
        super().close()
        self.person.close()


class OperatedPage(Operated):
    """The page in a browser."""

    person: deadman_table.Page

    def __init__(self) -> None:
        super().__init__(deadman_table.Page())

    def jog(self, at_ms: int | None = None, **motion: Any) -> object:
        """Send a jog, made at a time of the page's clock [ms]; by default now."""
        now_ms = self.run.session.clock.now_ns() // 1_000_000
        return self.person._send("jog", at=now_ms if at_ms is None else at_ms, press=self.person._press_ms, **motion)

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self.jog(joints={"shoulder_pan": value})
        yield lambda: self.jog(targets={"shoulder_pan": value})
        yield lambda: self.jog(linear=[value, 0.0, 0.0])
        yield lambda: self.jog(turn=[0.0, value, 0.0])

    @override
    def with_time(self, off_s: float) -> object:
        now_ms = self.run.session.clock.now_ns() // 1_000_000
        return self.jog(max(0, now_ms + round(1e3 * off_s)), joints={"shoulder_pan": 0.5})

    @override
    def ask_tool(self) -> object:
        return self.jog(linear=[1.0, 0.0, 0.0])


class OperatedHeadset(Operated):
    """A controller of a headset, at its page."""

    person: deadman_table.Headset

    def __init__(self) -> None:
        super().__init__(deadman_table.Headset())

    def _hand(self, **changes: Any) -> object:
        self.person._sent += 1
        hand = {
            "orientation": [0, 0, 0, 1], "position": [0, 1, 0], "clutch": True, "gripper": None, "open": 0,
            "move": [0, 0, 0], **changes,
        }  # fmt: skip
        number = self.person._sent
        message = {"type": "hands", "n": number, "t": 0.01 * number, "heading": 0, "hands": {"right": hand}}
        hands = decode(json.dumps(message))
        assert isinstance(hands, Hands)
        return self.person._exchange.put(hands, 0.0)

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self._hand(position=[value, 1, 0])
        yield lambda: self._hand(orientation=[value, 0, 0, 1])
        yield lambda: self._hand(position=None, move=[value, 0, 0])
        yield lambda: self._hand(gripper=value)


class ToolKeys(deadman_table.KittyKeyboard):
    """Keys that move the tool."""

    device = "{type: keyboard}"

    @override
    def meet(self, runtime: Runtime) -> None:
        self.type(b"m")


class ToolPad(deadman_table.Xbox):
    """A pad that moves the tool."""

    device = "{type: gamepad, via: hid, start: tool}"


class ToolMouse(deadman_table.SpaceMouse):
    """A SpaceMouse that moves the tool."""

    device = "{type: spacemouse}"

    @override
    def reports(self, held: bool) -> tuple[bytes, ...]:
        return tuple(self.fake.spacemouse(y=0.8) if each[0] == 1 else each for each in super().reports(held))


class Leader(Operated):
    """An arm that is moved by hand; it is held still but for jumps of its readings."""

    person: deadman_table.LeaderHold

    @override
    def prepare(self) -> None:
        super().prepare()
        self.run.ticks(60, self.still)
        for _ in range(100):  # the robot approaches the leader's pose
            begun = len(self.run.commands)
            self.run.ticks(10, self.still)
            if self.run.moved(begun) < 1e-4:
                return
        pytest.fail("the robot does not arrive at the leader's pose")

    def still(self) -> None:
        """One tick with the deadman pressed, in which nobody moves the leader."""
        deadman_table.Keyboard.hold(self.person)
        self.person.tick()

    speaks_floats: ClassVar[bool] = False
    """Whether its readings can be NaN or infinite; those of servos are whole numbers."""

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        def jumped() -> None:
            self.person.place(value)
            self.still()

        if self.speaks_floats or np.isfinite(value):
            yield jumped


class Twists(Operated):
    """A program that sends twists."""

    def __init__(self) -> None:
        super().__init__(deadman_table.Twists())

    def publish(self, speed: float, off_s: float = 0.0, turn: float = 0.0) -> None:
        """Publish a twist."""
        header = Header(self.run.session.clock.now_ns() + ns(off_s))
        sent = TwistStamped(header, Twist(Vector3(0.0, 0.0, speed), Vector3(0.0, 0.0, turn)))
        self.run.session.bus.publish("/servo_node/delta_twist_cmds", sent)

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self.publish(value)
        yield lambda: self.publish(0.0, turn=value)

    @override
    def with_time(self, off_s: float) -> object:
        return self.publish(0.1, off_s)

    @override
    def ask_tool(self) -> object:
        header = Header(self.run.session.clock.now_ns())
        sent = TwistStamped(header, Twist(Vector3(0.1, 0.0, 0.0), Vector3(0.0, 0.0, 0.0)))
        return self.run.session.bus.publish("/servo_node/delta_twist_cmds", sent)


class PageGoal(Entrance):
    """The goals of the page in a browser."""

    service: ClassVar[str] = "/planning/go_to"
    goal: ClassVar[str] = f"shoulder_pan={FAR}"

    @override
    def meet(self) -> None:
        session = self.run.session
        failed: list[Exception] = []
        self.replies: list[Mapping[str, Any]] = []
        self._commands = page_commands.Commands(session, session.finish, self.replies.append, failed.append)

    def send(self, stops: int, request: str) -> None:
        """Send a request by a page that has seen `stops` emergency stops, and wait until it was carried out."""
        before = len(self.replies)
        message = {"do": "call", "id": 7, "stops": stops, "service": self.service, "request": request}
        sent = to_run(from_page(json.dumps(message)))  # type: ignore[arg-type]
        command = from_server(json.loads(json.dumps(sent)))
        assert isinstance(command, Sent)
        self._commands.take(command)
        done = threading.Event()
        while len(self.replies) == before:
            done.wait(0.001)

    @override
    def ask(self) -> object:
        return self.send(self.run.session.stops, self.goal)

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self.send(self.run.session.stops, f"shoulder_pan={value}")
        yield lambda: self.send(self.run.session.stops, f"xyz={value},0.1,0.1")

    @override
    def keep(self) -> Callable[[], object]:
        stops = self.run.session.stops
        return lambda: self.send(stops, self.goal)

    @override
    def close(self) -> None:
        super().close()
        if hasattr(self, "_commands"):
            self._commands.close(_PATIENCE_S)


class PageMode(PageGoal):
    """The modes of the page in a browser: that of a policy moves the robot."""

    service = "/set_mode"
    goal = "model_inference"
    overrides = Policy.overrides

    @override
    def ask(self) -> object:
        chunk = np.tile(self.run.commands[-1], (3, 1))
        chunk[:, 0] = self.far
        sys.modules["far_policy"].answers[:] = [chunk] * 5
        return super().ask()


class SetMode(Policy):
    """`/set_mode`: the mode of a policy moves the robot."""

    mode = "moveit_planning"
    streams = False
    far = FAR

    def switch(self, stops: int) -> object:
        """Enter the mode by a caller that knows of `stops` emergency stops."""
        chunk = np.tile(self.run.commands[-1], (30, 1))
        chunk[:, 0] = self.far
        self.answers[:] = [chunk] * 5
        return self.call("/set_mode", {"mode": "model_inference", "stops": stops})

    @override
    def ask(self) -> object:
        return self.switch(self.run.session.stops)

    @override
    def keep(self) -> Callable[[], object]:
        stops = self.run.session.stops
        return lambda: self.switch(stops)


class Reset(SetMode):
    """`/reset`: it lets a robot move again."""

    @override
    def keep(self) -> Callable[[], object]:
        stops = self.run.session.stops

        def reset() -> None:
            self.run.stop()
            self.run.ticks(30)
            with suppress(IbrobotError):
                self.call("/reset", {"stops": stops})
            assert self.run.session.faults, "a reset from before the stop clears it"
            self.run.reset()

        return reset


class _LeRobotLeader(deadman_table.Keyboard):
    """A leader of LeRobot's, in a device process with a fake of LeRobot; space is its deadman."""

    key = b" "
    faults = True
    at, way = 5.0, 0.5

    def __init__(self, folder: Path) -> None:
        super().__init__()
        fakes = of_tests("ibrobot-plugin-lerobot-devices", "conftest")
        site = folder / "site"
        shutil.copytree(fakes.FAKE, site)
        fakes.install(site, "lerobot", "0.6.1")
        self._patches = pytest.MonkeyPatch()
        self._patches.syspath_prepend(str(site))
        self._patches.setenv("PYTHONPATH", os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")]))
        self._patches.setenv("XDG_CACHE_HOME", str(folder))
        self._patches.setattr(lerobot_teleop, "age_ns", lambda answer: 0)
        self.answers(in_time=True)
        self.motors = fakes.Motors.at(folder / "port")
        config = f"{{port: {self.motors.port}, id: tester}}"
        self.device = f"{{type: lerobot, teleop: fake_leader, config: {config}, deadman: hold}}"

    def answers(self, *, in_time: bool) -> None:
        """Whether its readings come within a tick."""
        self._patches.setattr(lerobot_teleop, "_WAIT_S", _PATIENCE_S if in_time else 0.0)

    def hold(self, *, arrives: bool = True) -> None:
        super().hold()
        if abs(self.at + self.way) > 60.0:
            self.way = -self.way
        self.at += self.way
        self.motors.move(shoulder_pan=self.at)

    def rest(self) -> None:
        self.motors.suffer("")

    def freeze(self) -> None:
        self.answers(in_time=False)
        self.motors.suffer("block")

    unplug = freeze

    def tick(self) -> None:
        """Time passes."""

    def place(self, value: float) -> None:
        """Have a reading with a number."""
        if np.isfinite(value):
            self.motors.move(shoulder_pan=self.at + (60.0 if value > 0 else -60.0))
        else:
            self.motors.move(shoulder_pan=value)

    def close(self) -> None:
        self.motors.suffer("")
        self._patches.undo()


class LeRobotLeader(Leader):
    """A leader of LeRobot's."""

    speaks_floats = True

    def __init__(self, folder: Path) -> None:
        super().__init__(_LeRobotLeader(folder))  # type: ignore[arg-type]


BASE = """
robot:
  name: base
  joints:
    - {name: x, lower: -1000, upper: 1000, max_velocity: 0.5, max_acceleration: 5.0}
    - {name: y, lower: -1000, upper: 1000, max_velocity: 0.5, max_acceleration: 5.0}
    - {name: theta, lower: -1000, upper: 1000, max_velocity: 1.0, max_acceleration: 10.0}
  groups: {base: [x, y, theta]}
simulation: {type: wheels}
executors:
  base_position: {type: position, group: base}
control_modes:
  drive: {executors: [base_position], teleop: wheels}
  idle: {executors: [base_position]}
default_control_mode: drive
teleoperation:
  wheels: {type: cmd_vel}
contract: {rate_hz: 30, max_duration_s: 20}
control: {rate_hz: 100, stop: hold}
"""
"""A base, whose axes are joints."""


class CmdVel(_Stream):
    """A program that drives a base by twists."""

    mode = "drive"
    overrides = ()
    joint = "x"

    @override
    def config(self, changes: tuple[str, ...]) -> RobotConfig:
        return from_document(
            yaml.safe_load(BASE), source=Path("base.yaml"), sim=True, mode=self.mode, overrides=changes
        )

    def publish(self, speed: float, off_s: float = 0.0, turn: float = 0.0) -> None:
        """Publish a twist."""
        header = Header(self.run.session.clock.now_ns() + ns(off_s), "base_link")
        sent = TwistStamped(header, Twist(Vector3(speed, 0.0, 0.0), Vector3(0.0, 0.0, turn)))
        self.run.session.bus.publish("/cmd_vel", sent)

    @override
    def prepare(self) -> None:
        self.run.ticks(60, lambda: self.publish(0.0))

    @override
    def ask(self) -> object:
        return self.publish(0.5)

    @override
    def with_number(self, value: float) -> Iterator[Callable[[], object]]:
        yield lambda: self.publish(value)
        yield lambda: self.publish(0.0, turn=value)

    @override
    def with_time(self, off_s: float) -> object:
        return self.publish(0.2, off_s)
