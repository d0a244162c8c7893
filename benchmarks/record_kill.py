"""What a killed recording has lost: `kill -9` at random times, then a plain reading of what is there, without repair.

    python benchmarks/record_kill.py [--kills 50] [--seconds 30] [--parallel 10]

Each recording process writes joint states at 100 Hz and one raw 320x240 picture at 10 Hz. Whatever was handed to the
recorder a second or more before the kill must be found, bit by bit and in order. Exits with 1 when anything is missing.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from ibrobot_core.clock import RealClock
from ibrobot_core.interfaces import EpisodeStart
from ibrobot_core.messages import Header, Image, JointState
from ibrobot_core.plugins import installed
from ibrobot_core.testing.contexts import host_context

JOINTS, CAMERA = "/joint_states", "/camera/top/image_raw"
SIZE = 320 * 240 * 3
COMPRESSIONS = ("none", "lz4", "zstd")


def picture(index: int) -> np.ndarray:
    """The picture of joint state `index`."""
    return np.random.default_rng(index).integers(0, 255, SIZE, np.uint8)


def record(directory: Path, compression: str) -> None:
    """Record until killed, and print the stamp [ns] of every joint state that was handed over."""
    descriptor = installed().find("recorder", "mcap")
    clock = RealClock()
    recorder = descriptor.make(descriptor.options(compression=compression), host_context(clock=clock))
    start_ns = clock.now_ns()
    topics = {JOINTS: JointState.ros_type, CAMERA: Image.ros_type}
    recorder.begin(EpisodeStart(directory, start_ns, topics, {}))
    index = 0
    while True:
        stamp_ns = clock.now_ns()
        if index % 10 == 0:
            recorder.write(CAMERA, Image(Header(index), 240, 320, "rgb8", 960, picture(index)), stamp_ns)
        recorder.write(JOINTS, JointState(Header(index), ("pan",), [float(index)]), stamp_ns)
        print(stamp_ns, flush=True)
        index += 1
        clock.sleep_until(start_ns + index * 10_000_000)


def kill_one(number: int, folder: Path, seconds: float) -> tuple[int, float, float]:
    """Kill one recording; returns messages missing, seconds recorded, and seconds lost."""
    path = folder / f"episode_{number:06d}"
    compression = COMPRESSIONS[number % len(COMPRESSIONS)]
    after_s = random.Random(number).uniform(1.0, seconds)
    stamps: list[int] = []
    with subprocess.Popen(
        [sys.executable, __file__, "--record", str(path), compression], stdout=subprocess.PIPE, text=True
    ) as child:
        lines = child.stdout
        assert lines is not None
        stamps.append(int(lines.readline()))
        reader = threading.Thread(target=lambda: stamps.extend(int(line) for line in lines if line.endswith("\n")))
        reader.start()
        time.sleep(after_s)
        child.kill()
        reader.join()
    found = list(read(path))
    states = [index for topic, index in found if topic == JOINTS]
    pictures = [index for topic, index in found if topic == CAMERA]
    needed = sum(stamp_ns <= stamps[-1] - 1_000_000_000 for stamp_ns in stamps)
    missing = max(0, needed - len(states)) + max(0, (needed + 9) // 10 - len(pictures))
    if states != list(range(len(states))) or pictures != list(range(0, 10 * len(pictures), 10)):
        missing += 1
    lost_s = (stamps[-1] - stamps[min(len(states), len(stamps)) - 1]) * 1e-9
    return missing, (stamps[-1] - stamps[0]) * 1e-9, lost_s


def read(path: Path) -> Iterator[tuple[str, int]]:
    """Topic and number of each message that is as it was written."""
    reader = installed().open_episode(path)
    for item in reader.messages():
        message = item.message
        if isinstance(message, JointState) and message.position.tolist() == [float(message.header.stamp_ns)]:
            yield item.topic, message.header.stamp_ns
        if isinstance(message, Image) and np.array_equal(message.data, picture(message.header.stamp_ns)):
            yield item.topic, message.header.stamp_ns
    reader.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=30.0, help="latest kill")
    parser.add_argument("--parallel", type=int, default=10)
    parser.add_argument("--record", nargs=2, metavar=("FOLDER", "COMPRESSION"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.record:
        record(Path(arguments.record[0]), arguments.record[1])
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(arguments.parallel) as pool:
        results = list(pool.map(lambda n: kill_one(n, Path(folder), arguments.seconds), range(arguments.kills)))
    losses = sorted(lost_s for _, _, lost_s in results)
    bad = [number for number, (missing, _, _) in enumerate(results) if missing]
    times = [recorded_s for _, recorded_s, _ in results]
    print(
        f"{len(results)} recordings killed after {min(times):.1f} to {max(times):.1f} s: "
        f"lost {losses[len(losses) // 2]:.2f} s (median), {losses[-1]:.2f} s (worst)"
    )
    for number in bad:
        print(f"recording {number}: {results[number][0]} messages missing")
    print("FAILED" if bad else "passed")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
