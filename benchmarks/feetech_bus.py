"""Cost of the servo bus's tick for six servos: ours and LeRobot's, against a bare round trip.

    python benchmarks/feetech_bus.py

`read` is a sync read of the position; `read+write` adds a sync write of the goals. The servos are a process for each
client that answers from prepared bytes over a pseudo-terminal, at once or, throttled, after the time that the bytes
take on a wire at 1 Mbaud. All clients run in turn, in short segments, so that a busy machine slows all. LeRobot's row
needs it installed, e.g. `uv pip install 'lerobot[feetech]'`. Exits with 1 when the median of `read` exceeds 1.3x that
of the bare one, throttled 1.05x, or throttled takes more than a fifth of LeRobot's CPU time.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
import termios
import time
import tty
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
from apparatus import in_rounds, report, started
from ibrobot_feetech import protocol
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.protocol import Packet
from ibrobot_feetech.registers import STS3215
from ibrobot_feetech.sync import SyncReader, SyncWriter

SERVOS = range(1, 7)
GOALS = [2048] * len(SERVOS)
LIMIT, LIMIT_THROTTLED, CPU_SHARE = 1.3, 1.05, 0.2
BYTE_S = 10 / 1_000_000

type Client = tuple[Callable[[], Any], Callable[[], Any]]


def serve(throttled: bool) -> None:
    """The servos: print the port's path, then answer until the port is closed for good (standard input ends)."""
    master, slave = os.openpty()
    tty.setraw(slave)
    print(os.ttyname(slave), flush=True)
    answers: dict[bytes, bytes] = {}
    waiting, free_at = b"", 0.0
    while True:
        waiting += os.read(master, 4096)
        while len(waiting) >= 4 and len(waiting) >= waiting[3] + 4:
            request, waiting = waiting[: waiting[3] + 4], waiting[waiting[3] + 4 :]
            answer = answers.get(request)
            if answer is None:
                answer = answers[request] = _answer(request)
            if throttled:
                free_at = max(free_at, time.monotonic()) + (len(request) + len(answer)) * BYTE_S
                if answer:
                    _sleep_until(free_at)
            if answer:
                os.write(master, answer)


def _answer(request: bytes) -> bytes:
    if request[4] != protocol.Instruction.SYNC_READ:
        return b""
    _, size, *servos = request[5:-1]
    content = (b"\x00\x08" + bytes(16))[:size]
    return b"".join(protocol.pack(Packet(servo, 0, content)) for servo in servos)


def _sleep_until(due: float) -> None:
    """To the microsecond: the other core spins through the last stretch."""
    if (wait := due - time.monotonic() - 0.0002) > 0:
        time.sleep(wait)
    while time.monotonic() < due:
        pass


def bare(port: str, stack: ExitStack) -> Client:
    descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)
    stack.callback(os.close, descriptor)
    tty.setraw(descriptor)
    register = STS3215["present_position"]
    read_request = protocol.sync_read(SERVOS, register.address, register.size)
    expected = len(SERVOS) * (protocol.OVERHEAD + register.size)
    attributes = termios.tcgetattr(descriptor)
    attributes[6][termios.VMIN], attributes[6][termios.VTIME] = expected, 0
    termios.tcsetattr(descriptor, termios.TCSANOW, attributes)
    goal = STS3215["goal_position"]
    write_request = protocol.sync_write(goal.address, {servo: goal.encode(2048) for servo in SERVOS})

    def read() -> None:
        os.write(descriptor, read_request)
        if len(os.read(descriptor, expected)) != expected:
            raise RuntimeError("a short reply")

    return read, lambda: os.write(descriptor, write_request)


def ours(port: str, stack: ExitStack) -> Client:
    bus = FeetechBus(port)
    bus.open()
    stack.callback(bus.close)
    reader, writer = SyncReader(bus, SERVOS, "present_position"), SyncWriter(bus, SERVOS)

    def read() -> None:
        if not reader.read().complete:
            raise RuntimeError("a servo did not answer")

    return read, lambda: writer.write(GOALS)


def lerobot(port: str, stack: ExitStack) -> Client:
    from lerobot.motors import Motor, MotorNormMode
    from lerobot.motors.feetech import FeetechMotorsBus

    motors = {f"m{servo}": Motor(servo, "sts3215", MotorNormMode.DEGREES) for servo in SERVOS}
    bus = FeetechMotorsBus(port, motors)
    bus.connect(handshake=False)
    stack.callback(bus.disconnect, disable_torque=False)
    goals = dict.fromkeys(motors, 2048)
    return (
        lambda: bus.sync_read("Present_Position", normalize=False),
        lambda: bus.sync_write("Goal_Position", goals, normalize=False),
    )


CLIENTS = {"bare": bare, "ours": ours} | ({"lerobot": lerobot} if importlib.util.find_spec("lerobot") else {})


def measure(throttled: bool, rounds: int, calls: int) -> dict[str, Any]:
    times: dict[tuple[str, str], list[float]] = {}
    cpu: dict[tuple[str, str], list[float]] = {}
    with ExitStack() as stack:
        servos = [__file__, "--serve", *(["--throttled"] if throttled else [])]
        clients = {name: make(stack.enter_context(started(*servos))[1], stack) for name, make in CLIENTS.items()}
        for number in in_rounds(rounds + 1):
            for name, (read, write) in clients.items():
                for what in ("read", "read+write"):
                    spans, begun = [], time.process_time()
                    for _ in range(calls):
                        start = time.perf_counter()
                        if what == "read+write":
                            write()
                        read()
                        spans.append(time.perf_counter() - start)
                    if number:  # the first round warms up
                        times.setdefault((name, what), []).extend(spans)
                        cpu.setdefault((name, what), []).append((time.process_time() - begun) / calls)
    result: dict[str, Any] = {}
    for (name, what), spans in times.items():
        p50, p99 = np.percentile(spans, (50, 99))
        floor = float(np.median(times["bare", what]))
        result.setdefault(what, {})[name] = {
            "p50_us": round(p50 * 1e6, 1),
            "p99_us": round(p99 * 1e6, 1),
            "cpu_us": round(float(np.median(cpu[name, what])) * 1e6, 1),
            "ratio": round(float(p50) / floor, 2),
        }
    return result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--calls", type=int, default=200, help="calls of each client in a round")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--throttled", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        serve(arguments.throttled)
    result = {
        "unthrottled": measure(False, arguments.rounds, arguments.calls),
        "throttled": measure(True, arguments.rounds, arguments.calls // 4),
    }
    print(json.dumps(result, indent=2))
    if "lerobot" not in CLIENTS:
        print("LeRobot is not installed: not measured", file=sys.stderr)
    read, wire = result["unthrottled"]["read"], result["throttled"]["read"]
    cpu = {f"{name}_cpu_us": wire[name]["cpu_us"] for name in ("ours", "lerobot") if name in wire}
    report(ratio=read["ours"]["ratio"], ratio_on_the_wire=wire["ours"]["ratio"], **cpu)
    good = read["ours"]["ratio"] <= LIMIT and wire["ours"]["ratio"] <= LIMIT_THROTTLED
    if "lerobot" in wire:
        good &= wire["ours"]["cpu_us"] <= CPU_SHARE * wire["lerobot"]["cpu_us"]
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
