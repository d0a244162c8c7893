"""Thirty robots on one server with a model of 20 ms: load and latency, with a hiccup, in batches, with a greedy robot.

    python benchmarks/serve_fleet.py [--robots 30] [--seconds 30] [--hiccup 2]

Server and robots are processes of their own, over Zenoh on this machine, ten robots a process. Each robot is a
dispatcher with chunks of 50 actions at 30 Hz, its observations a state and a picture of 96x96. The model takes 20 ms
for each request; in the middle it stands still for `--hiccup` seconds. `watermark: auto` is compared with half a chunk,
the fixed watermark that it starts from; `stepped_fleet.py` tries others, in stepped time. Then the model takes 20 ms
for a batch of any size, as a GPU that is not full does; then one robot more asks in four threads without a pause.

Prints load, latencies [ms] and holds of all robots together, before the hiccup and from 5 s after it. Exits with 1 when
`auto` is worse by more than 10 % than the fixed watermark, or when in batches, with or without the greedy robot, p99 is
60 ms or more.
"""

from __future__ import annotations

import argparse
import json
import logging
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, override

import attrs
import numpy as np
from ibrobot_serve.remote import RemoteEngine
from ibrobot_serve.service import InferenceService, ServiceOptions
from ibrobot_testing import host_context, make_robot
from ibrobot_testing.fakes import FakePolicy
from ibrobot_testing.ports import free_port

from ibrobot_core.bus import Bus
from ibrobot_core.clock import RealClock
from ibrobot_core.config.schema import (
    ActionSpec,
    ContractConfig,
    ControlMode,
    DispatchConfig,
    ExecutorConfig,
    ObservationSpec,
    RobotConfig,
)
from ibrobot_core.contract.specs import Contract
from ibrobot_core.dispatch.dispatcher import Dispatcher
from ibrobot_core.errors import PolicyError
from ibrobot_core.inference.client import Chunk, EngineClient
from ibrobot_core.interfaces import Frame, Policy, Tensors, Transport
from ibrobot_core.messages import Header, JointState
from ibrobot_core.options import NoOptions
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.robot import Vector

MODEL_S, CHUNK, RATE_HZ = 0.02, 50, 30.0
SETTLED_S = 5.0
"""After which a run, and a recovery, is measured."""
P99_LIMIT_MS = 60.0
A_PROCESS = 10
GREEDY_THREADS = 4
STATE = "observation.state"


class TwentyMilliseconds(FakePolicy):
    """A chunk of 50 actions after 20 ms, for each request or for each batch; `busy` has when it was at work [s]."""

    def __init__(self, *, together: bool = False) -> None:
        super().__init__(host_context())
        self.spec = attrs.evolve(self.spec, chunk_size=CHUNK)
        self._together = together
        self.stands_still = threading.Event()
        self.stands_still.set()
        self.busy: list[tuple[float, float]] = []

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        return {"state": frame.values[STATE].astype(np.float64), "top": np.zeros((96, 96, 3), np.uint8)}

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        return self.infer_batch([tensors])[0]

    @override
    def infer_batch(self, batch: Sequence[Tensors]) -> list[Tensors]:
        begun_s = time.monotonic()
        self.stands_still.wait()
        time.sleep(MODEL_S if self._together else MODEL_S * len(batch))
        self.busy.append((begun_s, time.monotonic()))
        return [{"actions": np.repeat(tensors["state"][None], CHUNK, axis=0)} for tensors in batch]

    @override
    def postprocess(self, tensors: Tensors) -> Vector:
        return np.asarray(tensors["actions"], np.float64)


def transport(**options: Any) -> Transport:
    """One of type zenoh."""
    descriptor = installed_plugins().find("transport", "zenoh")
    made: Transport = descriptor.make(descriptor.options(**options), host_context())
    return made


def serve(endpoint: str, batch: int) -> None:
    """The server, until its standard input ends; lines `stop` and `go` there make the model stand still and go on."""
    network = transport(mode="router", listen=(endpoint,))
    policy = TwentyMilliseconds(together=batch > 1)
    service = InferenceService(policy, network, "model", ServiceOptions(batch))
    service.start()
    print("ready", flush=True)
    for line in sys.stdin:
        (policy.stands_still.clear if line == "stop\n" else policy.stands_still.set)()
    print(json.dumps({"busy": policy.busy, "batches": service.statistics()["batches"]}))
    service.close()
    network.close()


class Robot:
    """A dispatcher on its ticks, in a thread."""

    def __init__(
        self,
        number: int,
        network: Transport,
        watermark: Any,
        policy: Policy | None = None,
        send: Callable[[int, int, Vector], None] = lambda *_: None,
    ) -> None:
        robot = self.robot = make_robot()
        joints = robot.joint_names
        config = RobotConfig(
            robot=robot,
            executors={"all": ExecutorConfig("position", NoOptions(), "all", "all", joints)},
            control_modes={"idle": ControlMode(())},
            default_control_mode="idle",
            contract=ContractConfig(
                RATE_HZ,
                observations=(ObservationSpec(STATE, topic="/joint_states"),),
                actions=(ActionSpec("all", "/commands"),),
            ),
        )
        self._clock, self._joints = RealClock(), joints
        self._bus = Bus(self._clock)
        policy = self.policy = policy or TwentyMilliseconds()
        self.engine = RemoteEngine(policy, network, "model", f"robot{number}", start_timeout_s=60.0)
        self._client = EngineClient(policy, self.engine, 5.0)
        contract = Contract.from_config(config)
        self._step_ns = contract.step_ns
        self.dispatcher = Dispatcher(
            contract, policy.spec, DispatchConfig(watermark), robot, self._bus, self._client, send, 5.0
        )
        self.chunks: list[tuple[float, float]] = []
        """When each came [s], and its latency [ms]."""
        self.holds: list[float] = []
        """When the plan ran dry [s]."""

    def start(self) -> None:
        """Wait for the server."""
        self.engine.start()

    def after_tick(self, now_ns: int) -> None:
        """What else to do in each tick."""

    def after_chunk(self, chunk: Chunk) -> None:
        """What else to do with each answer or error."""

    def run(self, until_s: float) -> None:
        """Go on until a time, which may be changed meanwhile."""
        self.until_s = until_s
        self.dispatcher.begin(0)
        next_ns, stats = self._clock.now_ns(), self.dispatcher.stats
        while time.monotonic() < self.until_s:
            chunk = self._client.poll(max(0.0, (next_ns - self._clock.now_ns()) / 1e9))
            if chunk is not None:
                self.after_chunk(chunk)
                before = stats.chunks
                self.dispatcher.accept(chunk, self._clock.now_ns())
                if stats.chunks > before:
                    self.chunks.append((time.monotonic(), stats.latency_ms))
            if (now_ns := self._clock.now_ns()) >= next_ns:
                holds = stats.holds
                self._bus.publish(
                    "/joint_states", JointState(Header(now_ns), self._joints, np.zeros(len(self._joints)))
                )
                self.dispatcher.tick(now_ns)
                self.holds += [time.monotonic()] * (stats.holds - holds)
                self.after_tick(now_ns)
                next_ns += self._step_ns
        self._client.close()
        self.engine.close()


def robots(endpoint: str, first: int, count: int, watermark: Any) -> None:
    """Some robots, from a line with the time of their end [s] on; what they counted is the last line."""
    network = transport(connect=(endpoint,))
    fleet = [Robot(first + i, network, watermark) for i in range(count)]
    for robot in fleet:
        robot.start()
    print("ready", flush=True)
    until_s = float(sys.stdin.readline())
    threads = [threading.Thread(target=robot.run, args=(until_s,)) for robot in fleet]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print(json.dumps([{"chunks": robot.chunks, "holds": robot.holds} for robot in fleet]))
    network.close()


def greedy(endpoint: str) -> None:
    """A robot that asks in several threads without a pause, until a time that is given by a line [s]."""
    network = transport(connect=(endpoint,))
    engines = [RemoteEngine(TwentyMilliseconds(), network, "model", "greedy") for _ in range(GREEDY_THREADS)]
    for engine in engines[1:]:
        engine._robot = engines[0]._robot  # one robot with several requests at a time
    engines[0].start()
    print("ready", flush=True)
    until_s = float(sys.stdin.readline())

    def ask(engine: RemoteEngine) -> None:
        tensors = {"state": np.arange(6.0), "top": np.zeros((96, 96, 3), np.uint8)}
        while time.monotonic() < until_s:
            try:
                engine.infer(tensors, 1, time.monotonic_ns() + 2_000_000_000)
            except PolicyError:
                time.sleep(0.001)  # a newer request took its place

    threads = [threading.Thread(target=ask, args=(engine,)) for engine in engines]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print("[]")
    network.close()


def started(*arguments: object) -> subprocess.Popen[str]:
    """This file in a process of its own, ready."""
    command = [sys.executable, __file__, *map(str, arguments)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    if process.stdout.readline() != "ready\n":
        raise SystemExit(f"{arguments[0]} did not start")
    return process


def say(process: subprocess.Popen[str], line: str) -> None:
    """Write a line to a process."""
    assert process.stdin is not None
    process.stdin.write(f"{line}\n")
    process.stdin.flush()


def fleet(
    count: int, seconds: float, watermark: str, *, hiccup_s: float = 0.0, batch: int = 1, with_greedy: bool = False
) -> dict[str, dict[str, Any]]:
    """One round, before the hiccup and after it."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    server = started("--serve", endpoint, "--batch", batch)
    asking = [
        started(
            "--first", first, "--count", min(A_PROCESS, count - first), "--endpoint", endpoint, "--fixed", watermark
        )
        for first in range(0, count, A_PROCESS)
    ]
    asking += [started("--greedy", "--endpoint", endpoint)] if with_greedy else []
    begun_s = time.monotonic()
    stop_s, end_s = begun_s + seconds / 2, begun_s + seconds + hiccup_s
    for process in asking:
        say(process, str(end_s))
    if hiccup_s:
        time.sleep(stop_s - time.monotonic())
        say(server, "stop")
        time.sleep(hiccup_s)
        say(server, "go")
    answers = [robot for process in asking for robot in json.loads(process.communicate()[0].splitlines()[-1])]
    busy = json.loads(server.communicate()[0].splitlines()[-1])["busy"]
    parts = {"before": (begun_s + SETTLED_S, stop_s), "after": (stop_s + hiccup_s + SETTLED_S, end_s)}
    return {name: _measured(answers, busy, *part) for name, part in parts.items()}


def _measured(answers: list[Any], busy: list[tuple[float, float]], begin_s: float, end_s: float) -> dict[str, Any]:
    worked = sum(max(0.0, min(done, end_s) - max(begun, begin_s)) for begun, done in busy)
    latencies = [latency for robot in answers for at, latency in robot["chunks"] if begin_s <= at < end_s]
    p50, p99 = np.percentile(latencies, [50, 99])
    return {
        "load": round(worked / (end_s - begin_s), 3),
        "p50_ms": round(float(p50), 1),
        "p99_ms": round(float(p99), 1),
        "holds": sum(begin_s <= at < end_s for robot in answers for at in robot["holds"]),
        "chunks": len(latencies),
    }


def main() -> int:
    """All rounds; 1 when a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--robots", type=int, default=30)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--hiccup", type=float, default=2.0)
    for hidden in ("serve", "endpoint", "fixed"):
        parser.add_argument(f"--{hidden}", help=argparse.SUPPRESS)
    for hidden in ("batch", "first", "count"):
        parser.add_argument(f"--{hidden}", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--greedy", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    logging.disable(logging.CRITICAL)
    if given.serve:
        serve(given.serve, given.batch)
        return 0
    if given.greedy:
        greedy(given.endpoint)
        return 0
    if given.count is not None:
        robots(given.endpoint, given.first, given.count, given.fixed if given.fixed == "auto" else int(given.fixed))
        return 0
    rounds = {
        "fixed": fleet(given.robots, given.seconds, str(CHUNK // 2), hiccup_s=given.hiccup),
        "auto": fleet(given.robots, given.seconds, "auto", hiccup_s=given.hiccup),
        "batches": fleet(given.robots, given.seconds, "auto", batch=8),
        "greedy": fleet(given.robots, given.seconds, "auto", batch=8, with_greedy=True),
    }
    for name, phases in rounds.items():
        print(json.dumps({"round": name, **phases}))
    worse = [
        f"{phase}: {name}"
        for phase in ("before", "after")
        for name in ("load", "p50_ms", "p99_ms", "holds")
        if rounds["auto"][phase][name] > 1.1 * rounds["fixed"][phase][name]
    ]
    slow = [name for name in ("batches", "greedy") if rounds[name]["before"]["p99_ms"] >= P99_LIMIT_MS]
    print(json.dumps({"auto_worse_by_10_percent": worse, "too_slow": slow}))
    return int(bool(worse or slow))


if __name__ == "__main__":
    sys.exit(main())
