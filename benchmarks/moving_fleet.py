"""Fifty dispatchers on three servers of one model: one server is killed, one drained for an update, one a canary.

    python benchmarks/moving_fleet.py [--robots 50] [--seconds 10]

Three `ibrobot serve` with a model of 20 ms a request, over Zenoh on this machine, with `lease=0.7`. Each robot is a
dispatcher with chunks of 50 actions at 30 Hz along a sine, ten robots a process, an episode every 8 s. After
`--seconds` each: one server gets `kill -9` and starts again; one is stopped (SIGSTOP) until its lease has run out, and
continues; one gets SIGTERM, ends, and starts again as a canary for 10 % of the robots, with other weights.

Prints for each phase p50 and p99 of the latency [ms], holds (plans that ran out), and the number of robots of each
server; for each event, how many robots the server had, and the seconds until the last of them had the answer to what it
asked, or had asked when its server went. Exits with 1 when that is more than a second, when setpoints moved faster
than their joint may, an answer was to another request, no robot tried the canary, or the drained server failed.
"""

from __future__ import annotations

import argparse
import json
import logging
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
from apparatus import plugin, report, started, transport
from ibrobot_serve.remote import RemoteEngine
from ibrobot_testing import host_context, ibrobot_command, make_robot
from ibrobot_testing.fakes import FakePolicy
from ibrobot_testing.ports import free_port
from stepped_fleet import CHUNK, RATE_HZ, REQUEST_TIMEOUT_S, fleet_contract

from ibrobot_core.bus import Bus
from ibrobot_core.clock import RealClock
from ibrobot_core.dispatch.dispatcher import Dispatcher
from ibrobot_core.inference.client import EngineClient
from ibrobot_core.interfaces import Frame, Tensors, Transport
from ibrobot_core.messages import Header, JointState
from ibrobot_core.robot import Vector
from ibrobot_core.schema import DispatchConfig

A_PROCESS = 10
"""Robots."""
EPISODE_S, LEASE_S, AGAIN_S = 8.0, 0.7, 1.0
PLUGIN = """
import time
from pathlib import Path
import attrs
import numpy as np
from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Options, PolicyDescriptor
from ibrobot_core.options import option
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy

@attrs.frozen
class GivenOptions(Options):
    path: Path = option(help="a folder with the file `weights`")

class Sine(FakePolicy):
    def __init__(self, options, ctx):
        super().__init__(host_context())
        self.spec = attrs.evolve(self.spec, chunk_size=50)
        self._weights = (options.path / "weights").read_text()
    def load(self):
        pass
    def weights(self):
        return self._weights
    def infer(self, tensors):
        time.sleep(0.02)
        at = 0.4 * np.sin(tensors["phase"])
        return {"actions": np.repeat(at[:, None], 6, axis=1), "echo": tensors["number"]}

@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor("sine", lambda options, ctx: Sine(options, ctx), "a sine", options=GivenOptions)
"""


class Sine(FakePolicy):
    """The robot's side: a period of 2 s, and a number that the answer must repeat."""

    def __init__(self) -> None:
        super().__init__(host_context())
        self.spec = attrs.evolve(self.spec, chunk_size=CHUNK)
        self.asked, self.wrong = 0, 0
        self._numbers = threading.local()

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        self.asked += 1
        self._numbers.last = self.asked
        times = frame.stamp_ns / 1e9 + np.arange(CHUNK) / RATE_HZ
        return {
            "phase": np.fmod(times, 2.0) * np.pi,
            "number": np.array([self.asked]),
            "top": np.zeros((96, 96, 3), "u1"),
        }

    @override
    def postprocess(self, tensors: Tensors) -> Vector:
        self.wrong += int(tensors["echo"][0]) != self._numbers.last
        return np.asarray(tensors["actions"], np.float64)


class Robot:
    """A dispatcher on its ticks, in a thread; an episode every 8 s, and its steps and servers are written down."""

    def __init__(self, number: int, network: Transport) -> None:
        robot = make_robot()
        self.policy = Sine()
        self.engine = RemoteEngine(self.policy, network, "model", f"robot{number}", start_timeout_s=60.0)
        # Names without chance: robots draw by them whether they try a canary.
        self.engine._robot = self.engine._choice.robot = f"robot{number}"
        self._clock, self._joints = RealClock(), robot.joint_names
        self._limits = np.array([joint.max_velocity for joint in robot.joints])
        self._bus = Bus(self._clock)
        self._client = EngineClient(self.policy, self.engine, REQUEST_TIMEOUT_S)
        contract = fleet_contract()
        self._step_ns = contract.step_ns
        self._dispatcher = Dispatcher(
            contract, self.policy.spec, DispatchConfig("auto"), robot, self._bus, self._client, self._take,
            REQUEST_TIMEOUT_S,
        )  # fmt: skip
        self._plan: tuple[int, int, Vector] | None = None
        self._last: tuple[int, Vector] | None = None
        """The last setpoint and its time [ns]; None while the arm holds."""
        self._episode_s = time.monotonic() + EPISODE_S * (1 + number % A_PROCESS / A_PROCESS)
        self.until_s = float("inf")
        self.chunks: list[tuple[float, float]] = []
        """When each came [s], and its latency [ms]."""
        self.holds: list[float] = []
        """When the plan ran dry [s]."""
        self.worst = 0.0
        """Greatest speed of a joint between setpoints, as a share of its limit, unless the arm held in between."""
        self.servers: list[tuple[float, str]] = []
        """When the robot came to which server [s]."""

    def run(self) -> None:
        """Go on until `until_s`."""
        self._dispatcher.begin(0)
        next_ns, stats = self._clock.now_ns(), self._dispatcher.stats
        while time.monotonic() < self.until_s:
            chunk = self._client.poll(max(0.0, (next_ns - self._clock.now_ns()) / 1e9))
            if chunk is not None:
                before = stats.chunks
                self._dispatcher.accept(chunk, self._clock.now_ns())
                if stats.chunks > before:
                    self.chunks.append((time.monotonic(), stats.latency_ms))
            if (now_ns := self._clock.now_ns()) >= next_ns:
                holds, state = stats.holds, JointState(Header(now_ns), self._joints, np.zeros(len(self._joints)))
                self._bus.publish("/joint_states", state)
                self._dispatcher.tick(now_ns)
                self.holds += [time.monotonic()] * (stats.holds - holds)
                self._note(now_ns)
                next_ns += self._step_ns
        self._client.close()
        self.engine.close()

    def _take(self, start_ns: int, step_ns: int, positions: Vector) -> None:
        self._plan = (start_ns, step_ns, positions)

    def _note(self, now_ns: int) -> None:
        server = self.engine._last_server
        if not self.servers or self.servers[-1][1] != server:
            self.servers.append((time.monotonic(), server))
        if time.monotonic() > self._episode_s:
            self._episode_s += EPISODE_S
            self._plan = None
            self._dispatcher.begin(int(self._episode_s))
        last, self._last = self._last, None
        if self._plan is None:
            return
        start_ns, step_ns, positions = self._plan
        step = (now_ns - start_ns) // step_ns
        if not 0 <= step < len(positions):  # the arm holds; what follows is led in by the control process
            return
        at_ns, at = start_ns + step * step_ns, positions[step]
        self._last = (at_ns, at)
        if last is not None:  # a tick may come late, and the setpoint is then that of a later time
            most = self._limits * max(step_ns, at_ns - last[0]) / 1e9
            self.worst = max(self.worst, float((np.abs(at - last[1]) / most).max()))

    def report(self) -> dict[str, Any]:
        """All that was counted, as JSON values."""
        names = ("chunks", "holds", "worst", "servers")
        counted = {name: getattr(self, name) for name in names}
        return {**counted, "wrong": self.policy.wrong, "failures": self.engine.stats.failures}


def robots(endpoints: list[str], first: int, count: int) -> None:
    """Some robots, until a line comes; what they counted is the last line."""
    network = transport(mode="peer", connect=tuple(endpoints))
    fleet = [Robot(first + i, network) for i in range(count)]
    for robot in fleet:
        robot.engine.start()
    print("ready", flush=True)
    threads = [threading.Thread(target=robot.run) for robot in fleet]
    for thread in threads:
        thread.start()
    sys.stdin.readline()
    for robot in fleet:
        robot.until_s = 0.0
    for thread in threads:
        thread.join()
    print(json.dumps([robot.report() for robot in fleet]))
    network.close()


class Server:
    """`ibrobot serve` in a process of its own."""

    def __init__(self, model: Path, endpoint: str, *options: str) -> None:
        command = [*ibrobot_command(), "serve", str(model), "--type", "sine", "--name", "model", "--listen", endpoint]
        command += ["--transport", f"lease={LEASE_S}"]
        self._process = subprocess.Popen(
            [*command, *options, "--batch", "1"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self.id = ""
        for line in self._process.stderr:
            if line.startswith("I server "):
                self.id = line.split()[2]
                break
        if "serving" not in self._process.stdout.readline():
            raise SystemExit(f"a server did not start: {self._process.stderr.read()}")

    def signal(self, number: signal.Signals) -> None:
        """Send a signal."""
        self._process.send_signal(number)

    def end(self) -> int:
        """Wait for the end; returns the exit status."""
        self._process.communicate()
        return self._process.returncode


def folder(root: Path, weights: str) -> Path:
    """A model."""
    made = root / weights
    made.mkdir()
    (made / "weights").write_text(weights)
    return made


def again_s(answers: list[Any], server: str, event_s: float) -> tuple[int, float]:
    """How many robots a server had, and seconds until each had an answer after they began to need one elsewhere."""
    waits: list[float] = []
    for robot in answers:
        before = [name for at_s, name in robot["servers"] if at_s <= event_s]
        if before and before[-1] == server:
            moved_s = next((at_s for at_s, name in robot["servers"] if at_s > event_s and name != server), None)
            first_s = next((at_s - latency / 1e3 for at_s, latency in robot["chunks"] if at_s > event_s), None)
            answered_s = next((at_s for at_s, _ in robot["chunks"] if at_s > event_s), None)
            if moved_s is None or first_s is None or answered_s is None:
                return len(waits) + 1, float("inf")
            waits.append(answered_s - max(event_s, first_s))
    return len(waits), round(max(waits, default=0.0), 3)


def measured(answers: list[Any], begin_s: float, end_s: float) -> dict[str, Any]:
    """Latencies and holds of a phase, and how many robots each server had at its end."""
    latencies = [latency for robot in answers for at_s, latency in robot["chunks"] if begin_s <= at_s < end_s]
    p50, p99 = np.percentile(latencies, [50, 99])
    at_end = [[name for at_s, name in robot["servers"] if at_s < end_s][-1] for robot in answers]
    return {
        "p50_ms": round(float(p50), 1),
        "p99_ms": round(float(p99), 1),
        "chunks": len(latencies),
        "holds": sum(begin_s <= at_s < end_s for robot in answers for at_s in robot["holds"]),
        "robots": sorted(map(at_end.count, set(at_end)), reverse=True),
    }


def ended(asking: list[subprocess.Popen[str]]) -> list[Any]:
    """What the robots counted until now."""
    printed = [process.communicate("end\n")[0] for process in asking]
    return [robot for lines in printed for robot in json.loads(lines.splitlines()[-1])]


def run(count: int, seconds: float, root: Path, stack: ExitStack) -> int:
    """All phases; 1 when a limit is missed."""
    models = {name: folder(root, name) for name in ("old", "new")}
    endpoints = [f"tcp/127.0.0.1:{free_port()}" for _ in range(3)]
    servers = [Server(models["old"], endpoint) for endpoint in endpoints]
    shares = [(first, min(A_PROCESS, count - first)) for first in range(0, count, A_PROCESS)]
    asking = [
        stack.enter_context(
            started(__file__, "--endpoints", *endpoints, "--first", first, "--count", share, says="ready")
        )[0]
        for first, share in shares
    ]
    events: dict[str, tuple[str, float]] = {}
    phases = {"before": time.monotonic() + seconds / 2}
    time.sleep(seconds)

    events["killed"] = (servers[0].id, time.monotonic())
    phases["one killed"] = time.monotonic()
    servers[0].signal(signal.SIGKILL)
    servers[0].end()
    time.sleep(seconds)
    servers[0] = Server(models["old"], endpoints[0])

    events["stopped"] = (servers[1].id, time.monotonic())
    phases["one stopped"] = time.monotonic()
    servers[1].signal(signal.SIGSTOP)
    time.sleep(seconds / 2)
    servers[1].signal(signal.SIGCONT)
    time.sleep(seconds / 2)

    events["drained"] = (servers[2].id, time.monotonic())
    phases["one drained"] = time.monotonic()
    servers[2].signal(signal.SIGTERM)
    drained = servers[2].end()
    servers[2] = Server(models["new"], endpoints[2], "--canary", "10%")
    time.sleep(2 * EPISODE_S)
    phases["a canary"] = time.monotonic()
    time.sleep(seconds)
    end_s = time.monotonic()
    answers = ended(asking)
    for server in servers:
        server.signal(signal.SIGTERM)
        server.end()

    ends = [*list(phases.values())[1:], end_s]
    for (name, begin_s), until_s in zip(phases.items(), ends, strict=True):
        print(json.dumps({"phase": name, **measured(answers, begin_s, until_s)}))
    again = {name: again_s(answers, *event) for name, event in events.items()}
    trying = sum(any(server == servers[2].id for _, server in robot["servers"]) for robot in answers)
    summary = {
        "again_s": {name: {"robots": robots, "seconds": seconds} for name, (robots, seconds) in again.items()},
        "canary_robots": trying,
        "worst_step": round(max(robot["worst"] for robot in answers), 3),
        "holds": sum(len(robot["holds"]) for robot in answers),
        "drain_exit": drained,
        "wrong_answers": sum(robot["wrong"] for robot in answers),
        "failures": sum(robot["failures"] for robot in answers),
    }
    print(json.dumps(summary))
    report(
        **{f"{name}_again_s": waited_s for name, (_, waited_s) in again.items()},
        worst_step=summary["worst_step"],
        wrong_answers=summary["wrong_answers"],
    )
    late = [name for name, (_, waited_s) in again.items() if waited_s > AGAIN_S]
    return int(bool(late or drained or summary["wrong_answers"] or summary["worst_step"] > 1 or not trying))


def main() -> int:
    """As a made-up plugin, which `ibrobot serve` finds."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--robots", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each phase")
    parser.add_argument("--endpoints", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--first", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--count", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.endpoints:
        logging.disable(logging.CRITICAL)
        robots(given.endpoints, given.first, given.count)
        return 0
    with plugin("sine_parts", PLUGIN) as root, ExitStack() as stack:
        return run(given.robots, given.seconds, root, stack)


if __name__ == "__main__":
    sys.exit(main())
