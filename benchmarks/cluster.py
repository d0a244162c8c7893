"""A conversion and an evaluation on a Ray cluster of three nodes whose processes die, beside one local process.

    python benchmarks/cluster.py [--bags 12] [--episodes 8]

The cluster is simulated on this machine. While a command runs, a process that does one of its jobs is killed every 5 s.
After its first episode a node is removed, and after its third one the command is killed and run again, and again while
an episode has lost five processes. Prints whether all files are there once, with the bytes of `--jobs 1` without Ray.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
sys.path.insert(0, str(Path(__file__).parents[1] / "tests/shared"))
from ray.cluster_utils import Cluster
from recordings import record

PROGRAM = "from ibrobot_core.cli.command import main; main()"
KILL_S = 5.0
MOST = 4
"""Times that a command is run again."""
LOOPBACK = "127.0.0.2"  # Ray replaces 127.0.0.1 by the address of the network when it connects
NODE: dict[str, Any] = dict(num_cpus=1, include_dashboard=False, node_ip_address=LOOPBACK, object_store_memory=80 << 20)


def job_processes() -> list[int]:
    """The processes in which Ray runs jobs at present."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if path.read_bytes().startswith(b"ray::_do"):
                found.append(int(path.parent.name))
    return found


@contextmanager
def killing(rng: random.Random) -> Iterator[list[int]]:
    """Kill a process of a job every `KILL_S` meanwhile."""
    killed: list[int] = []
    over = threading.Event()

    def kill() -> None:
        while not over.wait(KILL_S):
            if pids := job_processes():
                killed.append(rng.choice(pids))
                with contextlib.suppress(ProcessLookupError):
                    os.kill(killed[-1], signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed
    finally:
        over.set()
        thread.join()


@contextmanager
def cluster() -> Iterator[Any]:
    """Three nodes of one core each."""
    found: Any = Cluster()
    try:
        for _ in range(3):
            found.add_node(**NODE)
        yield found
    finally:
        found.shutdown()


def content(folder: Path) -> dict[str, str]:
    """Hash of each file."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def run(arguments: Sequence[str], folder: Path) -> float:
    """Run a command of ibrobot to its end; returns the seconds."""
    begin = time.monotonic()
    subprocess.run([sys.executable, "-c", PROGRAM, *arguments], cwd=folder, check=True, capture_output=True)
    return time.monotonic() - begin


def disturbed(arguments: Sequence[str], folder: Path, rng: random.Random) -> str:
    """Run a command on the cluster while it loses processes, a node and the command itself; returns what happened."""
    with cluster() as nodes, killing(rng) as killed:
        environment = {**os.environ, "RAY_ADDRESS": nodes.address}
        command = [sys.executable, "-c", PROGRAM, *arguments, "--on", "ray"]
        with subprocess.Popen(command, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True) as first:
            assert first.stderr is not None
            seen = 0
            for line in first.stderr:
                seen += " of " in line
                if seen == 1:
                    nodes.remove_node(next(iter(nodes.worker_nodes)), allow_graceful=False)
                if seen == 3:
                    first.kill()
                    break
        codes: list[int] = []
        while len(codes) < MOST and 0 not in codes:
            again = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
            codes.append(again.returncode)
        lost = f"{len(killed)} processes and 1 node lost"
        return f"{lost}, command killed after {seen} episodes, then exit {', '.join(map(str, codes))}"


def compare(name: str, arguments: Sequence[str], folder: Path, rng: random.Random) -> bool:
    """Run a command both ways, and compare."""
    run([*arguments, "--jobs", "1", "--out", f"{name}_one"], folder)
    what = disturbed([*arguments, "--out", f"{name}_ray"], folder, rng)
    one, other = content(folder / f"{name}_one"), content(folder / f"{name}_ray")
    equal = one == other
    print(f"{name}: {len(one)} files, {'all equal' if equal else 'NOT EQUAL'}; {what}", flush=True)
    return equal


def main() -> int:
    """Run both, and exit with 1 if a byte differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bags", type=int, default=12)
    parser.add_argument("--episodes", type=int, default=8)
    asked = parser.parse_args()
    rng = random.Random(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(1, asked.bags + 1):
            record(folder / f"bags/{number}", number, 1.0, "sort")
        evaluation = ("eval", "so101_pick_cube", "--sim", "--episodes", str(asked.episodes), "--videos", "0")
        good = compare("convert", ("convert", "bags", "--no-videos"), folder, rng)
        return 0 if compare("eval", evaluation, folder, rng) and good else 1


if __name__ == "__main__":
    sys.exit(main())
