"""Generated requests and messages for all services and topics of an SO-101 in motion, from several clients at once.

    python benchmarks/service_requests.py [--requests 5000] [--clients 2] [--seed 0]

They go over Zenoh to a simulation. What it offers comes from its bus, in each mode. Meanwhile one more client keeps the
arm moving, resets it, and enters its modes. It fails if the run ends, if a declared service was never reached, if an
answer or the log shows the environment or an error of Python, if a refused request takes more than a second, or if the
run grows by more than 200 MB within the second in which a request is answered. Requests that are accepted and take
longer are listed: planning has its own time limit. Each client is a process, so that none waits for another's work.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import queue
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from contextlib import suppress
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

from ibrobot_planning.client import Node
from ibrobot_ros2.services import Call, encode_call
from ibrobot_zenoh.sharing import TopicTransport

from ibrobot_core.api import IbrobotError

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "tests" / "shared"))
from plain_requests import CONFIG, EVERYTHING, SECRET, Offered, Requests, declared, offered  # noqa: E402

VALUE = "hunter2-0451"
SHOWN = re.compile(rf"{VALUE}|Traceback|the service failed|\b[A-Z]\w*(Error|Exception): |a bug|{os.environ['HOME']}/")
"""What no answer may show."""
WAITS = ("/moveit_gateway/move_to_pose", "/moveit_gateway/move_to_configuration")
"""They answer when the motion has ended."""
_REFUSED_S = 1.0
"""How long a refusal may take [s]."""
MIB = 1 << 20


def resident(pid: int) -> int:
    """Memory of a process [bytes]."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    return int(re.search(r"VmRSS:\s+(\d+)", status)[1]) * 1024  # type: ignore[index]


def await_port(port: int, run: subprocess.Popen[bytes]) -> None:
    """Wait until a run listens."""
    while run.poll() is None:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            return
        time.sleep(0.1)


class Findings:
    """What clients saw."""

    def __init__(self) -> None:
        self.outcomes = Counter[str]()
        self.reached = Counter[str]()
        """Service -> requests that found it served."""
        self.messages = 0
        self.slowest: dict[str, tuple[float, str]] = {}
        self.refused: tuple[float, str] = (0.0, "")
        self.wrong: list[str] = []

    def add(self, service: str, took_s: float, answer: str, *, accepted: bool, request: str) -> None:
        """Note an answer."""
        self.outcomes["accepted" if accepted else "refused"] += 1
        self.reached[service] += accepted or "nobody serves" not in answer
        self.slowest[service] = max(self.slowest.get(service, (0.0, "")), (took_s, request[:200]))
        if not accepted and service not in WAITS:
            self.refused = max(self.refused, (took_s, f"{service} {request[:300]} -> {answer[:200]}"))
        if shown := SHOWN.search(answer):
            self.wrong.append(f"{service} {request[:300]} -> {answer[:500]} shows {shown[0]!r}")

    def join(self, other: Findings) -> None:
        """Add what another client saw."""
        self.outcomes += other.outcomes
        self.reached.update(other.reached)
        self.messages += other.messages
        for service, slowest in other.slowest.items():
            self.slowest[service] = max(self.slowest.get(service, slowest), slowest)
        self.refused = max(self.refused, other.refused)
        self.wrong += other.wrong


class Memory:
    """Memory of the run [bytes], sampled often.

    Attributes:
        grown: the largest growth within a second.
        now: the newest sample.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._samples = deque[int](maxlen=50)
        self.grown = self.now = 0

    def sample(self) -> None:
        """Take a sample; call it every 20 ms."""
        with suppress(OSError, TypeError):  # the run may end at any time
            self.now = resident(self._pid)
            self._samples.append(self.now)
            self.grown = max(self.grown, self.now - min(self._samples))


def ask(node: Node, service: str, request: Any, findings: Findings) -> None:
    """Call a service, and note the answer, and how long the run took for it."""
    begun, accepted = time.monotonic(), True
    with suppress(IbrobotError):
        encode_call(Call(service, request))  # the call does it again: the client's work, seconds for the largest
    own_s = time.monotonic() - begun
    begun += 2.0 * own_s
    try:
        answer = json.dumps(node.call(service, request))
    except IbrobotError as error:
        answer, accepted = str(error), False
    findings.add(service, time.monotonic() - begun, answer, accepted=accepted, request=repr(request))


def connected(name: str, address: str) -> Node:
    """A client, as soon as the run answers."""
    while True:
        try:
            return Node(name, f"connect=[{address}]")
        except IbrobotError:
            time.sleep(0.5)


def client(
    address: str, number: int, count: int, seed: int, known: Offered, begin: Event, results: Queue[Findings]
) -> None:
    """Ask `count` generated requests, mostly of the service that was reached least, and send as many messages."""
    requests, topics, findings = Requests(seed), sorted(known.topics), Findings()
    begin.wait()
    with connected(f"client{number}", address) as node:
        transport = node._transport
        assert isinstance(transport, TopicTransport)
        served: list[str] = []
        for i in range(count):
            if i % 500 == 499:
                print(f"client {number}: {i + 1} requests", flush=True)
            if i % 10 == 0:
                served = [name for name in node.call("/rosapi/services") if name in known.services]
            least = min(served, key=lambda name: findings.reached[name])
            name = least if i % 2 else requests._random.choice(served)
            ask(node, name, requests.request(known.services[name]), findings)
            topic = topics[i % len(topics)]
            with suppress(IbrobotError):  # the client's own end knows the topic by another type
                transport.publish_message(topic, requests.message(known.topics[topic]))
                findings.messages += 1
    results.put(findings)


def mover(address: str, modes: list[str], ended: threading.Event, moved: list[int]) -> None:
    """Keep the arm moving, in spite of the others, and enter all modes."""
    with connected("mover", address) as node:
        for i in range(1_000_000):
            if ended.is_set():
                return
            for service, request in (
                ("/reset", None),
                ("/set_mode", modes[i // 4 % len(modes)] if i % 4 == 3 else "moveit_planning"),
                ("/planning/go_to", ("home", "shoulder_pan=0.6", "shoulder_pan=-0.6")[i % 3]),
            ):
                try:
                    node.call(service, request)
                    moved[0] += service == "/planning/go_to"
                except IbrobotError:
                    pass
            ended.wait(1.0)


def launched(folder: Path, transport: str) -> subprocess.Popen[bytes]:
    """A run that writes its `log` and `result` into a folder."""
    ibrobot = str(Path(sys.executable).with_name("ibrobot"))
    command = [ibrobot, "launch", str(CONFIG), "--sim", "--mode", "moveit_planning", "--json", "--set", transport]
    command += [part for override in EVERYTHING for part in ("--set", override)]
    with (folder / "log").open("w") as log, (folder / "result").open("w") as result:
        return subprocess.Popen(
            command, env=os.environ | {SECRET: VALUE}, stderr=log, stdout=result, stdin=subprocess.DEVNULL, cwd=folder
        )


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--requests", type=int, default=5000)
    parser.add_argument("--clients", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--port", type=int, default=17447)
    options = parser.parse_args()
    address = f"tcp/127.0.0.1:{options.port}"
    known = offered()
    types = ", ".join(f"{topic}: {min(each)}" for topic, each in known.topics.items())
    share = f"{{services: [{', '.join(known.services)}], subscribe: {{{types}}}}}"
    transport = f"transport={{type: zenoh, mode: router, listen: [{address}], share: {share}}}"
    findings, ended, moved = Findings(), threading.Event(), [0]
    context = multiprocessing.get_context("fork")  # a child inherits what is imported; nothing else runs yet
    begin, results = context.Event(), context.Queue()
    with tempfile.TemporaryDirectory() as folder:
        run = launched(Path(folder), transport)
        try:
            clients = [
                context.Process(
                    target=client,
                    args=(address, i, options.requests // options.clients, options.seed + i, known, begin, results),
                    daemon=True,
                )
                for i in range(options.clients)
            ]
            for each in clients:
                each.start()
            await_port(options.port, run)
            modes = sorted(set(known.modes.values()))
            threading.Thread(target=mover, args=(address, modes, ended, moved), daemon=True).start()
            while moved[0] < 3 and run.poll() is None:  # so that all libraries are loaded
                time.sleep(0.1)
            memory = Memory(run.pid)
            memory.sample()
            before, unread = memory.now, len(clients)
            begin.set()
            while unread and run.poll() is None:
                if not any(each.is_alive() for each in clients) and results.empty():
                    findings.wrong.append("a client died")
                    break
                memory.sample()
                with suppress(queue.Empty):
                    findings.join(results.get(timeout=0.02))
                    unread -= 1
            alive = run.poll() is None
        finally:
            ended.set()
            if run.poll() is None:
                run.send_signal(signal.SIGINT)
            run.wait(30)
        log, result = (Path(folder, name).read_text(encoding="utf-8") for name in ("log", "result"))
    grown = (memory.grown, memory.now - before)
    return report(findings, json.loads(result or "{}"), log, moved[0], grown, alive=alive)


def report(
    findings: Findings, summary: dict[str, Any], log: str, moved: int, grown: tuple[int, int], *, alive: bool
) -> int:
    """Print what was found; 1 if something is wrong. `grown`: memory within a second, and in all [bytes]."""
    print(f"{dict(findings.outcomes)}, {moved} motions of the mover, run alive: {alive}")
    missed = sorted({*declared(), *findings.reached} - {name for name, count in findings.reached.items() if count})
    least = min(findings.reached.items(), key=lambda item: item[1], default=("", 0))
    print(
        f"{len(+findings.reached)} services reached, {least[0]} least: {least[1]} times; {findings.messages} messages"
    )
    print(
        f"memory grew by at most {grown[0] / MIB:.0f} MiB within a second, by {grown[1] / MIB:.0f} MiB in all; "
        f"slowest refusal {findings.refused[0]:.2f} s: {findings.refused[1]}"
    )
    for service, (took, request) in sorted(findings.slowest.items(), key=lambda item: -item[1][0])[:8]:
        print(f"  {took:6.2f} s {service} {request[:100]}")
    print(f"faults {summary.get('faults')}, counters {summary.get('counters')}")
    wrong, lines = [*findings.wrong], log.splitlines()
    wrong += [line for line in lines if VALUE in line]
    wrong += [line for i, each in enumerate(lines) if "Traceback" in each for line in lines[i : i + 40]]
    wrong += [f"never reached: {', '.join(missed)}"] if missed else []
    wrong += [] if alive else ["the run ended:", *log.splitlines()[-20:]]
    wrong += [f"a refusal took {findings.refused[0]:.2f} s"] if findings.refused[0] > _REFUSED_S else []
    wrong += [f"memory grew by {grown[0] / MIB:.0f} MiB within a second"] if grown[0] > 200 * MIB else []
    for line in wrong[:120]:
        print("WRONG", line)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
