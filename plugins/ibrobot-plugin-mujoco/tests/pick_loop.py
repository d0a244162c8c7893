"""A small lockstep runtime for tests: simulated hardware, safety layer, executor, smoother and policy in one thread."""

from __future__ import annotations

import logging
from pathlib import Path

import attrs
import mujoco
import numpy as np
import so101_nexus
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.policy_options import ScriptedPickOptions
from ibrobot_mujoco.scripted_pick import SCENE, STATE, ScriptedPick

from ibrobot_core.clock import SteppedClock
from ibrobot_core.control.executors.position import PositionExecutor
from ibrobot_core.control.safety import SafetyLayer
from ibrobot_core.dispatch.smoother import TemporalSmoother
from ibrobot_core.executor_options import PositionOptions
from ibrobot_core.interfaces import Context, Episode, Frame, Plan
from ibrobot_core.robot import Description, Joint, Robot, Vector
from ibrobot_core.units import NS_PER_S, seconds

PERIOD_NS = 10_000_000
WATERMARK = 20


def so101() -> Robot:
    """The robot of configs/so101.yaml."""
    ranges = {
        "shoulder_pan": (-1.91986, 1.91986), "shoulder_lift": (-1.74533, 1.74533), "elbow_flex": (-1.69, 1.69),
        "wrist_flex": (-1.65806, 1.65806), "wrist_roll": (-2.74385, 2.74385), "gripper": (-0.17453, 1.74533),
    }  # fmt: skip
    joints = tuple(Joint(name, *limits, 4.0, 40.0 if name == "gripper" else 20.0) for name, limits in ranges.items())
    mjcf = Path(so101_nexus.__file__).parent / "assets" / "SO101_menagerie" / "so101.xml"
    poses = {"home": (0.0,) * 6, "rest": (0.0, -1.57, 1.57, 0.79, 0.0, 0.0)}
    groups = {"arm": tuple(ranges)[:-1], "gripper": ("gripper",)}
    return Robot("so101", joints, groups=groups, description=Description(mjcf=mjcf, poses=poses))


@attrs.define
class Outcome:
    """What an episode came to."""

    success: bool
    success_s: float | None
    """When it first succeeded [s]."""
    commands: Vector
    """What the hardware was told [rad], shape (T, J)."""
    chunks: list[Vector]
    interventions: dict[str, int]
    bumps: set[tuple[str, str]]
    """Pairs of the robot's bodies and the scenery that touched."""


class PickLoop:
    """One robot, one scene, any number of episodes."""

    def __init__(self, simulation: MujocoOptions | None = None, options: ScriptedPickOptions | None = None) -> None:
        self.clock = SteppedClock(NS_PER_S)
        robot = so101()
        ctx = Context("sim", self.clock, logging.getLogger("test"), robot, robot.joint_names, PERIOD_NS)
        self.ctx = ctx
        self.hardware = MujocoHardware(simulation or MujocoOptions(), ctx)
        self.hardware.connect()
        self.policy = ScriptedPick(options or ScriptedPickOptions(), ctx)
        self.policy.load()
        self.scene_index = [signal.topic for signal in self.hardware.signals].index("/simulation/scene")

    def frame(self, position: Vector) -> Frame:
        """The observations of this tick."""
        scene = np.empty(10)
        self.hardware.read_signal(self.scene_index, scene)
        return Frame(self.clock.now_ns(), {STATE: position.astype(np.float32), SCENE: scene.astype(np.float32)})

    def run(self, seed: int, duration_s: float = 8.0, *, disturb: float | None = None) -> Outcome:
        """One episode; at `disturb` [s] the cube is put elsewhere."""
        rate_hz = self.policy.spec.rate_hz or 30.0
        self.hardware.reset(Episode(seed))
        self.policy.reset(seed)
        safety, executor = SafetyLayer(self.ctx.robot, PERIOD_NS), PositionExecutor(PositionOptions(), self.ctx)
        smoother = TemporalSmoother(round(NS_PER_S / rate_hz), 6)
        start_ns = self.clock.now_ns()
        reading = self.hardware.read()
        safety.activate(reading.position)
        executor.activate(reading)
        outcome = Outcome(False, None, np.empty((0, 6)), [], {}, set())
        commands = []
        tick = 0
        for _ in range(round(duration_s * NS_PER_S / PERIOD_NS)):
            now_ns = self.clock.now_ns()
            reading = self.hardware.read()
            if now_ns - start_ns >= tick * NS_PER_S / rate_hz:
                tick += 1
                smoother.trim(now_ns)
                if smoother.remaining(now_ns) <= WATERMARK:
                    inputs = self.policy.preprocess(self.frame(reading.position))
                    chunk = self.policy.postprocess(self.policy.infer(inputs))
                    outcome.chunks.append(chunk)
                    smoother.update(chunk, now_ns)
                    executor.set_plan(Plan(*_plan(smoother)))
            command = safety.apply(executor.update(reading), reading.position)
            self.hardware.write(command)
            commands.append(command)
            self.hardware.advance(PERIOD_NS)
            self.clock.advance(PERIOD_NS)
            self._look(outcome)
            if outcome.success_s is None and self.hardware.success():
                outcome.success_s = seconds(self.clock.now_ns() - start_ns)
        outcome.success = bool(self.hardware.success())
        outcome.commands = np.array(commands)
        outcome.interventions = {kind: n for kind, n in safety.counters().items() if n}
        return outcome

    def _look(self, outcome: Outcome) -> None:
        model, physics = self.hardware._model, self.hardware._physics
        for pair in physics.contact.geom:
            names = [model.geom(int(g)).name for g in pair]
            bodies = [model.body(model.geom(int(g)).bodyid[0]).name for g in pair]
            for mine, other in ((0, 1), (1, 0)):
                if (names[other] == "table" or bodies[other] == "bin") and bodies[mine] not in {"cube", "bin", "base"}:
                    outcome.bumps.add((bodies[mine], names[other]))


def _plan(smoother: TemporalSmoother) -> tuple[int, int, Vector]:
    start_ns, positions = smoother.plan()
    return start_ns, smoother.step_ns, positions
