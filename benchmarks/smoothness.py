"""How smoothly the arm moves when the model is slow: replacement, temporal ensemble and real-time chunking compared.

    python benchmarks/smoothness.py [--duration 60] [--chunk 50 100] [--seed 0]

In stepped time, so that equal seeds give equal figures: the whole of control with the simulated SO-101, the dispatcher
with `watermark: auto`, and a model (`flow_policy.py`) whose answers take 50, 200 and 800 ms, each up to 50 % more or
less; 2 % of them never come, and for three seconds none does. Chunks have 50 and 100 actions: 1.7 and 3.3 s. Prints one
JSON object a run, and exits with 1 when a command is beyond the limits of a joint, when the arm holds although no
answer was lost that would have come in time, or when real-time chunking leaves more than half of the jerk.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from itertools import product
from typing import Any, override

import numpy as np
from apparatus import CONFIGS, report
from flow_policy import FlowPolicy

from ibrobot_core.bus import Bus
from ibrobot_core.clock import SteppedClock
from ibrobot_core.config import RobotConfig, load_config
from ibrobot_core.contract.specs import Contract
from ibrobot_core.control.commands import GetCounters
from ibrobot_core.control.host import InlineControl
from ibrobot_core.dispatch.dispatcher import Dispatcher
from ibrobot_core.inference.client import Chunk, DispatchInfer, InferenceClient, LocalEngine, run_policy
from ibrobot_core.interfaces import Policy
from ibrobot_core.interfaces.run_state import ControlState, PlanRecord
from ibrobot_core.messages import Header, JointState
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.robot import Vector
from ibrobot_core.schema import DispatchConfig
from ibrobot_core.units import NS_PER_S, ns

CONFIG = CONFIGS / "so101_blind.yaml"
LATENCIES_MS = (50, 200, 800)
STRATEGIES = ("replace", "ensemble", "rtc")
SPREAD, LOSS, OUTAGE_AT_S, OUTAGE_S = 0.5, 0.02, 25.0, 3.0
AWAY_S = 2.0
"""The way from where the arm begins to the first chunk: the same for all, and left out of steps and jerk."""


class SlowClient(InferenceClient):
    """Answers after a random time, or never: a model behind a bad network, in stepped time."""

    parallel = 8  # the network takes the time, not the model

    def __init__(self, policy: Policy, clock: SteppedClock, latency_ns: int, outage: range, seed: int) -> None:
        self._policy, self._engine, self._clock = policy, LocalEngine(policy), clock
        self._latency_ns, self._outage = latency_ns, outage
        self._rng = np.random.default_rng(seed)
        self._coming: list[tuple[int, Chunk]] = []
        self._lost: list[tuple[int, int]] = []
        """When a request was made whose answer never comes, and when that was due [ns]."""
        self._newest_ns = 0
        """Of the observations that were answered."""

    @property
    def owes(self) -> bool:
        """Whether an answer was lost that would be here by now, for newer observations than the newest that came."""
        now_ns = self._clock.now_ns()
        return any(asked_ns > self._newest_ns and due_ns <= now_ns for asked_ns, due_ns in self._lost)

    @override
    def submit(self, request: DispatchInfer) -> None:
        now_ns = self._clock.now_ns()
        due_ns = now_ns + round(self._latency_ns * self._rng.uniform(1 - SPREAD, 1 + SPREAD))
        if self._rng.random() < LOSS or now_ns in self._outage or due_ns in self._outage:
            self._lost.append((now_ns, due_ns))
        else:
            self._coming.append((due_ns, run_policy(self._policy, self._engine, request, due_ns)))

    @override
    def poll(self, timeout_s: float = 0.0) -> Chunk | None:
        for i, (due_ns, _) in enumerate(self._coming):
            if due_ns <= self._clock.now_ns():
                chunk = self._coming.pop(i)[1]
                self._newest_ns = max(self._newest_ns, chunk.start_ns)
                return chunk
        return None

    @override
    def reset(self, seed: int) -> None:
        self._coming.clear()
        self._policy.reset(seed)

    @override
    def close(self) -> None:
        self._coming.clear()


class Arm:
    """Control and dispatcher of a simulated robot, joined as a run joins them."""

    def __init__(self, config: RobotConfig, strategy: str, latency_ms: int, chunk: int, seed: int) -> None:
        self.config = config
        self._seed = seed
        self.clock = SteppedClock(0)
        self.bus = Bus(self.clock)
        self.control = InlineControl(config, installed_plugins(), self.clock, seed, self._publish, lambda _: None)
        self.contract = Contract.from_config(config)
        policy = FlowPolicy(config.robot, self.contract.rate_hz, chunk, seed)
        outage = range(ns(OUTAGE_AT_S), ns(OUTAGE_AT_S + OUTAGE_S))
        self.client = SlowClient(policy, self.clock, latency_ms * 1_000_000, outage, seed)
        self.dispatcher = Dispatcher(
            self.contract,
            policy.spec,
            DispatchConfig(strategy=strategy),
            config.robot,
            self.bus,
            self.client,
            self._send,
            5.0,
        )
        self.commands: list[Vector] = []
        self.holds = {"for_lost_answers": 0, "others": 0}
        """Times the plan ran dry: where an answer would have gone on that was lost, as all in the outage are; else."""

    def run(self, duration_s: float) -> None:
        """So many seconds."""
        self.control.start()
        self._generation = int(self.control.call(GetCounters())["generation"])
        self.dispatcher.begin(self._seed)
        period_ns = ns(1 / self.config.control.rate_hz)
        next_ns = begin_ns = self.clock.now_ns()
        while self.clock.now_ns() < begin_ns + duration_s * NS_PER_S:
            self.control.step()
            now_ns = self.bus.snapshot_ns()
            while (chunk := self.client.poll()) is not None:
                self.dispatcher.accept(chunk, now_ns)
            if now_ns >= next_ns:
                holds = self.dispatcher.stats.holds
                self.dispatcher.tick(next_ns)
                why = "for_lost_answers" if self.client.owes else "others"
                self.holds[why] += self.dispatcher.stats.holds - holds
                next_ns += self.contract.step_ns
            self.clock.advance(period_ns)
        self.commanded = np.array(self.commands)
        self.control.stop()

    def _publish(self, state: ControlState) -> None:
        names = self.config.robot.joint_names
        self.bus.publish("/joint_states", JointState(Header(state.stamp_ns), names, state.position, state.velocity))
        self.commands.append(state.command.copy())

    def _send(self, start_ns: int, step_ns: int, positions: Vector) -> None:
        mask = np.ones(len(self.config.robot.joints), dtype=bool)
        self.control.write_plan(PlanRecord(self._generation, start_ns, step_ns, mask, positions))


def measure(
    config: RobotConfig, strategy: str, latency_ms: int, chunk: int, duration_s: float, seed: int
) -> dict[str, Any]:
    arm = Arm(config, strategy, latency_ms, chunk, seed)
    arm.run(duration_s)
    stats, robot = arm.dispatcher.stats, config.robot
    period_s = 1 / config.control.rate_hz
    speed = np.abs(np.diff(arm.commanded, axis=0)) / period_s / robot.max_velocity
    acceleration = np.abs(np.diff(arm.commanded, 2, axis=0)) / period_s**2 / robot.max_acceleration
    moving = arm.commanded[round(AWAY_S / period_s) :]
    jerk = np.diff(moving, 3, axis=0) / period_s**3
    safety = arm.control.report["counters"]["safety"]
    return {
        "strategy": strategy,
        "chunk": chunk,
        "latency_ms": latency_ms,
        "largest_step_mrad": round(1e3 * float(np.abs(np.diff(moving, axis=0)).max()), 1),
        "rms_jerk": round(float(np.sqrt((jerk**2).mean())), 1),
        "of_velocity_limit": round(float(speed.max()), 6),
        "of_acceleration_limit": round(float(acceleration.max()), 6),
        "limited_joint_ticks": safety["velocity"] + safety["acceleration"],
        "holds": arm.holds,
        "requests": stats.requests,
        "retries": stats.retries,
        "measured_ms": {"p50": round(stats.latency_p50_ms), "p99": round(stats.latency_p99_ms)},
    }


def missed(results: list[dict[str, Any]]) -> Iterator[str]:
    """What misses its limit."""
    for result in results:
        name = f"{result['strategy']}, {result['chunk']} actions, {result['latency_ms']} ms"
        for limit in ("velocity", "acceleration"):
            if result[f"of_{limit}_limit"] > 1.000001:
                yield f"{name}: a command beyond the {limit} limit"
        if result["holds"]["others"]:
            yield f"{name}: {result['holds']['others']} holds though no answer was lost"
        alike = [r for r in results if r["latency_ms"] == result["latency_ms"] and r["chunk"] == result["chunk"]]
        others = [r["rms_jerk"] for r in alike if r is not result]
        if result["strategy"] == "rtc" and 2 * result["rms_jerk"] > min(others):
            yield f"{name}: more than half of the jerk without"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--duration", type=float, default=60.0, help="of each run [s]; the outage is from 25 to 28 s")
    parser.add_argument("--chunk", type=int, nargs="+", default=[50, 100], help="actions in a chunk")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    config = load_config(CONFIG, sim=True)
    results = []
    for chunk, latency_ms, strategy in product(arguments.chunk, LATENCIES_MS, STRATEGIES):
        results.append(measure(config, strategy, latency_ms, chunk, arguments.duration, arguments.seed))
        print(json.dumps(results[-1]), flush=True)
    problems = list(missed(results))
    jerks = {s: np.mean([r["rms_jerk"] for r in results if r["strategy"] == s]) for s in STRATEGIES}
    report(
        jerk_of_rtc=float(jerks["rtc"] / min(jerks["replace"], jerks["ensemble"])),
        of_velocity_limit=max(r["of_velocity_limit"] for r in results),
        of_acceleration_limit=max(r["of_acceleration_limit"] for r in results),
        needless_holds=sum(r["holds"]["others"] for r in results),
    )
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
