"""The control loop beside a busy, stopped or dead ROS node, and how late images are in ROS.

    python benchmarks/ros.py --python .nox/ros/tmp/jazzy/bin/python [--seconds 5] [--rounds 5]

`nox -s ros` makes that interpreter. First it prints the lateness of the simulated SO-101's control loop in each of
these cases: without a node, without one beside two busy processes, with an idle node, with one that is flooded with
messages and calls by two processes, with one that is stopped, and with one that is killed again and again. Then it
prints the age of images of 640x480 pixels at 30 Hz when rclpy gets them in another process, and how many are lost from
the first one on: of those that a run publishes, and of those that rclpy itself publishes.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ibrobot_core.api import Header, Image
from ibrobot_core.app import LaunchRequest, Runtime, Session, find_config, installed_plugins, load_config

PEER = Path(__file__).parents[1] / "plugins/ibrobot-plugin-ros/tests/with_ros/peer.py"
TRIGGER = "std_srvs/srv/Trigger"
DOMAIN = 77
BUSY = "without a node, two busy processes"
LIMIT = 1.2
"""Times the lateness without a node that the others may have, at the 99th percentile."""
_STAMP = struct.Struct("<4xiI")


class Peer:
    """A node of rclpy's in a process of its own; see its script."""

    def __init__(self, python: str) -> None:
        root = Path(python).absolute().parent.parent
        found = (
            {"AMENT_PREFIX_PATH": str(root), "LD_LIBRARY_PATH": str(root / "lib")} if (root / "share").is_dir() else {}
        )
        reach = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(DOMAIN)}
        self._process = subprocess.Popen(
            [python, str(PEER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **found, **reach},
        )
        self.answer()

    def send(self, method: str, **keywords: Any) -> None:
        """Begin a method."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([method, keywords]) + "\n")
        self._process.stdin.flush()

    def answer(self) -> Any:
        """The result of the method."""
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())[1]

    def ask(self, method: str, **keywords: Any) -> Any:
        """Do a method."""
        self.send(method, **keywords)
        return self.answer()

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()


def run(*overrides: str) -> Runtime:
    """A started run of the simulated SO-101."""
    registry = installed_plugins()
    config = load_config(
        find_config("so101", registry), overrides=overrides, sim=True, mode="moveit_planning", registry=registry
    )
    runtime = Runtime(Session(config, registry, LaunchRequest()))
    runtime.start()
    return runtime


def lateness(runtime: Runtime, seconds: float, meanwhile: Callable[[], None] = lambda: None) -> dict[str, float]:
    """Lateness of the loop [ms] for a while."""
    late: list[int] = []
    note = lambda state: late.append(state.late_ns)  # noqa: E731
    runtime.session.on_state.append(note)
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        meanwhile()
        time.sleep(0.05)
    runtime.session.on_state.remove(note)
    values = np.array(late) / 1e6
    return {"p50": np.quantile(values, 0.5), "p99": np.quantile(values, 0.99), "worst": values.max()}


def _kill(runtime: Runtime) -> Callable[[], None]:
    node = next(each for each in runtime.plan.components if each.name == "ros")

    def kill() -> None:
        pid = getattr(node, "pid", None)
        if pid is not None:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    return kill


def loops(python: str, seconds: float) -> dict[str, dict[str, float]]:
    """Lateness in each case; those of one round follow one another, so that other work on the machine affects all."""
    found = {}
    runtime = run()
    found["without a node"] = lateness(runtime, seconds)
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    found[BUSY] = lateness(runtime, seconds)
    for process in busy:
        process.kill()
        process.wait()
    runtime.stop()
    runtime = run(f"ros.python={python}", f"ros.domain={DOMAIN}", "ros.subscribe={/lamp: std_msgs/msg/Bool}")
    node = next(each for each in runtime.plan.components if each.name == "ros")
    found["idle node"] = lateness(runtime, seconds)
    flood, caller = Peer(python), Peer(python)
    flood.send("publish", topic="/lamp", type="std_msgs/msg/Bool", raw="0001000001", count=10_000_000)
    caller.send("call", name="/set_mode/moveit_planning", type=TRIGGER, count=10_000_000)
    found["flooded node"] = lateness(runtime, seconds)
    for peer in (flood, caller):
        peer.close()
    pid: int = getattr(node, "pid")  # noqa: B009 - a component of the plugin
    os.kill(pid, signal.SIGSTOP)
    found["stopped node"] = lateness(runtime, seconds)
    os.kill(pid, signal.SIGCONT)
    found["node killed again and again"] = lateness(runtime, seconds, _kill(runtime))
    runtime.stop()
    return found


def floor_of(case: str) -> str:
    """The case without a node that a case is compared with: with as many busy processes."""
    return BUSY if case == "flooded node" else "without a node"


def ratios(rounds: list[dict[str, dict[str, float]]]) -> dict[str, float]:
    """Median over the rounds of the p99 of each case with a node, in times that of its floor in the same round."""
    return {
        name: float(np.median([each[name]["p99"] / each[floor_of(name)]["p99"] for each in rounds]))
        for name in rounds[0]
        if "node" in name and not name.startswith("without")
    }


def ages(peer: Peer, topic: str, publish: Callable[[], None], count: int) -> dict[str, float]:
    """Ages of up to `count` images [ms] when they come to `peer`, and the share of those that are lost."""
    peer.ask("subscribe", topic=topic, type="sensor_msgs/msg/Image", qos="sensor_data", head=16)
    publish()
    taken = peer.ask("take", topic=topic, count=count, timeout_s=2 * count / 30)
    stamps = [_STAMP.unpack(bytes.fromhex(raw)[: _STAMP.size]) for _, raw in taken]
    begun = np.array([sec * 1_000_000_000 + nanosec for sec, nanosec in stamps])
    values = (np.array([at_ns for at_ns, _ in taken]) - begun)[10:] / 1e6
    sent = round((begun[-1] - begun[0]) * 30 / 1e9) + 1
    lost = 100 * (1 - len(taken) / sent)
    return {"p50": np.quantile(values, 0.5), "p99": np.quantile(values, 0.99), "lost %": lost}


def images(python: str, seconds: float) -> dict[str, dict[str, float]]:
    """Ages of images of a run, and of rclpy's own."""
    count = round(30 * seconds)
    pixels = np.zeros(640 * 480 * 3, np.uint8)
    runtime = run(f"ros.python={python}", f"ros.domain={DOMAIN}", "ros.publish=[/image]")
    clock, bus = runtime.session.clock, runtime.session.bus

    def ours() -> None:
        begin_ns = clock.now_ns()
        for i in range(count + 30):  # a second of images until the subscriber is known
            clock.sleep_until(begin_ns + round(i * 1e9 / 30))
            bus.publish("/image", Image(Header(clock.now_ns(), "camera"), 480, 640, "rgb8", 3 * 640, pixels))

    # The run goes on beside rclpy's own images, so that both have as much of the machine.
    peer, publisher = Peer(python), Peer(python)
    found = {"a run": ages(peer, "/image", ours, count)}
    found["rclpy alone"] = ages(
        peer, "/theirs", lambda: publisher.send("publish_images", topic="/theirs", count=count + 30), count
    )
    runtime.stop()
    for each in (peer, publisher):
        each.close()
    return found


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", required=True, help="interpreter that has rclpy")
    parser.add_argument("--seconds", type=float, default=5.0, help="duration of each case of a round [s]")
    parser.add_argument("--rounds", type=int, default=5, help="number of rounds")
    given = parser.parse_args()
    late = []
    for number in range(1, given.rounds + 1):
        late.append(loops(given.python, given.seconds))
        show(f"lateness of the control loop in round {number} [ms]", late[-1])
    found = ratios(late)
    show("p99 in times that without a node, median of the rounds", {name: {"": each} for name, each in found.items()})
    show("age of images in another process [ms]", images(given.python, 3 * given.seconds))
    if missed := [name for name, ratio in found.items() if ratio > LIMIT]:
        raise SystemExit(f"p99 above {LIMIT:g} times that without a node: {', '.join(missed)}")


def show(title: str, table: dict[str, dict[str, float]]) -> None:
    """Print a table."""
    print(title)
    for name, values in table.items():
        print(f"  {name:36}", "  ".join(f"{key} {value:.3f}" for key, value in values.items()))


if __name__ == "__main__":
    main()
