"""Generated goals of trajectories by every entrance: one verdict, and nothing executed that a second engine objects to.

    python tests/shared/goal_entrances.py [--goals 5000] [--seed 0]

The simulated SO-101 in lockstep, beside a wall and on a table that the run's world knows. Each goal is sent as a ROS
action (as the rclpy node and Zenoh pass it to the run), by `/execute_trajectory` as plain data, by the client package,
and as a task sends its motions. All must accept it, or all refuse it for the same kind of reason. One of them, in turn,
executes it: sampled at each tick, the command must be within the limits of position, velocity and acceleration, and by
MuJoCo clear of wall and table, and the end must be the last point. Exits with 1 otherwise.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import yaml
from ibrobot_mujoco.so101 import so101
from ibrobot_planning.client import Client
from ibrobot_planning.execution.requests import GoTo
from ibrobot_planning.goals.grammar import Target
from ibrobot_planning.world.objects import Box, World, WorldObject
from ibrobot_ros2.calls import GoalRequest
from ibrobot_ros2.goals import Actions
from referee import Referee

from ibrobot_core.api import (
    FollowTrajectory,
    Header,
    IbrobotError,
    JointTrajectory,
    JointTrajectoryPoint,
    Pose,
    SlowDown,
    Vector,
    Vector3,
    ns,
)
from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config
from ibrobot_core.control.commands import SendGoal

CONFIG = Path(__file__).parents[2] / "configs" / "so101_blind.yaml"
ARM_JOINTS = so101().joint_names[:5]
MODE, ARM = "moveit_planning", "arm_trajectory"
WALL = {"shape": "box", "size": [0.3, 0.02, 0.3], "position": [0.25, 0.0, 0.15]}
LEFT = (0.9, -0.6, 0.6, 0.9, 0.0)
"""Arm positions [rad] beside the wall."""
WORLD = World({
    "wall": WorldObject(Box((0.3, 0.02, 0.3)), Pose(Vector3(0.25, 0.0, 0.15))),
    "table": WorldObject(Box((2.0, 2.0, 0.1)), Pose(Vector3(0.0, 0.0, -0.05))),
})  # fmt: skip
SLACK = 1.02
TOUCHING_M = -0.001
"""Least distance by MuJoCo; the planner keeps 5 mm, by other hulls of the meshes."""
EXECUTED_S = 30.0
"""Longest execution [s]."""
_RETURN_S = 0.5
REASONS = {
    "joints": ("joint_names", "no executor of mode", "joints one", "INVALID_GROUP", "no joint"),
    "header": ("was to begin",),
    "tolerance": ("tolerance",),
    "world": ("not free",),
    "start": ("begins with", "begins at"),
    "limits": ("its limit", "outside its limits"),
    "numbers": ("finite",),
    "shape": (
        "increase", "leaves no time", "point", "for 5 joints", "efforts", "at rest", "at most", "must be", "expected",
    ),
}  # fmt: skip
"""Kind of reason -> what its messages contain; the first that fits counts."""

type Fields = dict[str, Any]


@attrs.frozen
class Verdict:
    """What an entrance said."""

    accepted: bool
    message: str = ""

    @property
    def reason(self) -> str:
        """The kind of reason of a refusal; empty if it was accepted."""
        if self.accepted:
            return ""
        found = (kind for kind, texts in REASONS.items() if any(text in self.message for text in texts))
        return next(found, f"other: {self.message}")


@attrs.frozen
class Goal:
    """A generated goal, in ROS's fields."""

    kind: str
    names: tuple[str, ...]
    points: tuple[Fields, ...]
    """Each with `time` [s], `positions`, and maybe `velocities`, `accelerations`, `effort`."""
    extras: Fields = attrs.field(factory=dict)
    """Fields that only a ROS action has: `stamp` [s] from now, `path_tolerance`, `goal_tolerance`, `goal_time`."""

    @property
    def message(self) -> JointTrajectory:
        """The goal as a message."""
        points = []
        for point in self.points:
            fields = {key: np.array(value, dtype=float) for key, value in point.items() if key != "time"}
            points.append(JointTrajectoryPoint(round(point["time"] * 1e9), **fields))
        return JointTrajectory(Header(), self.names, tuple(points))

    @property
    def plain(self) -> Fields:
        """The goal as a request in plain data."""
        points = [
            {"time_from_start_ns": round(p["time"] * 1e9), **{k: list(v) for k, v in p.items() if k != "time"}}
            for p in self.points
        ]
        return {"joint_names": list(self.names), "points": points}

    def ros(self, now_ns: int) -> Fields:
        """The goal of a FollowJointTrajectory, as a node or Zenoh passes it on."""
        points = []
        for point in self.points:
            fields = {
                name: list(point.get(name, ())) for name in ("positions", "velocities", "accelerations", "effort")
            }
            points.append({**fields, "time_from_start": _duration(round(point["time"] * 1e9))})
        stamp_ns = now_ns + round(self.extras["stamp"] * 1e9) if "stamp" in self.extras else 0
        return {
            "trajectory": {
                "header": {"stamp": _duration(stamp_ns), "frame_id": ""},
                "joint_names": list(self.names),
                "points": points,
            },
            "multi_dof_trajectory": {
                "header": {"stamp": _duration(0), "frame_id": ""},
                "joint_names": [],
                "points": [],
            },
            "path_tolerance": self.extras.get("path_tolerance", []),
            "goal_tolerance": self.extras.get("goal_tolerance", []),
            "component_path_tolerance": [],
            "component_goal_tolerance": [],
            "goal_time_tolerance": _duration(round(self.extras.get("goal_time", 0.0) * 1e9)),
        }


def _duration(time_ns: int) -> dict[str, int]:
    sec, nanosec = divmod(time_ns, 1_000_000_000)
    return {"sec": sec, "nanosec": nanosec}


def tolerance(name: str, position: float, **others: float) -> Fields:
    """A control_msgs/msg/JointTolerance."""
    return {"name": name, "position": position, "velocity": 0.0, "acceleration": 0.0, **others}


class Robot:
    """A run with all its entrances.

    Attributes:
        runtime: the run.
        commands: commands of the arm at each tick since the last `mark`, each shape (5,).
    """

    def __init__(self, runtime: Runtime) -> None:
        self.runtime = runtime
        self.session = runtime.session
        self.commands: list[Vector] = []
        self.ends: dict[int, tuple[str, Mapping[str, Any]]] = {}
        """State and result of ROS goals that ended or were refused, by number."""
        self.actions = Actions(
            self.session, [ARM, "gripper_action"], lambda name: False, lambda name: name, "ros", "GripperCommand"
        )
        self.actions.open()
        self.actions.declare(self)
        self.session.on_goal.append(self._take)
        self._events: list[Mapping[str, Any]] = []
        self._number = 0
        self._columns = self.session.config.robot.indices(ARM_JOINTS)
        self.entrances: dict[str, Callable[[Goal], tuple[Verdict, Any]]] = {
            "ros": self.by_ros,
            "service": self.by_service,
            "client": self.by_client,
            "task": self.by_task,
        }

    def offer(self, name: str, type_name: str, *, executor: str = "", service: str = "") -> None:
        """As if a client were there."""

    def feed(self, goal: int, values: Mapping[str, Any]) -> None:
        """Drop feedback."""

    def end(self, goal: int, state: str, values: Mapping[str, Any]) -> None:
        """Take the result of a goal."""
        self.ends[goal] = state, values

    def _take(self, event: Mapping[str, Any]) -> None:
        self._events.append(event)

    @property
    def command(self) -> Vector:
        """Commanded positions of the arm [rad], shape (5,)."""
        state = self.session.state
        assert state is not None
        return state.command[self._columns].copy()

    def step(self) -> None:
        """Let a tick pass."""
        self.runtime.step()
        if self.session.faults or self.session.finished.is_set():
            raise SystemExit(f"the run stopped: {self.session.faults} {self.session.failure_text}")
        self.commands.append(self.command)

    def rest(self) -> None:
        """Let time pass until the command rests."""
        still = 0
        while still < 4:
            before = self.command
            self.step()
            still = still + 1 if np.abs(self.command - before).max() < 1e-6 else 0

    def by_ros(self, goal: Goal) -> tuple[Verdict, Any]:
        """Send a goal as a ROS action; with its number."""
        self._number += 1
        number = self._number
        request = GoalRequest(number, goal.ros(self.session.clock.now_ns()), ARM)
        if not self.actions.take_goal(self, request, self.session.stops):
            return Verdict(False, "rejected without a reason"), number
        end = self.ends.get(number)
        return (Verdict(True), number) if end is None else (Verdict(False, end[1]["error_string"]), number)

    def by_service(self, goal: Goal) -> tuple[Verdict, Any]:
        """Send a goal to `/execute_trajectory`."""
        return self._asked(lambda: self.session.bus.call("/execute_trajectory", goal.plain))

    def by_task(self, goal: Goal) -> tuple[Verdict, Any]:
        """Send a goal as tasks send their motions."""
        go = GoTo(Target("trajectory", trajectory=goal.message))
        return self._asked(lambda: self.session.bus.call("/planning/go_to", go))

    def by_client(self, goal: Goal) -> tuple[Verdict, Any]:
        """Send a goal by the client package."""
        return self._asked(lambda: Client.of_run(self.runtime).follow(goal.message).number)

    def _asked(self, send: Callable[[], int]) -> tuple[Verdict, Any]:
        """Send a goal to the planner's source, which decides at its next unit of work."""
        self._events.clear()
        try:
            number = send()
        except (IbrobotError, ValueError) as error:
            return Verdict(False, str(error)), None
        for _ in range(1000):
            self.step()
            result = self.session.bus.call("/planning/result", number)
            if result is not None and not result.success and not self._events:
                return Verdict(False, result.message), number
            if result is not None or self._events:
                return Verdict(True), number
        raise SystemExit("no verdict")

    def drop(self) -> None:
        """Stop what moves."""
        self.session.bus.call("/planning/cancel")
        self.session.control.call(SendGoal(executor=ARM, goal_id="drop", goal=SlowDown()))
        self.rest()

    def bring(self, positions: Vector) -> None:
        """Move a little way back to where a goal began, past all checks."""
        if np.abs(self.command - positions).max() < 1e-9:
            return
        rest = np.zeros(len(ARM_JOINTS))
        point = JointTrajectoryPoint(ns(_RETURN_S), positions, rest, rest)
        goal = FollowTrajectory(JointTrajectory(Header(), ARM_JOINTS, (point,)), path_tolerance=-1, goal_tolerance=-1)
        self.session.control.call(SendGoal(executor=ARM, goal_id="back", goal=goal))
        for _ in range(round(_RETURN_S * 100) + 2):
            self.step()
        self.rest()

    def finish(self, entrance: str, number: Any) -> str:
        """Let a goal end; returns what went wrong."""
        for _ in range(round(EXECUTED_S * 100)):
            if entrance == "ros":
                if (end := self.ends.get(number)) is not None:
                    state, values = end
                    return "" if state == "succeeded" else f"{state}: {values['error_string']}"
            elif (result := self.session.bus.call("/planning/result", number)) is not None:
                return "" if result.success else str(result.message)
            self.step()
        return "did not end"


@contextmanager
def robot(**overrides: Any) -> Iterator[Robot]:
    """A run in lockstep, with its arm on the left of the wall."""
    document = yaml.safe_load(CONFIG.read_text())
    document["simulation"] |= {"scene": "empty"}
    document["world"] = {}
    document |= overrides
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.yaml"
        path.write_text(yaml.safe_dump(document, sort_keys=False))
        registry = installed_plugins()
        config = load_config(path, mode=MODE, sim=True, registry=registry)
        runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True)))
        runtime.start()
        try:
            made = Robot(runtime)
            runtime.step()
            yield made
        finally:
            runtime.stop()


def to_left(made: Robot) -> None:
    """Move to the left side of the wall, and add it to the world."""
    text = ",".join(f"{name}={value}" for name, value in zip(ARM_JOINTS, LEFT, strict=True))
    number = made.session.bus.call("/planning/go_to", text)
    if wrong := made.finish("service", number):
        raise SystemExit(wrong)
    made.rest()
    made.session.bus.call("/world/add", {"name": "wall", "object": WALL})


class Maker:
    """Generates goals.

    Args:
        seed: equal seeds give equal goals at equal places.
        lower: limits of the arm's joints [rad], shape (5,).
        upper: limits of the arm's joints [rad], shape (5,).
    """

    def __init__(self, seed: int, lower: Vector, upper: Vector) -> None:
        self._rng = np.random.default_rng(seed)
        self._lower, self._upper = lower, upper
        self._kinds: dict[str, Callable[[Vector], Goal]] = {
            "near": self._near,
            "far": self._far,
            "fast": self._fast,
            "spline": self._spline,
            "through": self._through,
            "beyond": self._beyond,
            "numbers": self._numbers,
            "shape": self._shape,
            "names": self._names,
            "start": self._start,
            "extras": self._extras,
        }

    def goal(self, here: Vector) -> Goal:
        """A goal for an arm at positions `here` [rad], shape (5,)."""
        kind = str(self._rng.choice(list(self._kinds)))
        made = self._kinds[kind](here)
        if kind != "names" and self._rng.random() < 0.3:
            made = self._shuffled(made)
        return attrs.evolve(made, kind=kind)

    def _shuffled(self, goal: Goal) -> Goal:
        order = self._rng.permutation(len(goal.names)).tolist()

        def mixed(values: Any) -> Any:
            return [values[i] for i in order] if len(values) == len(order) else values

        points = tuple({key: value if key == "time" else mixed(value) for key, value in p.items()} for p in goal.points)
        return attrs.evolve(goal, names=tuple(goal.names[i] for i in order), points=points)

    def _way(self, here: Vector, ends: list[Vector], pace: float) -> Goal:
        """Points through places, at `pace` times 3 rad/s, with random fields."""
        rng = self._rng
        points: list[Fields] = []
        now, at, fields = 0.0, here, int(rng.integers(1, 4))
        if rng.random() < 0.5:
            points.append(self._point(0.0, here, fields))
        for end in ends:
            distance = float(np.abs(end - at).max())
            now += max(distance / (3.0 * pace) * 1.9, math.sqrt(6 * distance / 40.0) / max(pace, 0.2), 0.02)
            points.append(self._point(now, end, fields))
            at = end
        return Goal("", ARM_JOINTS, tuple(points))

    @staticmethod
    def _point(time: float, positions: Vector, fields: int) -> Fields:
        rest = [0.0] * len(positions)
        point: Fields = {"time": round(time, 6), "positions": positions.tolist()}
        for name in ("velocities", "accelerations")[: fields - 1]:
            point[name] = list(rest)
        return point

    def _beside(self, here: Vector, width: float) -> Vector:
        return np.clip(here + self._rng.uniform(-width, width, len(here)), self._lower, self._upper)

    def _near(self, here: Vector) -> Goal:
        return self._way(here, [self._beside(here, 0.2) for _ in range(int(self._rng.integers(1, 4)))], 0.3)

    def _far(self, here: Vector) -> Goal:
        ends = [self._rng.uniform(self._lower, self._upper) for _ in range(int(self._rng.integers(1, 3)))]
        return self._way(here, ends, 0.5)

    def _fast(self, here: Vector) -> Goal:
        return self._way(here, [self._beside(here, 0.5)], float(self._rng.uniform(0.6, 3.0)))

    def _spline(self, here: Vector) -> Goal:
        """Velocities at inner points, with which splines overshoot."""
        goal = self._way(here, [self._beside(here, 0.3) for _ in range(3)], 0.3)
        points = [dict(point) for point in goal.points]
        for point in points:
            point.pop("accelerations", None)
            point["velocities"] = [0.0] * 5
        for point in points[-3:-1]:
            point["velocities"] = self._rng.uniform(-3.2, 3.2, 5).tolist()
        return attrs.evolve(goal, points=tuple(points))

    def _through(self, here: Vector) -> Goal:
        """To the other side of the wall, or into the table."""
        if self._rng.random() < 0.5:
            end = here.copy()
            end[0] = -end[0]
        else:
            end = here + np.array([0.0, 1.2, 0.4, 0.0, 0.0])
        return self._way(here, [np.clip(end, self._lower, self._upper)], 0.4)

    def _beyond(self, here: Vector) -> Goal:
        """A waypoint beyond a limit, and back."""
        out = here.copy()
        joint = int(self._rng.integers(5))
        out[joint] = self._upper[joint] + self._rng.choice([1e-3, 0.5, 7.0])
        return self._way(here, [out, here], 0.3)

    def _numbers(self, here: Vector) -> Goal:
        """A number that is not finite, or huge."""
        goal = self._way(here, [self._beside(here, 0.2) for _ in range(2)], 0.3)
        points = [dict(point) for point in goal.points]
        point = points[int(self._rng.integers(len(points)))]
        field = str(self._rng.choice([key for key in point if key != "time"]))
        values = list(point[field])
        values[int(self._rng.integers(5))] = float(self._rng.choice([np.nan, np.inf, -np.inf, 1e6, 1e308, -1e308]))
        point[field] = values
        return attrs.evolve(goal, points=tuple(points))

    def _shape(self, here: Vector) -> Goal:
        """Times, lengths and fields that do not fit."""
        goal = self._way(here, [self._beside(here, 0.2) for _ in range(2)], 0.3)
        points = [dict(point) for point in goal.points]
        match int(self._rng.integers(7)):
            case 0:
                points[-1]["time"] = points[-2]["time"]
            case 1:
                points.reverse()
            case 2:
                points[-1]["positions"] = points[-1]["positions"][:4]
            case 3:
                points[-1]["velocities"] = [0.5] * 5
            case 4:
                points[-1]["effort"] = [0.5] * 5
            case 5:
                points[-1] = points[-1] | {"velocities": [0.0] * 5, "accelerations": []}
                points[0].pop("velocities", None)
            case 6:
                points[-1]["time"] = 400.0
        return attrs.evolve(goal, points=tuple(points))

    def _names(self, here: Vector) -> Goal:
        goal = self._way(here, [self._beside(here, 0.2)], 0.3)
        names = list(ARM_JOINTS)
        wrong = int(self._rng.integers(3))
        if wrong == 0:
            names[2] = "elbow"
        elif wrong == 1:
            names[2] = names[1]
        else:
            names[2] = "gripper"
        return attrs.evolve(goal, names=tuple(names))

    def _start(self, here: Vector) -> Goal:
        """A first point at time 0 beside the robot."""
        away = here + self._rng.choice([-1, 1], 5) * float(self._rng.choice([0.003, 0.009, 0.05, 0.3]))
        end = self._way(here, [self._beside(here, 0.2)], 0.3)
        fields = sum(name in end.points[-1] for name in ("positions", "velocities", "accelerations"))
        first = self._point(0.0, np.clip(away, self._lower, self._upper), fields)
        return attrs.evolve(end, points=(first, *(p for p in end.points if p["time"] > 0)))

    def _extras(self, here: Vector) -> Goal:
        """What only a ROS action has."""
        rng = self._rng
        joint, position = str(rng.choice(ARM_JOINTS)), float(rng.choice([0.0, -1.0, 0.3, np.nan, np.inf, -np.inf, 1e9]))
        extras: list[Fields] = [
            {"stamp": float(rng.choice([-0.1, -0.4, -0.6, -3600.0, 0.1, 0.5, 400.0]))},
            {str(rng.choice(["path_tolerance", "goal_tolerance"])): [tolerance(joint, position)]},
            {"path_tolerance": [tolerance("elbow_flex", 0.3, velocity=float(rng.choice([0.0, -1.0, 1.0, np.nan])))]},
            {"goal_time": float(rng.choice([0.0, 2.0, -1.0, -2.0, 1e8]))},
        ]  # fmt: skip
        return attrs.evolve(self._near(here), extras=extras[int(rng.integers(len(extras)))])


@attrs.define
class Tally:
    """What became of generated goals."""

    verdicts: Counter[tuple[str, str]] = attrs.field(factory=Counter)
    """Kind and verdict -> number of goals."""
    asked: Counter[str] = attrs.field(factory=Counter)
    """Entrance and whether accepted -> number of goals."""
    executed: Counter[str] = attrs.field(factory=Counter)
    """Entrance -> executed goals."""
    wrong: list[str] = attrs.field(factory=list)
    """What must not be."""
    least_m: float = math.inf
    """Least clearance by MuJoCo of commands [m]; 20 mm if all are further."""
    velocity: float = 0.0
    """Greatest share of a velocity limit."""
    acceleration: float = 0.0
    """Greatest share of an acceleration limit."""


class Trial:
    """Sends generated goals by all entrances."""

    def __init__(self, made: Robot, seed: int) -> None:
        self._robot = made
        model = made.session.config.robot
        order = model.indices(ARM_JOINTS)
        self._lower, self._upper = model.lower[order], model.upper[order]
        self._velocity, self._acceleration = model.max_velocity[order], model.max_acceleration[order]
        self._maker = Maker(seed, self._lower, self._upper)
        assert model.description.mjcf is not None
        self._referee = Referee(model.description.mjcf, ARM_JOINTS, WORLD)
        self.tally = Tally()

    def send(self, number: int) -> None:
        """Send goal `number`, and execute it if it is accepted."""
        made, tally = self._robot, self.tally
        here = made.command
        goal = self._maker.goal(here)
        names = ["ros"] if goal.extras else list(made.entrances)
        # The one that executes it comes last.
        order = [*names[number % len(names) + 1 :], *names[: number % len(names) + 1]]
        verdicts: dict[str, Verdict] = {}
        for name in order:
            made.commands = [made.command]
            verdict, address = made.entrances[name](goal)
            verdicts[name] = verdict
            tally.asked[f"{name} {'accepted' if verdict.accepted else 'refused'}"] += 1
            if not verdict.accepted:
                if name == "ros" and address not in made.ends:
                    tally.wrong.append(f"goal {number}: no result: {goal}")
                if np.abs(made.command - here).max() > 0:
                    tally.wrong.append(f"goal {number} ({goal.kind}) was refused by {name}, and moved the arm: {goal}")
            elif name == order[-1]:
                wrong = made.finish(name, address)
                made.rest()
                tally.executed[name] += 1
                self._judge(number, goal, name, wrong)
            else:
                made.drop()
            if name != order[-1]:
                made.bring(here)
        reasons = {verdict.reason for verdict in verdicts.values()}
        tally.verdicts[goal.kind, "/".join(sorted(reason or "accepted" for reason in reasons))] += 1
        if len(reasons) > 1 or any(reason.startswith("other") for reason in reasons):
            tally.wrong.append(f"goal {number} ({goal.kind}): verdicts {verdicts}: {goal}")

    def _judge(self, number: int, goal: Goal, name: str, wrong: str) -> None:
        """Judge an executed goal by its commands."""
        tally, commands = self.tally, np.array(self._robot.commands)
        whole = np.concatenate([np.repeat(commands[:1], 2, axis=0), commands, np.repeat(commands[-1:], 2, axis=0)])
        speed = float((np.abs(np.diff(whole, axis=0)) * 100 / self._velocity).max())
        change = float((np.abs(np.diff(whole, 2, axis=0)) * 1e4 / self._acceleration).max())
        clear = self._referee.clearance(commands[::2])
        tally.velocity, tally.acceleration = max(tally.velocity, speed), max(tally.acceleration, change)
        tally.least_m = min(tally.least_m, clear)
        last = dict(zip(goal.names, goal.points[-1]["positions"], strict=True))
        off = float(np.abs(commands[-1] - [last[joint] for joint in ARM_JOINTS]).max())
        outside = float(np.maximum(self._lower - commands, commands - self._upper).max())
        faults = {
            wrong: bool(wrong),
            f"velocity {speed:.3f} of its limit": speed > SLACK,
            f"acceleration {change:.3f} of its limit": change > SLACK,
            f"clearance {1000 * clear:.1f} mm": clear < TOUCHING_M,
            f"ends {off:.4f} rad beside its goal": off > 1e-3,
            f"{outside:.5f} rad outside the limits": outside > 2e-5,
        }
        for fault in (each for each, holds in faults.items() if holds):
            tally.wrong.append(f"goal {number} ({goal.kind}), executed by {name}: {fault}: {goal}")


def tried(goals: int, seed: int) -> Tally:
    """Send generated goals, and return what became of them."""
    with robot() as made:
        to_left(made)
        trial = Trial(made, seed)
        for number in range(goals):
            trial.send(number)
            if number % 250 == 249:
                counts = trial.tally
                print(f"goal {number + 1}: {counts.asked.total()} verdicts, {len(counts.wrong)} wrong", file=sys.stderr)
        return trial.tally


def main() -> int:
    """Send goals, and print what became of them; 1 if one is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--goals", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    tally = tried(asked.goals, asked.seed)
    for (kind, verdict), number in sorted(tally.verdicts.items()):
        print(f"{number:6} {kind:8} {verdict}")
    print(json.dumps({"asked": dict(sorted(tally.asked.items())), "executed": dict(sorted(tally.executed.items()))}))
    print(
        f"commands: velocity {tally.velocity:.3f} and acceleration {tally.acceleration:.3f} of their limits at most, "
        f"least clearance by MuJoCo {1000 * tally.least_m:.1f} mm; {len(tally.wrong)} wrong"
    )
    for line in tally.wrong[:20]:
        print(line)
    return 1 if tally.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
