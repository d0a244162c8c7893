"""Thirty robots on one model of 20 ms, in stepped time: load, latency and holds by watermark, and after a hiccup.

    python benchmarks/stepped_fleet.py [--robots 30] [--seconds 60] [--hiccup 2] [--watermark 5 10 15 20 25 28 30]

The dispatchers, the server's queue and its pacing are the real ones; network, model and clock are simulated, so that
equal arguments give equal figures. A robot asks for chunks of 50 actions at 30 Hz; the model takes 20 ms for each
request, and in the middle of the run stands still for `--hiccup` seconds. Prints one JSON object for each watermark:
load, latency, holds, and the mean age of the observations that an arm acts on. The best fixed watermark is the one
with the least age and no holds; exits with 1 when `auto` is worse by more than 10 % in anything, once it has settled.
"""

from __future__ import annotations

import argparse
import heapq
import json
import logging
import sys
from collections.abc import Callable
from itertools import count, pairwise
from typing import Any, override

import attrs
import numpy as np
from apparatus import report
from ibrobot_serve.fair_queue import FairQueue
from ibrobot_serve.pacing import Pacing
from ibrobot_testing import make_robot

from ibrobot_core.bus import Bus
from ibrobot_core.clock import SteppedClock
from ibrobot_core.contract.specs import Contract
from ibrobot_core.descriptors import Options
from ibrobot_core.dispatch.dispatcher import Dispatcher
from ibrobot_core.inference.client import Chunk, DispatchInfer, InferenceClient
from ibrobot_core.interfaces import PolicySpec
from ibrobot_core.messages import Header, JointState
from ibrobot_core.schema import (
    ActionSpec,
    ContractConfig,
    ControlMode,
    DispatchConfig,
    ExecutorConfig,
    ObservationSpec,
    RobotConfig,
)
from ibrobot_core.units import ns

RATE_HZ, CHUNK = 30.0, 50
MODEL_NS, NETWORK_NS = 20_000_000, 2_000_000
REQUEST_TIMEOUT_S = 5.0
START_S = 0.3
"""Within which all robots start."""
SETTLED_S = 5.0
"""After which a run, and a recovery, is measured."""


def fleet_contract() -> Contract:
    """Of the robot for tests: its policy sees and moves all joints."""
    robot = make_robot()
    state = ObservationSpec("observation.state", topic="/joint_states")
    config = RobotConfig(
        robot=robot,
        executors={"all": ExecutorConfig("position", Options(), "all", "all", robot.joint_names)},
        control_modes={"idle": ControlMode(())},
        default_control_mode="idle",
        contract=ContractConfig(RATE_HZ, observations=(state,), actions=(ActionSpec("all", "/commands"),)),
    )
    return Contract.from_config(config)


class Events:
    """What happens when, in stepped time."""

    def __init__(self) -> None:
        self.clock = SteppedClock(0)
        self._coming: list[tuple[int, int, Callable[[], object]]] = []
        self._numbers = count()

    def at(self, time_ns: int, do: Callable[[], object]) -> None:
        """Call `do` at a time [ns]."""
        heapq.heappush(self._coming, (time_ns, next(self._numbers), do))

    def run(self, until_ns: int) -> None:
        """Let everything happen that is due before a time [ns]."""
        while self._coming and self._coming[0][0] < until_ns:
            time_ns, _, do = heapq.heappop(self._coming)
            self.clock.sleep_until(time_ns)
            do()


@attrs.frozen(eq=False)
class Waiting:
    """A request in the server's queue."""

    robot: Robot
    request: DispatchInfer
    arrived_ns: int


class Server:
    """A model that takes 20 ms for each request, behind the queue of `InferenceService`."""

    def __init__(self, events: Events, hiccup: range) -> None:
        self._events = events
        self._hiccup = hiccup
        self._queue: FairQueue[Waiting] = FairQueue(64)
        self._pacing = Pacing()
        self._busy = False
        self.work: list[tuple[int, int]] = []
        """When each request was begun and done [ns]."""

    def receive(self, waiting: Waiting) -> None:
        """A request arrives."""
        self._pacing.ask(waiting.robot.name, waiting.arrived_ns)
        given_up = self._queue.put(waiting.robot.name, waiting)
        if given_up is not None:
            self._send(given_up, Chunk(given_up.request.id, 0, None, "not begun"))
        if not self._busy:
            self._begin()

    def _begin(self) -> None:
        now_ns = self._events.clock.now_ns()
        self._busy = len(self._queue) > 0
        if not self._busy:
            return
        (waiting,) = self._queue.take(1, lambda first, other: True)
        done_ns = now_ns + MODEL_NS
        if now_ns < self._hiccup.stop and done_ns >= self._hiccup.start:
            done_ns += self._hiccup.stop - max(now_ns, self._hiccup.start)
        self.work.append((now_ns, done_ns))
        self._events.at(done_ns, lambda: self._end(waiting, now_ns))

    def _end(self, waiting: Waiting, begun_ns: int) -> None:
        frame = waiting.request.frame
        actions = np.repeat(frame.values["observation.state"][None].astype(float), CHUNK, axis=0)
        now_ns = self._events.clock.now_ns()
        self._pacing.work(1, now_ns - begun_ns)
        queued_ns, pace_ns = begun_ns - waiting.arrived_ns, self._pacing.pace_ns(now_ns)
        chunk = Chunk(waiting.request.id, frame.stamp_ns, actions, queued_ns=queued_ns, pace_ns=pace_ns)
        self._send(waiting, chunk)
        self._begin()

    def _send(self, waiting: Waiting, chunk: Chunk) -> None:
        robot = waiting.robot
        self._events.at(self._events.clock.now_ns() + NETWORK_NS, lambda: robot.accept(chunk))


class Robot(InferenceClient):
    """A dispatcher on its own ticks, and its way to the server."""

    def __init__(self, number: int, events: Events, server: Server, watermark: Any, first_ns: int) -> None:
        self.name = f"robot {number}"
        self._events = events
        self._server = server
        self._bus = Bus(events.clock)
        self._answered = False
        self._asked: dict[int, int] = {}
        self.latencies: list[tuple[int, int]] = []
        """When each answer came, and how long after its observation [ns]."""
        self.holds: list[int] = []
        """When the plan ran dry [ns]."""
        robot = make_robot()
        self._joints = robot.joint_names
        contract = fleet_contract()
        spec = PolicySpec({"observation.state": (len(self._joints),)}, self._joints, len(self._joints), CHUNK)
        self._step_ns = contract.step_ns
        self.dispatcher = Dispatcher(
            contract, spec, DispatchConfig(watermark), robot, self._bus, self, lambda *_: None, REQUEST_TIMEOUT_S
        )
        self.dispatcher.begin(0)
        events.at(first_ns, self._tick)

    @property
    @override
    def parallel(self) -> int:
        return 1 if self._answered else 8  # as `EngineClient` finds of a server that is near

    @override
    def submit(self, request: DispatchInfer) -> None:
        now_ns = self._events.clock.now_ns()
        self._asked[request.id] = now_ns
        arrives_ns = now_ns + NETWORK_NS
        self._events.at(arrives_ns, lambda: self._server.receive(Waiting(self, request, arrives_ns)))

    def accept(self, chunk: Chunk) -> None:
        """An answer arrives."""
        now_ns = self._events.clock.now_ns()
        chunks = self.dispatcher.stats.chunks
        self.dispatcher.accept(chunk, now_ns)
        if self.dispatcher.stats.chunks > chunks:
            self._answered = True
            self.latencies.append((now_ns, now_ns - self._asked[chunk.id]))

    def age_ns(self, part: range) -> float:
        """How old the newest observations are that have been answered [ns], mean over a part of the run."""
        came = [(at, latency) for at, latency in self.latencies if at in part]
        ages = [(at, latency, later - at) for (at, latency), (later, _) in pairwise(came)]
        return sum(latency * time + time**2 / 2 for _, latency, time in ages) / sum(time for *_, time in ages)

    @override
    def poll(self, timeout_s: float = 0.0) -> Chunk | None:
        return None

    @override
    def reset(self, seed: int) -> None:
        pass

    @override
    def close(self) -> None:
        pass

    def _tick(self) -> None:
        now_ns, stats = self._events.clock.now_ns(), self.dispatcher.stats
        self._bus.publish("/joint_states", JointState(Header(now_ns), self._joints, np.zeros(len(self._joints))))
        holds = stats.holds
        self.dispatcher.tick(now_ns)
        self.holds += [now_ns] * (stats.holds - holds)
        self._events.at(now_ns + self._step_ns, self._tick)


class Fleet:
    """Robots and their server.

    Args:
        robots: how many.
        watermark: of each.
        seconds: how long to run [s].
        hiccup_s: for how long the model stands still in the middle [s].
    """

    def __init__(self, robots: int, watermark: Any, seconds: float, hiccup_s: float = 0.0, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        events = Events()
        self.seconds = seconds
        self.hiccup = range(ns(seconds / 2), ns(seconds / 2 + hiccup_s))
        self.server = Server(events, self.hiccup)
        starts = np.sort(rng.uniform(0, START_S, robots))
        self.robots = [Robot(i, events, self.server, watermark, ns(start)) for i, start in enumerate(starts)]
        events.run(ns(seconds))

    def measure(self, begin_s: float, end_s: float) -> dict[str, Any]:
        """A part of the run: load, latencies, holds, and how old the observations are that the arms act on."""
        part = range(ns(begin_s), ns(end_s))
        busy = sum(max(0, min(done, part.stop) - max(begun, part.start)) for begun, done in self.server.work)
        latencies = [latency for robot in self.robots for at, latency in robot.latencies if at in part]
        p50, p99 = np.percentile(latencies, [50, 99]) / 1e6
        age = np.mean([robot.age_ns(part) for robot in self.robots]) / 1e6
        return {
            "load": round(busy / len(part), 3),
            "p50_ms": round(float(p50), 1),
            "p99_ms": round(float(p99), 1),
            "age_ms": round(float(age), 1),
            "holds": sum(at in part for robot in self.robots for at in robot.holds),
        }

    def phases(self) -> dict[str, dict[str, Any]]:
        """Before the hiccup, from its begin until 5 s after it, and from then on."""
        begin_s, settled_s = self.hiccup.start / 1e9, self.hiccup.stop / 1e9 + SETTLED_S
        return {
            "before": self.measure(SETTLED_S, begin_s),
            "hiccup": self.measure(begin_s, settled_s),
            "after": self.measure(settled_s, self.seconds),
        }


def worse(auto: dict[str, Any], fixed: dict[str, Any]) -> list[str]:
    """By which figures `auto` is worse than a fixed watermark by more than 10 %."""
    return [name for name in auto if auto[name] > 1.1 * fixed[name]]


def main() -> int:
    """One run for each watermark; 1 when auto is worse than the best fixed one."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--robots", type=int, default=30)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--hiccup", type=float, default=2.0, help="[s]")
    parser.add_argument("--watermark", type=int, nargs="+", default=[5, 10, 15, 20, 25, 28, 30], help="[actions]")
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    runs = {}
    for watermark in ("auto", *given.watermark):
        runs[watermark] = Fleet(given.robots, watermark, given.seconds, given.hiccup).phases()
        print(json.dumps({"watermark": watermark, **runs[watermark]}), flush=True)
    auto = runs.pop("auto")
    problems = []
    for phase in ("before", "after"):
        best = min(runs, key=lambda watermark: (runs[watermark][phase]["holds"], runs[watermark][phase]["age_ms"]))
        problems += worse(auto[phase], runs[best][phase])
        print(json.dumps({"phase": phase, "best": best, "worse": worse(auto[phase], runs[best][phase])}))
    report(
        **{
            f"{name}_{phase}": auto[phase][name]
            for phase in ("before", "after")
            for name in ("load", "p50_ms", "p99_ms")
        }
    )
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
