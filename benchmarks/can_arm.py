"""The arm with CAN motors, on an emulator: the time of a read, and how late its control loop is.

    python benchmarks/can_arm.py

`read` asks eight motors for their state, at a real-time priority as the control loop does. The bare one sends and
receives the same frames by python-can alone; `socket` writes and reads their bytes without it, which shows what
pyserial's sockets cost: a byte for each system call.
`lateness` is that of the control loop of the robot of `docs/how-to/drive-a-can-arm.md`, on the emulator and with
simulated joints that follow at once, in turn. Exits with 1 if the median read takes more than 1.25x the bare one.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import can
import numpy as np
import yaml
from apparatus import ROOT, in_rounds, report, started
from ibrobot_damiao.bus import Channel, DamiaoBus
from ibrobot_damiao.emulator.serve import line_of
from ibrobot_damiao.protocol import REGISTER_ID, refresh
from ibrobot_testing import ibrobot_command

MOTORS = range(1, 9)
LIMIT = 1.25
PRIORITY = 60
"""Real-time priority of the reads, below that of the emulator."""
PAGE = ROOT / "docs/how-to/drive-a-can-arm.md"
_ANSWER_BYTES = len(line_of((0, bytes(8))))


def emulator(stack: ExitStack) -> str:
    """The channel of emulated motors in a process of their own."""
    command = [*ibrobot_command()[1:], "damiao", "emulate", "--motors", len(MOTORS)]
    return stack.enter_context(started(*command))[1]


def bare(channel: str, stack: ExitStack) -> Callable[[], None]:
    """Read by python-can alone."""
    bus = stack.enter_context(can.Bus(channel, "slcan", bitrate=1_000_000))
    requests = [can.Message(arbitration_id=REGISTER_ID, is_extended_id=False, data=refresh(each)) for each in MOTORS]

    def read() -> None:
        for request in requests:
            bus.send(request)
        for _ in requests:
            if bus.recv(0.1) is None:
                raise RuntimeError("a motor did not answer")

    return read


def by_socket(channel: str, stack: ExitStack) -> Callable[[], None]:
    """Read by the socket alone."""
    host, _, port = channel.removeprefix("socket://").partition(":")
    wire = stack.enter_context(socket.create_connection((host, int(port))))
    wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    wire.sendall(b"O\r")
    request = b"".join(line_of((REGISTER_ID, refresh(motor))) for motor in MOTORS)

    def read() -> None:
        wire.sendall(request)
        missing = len(MOTORS) * _ANSWER_BYTES
        while missing > 0:
            missing -= len(wire.recv(4096))

    return read


def ours(channel: str, stack: ExitStack) -> Callable[[], None]:
    """Read by the driver."""
    bus = DamiaoBus(Channel(channel))
    bus.open()
    stack.callback(bus.close)
    for motor in MOTORS:
        bus.find(motor)

    def read() -> None:
        if len(bus.refresh(MOTORS, 0.1)) != len(MOTORS):
            raise RuntimeError("a motor did not answer")

    return read


def wire_time(rounds: int, calls: int) -> dict[str, float]:
    """Median time of a read [us], of each client."""
    makers = {"bare": bare, "ours": ours, "socket": by_socket}
    times: dict[str, list[float]] = {name: [] for name in makers}
    with ExitStack() as stack:
        clients = {name: make(emulator(stack), stack) for name, make in makers.items()}
        with suppress(PermissionError):  # then other processes make all of them slower
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
            stack.callback(os.sched_setscheduler, 0, os.SCHED_OTHER, os.sched_param(0))
        for number in in_rounds(rounds + 1):
            for name, read in clients.items():
                for _ in range(calls):
                    begun = time.perf_counter()
                    read()
                    if number:  # the first round warms up
                        times[name].append(time.perf_counter() - begun)
    return {name: float(np.median(each)) * 1e6 for name, each in times.items()}


def lateness(rounds: int, duration_s: float) -> dict[str, tuple[float, float]]:
    """Lateness of the control loop, p50 and p99 [us], of the arm on the emulator and of the simulated one."""
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    robot: dict[str, Any] = yaml.safe_load(text)
    robot["simulation"] = {"type": "fake"}
    robot["control_modes"] = {"jog": {"executors": ["arm", "gripper"]}}
    del robot["teleoperation"], robot["contract"]
    found: dict[str, list[tuple[float, float]]] = {"emulated": [], "simulated": []}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (folder / "openarm.yaml").write_text(yaml.safe_dump(robot), encoding="utf-8")
        for _ in in_rounds(rounds, "run"):
            for name, more in (("emulated", []), ("simulated", ["--sim"])):
                command = [*ibrobot_command(), "launch", "openarm.yaml", "--headless", "--json", *more]
                with ExitStack() as running:
                    channel = "can0" if more else emulator(running)
                    done = subprocess.run(
                        [*command, "--duration", str(duration_s)], cwd=folder, stdout=subprocess.PIPE, check=True,
                        env={**os.environ, "IBROBOT_CAN": channel},
                    )  # fmt: skip
                loop = json.loads(done.stdout)["loop"]
                found[name].append((loop["lateness_p50_us"], loop["lateness_p99_us"]))
    p50, p99 = ({name: float(np.median([each[i] for each in runs])) for name, runs in found.items()} for i in (0, 1))
    return {name: (p50[name], p99[name]) for name in found}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--calls", type=int, default=100, help="reads of each client in a round")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--duration", type=float, default=10.0, help="of each run [s]")
    arguments = parser.parse_args()
    wire = wire_time(arguments.rounds, arguments.calls)
    late = lateness(arguments.runs, arguments.duration)
    print(json.dumps({"wire_us": wire, "lateness_us": late}, indent=2))
    figures = {f"{name}_{which}_us": each[i] for name, each in late.items() for i, which in enumerate(("p50", "p99"))}
    ratio = wire["ours"] / wire["bare"]
    report(ratio=ratio, read_us=wire["ours"], bare_us=wire["bare"], socket_us=wire["socket"], **figures)
    return 0 if ratio <= LIMIT else 1


if __name__ == "__main__":
    sys.exit(main())
