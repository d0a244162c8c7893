"""A lockstep runtime of a few lines: simulated hardware, safety layer, executor, smoother and policy in one thread."""

from __future__ import annotations

import logging
from time import perf_counter

import attrs
import mujoco
import numpy as np
from ibrobot_mujoco.experts import EXPERTS
from ibrobot_mujoco.experts.expert import SCENE, STATE
from ibrobot_mujoco.experts.options import ExpertOptions
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.scenes.pick_cube import BIN, CUBE
from ibrobot_mujoco.scenes.table import TABLE
from ibrobot_mujoco.so101 import so101
from ibrobot_mujoco.state import PHYSICS_TOPIC, SCENE_TOPIC, DrawnWorld

from ibrobot_core.api import NS_PER_S, Context, EpisodeSetup, Executor, Frame, Plan, SteppedClock, Vector, seconds
from ibrobot_core.app import installed_plugins
from ibrobot_core.control.safety import SafetyLayer
from ibrobot_core.dispatch.smoother import TemporalSmoother

RATE_HZ = 30
PERIOD_NS = 10_000_000
WATERMARK = 20


@attrs.define
class Outcome:
    """What an episode came to. Times are since it began."""

    success: bool = False
    success_s: float | None = None
    """When it first succeeded."""
    commands: list[Vector] = attrs.field(factory=list)
    """The hardware's command of each tick [rad], shape (J,)."""
    chunks: list[tuple[float, Vector]] = attrs.field(factory=list)
    """When each chunk was asked for, and its actions, shape (N, J)."""
    infer_s: list[float] = attrs.field(factory=list)
    """What each chunk took."""
    interventions: dict[str, int] = attrs.field(factory=dict)
    """The safety layer's counters that are not zero."""
    bumps: set[tuple[str, str]] = attrs.field(factory=set)
    """Which body of the robot touched which geom of the scenery."""


class PickLoop:
    """One robot in one scene, for any number of episodes."""

    def __init__(self, simulation: MujocoOptions | None = None, options: ExpertOptions | None = None) -> None:
        simulation, robot = simulation or MujocoOptions(), so101()
        self.clock = SteppedClock(NS_PER_S)
        self.ctx = Context("loop", self.clock, logging.getLogger("ibrobot.test"), robot, robot.joint_names, PERIOD_NS)
        self.hardware = MujocoHardware(simulation, self.ctx)
        self.hardware.connect()
        self.policy = EXPERTS[0].make(options or ExpertOptions(), self.ctx)
        self.policy.load()
        self._watch = DrawnWorld.of(simulation, robot, visual=False)

    def run(self, seed: int, duration_s: float = 6.5) -> Outcome:
        """One episode."""
        self.hardware.reset(EpisodeSetup(seed))
        self.policy.reset(seed)
        robot, outcome = self.ctx.robot, Outcome()
        position = installed_plugins().find("executor", "position")
        safety, executor = SafetyLayer(robot, PERIOD_NS), position.make(position.options(), self.ctx)
        smoother = TemporalSmoother(round(NS_PER_S / RATE_HZ), len(robot.joints))
        reading = self.hardware.read()
        safety.activate(reading.position)
        executor.activate(reading)
        begin_ns, observed = self.clock.now_ns(), 0
        for _ in range(round(duration_s * NS_PER_S / PERIOD_NS)):
            reading = self.hardware.read()
            elapsed_s = seconds(self.clock.now_ns() - begin_ns)
            # An observation is at the first control tick after it is due, so its stamps jitter by up to a period.
            if elapsed_s >= observed / RATE_HZ:
                observed += 1
                self._dispatch(reading.position, smoother, executor, outcome, elapsed_s)
            outcome.commands.append(safety.apply(executor.update(reading), reading.position))
            self.hardware.write(outcome.commands[-1])
            self.hardware.advance(PERIOD_NS)
            self.clock.advance(PERIOD_NS)
            self._look(outcome)
            if outcome.success_s is None and self.hardware.success():
                outcome.success_s = seconds(self.clock.now_ns() - begin_ns)
        outcome.success = bool(self.hardware.success())
        outcome.interventions = {kind: count for kind, count in safety.counters().items() if count}
        return outcome

    def _dispatch(
        self, position: Vector, smoother: TemporalSmoother, executor: Executor, outcome: Outcome, now_s: float
    ) -> None:
        """Ask for a chunk where the plan has come down to the watermark."""
        now_ns = self.clock.now_ns()
        smoother.trim(now_ns)
        if smoother.remaining(now_ns) > WATERMARK:
            return
        values = {STATE: position.astype(np.float32), SCENE: self._signal(SCENE_TOPIC).astype(np.float32)}
        begin = perf_counter()
        chunk = self.policy.postprocess(self.policy.infer(self.policy.preprocess(Frame(now_ns, values))))
        outcome.infer_s.append(perf_counter() - begin)
        outcome.chunks.append((now_s, chunk))
        smoother.update(chunk, now_ns)
        start_ns, positions = smoother.plan()
        executor.set_plan(Plan(start_ns, smoother.step_ns, positions))

    def _signal(self, topic: str) -> Vector:
        index, signal = next((i, s) for i, s in enumerate(self.hardware.signals) if s.topic == topic)
        value = np.empty(signal.size)
        self.hardware.read_signal(index, value)
        return value

    def _look(self, outcome: Outcome) -> None:
        """Note where the robot touches table or bin."""
        model, data = self._watch.model, self._watch.data
        self._watch.follow(self._signal(PHYSICS_TOPIC))
        mujoco.mj_collision(model, data)
        for pair in data.contact.geom:
            bodies = [model.body(model.geom_bodyid[geom]).name for geom in pair]
            names = [model.geom(int(geom)).name for geom in pair]
            for mine, other in ((0, 1), (1, 0)):
                scenery = names[other] == TABLE or bodies[other] == BIN
                if scenery and bodies[mine] not in {CUBE, BIN, "base"}:
                    outcome.bumps.add((bodies[mine], names[other]))
