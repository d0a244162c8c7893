"""What `ibrobot explain` costs: seconds and memory for an episode of a minute with two cameras, and for 20 as a job.

    python benchmarks/explain_cost.py [--work explain_cost] [--seconds 60] [--episodes 20]

Records a made-up run (`tests/shared/made_runs.py`) with two cameras of 672 x 504 pixels at 30 Hz as a bag, and explains
it with the card of some short demonstrations. The job explains that bag as often as `--episodes` says, two at a time.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from apparatus import report

MOST_MB = 300
"""Most memory of a process that explains [MB]."""
LARGER = 7
"""How many times as large as usual the pictures are, in each direction."""


def record(folder: Path, **options: Any) -> None:
    """Record a made-up run as a bag."""
    from ibrobot_testing.contexts import host_context
    from made_runs import Made, Run, metadata

    from ibrobot_core.api import EpisodeEnd, EpisodeStart
    from ibrobot_core.app import installed_plugins

    run = Run(picture=lambda camera, picture, t_s: np.kron(picture, np.ones((LARGER, LARGER, 1), np.uint8)), **options)
    descriptor = installed_plugins().find("recorder", "mcap")
    made, recorder = Made(run), descriptor.make(descriptor.options(images="jpeg"), host_context())
    summary = made.summary()
    folder.parent.mkdir(parents=True, exist_ok=True)
    topics = {topic: each.type for topic, each in summary.topics.items()}
    recorder.begin(EpisodeStart(folder, summary.start_ns, topics, metadata(run)))
    for item in made.messages():
        recorder.write(item.topic, item.message, item.received_ns)
    recorder.end(EpisodeEnd(summary.end_ns, run.outcome, {}))
    recorder.close()


def recorded(folder: Path, **options: Any) -> None:
    """As `record`, in a process of its own: one that is forked from a large one counts as large itself."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        pool.submit(record, folder, **options).result()


def measured(*words: str | Path) -> tuple[float, float]:
    """Seconds and memory of the largest process [MB] of a command."""
    begin = perf_counter()
    process = subprocess.Popen(
        [Path(sys.executable).with_name("ibrobot"), *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{words[0]} ended with {os.waitstatus_to_exitcode(status)}")
    return perf_counter() - begin, used.ru_maxrss / 1e3


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("explain_cost"), help="folder of the episodes")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of an episode")
    parser.add_argument("--episodes", type=int, default=20, help="episodes of the job")
    arguments = parser.parse_args()
    work = arguments.work.absolute()
    long, card = work / "long" / "episodes" / "episode_000001", work / "reference.json"
    if not long.exists():
        recorded(long, seed=1, seconds=arguments.seconds, camera_hz=30.0, outcome="failure")
    if not card.exists():
        for seed in range(3):
            recorded(work / f"demos/episodes/episode_00000{seed + 1}", seed=seed, acts=False, camera_hz=5.0)
        measured("datasets", "card", work / "demos", "--out", card)
    alone = measured("explain", long, "--data", card, "--out", work / "report")
    many = [work / "many" / "episodes" / f"episode_{i:06d}" for i in range(1, arguments.episodes + 1)]
    for each in many:
        each.mkdir(parents=True, exist_ok=True)
        for file in long.iterdir():
            if not (each / file.name).exists():
                os.link(file, each / file.name)
    job = measured("explain", *many, "--data", card, "--out", work / "reports", "--jobs", "2")
    size = sum(file.stat().st_size for file in long.iterdir()) / 1e6
    result = {
        "seconds": alone[0], "memory_mb": alone[1], "bag_mb": size, "job_episodes": len(many), "job_seconds": job[0],
    }  # fmt: skip
    print(json.dumps(result))
    report(**result)
    return int(alone[0] > arguments.seconds or alone[1] > MOST_MB)


if __name__ == "__main__":
    sys.exit(main())
