"""A GPU's work in one command of at most ten minutes: training, evaluation, and inference here and behind a server.

    python benchmarks/gpu.py [--device cuda] [--demonstrations 100] [--trials 100] [--work gpu] [--miniature]

1. `ibrobot record` and `ibrobot convert`: the scripted pick with two cameras, in as many processes as there are cores.
2. `ibrobot train`: LeRobot's ACT from random weights, for 6000 steps of 32 frames or three and a half minutes.
3. `ibrobot eval`: the trained policy with cubes at places that were in no demonstration, and its exact 95 % interval.
4. In this process: chunks for 1, 8 and 32 requests at once, in single precision, bfloat16 and float16.
5. `ibrobot serve` with batches of up to 32: as many robots, which ask again as soon as they are answered.

The requests of 4 and 5 are observations of the demonstrations. `off` is the largest difference of a joint from the
chunk that the CPU computes in single precision for the same request [rad]. Times are those of a whole batch, or from a
robot's request to its answer. Memory is what the device has in use, beside what it had before; on the CPU it is the
process's largest so far.

Needs LeRobot in the same environment: `pip install 'lerobot[dataset,training]'`. A stage whose result is in the folder
`--work` is not done again. Writes `table.md` there, and prints it. Exits with 1 when single precision, here or behind
the server, is off by 1e-3 rad or more. `--miniature` does all of it on the CPU in about a minute, with small pictures
and a tiny network that learns nothing: it shows that the command works.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent import futures
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

import attrs
import numpy as np
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import LeRobotPolicy
from ibrobot_serve.remote import RemoteEngine
from ibrobot_testing import host_context
from ibrobot_testing.ports import free_port
from numpy.typing import NDArray
from train_pick_cube import FIRST_TRAINING_SEED, run

from ibrobot_core.app import installed_plugins
from ibrobot_core.interfaces import Frame

CONFIG = Path(__file__).parents[1] / "configs" / "so101.yaml"
MODE, PROMPT = "model_inference", "put the cube into the bin"
STATE, CAMERAS = "observation.state", ("top", "wrist")
SINGLE = "float32"
HALF = ("bfloat16", "float16")
LIMIT_RAD = 1e-3
A_PROCESS = 8
"""Robots in a process."""
DEADLINE_S = 60.0
LEARNING = ("--policy.optimizer_lr=1e-4", "--policy.optimizer_lr_backbone=1e-4")
"""Of a network that begins with random weights; ACT's own rates are for pretrained ones."""
TINY = (
    "--policy.dim_model=32", "--policy.n_heads=2", "--policy.dim_feedforward=32", "--policy.n_encoder_layers=1",
    "--policy.n_vae_encoder_layers=1",
)  # fmt: skip


@attrs.frozen(kw_only=True)
class Size:
    """How much is done."""

    height: int = 240
    """Of the pictures [px]; their width is 4/3 of it."""
    steps: int = 6000
    batch: int = 32
    chunk: int = 50
    """Actions of a chunk."""
    training_s: float = 210.0
    """After which the training ends with what it has [s]."""
    network: tuple[str, ...] = ()
    """What of ACT differs from LeRobot's defaults."""
    trial_s: float = 20.0
    """Longest episode of the evaluation [s]."""
    at_once: tuple[int, ...] = (1, 8, 32)
    rounds: int = 50
    """Runs of each kind, and requests of each robot."""

    @property
    def width(self) -> int:
        """Of the pictures [px]."""
        return self.height * 4 // 3


MINIATURE = Size(height=30, steps=2, batch=1, chunk=4, network=TINY, trial_s=0.2, at_once=(1, 2), rounds=2)


def main() -> int:
    """All stages; 1 when single precision is off."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--demonstrations", type=int, default=100)
    parser.add_argument("--trials", type=int, default=100, help="episodes of the trained policy")
    parser.add_argument("--work", type=Path, default=Path("gpu"), help="folder of all that comes to be")
    parser.add_argument("--miniature", action="store_true", help="all of it small, on the CPU")
    parser.add_argument("--robots", nargs=4, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.robots:
        endpoint, first, count, rounds = given.robots
        robots(given.work, endpoint, int(first), int(count), int(rounds))
        return 0
    size, device, demonstrations, trials = Size(), given.device, given.demonstrations, given.trials
    if given.miniature:
        size, device, demonstrations, trials = MINIATURE, "cpu", 1, 1
    work = given.work.absolute()
    work.mkdir(parents=True, exist_ok=True)
    figures = all_figures(work, device, demonstrations, trials, size)
    table = shown(figures)
    (work / "table.md").write_text(table, encoding="utf-8")
    print(table)
    return int(any(row["off_rad"] >= LIMIT_RAD for row in figures["inference"] if row["precision"] == SINGLE))


def all_figures(work: Path, device: str, demonstrations: int, trials: int, size: Size) -> dict[str, Any]:
    """The figures of all stages; those that `figures.json` has already are kept."""
    stages: dict[str, Callable[[], Any]] = {
        "machine": lambda: machine(device),
        "recorded": lambda: record(work / "episodes", demonstrations, size),
        "converted": lambda: convert(work),
        "trained": lambda: train(work, device, size),
        "evaluated": lambda: evaluate(work, device, trials, size),
        "inference": lambda: infer(work, device, size),
    }
    file = work / "figures.json"
    figures: dict[str, Any] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {"s": {}}
    for name, stage in stages.items():
        if name not in figures:
            begun_s = perf_counter()
            figures[name] = stage()
            figures["s"][name] = round(perf_counter() - begun_s, 1)
            file.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    return figures


def machine(device: str) -> dict[str, Any]:
    """What computes."""
    import torch

    name = torch.cuda.get_device_name() if device == "cuda" else device
    return {"device": name, "cores": cores(), "torch": torch.__version__}


def cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0))


def of_cameras(size: Size) -> list[str]:
    """The options for the size of the pictures."""
    changes = []
    for number, name in enumerate(CAMERAS, 1):
        changes += [f"peripherals.{name}.width={size.width}", f"peripherals.{name}.height={size.height}"]
        changes.append(f"contract.observations.{number}.image.resize=[{size.height}, {size.width}]")
    return [word for change in changes for word in ("--set", change)]


def record(root: Path, count: int, size: Size) -> dict[str, Any]:
    """Record the demonstrations, a part of them in each process."""
    parts = min(cores(), count)
    shares = [count // parts + (number < count % parts) for number in range(parts)]
    seeds = FIRST_TRAINING_SEED + np.cumsum([0, *shares])

    def part(number: int) -> int:
        printed = run(
            "ibrobot", "record", CONFIG, "--sim", "--lockstep", "--headless", "--mode", MODE, "--episodes",
            str(shares[number]), "--seed", str(seeds[number]), "--root", root, "--dataset", f"part_{number}",
            "--prompt", PROMPT, "--json", *of_cameras(size),
        )  # fmt: skip
        return int(json.loads(printed)["successes"])

    with futures.ThreadPoolExecutor(parts) as pool:
        return {"episodes": count, "successes": sum(pool.map(part, range(parts)))}


def convert(work: Path) -> dict[str, Any]:
    """Make a dataset of the successes, with pictures that are quick to read at random."""
    printed = run(
        "ibrobot", "convert", work / "episodes", "--out", work / "dataset", "--outcome", "success", "--no-videos",
        "--json",
    )  # fmt: skip
    found = json.loads(printed)
    return {key: found[key] for key in ("episodes", "frames")}


def train(work: Path, device: str, size: Size) -> dict[str, Any]:
    """Train ACT, at most for a while: its rate of learning is constant, so that it may end at any time."""
    workers = 0 if device == "cpu" else max(1, cores() - 2)
    command: list[str | Path] = [
        Path(sys.executable).with_name("ibrobot"), "train", work / "dataset", "--policy", "act", "--out",
        work / "train", "--steps", str(size.steps), "--save-every", str(max(size.steps // 12, 2)), "--batch-size",
        str(size.batch), "--device", device, "--events", "--policy.pretrained_backbone_weights=null",
        f"--policy.chunk_size={size.chunk}", f"--policy.n_action_steps={size.chunk}", f"--num_workers={workers}",
        *LEARNING, *size.network,
    ]  # fmt: skip
    print(f"$ {' '.join(map(str, command))}", file=sys.stderr)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    end = threading.Timer(size.training_s, lambda: process.send_signal(signal.SIGINT))
    end.start()
    assert process.stdout is not None
    events = [json.loads(line) for line in process.stdout if line.startswith("{")]
    end.cancel()
    reports = [each for each in events if each["event"] == "progress"]
    newest = (work / "train/checkpoints/last").resolve()
    if process.wait() and not newest.exists():
        raise SystemExit(f"ibrobot train ended with {process.returncode} before its first checkpoint")
    first, last = reports[0], reports[-1]
    rate = (last["step"] - first["step"]) / (last["seconds"] - first["seconds"])
    return {"steps": int(newest.name), "frames_per_s": round(rate * size.batch, 1), "loss": round(last["loss"], 3)}


def checkpoint(work: Path) -> Path:
    """The trained policy."""
    return work / "train/checkpoints/last/pretrained_model"


def evaluate(work: Path, device: str, trials: int, size: Size) -> dict[str, Any]:
    """Count the successes of the trained policy."""
    printed = run(
        "ibrobot", "eval", CONFIG, "--sim", "--mode", MODE, "--episodes", str(trials), "--videos", "0", "--json",
        "--model", "act", "--set", f"models.act={{type: lerobot, path: {checkpoint(work)}, device: {device}}}",
        "--set", f"contract.max_duration_s={size.trial_s}", *of_cameras(size), "--out", work / "evaluation",
    )  # fmt: skip
    [found] = json.loads(printed)["policies"]
    return {key: found[key] for key in ("successes", "episodes", "exact", "errors")}


def infer(work: Path, device: str, size: Size) -> list[dict[str, Any]]:
    """A row for each precision and number of requests here, and for each number of robots of a server."""
    frames = observed(work, max(size.at_once))
    stacked: dict[str, Any] = {key: np.stack([each.values[key] for each in frames]) for key in frames[0].values}
    np.savez(work / "frames.npz", **stacked)
    reference = made(work, "cpu", SINGLE)
    requests = [reference.preprocess(frame) for frame in frames]
    expected = [reference.postprocess(reference.infer(each)) for each in requests]
    reference.close()
    rows = []
    for precision in (SINGLE, *HALF):
        before = before_use(device)
        policy = made(work, device, precision)
        for count in size.at_once:
            batch = requests[:count]
            chunks = [policy.postprocess(each) for each in policy.infer_batch(batch)]  # also warms up
            times_ms = []
            for _ in range(size.rounds):
                begun_s = perf_counter()
                policy.infer_batch(batch)  # its results are on the CPU when it returns
                times_ms.append((perf_counter() - begun_s) * 1e3)
            memory_mib = in_use(device) - before
            rows.append(row("here", precision, count, times_ms, sum(times_ms) / 1e3, memory_mib, chunks, expected))
        policy.close()
    with served(work, device, max(size.at_once)) as (endpoint, used_mib):
        for count in size.at_once:
            times_ms, chunks, took_s = fleet(work, endpoint, count, size.rounds)
            rows.append(row("ibrobot serve", SINGLE, count, times_ms, took_s, used_mib(), chunks, expected))
    return rows


def row(
    where: str, precision: str, count: int, times_ms: list[float], took_s: float, memory_mib: float,
    chunks: list[NDArray[np.float64]], expected: list[NDArray[np.float64]],
) -> dict[str, Any]:  # fmt: skip
    """A row of the table of inference."""
    p50, p99 = np.percentile(times_ms, [50, 99])
    off = max(float(np.abs(ours - theirs).max()) for ours, theirs in zip(chunks, expected, strict=False))
    answers = len(times_ms) * (count if where == "here" else 1)
    return {
        "where": where, "precision": precision, "at_once": count, "p50_ms": round(float(p50), 2),
        "p99_ms": round(float(p99), 2), "chunks_per_s": round(answers / took_s, 1), "memory_mib": round(memory_mib),
        "off_rad": off,
    }  # fmt: skip


def observed(work: Path, count: int) -> list[Frame]:
    """Observations of the demonstrations, evenly over all."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("local/dataset", root=work / "dataset")
    frames = []
    for number, index in enumerate(np.linspace(0, len(dataset) - 1, count).astype(int)):
        item = dataset[int(index)]
        values = {STATE: item[STATE].numpy()}
        for name in CAMERAS:
            pixels = item[f"observation.images.{name}"] * 255
            values[f"observation.images.{name}"] = pixels.round().byte().permute(1, 2, 0).contiguous().numpy()
        frames.append(Frame(number, values))
    return frames


def made(work: Path, device: str, precision: str) -> LeRobotPolicy:
    """The trained policy, loaded."""
    policy = LeRobotPolicy(LeRobotPolicyOptions(checkpoint(work), device=device, dtype=precision), host_context())
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
def served(work: Path, device: str, batch: int) -> Iterator[tuple[str, Callable[[], float]]]:
    """A server with the trained policy: its endpoint, and the memory that it uses [MiB]."""
    endpoint, before = f"tcp/127.0.0.1:{free_port()}", before_use(device)
    command: list[str | Path] = [
        Path(sys.executable).with_name("ibrobot"), "serve", checkpoint(work), "--type", "lerobot", "--name", "act",
        "--set", f"device={device}", "--set", f"dtype={SINGLE}", "--batch", str(batch), "--listen", endpoint,
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        if not process.stdout.readline().startswith("serving act"):
            raise SystemExit(f"ibrobot serve ended with {process.wait()}")
        yield endpoint, lambda: in_use(device, process.pid) - before
    finally:
        process.terminate()
        process.communicate()


def fleet(work: Path, endpoint: str, count: int, rounds: int) -> tuple[list[float], list[NDArray[np.float64]], float]:
    """Robots that ask without a pause: times of all requests [ms], a chunk of each robot, and how long it took [s]."""
    processes = [
        subprocess.Popen(
            [
                sys.executable, __file__, "--work", str(work), "--robots", endpoint, str(first),
                str(min(A_PROCESS, count - first)), str(rounds),
            ],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )
        for first in range(0, count, A_PROCESS)
    ]  # fmt: skip
    for process in processes:
        assert process.stdout is not None
        if process.stdout.readline() != "ready\n":
            raise SystemExit("the robots did not start")
    begun_s = perf_counter()
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    answers = []
    for process in processes:
        assert process.stdout is not None
        answers += json.loads(process.stdout.readline())
    took_s = perf_counter() - begun_s
    for process in processes:
        process.communicate()
    times_ms = [each for answer in answers for each in answer["times_ms"]]
    return times_ms, [np.array(answer["chunk"]) for answer in answers], took_s


def robots(work: Path, endpoint: str, first: int, count: int, rounds: int) -> None:
    """Some robots of a fleet, from the next line of the standard input on."""
    transports = installed_plugins().find("transport", "zenoh")
    network = transports.make(transports.options(connect=(endpoint,)), host_context())
    policy = LeRobotPolicy(LeRobotPolicyOptions(checkpoint(work)), host_context())  # its network is at the server
    with np.load(work / "frames.npz") as frames:
        seen = [{key: frames[key][number] for key in frames.files} for number in range(first, first + count)]

    def ask(engine: RemoteEngine, number: int) -> dict[str, Any]:
        times_ms = []
        for request in range(1, rounds + 1):
            begun_s = perf_counter()
            tensors = policy.preprocess(Frame(first + number, seen[number]))
            outputs = engine.infer(tensors, request, time.monotonic_ns() + int(DEADLINE_S * 1e9))
            chunk = policy.postprocess(outputs)
            times_ms.append((perf_counter() - begun_s) * 1e3)
        return {"times_ms": times_ms, "chunk": chunk.tolist()}

    engines = [RemoteEngine(policy, network, "act", f"robot{first + i}", DEADLINE_S) for i in range(count)]
    for engine in engines:
        engine.start()
    print("ready", flush=True)
    sys.stdin.readline()
    with futures.ThreadPoolExecutor(count) as pool:
        print(json.dumps(list(pool.map(ask, engines, range(count)))), flush=True)
    for engine in engines:
        engine.close()
    network.close()


def shown(figures: dict[str, Any]) -> str:
    """The tables."""
    took, recorded, converted = figures["s"], figures["recorded"], figures["converted"]
    trained, evaluated, on = figures["trained"], figures["evaluated"], figures["machine"]
    low, high = (evaluated["exact"][end] * 100 for end in ("low", "high"))
    rate = f"{evaluated['successes']} of {evaluated['episodes']}, 95 % interval {low:.0f} to {high:.0f} %"
    stages = {
        "recorded": f"{recorded['successes']} of {recorded['episodes']} demonstrations succeeded",
        "converted": f"{converted['episodes']} episodes, {converted['frames']} frames with two pictures each",
        "trained": f"{trained['steps']} steps, {trained['frames_per_s']} frames/s, loss {trained['loss']}",
        "evaluated": rate + (f", {evaluated['errors']} errors" if evaluated["errors"] else ""),
        "inference": "below",
    }
    lines = [f"{on['device']}, {on['cores']} cores, torch {on['torch']}", "", "| stage | | s |", "|---|---|---|"]
    lines += [f"| {name} | {text} | {took[name]:.0f} |" for name, text in stages.items()]
    lines += ["", "| ACT | precision | at once | p50 ms | p99 ms | chunks/s | memory MiB | off rad |"]
    lines.append("|---|---|---|---|---|---|---|---|")
    for each in figures["inference"]:
        off = f"{each['off_rad']:.1e}"
        values = [each[key] for key in ("where", "precision", "at_once", "p50_ms", "p99_ms", "chunks_per_s")]
        lines.append(f"| {' | '.join(map(str, [*values, each['memory_mib'], off]))} |")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    sys.exit(main())
