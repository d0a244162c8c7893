"""Chunks of a policy on a GPU: latency, memory, and how far they are from the CPU's, here and behind a server.

    python benchmarks/gpu.py CHECKPOINT [--device cuda] [--at-once 1 8 32] [--rounds 50]

CHECKPOINT is a policy of LeRobot's, e.g. that of `train_pick_cube.py --device cuda`. In this process: chunks for 1, 8
and 32 requests at once, in single precision, bfloat16 and float16. Then `ibrobot serve` with batches of up to 32: as
many robots, which ask again as soon as they are answered. The observations are from the middle of the training data,
with pictures of noise.

Prints a table. `off` is the largest difference of a joint from the chunk that the CPU computes in single precision for
the same request [rad]. Times are those of a whole batch, or from a robot's request to its answer. Memory is what the
device has in use, beside what it had before; on the CPU it is the process's largest so far. Exits with 1 when single
precision, here or behind the server, is off by 1e-3 rad or more. Needs LeRobot in the same environment.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent import futures
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from apparatus import started, transport
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import LeRobotPolicy
from ibrobot_serve.remote import RemoteEngine
from ibrobot_testing import host_context, ibrobot_command
from ibrobot_testing.ports import free_port
from numpy.typing import NDArray

from ibrobot_core.interfaces import Frame

SINGLE, HALF = "float32", ("bfloat16", "float16")
LIMIT_RAD = 1e-3
A_PROCESS = 8
"""Robots in a process."""
DEADLINE_S = 60.0
HEAD = "| where | precision | at once | p50 ms | p99 ms | chunks/s | memory MiB | off rad |\n" + 8 * "|---" + "|"

type Chunks = list[NDArray[np.float64]]


def main() -> int:
    """Measure, and print the table; 1 when single precision is off."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--at-once", type=int, nargs="+", default=[1, 8, 32], help="requests at once, and robots")
    parser.add_argument("--rounds", type=int, default=50, help="runs of each kind, and requests of each robot")
    parser.add_argument("--robots", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.robots:
        endpoint, first, count = given.robots
        robots(given.checkpoint, endpoint, int(first), int(count), given.rounds)
        return 0
    reference = loaded(given.checkpoint, "cpu", SINGLE)
    requests = [reference.preprocess(observed(reference, number)) for number in range(max(given.at_once))]
    expected = [reference.postprocess(reference.infer(each)) for each in requests]
    reference.close()
    worst = 0.0
    print(HEAD)

    def show(
        where: str, precision: str, count: int, times_ms: list[float], took_s: float, mib: float, found: Chunks
    ) -> None:
        nonlocal worst
        p50, p99 = np.percentile(times_ms, [50, 99])
        off = max(float(np.abs(ours - theirs).max()) for ours, theirs in zip(found, expected, strict=False))
        worst = max(worst, off if precision == SINGLE else 0.0)
        rate = given.rounds * count / took_s
        print(
            f"| {where} | {precision} | {count} | {p50:.2f} | {p99:.2f} | {rate:.1f} | {mib:.0f} | {off:.1e} |",
            flush=True,
        )

    for precision in (SINGLE, *HALF):
        before = before_use(given.device)
        policy = loaded(given.checkpoint, given.device, precision)
        for count in given.at_once:
            chunks = [policy.postprocess(each) for each in policy.infer_batch(requests[:count])]  # also warms up
            times_ms = []
            for _ in range(given.rounds):
                begun_s = time.perf_counter()
                policy.infer_batch(requests[:count])  # its results are on the CPU when it returns
                times_ms.append((time.perf_counter() - begun_s) * 1e3)
            show("here", precision, count, times_ms, sum(times_ms) / 1e3, in_use(given.device) - before, chunks)
        policy.close()
    with served(given.checkpoint, given.device, max(given.at_once)) as (endpoint, used_mib):
        for count in given.at_once:
            times_ms, chunks, took_s = fleet(given.checkpoint, endpoint, count, given.rounds)
            show("ibrobot serve", SINGLE, count, times_ms, took_s, used_mib(), chunks)
    return int(worst >= LIMIT_RAD)


def observed(policy: LeRobotPolicy, number: int) -> Frame:
    """An observation from the middle of the training data, with pictures of noise; equal numbers give equal ones."""
    rng, frame = np.random.default_rng(number), policy._typical()
    pictures = {
        key: rng.integers(0, 255, shape, np.uint8) for key, shape in policy.spec.observations.items() if len(shape) == 3
    }
    return attrs.evolve(frame, stamp_ns=number, values={**frame.values, **pictures})


def loaded(checkpoint: Path, device: str, precision: str) -> LeRobotPolicy:
    """The policy."""
    policy = LeRobotPolicy(LeRobotPolicyOptions(checkpoint, device=device, dtype=precision), host_context())
    policy.load()
    return policy


def before_use(device: str) -> float:
    """What is in use before a policy is loaded [MiB]."""
    if device != "cuda":
        return 0.0
    import torch

    torch.cuda.empty_cache()
    return in_use(device)


def in_use(device: str, pid: int | str = "self") -> float:
    """Memory of the device in use by all programs, or on the CPU the largest of a process so far [MiB]."""
    if device == "cuda":
        import torch

        free, total = torch.cuda.mem_get_info()
        return (total - free) / 2**20
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))


@contextmanager
def served(checkpoint: Path, device: str, batch: int) -> Iterator[tuple[str, Callable[[], float]]]:
    """A server with the policy: its endpoint, and the memory that it uses [MiB]."""
    endpoint, before = f"tcp/127.0.0.1:{free_port()}", before_use(device)
    command = [
        *ibrobot_command()[1:], "serve", checkpoint, "--type", "lerobot", "--name", "policy", "--set",
        f"device={device}", "--set", f"dtype={SINGLE}", "--batch", batch, "--listen", endpoint,
    ]  # fmt: skip
    with started(*command, says="serving policy") as (process, _):
        yield endpoint, lambda: in_use(device, process.pid) - before


def fleet(checkpoint: Path, endpoint: str, count: int, rounds: int) -> tuple[list[float], Chunks, float]:
    """Robots that ask without a pause: times of all requests [ms], a chunk of each robot, and how long it took [s]."""
    command = (__file__, checkpoint, "--rounds", rounds, "--robots", endpoint)
    shares = [(first, min(A_PROCESS, count - first)) for first in range(0, count, A_PROCESS)]
    with ExitStack() as stack:
        processes = [stack.enter_context(started(*command, *share, says="ready"))[0] for share in shares]
        begun_s = time.perf_counter()
        with futures.ThreadPoolExecutor(len(processes)) as pool:
            printed = list(pool.map(asked, processes))
        took_s = time.perf_counter() - begun_s
    answers = [answer for lines in printed for answer in json.loads(lines)]
    return (
        [each for answer in answers for each in answer["times_ms"]],
        [np.array(answer["chunk"]) for answer in answers],
        took_s,
    )


def asked(process: subprocess.Popen[str]) -> str:
    """What robots print once they may ask."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("go\n")
    process.stdin.flush()
    return process.stdout.readline()


def robots(checkpoint: Path, endpoint: str, first: int, count: int, rounds: int) -> None:
    """Some robots of a fleet, from the next line of the standard input on."""
    network = transport(connect=(endpoint,))
    policy = LeRobotPolicy(LeRobotPolicyOptions(checkpoint), host_context())  # its network is at the server

    def ask(engine: RemoteEngine, number: int) -> dict[str, Any]:
        times_ms, frame = [], observed(policy, number)
        for request in range(1, rounds + 1):
            begun_s = time.perf_counter()
            tensors = policy.preprocess(frame)
            chunk = policy.postprocess(engine.infer(tensors, request, time.monotonic_ns() + int(DEADLINE_S * 1e9)))
            times_ms.append((time.perf_counter() - begun_s) * 1e3)
        return {"times_ms": times_ms, "chunk": chunk.tolist()}

    numbers = range(first, first + count)
    engines = [RemoteEngine(policy, network, "policy", f"robot{number}", DEADLINE_S) for number in numbers]
    for engine in engines:
        engine.start()
    print("ready", flush=True)
    sys.stdin.readline()
    with futures.ThreadPoolExecutor(count) as pool:
        print(json.dumps(list(pool.map(ask, engines, numbers))), flush=True)
    for engine in engines:
        engine.close()
    network.close()


if __name__ == "__main__":
    sys.exit(main())
