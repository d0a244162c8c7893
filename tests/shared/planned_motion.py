"""Motions under way: obstacles, goals cancelled and replaced, lost joints.

The simulated SO-101 with the planner `rrt_connect`, between the table, the bin and the cube of its scene, in lockstep.

1. Obstacles: a box appears on the rest of a motion, far enough ahead for the arm to stop. The arm must stand before it
   and name it; MuJoCo measures the distance of the measured positions from the box.
2. Goals: each is cancelled or replaced at a random time. No command may exceed the limits of velocity and acceleration,
   and the safety layer must have nothing to correct.
3. Losses: something that the planner does not know stops the arm, a joint no longer follows its commands, or the
   hardware no longer answers. The arm must stop, no command may exceed the limits, and the result must name the joint
   or what is lost. Acceleration does not count where a joint is further than half of `max_lead` from its command: the
   limit on this lead comes first.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from ibrobot_kinematics import robot_model
from ibrobot_mujoco.so101 import so101
from ibrobot_planning.execution.requests import MoveResult
from ibrobot_planning.world.objects import Box, World, WorldObject
from referee import Referee

from ibrobot_core.api import Pose, Vector, Vector3
from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config

CONFIG = Path(__file__).parents[2] / "configs" / "so101_blind.yaml"
ARM_JOINTS = so101().joint_names[:5]
MODE = "moveit_planning"
BOX_M = 0.05
REACTION_S = 0.25
"""Time in which the arm must come to rest: the box stands further along the motion."""
LEAD_SHARE = 0.5
"""Of `max_lead`: the command of a joint further from it brakes for the limit on its lead."""
CAUSES = ("blocked", "joint", "hardware")
LEAST_WAY_RAD = 0.8
"""Least way of a joint that is lost: it has to deviate."""


@contextmanager
def run(simulation: Mapping[str, Any] | None = None, **asked: Any) -> Iterator[Runtime]:
    """A run in the scene with the cube; with options of the simulation, on an empty table that the planner knows."""
    document = yaml.safe_load(CONFIG.read_text())
    if simulation is None:
        document["control_modes"][MODE]["planner"] = {"type": "rrt_connect"}
        document["world"] = {"scene": True}
    else:
        document["simulation"] |= {"scene": "empty", **simulation}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.yaml"
        path.write_text(yaml.safe_dump(document, sort_keys=False))
        registry = installed_plugins()
        config = load_config(path, mode=MODE, sim=True, registry=registry)
        runtime = Runtime(Session(config, registry, LaunchRequest(**asked)))
        runtime.start()
        try:
            yield runtime
        finally:
            runtime.stop()


class Arm:
    """A run in lockstep, with what it commanded and measured at each tick."""

    def __init__(self, runtime: Runtime, *, faulty: bool = False) -> None:
        self._runtime = runtime
        self._faulty = faulty
        self.call = runtime.session.bus.call
        self.commands: list[Vector] = []
        self.measured: list[Vector] = []

    def step(self, ticks: int = 1) -> None:
        """Let so many ticks pass."""
        for _ in range(ticks):
            self._runtime.step()
            if self._runtime.session.faults and not self._faulty:
                raise SystemExit(f"fault: {self._runtime.session.faults[0]}")
            state = self._runtime.session.state
            assert state is not None
            self.commands.append(state.command.copy())
            self.measured.append(state.position.copy())

    def finish(self, goal: int) -> MoveResult:
        """Let time pass until a goal has ended."""
        while (result := self.call("/planning/result", goal)) is None:
            self.step()
        assert isinstance(result, MoveResult)
        return result

    def go(self, positions: Vector) -> int:
        """Ask for positions of the arm [rad], shape (5,); returns the number of the goal."""
        goal = ",".join(f"{name}={value:.4f}" for name, value in zip(ARM_JOINTS, positions.tolist(), strict=True))
        return int(self.call("/planning/go_to", goal))

    def faults(self, *, corrections: bool = True) -> str:
        """What was beyond the limits, or corrected by the safety layer; empty if nothing."""
        robot = self._runtime.session.config.robot
        rate = self._runtime.session.config.control.rate_hz
        velocities = np.diff(self.commands, axis=0) * rate
        accelerations = np.diff(velocities, axis=0) * rate
        leads = np.abs(np.array(self.commands) - self.measured)
        accelerations[(leads > LEAD_SHARE * robot.max_lead)[:-2]] = 0.0
        found = []
        if (np.abs(velocities) > 1.001 * robot.max_velocity).any():
            found.append(f"velocity {np.abs(velocities).max():.2f} rad/s")
        if (np.abs(accelerations) > 1.02 * robot.max_acceleration).any():
            found.append(f"acceleration {np.abs(accelerations).max():.1f} rad/s^2")
        corrected = sum(self._runtime.session.counts()["interventions"].values())
        if corrected and corrections:
            found.append(f"{corrected} corrections by the safety layer")
        return ", ".join(found)


def obstacles(number: int, seed: int) -> bool:
    rng = np.random.default_rng(seed)
    clearances: list[float] = []
    reactions: list[float] = []
    stops: list[float] = []
    wrong: list[str] = []
    with run(lockstep=True, seed=seed) as runtime:
        arm, robot = Arm(runtime), runtime.session.config.robot
        model, mjcf = robot_model(robot), robot.description.mjcf
        assert mjcf is not None
        lower, upper = robot.lower[:5] * 0.8, robot.upper[:5] * 0.8
        rate = runtime.session.config.control.rate_hz
        arm.step(5)
        while len(clearances) < number:
            start, goal = rng.uniform(lower, upper, (2, 5))
            if not (arm.finish(arm.go(start)).success and _recorded(arm, goal)):
                continue
            free = np.array(arm.commands)
            if not arm.finish(arm.go(start)).success:
                continue
            when = int(rng.uniform(0.15, 0.6) * len(free))
            hit = when + int(rng.uniform(REACTION_S + 0.1, 1.0) * rate)
            if hit >= len(free):
                continue
            place = model.forward(free[hit]).position
            world = World({"box": WorldObject(Box((BOX_M,) * 3), Pose(Vector3(*place.tolist())))})
            referee = Referee(mjcf, ARM_JOINTS, world)
            if referee.clearance(free[: when + int(REACTION_S * rate), :5]) < 0.015:
                continue
            arm.commands.clear()
            arm.measured.clear()
            move = arm.go(goal)
            arm.step(when)
            box = {"shape": "box", "size": [BOX_M] * 3, "position": place.tolist()}
            arm.call("/world/add", {"name": "box", "object": box})
            result = arm.finish(move)
            commands = np.array(arm.commands)
            arm.step(50)
            clearances.append(referee.clearance(np.array(arm.measured)[when:, :5]))
            length = min(len(commands), len(free))
            differ = np.flatnonzero(np.abs(commands[:length] - free[:length]).max(axis=1) > 1e-6)
            reactions.append(1000 * (int(differ[0]) - when + 1) / rate if len(differ) else np.nan)
            moving = np.flatnonzero(np.abs(np.diff(commands[when:], axis=0)).max(axis=1) > 1e-6)
            stops.append(1000 * (int(moving[-1]) + 1) / rate)
            if result.code.name != "MOTION_PLAN_INVALIDATED_BY_ENVIRONMENT_CHANGE" or "box" not in result.message:
                wrong.append(f"{result.code.name}: {result.message}")
            arm.call("/world/remove", {"name": "box"})
        faults = arm.faults()
    hits = sum(clearance <= 0 for clearance in clearances)
    print(
        f"obstacles: the arm stood before {number - hits} of {number}; clearance at least"
        f" {1000 * min(clearances):.1f} mm (MuJoCo measures up to 20 mm); first slower command"
        f" {np.nanmedian(reactions):.0f} ms after the box appeared, at most {np.nanmax(reactions):.0f};"
        f" at rest after {np.median(stops):.0f} ms, at most {max(stops):.0f}"
        + "".join(f"; {each}" for each in (*wrong, faults) if each),
        flush=True,
    )
    return not hits and not wrong and not faults


def _recorded(arm: Arm, goal: Vector) -> bool:
    arm.commands.clear()
    arm.measured.clear()
    return arm.finish(arm.go(goal)).success


def goals(number: int, seed: int) -> bool:
    rng = np.random.default_rng(seed)
    outcomes: dict[str, int] = {}
    slowest = []
    with run(lockstep=True, seed=seed) as runtime:
        arm, robot = Arm(runtime), runtime.session.config.robot
        lower, upper = robot.lower[:5] * 0.6, robot.upper[:5] * 0.6
        arm.step(5)
        while outcomes.get("CANCELLED", 0) < number:
            move = arm.go(rng.uniform(lower, upper))
            arm.step(int(rng.integers(1, 60)))
            if arm.call("/planning/result", move) is not None:
                continue  # it has ended already, or could not be planned
            if outcomes.get("CANCELLED", 0) % 2:
                arm.call("/planning/cancel", None)
                result = arm.finish(move)
                arm.step(30)
            else:
                before = len(arm.commands)
                following = arm.go(rng.uniform(lower, upper))
                arm.step()
                result = arm.finish(move)
                arm.step(40)
                speeds = np.linalg.norm(np.diff(arm.commands[before - 1 : before + 30], axis=0), axis=1)
                reached = arm.finish(following).success
                if result.outcome == "CANCELLED" and reached and speeds[0] > 0.005:
                    slowest.append(float(speeds.min() / speeds[0]))
                outcomes["next reached"] = outcomes.get("next reached", 0) + reached
            outcomes[result.outcome] = outcomes.get(result.outcome, 0) + 1
        faults = arm.faults()
        ticks = len(arm.commands)
    print(
        f"goals: {number} cancelled or replaced under way ({outcomes}), {ticks} ticks; from one motion to the next the"
        f" joints keep {100 * np.median(slowest):.0f} % of their speed or more (median);"
        f" {faults or 'no command beyond the limits, nothing corrected'}",
        flush=True,
    )
    return not faults


def losses(number: int, seed: int) -> bool:
    rng = np.random.default_rng(seed)
    stops: list[float] = []
    wrong: list[str] = []
    messages: dict[str, str] = {}
    done = slipped = 0
    while done < number:
        cause = CAUSES[done % len(CAUSES)]
        with run({}, lockstep=True, seed=seed) as runtime:
            arm, robot = Arm(runtime), runtime.session.config.robot
            goal = rng.uniform(robot.lower[:5] * 0.6, robot.upper[:5] * 0.6)
            arm.step(5)
            if not (_recorded(arm, goal)):
                continue
            free = np.array(arm.commands)
            rate = runtime.session.config.control.rate_hz
            first, place, last = (
                robot_model(robot).forward(free[i]).position for i in (0, len(free) // 2, len(free) - 1)
            )
        moved = int(np.abs(free[-1, :5] - free[0, :5]).argmax())
        away = min(np.linalg.norm(place - first), np.linalg.norm(place - last))
        if np.ptp(free[:, moved]) < LEAST_WAY_RAD or place[2] < BOX_M or away < 2 * BOX_M:
            continue
        at = 0.06 + 0.4 * len(free) / rate
        if cause == "blocked":
            box = {"shape": "box", "size": [BOX_M] * 3, "position": place.tolist()}
            simulation: dict[str, Any] = {"objects": {"post": box}}
        elif cause == "joint":
            simulation = {"faults": [{"at": at, "kind": "freeze_joint", "joint": ARM_JOINTS[moved]}]}
        else:
            simulation = {"faults": [{"at": at, "kind": "silent"}]}
        with run(simulation, lockstep=True, seed=seed) as runtime:
            arm = Arm(runtime, faulty=True)
            arm.step(5)
            move = arm.go(goal)
            result = arm.finish(move)
            arm.step(80)
            faults = arm.faults(corrections=False)
        if cause == "blocked" and result.success:
            slipped += 1
            continue
        done += 1
        commands = np.array(arm.commands)
        still = np.abs(np.diff(commands, axis=0)).max(axis=1) < 1e-6
        moving = np.flatnonzero(~still)
        stops.append(1000 * (int(moving[-1]) / rate - at))
        named = {"blocked": " off its ", "joint": ARM_JOINTS[moved], "hardware": "state"}[cause]
        messages[cause] = result.message
        if result.code.name != "CONTROL_FAILED" or named not in result.message or faults or not still[-10:].all():
            wrong.append(f"{cause}: {result.code.name}: {result.message} {faults}")
    print(
        f"losses: the arm stopped, and the result named the cause, in {number - len(wrong)} of {number}"
        f" ({slipped} slipped past what was to block them); at rest"
        f" {np.median(stops):.0f} ms after the loss, at most {max(stops):.0f}; the last messages: "
        + "; ".join(messages.values())
        + "".join(f"; WRONG {each}" for each in wrong),
        flush=True,
    )
    return not wrong
