"""What a killed recording has lost: `kill -9` at random times, then what the commands make of what is there.

    python benchmarks/record_kill.py [--kills 50] [--seconds 30] [--parallel 10]

Each recording process writes joint states and commands at 100 Hz and one raw 320x240 picture at 10 Hz. Whatever was
handed to the recorder a second or more before the kill must be found, bit by bit and in order: as the bag lies
there, in what `ibrobot convert` makes of it, and, after `ibrobot episodes repair`, by the MCAP library's indexed
reader as well. Exits with 1 when anything is missing, or a command fails.
"""

from __future__ import annotations

import argparse
import json
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
from figures import report
from ibrobot_testing.contexts import host_context
from mcap.reader import make_reader

from ibrobot_core.clock import RealClock
from ibrobot_core.contract.specs import ActionPart, Contract, ObservationPart
from ibrobot_core.interfaces import EpisodeStart, Feature
from ibrobot_core.messages import Float64MultiArray, Header, Image, JointState
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.schema import Align, ImageSpec

JOINTS, CAMERA, COMMANDS = "/joint_states", "/camera/top/image_raw", "/commands"
SIZE = 320 * 240 * 3
COMPRESSIONS = ("none", "lz4", "zstd")
RATE_HZ = 10
CONTRACT = Contract(
    float(RATE_HZ),
    (
        ObservationPart(
            "observation.state", JOINTS, JointState.ros_type, ("position.pan",), None, Align("hold", "receive"),
            Feature("float32", (1,)),
        ),
        ObservationPart(
            "observation.images.top", CAMERA, Image.ros_type, (), ImageSpec((48, 64)), Align("hold", "receive"),
            Feature("image", (48, 64, 3)),
        ),
    ),
    (ActionPart("arm", COMMANDS, Float64MultiArray.ros_type, "hold", ("pan",)),),
)  # fmt: skip


def picture(index: int) -> np.ndarray:
    """The picture of joint state `index`."""
    return np.random.default_rng(index).integers(0, 255, SIZE, np.uint8)


def record(directory: Path, compression: str) -> None:
    """Record until killed, and print the stamp [ns] of every joint state that was handed over."""
    descriptor = installed_plugins().find("recorder", "mcap")
    clock = RealClock()
    recorder = descriptor.make(descriptor.options(compression=compression), host_context(clock=clock))
    start_ns = clock.now_ns()
    metadata = {"contract": json.dumps(CONTRACT.canonical()), "prompt": "wait for the end"}
    recorder.begin(EpisodeStart(directory, start_ns, CONTRACT.topics, metadata))
    index = 0
    while True:
        stamp_ns = clock.now_ns()
        if index % 10 == 0:
            recorder.write(CAMERA, Image(Header(index), 240, 320, "rgb8", 960, picture(index)), stamp_ns)
        recorder.write(COMMANDS, Float64MultiArray([float(index)]), stamp_ns)
        recorder.write(JOINTS, JointState(Header(index), ("pan",), [float(index)]), stamp_ns)
        print(stamp_ns, flush=True)
        index += 1
        clock.sleep_until(start_ns + index * 10_000_000)


def kill_one(number: int, folder: Path, seconds: float) -> tuple[list[str], float, float]:
    """Kill one recording; returns what is wrong, seconds recorded, and seconds lost."""
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
    needed = sum(stamp_ns <= stamps[-1] - 1_000_000_000 for stamp_ns in stamps)
    wrong, states = check(path, "as it lies there", needed)
    wrong += ibrobot("episodes", "info", path)
    dataset = path.with_suffix(".dataset")
    wrong += ibrobot("convert", path, "--out", dataset, "--no-videos", "--jobs", 1)
    if not wrong:
        frames = json.loads((dataset / "meta/info.json").read_bytes())["total_frames"]
        if frames < needed * RATE_HZ // 100:
            wrong.append(f"converted: {frames} frames of {needed * RATE_HZ // 100}")
    wrong += ibrobot("episodes", "repair", path)
    wrong += check(path, "repaired", needed)[0]
    with next(path.glob("*.mcap")).open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
        if summary is None or summary.statistics is None or summary.statistics.message_count < 2 * needed:
            wrong.append("repaired: no whole MCAP file")
    lost_s = (stamps[-1] - stamps[min(states, len(stamps)) - 1]) * 1e-9
    return wrong, (stamps[-1] - stamps[0]) * 1e-9, lost_s


def check(path: Path, which: str, needed: int) -> tuple[list[str], int]:
    """What is wrong with the messages there, and how many joint states are."""
    found = list(read(path))
    states = [index for topic, index in found if topic == JOINTS]
    pictures = [index for topic, index in found if topic == CAMERA]
    missing = max(0, needed - len(states)) + max(0, (needed + 9) // 10 - len(pictures))
    wrong = [f"{which}: {missing} messages missing"] if missing else []
    if states != list(range(len(states))) or pictures != list(range(0, 10 * len(pictures), 10)):
        wrong.append(f"{which}: messages out of order")
    return wrong, len(states)


def ibrobot(*arguments: object) -> list[str]:
    """Run a command; what it says where it fails."""
    program = "from ibrobot_core.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)], capture_output=True, text=True, check=False
    )
    return (
        [f"{arguments[0]} {arguments[1]}: exit {done.returncode}: {done.stdout[-300:]}{done.stderr[-300:]}"]
        if done.returncode
        else []
    )


def read(path: Path) -> Iterator[tuple[str, int]]:
    """Topic and number of each message that is as it was written."""
    reader = installed_plugins().open_episode(path)
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
    bad = [number for number, (wrong, _, _) in enumerate(results) if wrong]
    times = [recorded_s for _, recorded_s, _ in results]
    print(
        f"{len(results)} recordings killed after {min(times):.1f} to {max(times):.1f} s: "
        f"lost {losses[len(losses) // 2]:.2f} s (median), {losses[-1]:.2f} s (worst)"
    )
    for number in bad:
        print(f"recording {number}: {'; '.join(results[number][0])}")
    print("FAILED" if bad else "passed")
    report(
        killed=len(results),
        whole=len(results) - len(bad),
        median_lost_s=losses[len(losses) // 2],
        worst_lost_s=losses[-1],
    )
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
