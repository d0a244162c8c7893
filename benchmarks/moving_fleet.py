"""Fifty dispatchers on three servers of one model: one server is killed, one drained for an update, one a canary.

    python benchmarks/moving_fleet.py [--robots 50] [--seconds 10]
    python benchmarks/moving_fleet.py --faults [--robots 12] [--seconds 30]

Three `ibrobot serve` with a model of 20 ms a request, over Zenoh on this machine, with `lease=0.7`. Each robot is a
dispatcher with chunks of 50 actions at 30 Hz along a sine, ten robots a process, an episode every 8 s. After
`--seconds` each: one server gets `kill -9` and starts again; one is stopped (SIGSTOP) until its lease has run out, and
continues; one gets SIGTERM, ends, and starts again as a canary for 10 % of the robots, with other weights.

Prints for each phase p50 and p99 of the latency [ms], holds (plans that ran out), and the number of robots of each
server; for each event, how many robots the server had, and the seconds until the last of them had the answer to what it
asked, or had asked when its server went. Exits with 1 when that is more than a second, when setpoints moved faster
than their joint may, an answer was to another request, no robot tried the canary, or the drained server failed.

With `--faults` there are four servers and twelve robots: a server whose model works, one whose model raises at every
request, one that takes 500 ms, and a canary for 30 % whose model raises. Prints for each robot its largest number of
failed requests in a row, and for each server its requests, errors, latency, state and robots. Exits with 1 when a robot
had more than two failures in a row, a faulty server got no robot, or a robot is at the slow server or a faulty canary
at the end; robots may try the ordinary server that raises again, which the working one then answers for.
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
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
from figures import report
from fleet_robot import RATE_HZ, Robot, transport
from ibrobot_serve.wire import health_name
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy
from ibrobot_testing.ports import free_port
from made_up import plugin

from ibrobot_core.inference.client import Chunk
from ibrobot_core.interfaces import Frame, Tensors, Transport
from ibrobot_core.robot import Vector

CHUNK = 50
A_PROCESS = 10
"""Robots."""
EPISODE_S, LEASE_S, AGAIN_S = 8.0, 0.7, 1.0
FAULTS = {"works": "", "raises": "raises", "slow": "slow", "canary": "raises"}
"""What is wrong with the models of `--faults`."""
CANARY_SHARE, MOST_FAILURES = 30, 2
REPLACED = "replaced by the newer request"
PLUGIN = """
import time
from pathlib import Path
import attrs
import numpy as np
from ibrobot_core import hookimpl
from ibrobot_core.descriptors import PolicyDescriptor
from ibrobot_core.options import option
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy

@attrs.frozen
class GivenOptions(Options):
    path: Path = option(help="a folder with the files `weights` and `fault`")

class Sine(FakePolicy):
    def __init__(self, options, ctx):
        super().__init__(host_context())
        self.spec = attrs.evolve(self.spec, chunk_size=50)
        self._weights = (options.path / "weights").read_text()
        self._fault = (options.path / "fault").read_text()
    def load(self):
        pass
    def weights(self):
        return self._weights
    def infer(self, tensors):
        time.sleep(0.5 if self._fault == "slow" else 0.02)
        if self._fault == "raises":
            raise RuntimeError("CUDA error: device-side assert triggered")
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


class MovingRobot(Robot):
    """A dispatcher whose steps and servers are written down; an episode every 8 s."""

    def __init__(self, number: int, network: Transport) -> None:
        super().__init__(number, network, "auto", Sine(), self._take)
        # Names without chance: robots draw by them whether they try a canary.
        self.engine._robot = self.engine._choice.robot = f"robot{number}"
        self._plan: tuple[int, int, Vector] | None = None
        self._last: tuple[int, Vector] | None = None
        """The last setpoint and its time [ns]; None while the arm holds."""
        self._episode_s = time.monotonic() + EPISODE_S * (1 + number % A_PROCESS / A_PROCESS)
        self.worst = 0.0
        """Greatest speed of a joint between setpoints, as a share of its limit, unless the arm held in between."""
        self.servers: list[tuple[float, str]] = []
        """When the robot came to which server [s]."""
        self.failures: list[bool] = []
        """Whether each request failed, but for those in whose place the robot itself sent a newer one."""
        self.replaced = 0

    @override
    def after_chunk(self, chunk: Chunk) -> None:
        if REPLACED in chunk.error:
            self.replaced += 1
        else:
            self.failures.append(chunk.actions is None)

    def _take(self, start_ns: int, step_ns: int, positions: Vector) -> None:
        self._plan = (start_ns, step_ns, positions)

    @override
    def after_tick(self, now_ns: int) -> None:
        server = self.engine._last_server
        if not self.servers or self.servers[-1][1] != server:
            self.servers.append((time.monotonic(), server))
        if time.monotonic() > self._episode_s:
            self._episode_s += EPISODE_S
            self._plan = None
            self.dispatcher.begin(int(self._episode_s))
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
            most = np.array([joint.max_velocity for joint in self.robot.joints]) * max(step_ns, at_ns - last[0]) / 1e9
            self.worst = max(self.worst, float((np.abs(at - last[1]) / most).max()))

    def report(self) -> dict[str, Any]:
        """All that was counted, as JSON values."""
        assert isinstance(self.policy, Sine)
        return {
            "chunks": self.chunks,
            "holds": self.holds,
            "worst": self.worst,
            "servers": self.servers,
            "wrong": self.policy.wrong,
            "failures": self.engine.stats.failures,
            "requests": len(self.failures),
            "replaced": self.replaced,
            "failed": sum(self.failures),
            "in_a_row": max((len(list(row)) for failed, row in groupby(self.failures) if failed), default=0),
        }


def robots(endpoints: list[str], first: int, count: int) -> None:
    """Some robots, until a line comes; what they counted is the last line."""
    network = transport(mode="peer", connect=tuple(endpoints))
    fleet = [MovingRobot(first + i, network) for i in range(count)]
    for robot in fleet:
        robot.start()
    print("ready", flush=True)
    threads = [threading.Thread(target=robot.run, args=(float("inf"),)) for robot in fleet]
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
        command = [sys.executable, "-c", "from ibrobot_core.cli.main import main; main()", "serve", str(model)]
        command += ["--type", "sine", "--name", "model", "--listen", endpoint, "--transport", f"lease={LEASE_S}"]
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


def folder(root: Path, name: str, weights: str, fault: str = "") -> Path:
    """A model."""
    made = root / name
    made.mkdir()
    (made / "weights").write_text(weights)
    (made / "fault").write_text(fault)
    return made


def started(arguments: list[str]) -> subprocess.Popen[str]:
    """Robots in a process of their own, ready."""
    process = subprocess.Popen(
        [sys.executable, __file__, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    if process.stdout.readline() != "ready\n":
        raise SystemExit("robots did not start")
    return process


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


def fleet(endpoints: list[str], count: int) -> list[subprocess.Popen[str]]:
    """Robots at these servers, ready."""
    shares = [(first, min(A_PROCESS, count - first)) for first in range(0, count, A_PROCESS)]
    return [
        started(["--endpoints", *endpoints, "--first", str(first), "--count", str(share)]) for first, share in shares
    ]


def ended(asking: list[subprocess.Popen[str]]) -> list[Any]:
    """What the robots counted until now."""
    for process in asking:
        assert process.stdin is not None
        process.stdin.write("end\n")
        process.stdin.flush()
    return [robot for process in asking for robot in json.loads(process.communicate()[0].splitlines()[-1])]


def run(count: int, seconds: float, root: Path) -> int:
    """All phases; 1 when a limit is missed."""
    models = {name: folder(root, name, weights=name) for name in ("old", "new")}
    endpoints = [f"tcp/127.0.0.1:{free_port()}" for _ in range(3)]
    servers = [Server(models["old"], endpoint) for endpoint in endpoints]
    asking = fleet(endpoints, count)
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


def health(endpoint: str) -> dict[str, Any]:
    """What a server says of itself."""
    network = transport(mode="client", connect=(endpoint,))
    try:
        answer: dict[str, Any] = json.loads(bytes(network.request(health_name("model"), b"", 5.0)))
    finally:
        network.close()
    return answer


def run_faults(count: int, seconds: float, root: Path) -> int:
    """Servers with faults; 1 when a limit is missed."""
    endpoints = {name: f"tcp/127.0.0.1:{free_port()}" for name in FAULTS}

    def serve(name: str) -> Server:
        canary = name == "canary"
        model = folder(root, name, weights="new" if canary else "old", fault=FAULTS[name])
        return Server(model, endpoints[name], *(("--canary", f"{CANARY_SHARE}%") if canary else ()))

    with ThreadPoolExecutor() as pool:
        servers = dict(zip(FAULTS, pool.map(serve, FAULTS), strict=True))
    asking = fleet([*endpoints.values()], count)
    time.sleep(seconds)
    states = {name: health(endpoint) for name, endpoint in endpoints.items()}
    answers = ended(asking)
    for server in servers.values():
        server.signal(signal.SIGTERM)
    for server in servers.values():
        server.end()

    print(f"{'robot':>8} {'requests':>8} {'replaced':>8} {'failed':>8} {'in a row':>8}  servers")
    names = {server.id: name for name, server in servers.items()}
    ways = [[names[server] for _, server in robot["servers"]] for robot in answers]
    for number, (robot, way) in enumerate(zip(answers, ways, strict=True)):
        figures = " ".join(f"{robot[key]:>8}" for key in ("requests", "replaced", "failed", "in_a_row"))
        print(f"{number:>8} {figures}  {' -> '.join(way)}")
    print(
        f"\n{'server':>8} {'requests':>8} {'errors':>8} {'p50 ms':>8} {'p99 ms':>8} {'state':>8} {'robots':>8}",
        "at the end",
    )
    ever = {name: sum(name in way for way in ways) for name in FAULTS}
    last = {name: sum(name == way[-1] for way in ways) for name in FAULTS}
    for name, state in states.items():
        keys = ("requests", "failed", "latency_p50_ms", "latency_p99_ms", "state")
        print(f"{name:>8} {' '.join(f'{state[key]:>8}' for key in keys)} {ever[name]:>8} {last[name]:>10}")
    worst = max(robot["in_a_row"] for robot in answers)
    unused = [name for name in FAULTS if not ever[name]]
    stayed = [name for name in ("slow", "canary") if last[name]]
    share = states["canary"]["requests"] / sum(state["requests"] for state in states.values())
    tried = f"{ever['canary']} of {count} tried it, with {share:.1%} of all requests"
    print(f"\nthe canary asks for {CANARY_SHARE} % of the robots: {tried}; {last['canary']} are there at the end")
    print(f"failed requests in a row: at most {worst}")
    print(f"servers without robots: {', '.join(unused) or 'none'}; servers not left: {', '.join(stayed) or 'none'}")
    wrong = sum(robot["wrong"] for robot in answers)
    report(failed_in_a_row=worst, canary_share=share, not_left=len(stayed), wrong_answers=wrong)
    return int(bool(worst > MOST_FAILURES or unused or stayed or wrong))


def main() -> int:
    """As a made-up plugin, which `ibrobot serve` finds."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--faults", action="store_true")
    parser.add_argument("--robots", type=int)
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--endpoints", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--first", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--count", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.endpoints:
        logging.disable(logging.CRITICAL)
        robots(given.endpoints, given.first, given.count)
        return 0
    with plugin("sine_parts", PLUGIN) as root:
        if given.faults:
            return run_faults(given.robots or 12, given.seconds or 30.0, root)
        return run(given.robots or 50, given.seconds or 10.0, root)


if __name__ == "__main__":
    sys.exit(main())
