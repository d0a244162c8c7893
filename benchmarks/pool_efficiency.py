"""Efficiency of a pool with jobs that wait, as for an encoder or a GPU, with 1 to 8 workers, and its overhead per job.

    python benchmarks/pool_efficiency.py [--on processes] [--on ray]

The efficiency is the time that the jobs wait in all, divided by that of the workers. With Ray, a cluster of 8 cores is
simulated on this machine.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

from ibrobot_core.app import Job, Pool, installed_plugins

WAIT_S = 1.0
ROUNDS = 8
"""Jobs that wait for each worker."""
QUICK = 100
"""Jobs that do nothing, for the overhead."""
WORKERS = (1, 2, 4, 8)


def wait(seconds: float, progress: Callable[[int], None]) -> None:
    """A job."""
    time.sleep(seconds)


def efficiency(pool: Pool, workers: int) -> float:
    """Share of the workers' time in which jobs waited."""
    list(pool.run(Job(wait, 0.5) for _ in range(workers)))  # a cluster, or what processes are forked from, starts
    begin = time.monotonic()
    list(pool.run(Job(wait, WAIT_S) for _ in range(ROUNDS * workers)))
    return ROUNDS * WAIT_S / (time.monotonic() - begin)


def overhead_s(pool: Pool, *, own_process: bool) -> float:
    """Time for a job that does nothing, with one worker [s]."""
    begin = time.monotonic()
    count = QUICK // (10 if own_process else 1)
    list(pool.run(Job(wait, 0.0, own_process=own_process) for _ in range(count)))
    return (time.monotonic() - begin) / count


@contextmanager
def cluster(on: str) -> Iterator[None]:
    """For Ray, a cluster with a core for each worker."""
    if on != "ray":
        yield
        return
    from ray.cluster_utils import Cluster

    found: Any = Cluster()
    loopback = "127.0.0.2"  # Ray replaces 127.0.0.1 by the address of the network when it connects
    try:
        found.add_node(num_cpus=max(WORKERS), include_dashboard=False, node_ip_address=loopback)
        os.environ["RAY_ADDRESS"] = found.address
        yield
    finally:
        os.environ.pop("RAY_ADDRESS", None)
        found.shutdown()


def main() -> None:
    """Measure each pool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--on", action="append")
    for on in parser.parse_args().on or ["processes", "ray"]:
        with cluster(on):
            for workers in WORKERS:
                with closing(installed_plugins().pool(on, workers)) as pool:
                    print(f"{on}, {workers} workers: efficiency {efficiency(pool, workers):.2f}", flush=True)
            with closing(installed_plugins().pool(on, 1)) as pool:
                quick, own = overhead_s(pool, own_process=False), overhead_s(pool, own_process=True)
                print(f"{on}: {1e3 * quick:.1f} ms per job, {1e3 * own:.0f} ms in a process of its own", flush=True)


if __name__ == "__main__":
    main()
