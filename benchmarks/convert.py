"""What `ibrobot convert` costs beside LeRobot's own writer: the same pictures, the same encoder.

    python benchmarks/convert.py [--lerobot PYTHON] [--frames 300] [--times 3] [--only speed|memory]

Two 640x480 cameras at 30 Hz, joint states and actions at 100 Hz, recorded as raw bags; synthetic pictures with texture,
motion and sensor noise. `--lerobot` is an interpreter that has `lerobot[dataset]`; by default this one. In one run:

- `ibrobot convert` of two episodes that differ, its reading of the bags included, with its own choice of `--jobs`;
- LeRobot's `LeRobotDataset` as `lerobot-record` uses it by default (pictures as PNG files, encoded at the end of an
  episode) and streaming, fed with the same pictures from memory. Streaming is fed no faster than it encodes, since it
  drops pictures otherwise. Both may use all cores.

As root, libsvtav1 gives its threads real-time priority. Ours takes it back, LeRobot does not: here both run without
the right to it, so that a busy machine slows both.

Three times in turn; printed are medians, and those of the paired ratios. Frames a second leave out what the two
commands import (not what the converting processes of ours do), and so does LeRobot's CPU time; all else is of the whole
command. Both should have the same PyAV: its releases bring encoders of very different speed.

Then the memory of `ibrobot convert` for episodes of 60 and 600 frames, and for 1, 10 and 50 of them. Memory is the
proportional share of all processes of the command together. Exits with 1 below 3x the frames a second of LeRobot's
default, below its streaming, or when memory grows by more than a quarter.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any
from uuid import UUID

import numpy as np
from apparatus import report

HEIGHT, WIDTH, FPS = 480, 640, 30
CAMERAS = ("top", "wrist")
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
ENOUGH, GROWTH = 3.0, 1.25


def pictures(stream: int, count: int) -> Iterator[np.ndarray[Any, np.dtype[np.uint8]]]:
    """A table with the spectrum of natural pictures behind a lens, a thing that moves over it, and a sensor's noise.

    An amplitude of 1/f^1.4 makes them as costly as a webcam's: about 30 kB each in AV1 at crf 30. Each stream has
    others.
    """
    rng = np.random.default_rng(stream)
    frequency = np.hypot(np.fft.fftfreq(HEIGHT)[:, None], np.fft.rfftfreq(WIDTH)[None, :])
    frequency[0, 0] = np.inf
    field = np.fft.irfft2(
        np.fft.rfft2(rng.normal(size=(HEIGHT, WIDTH, 3)), axes=(0, 1)) / frequency[..., None] ** 1.4, axes=(0, 1)
    )
    table = 128 + 40 * field / field.std()
    noise = rng.normal(0, 1.5, (8, HEIGHT, WIDTH, 3))
    for i in range(count):
        picture = table + noise[i % len(noise)]
        x = int((0.5 + 0.4 * np.sin(i / 20 + stream)) * (WIDTH - 80))
        picture[200:280, x : x + 80] = (220, 40, 60)
        yield picture.clip(0, 255).astype(np.uint8)


def uuid_of(episode: int) -> str:
    return str(UUID(int=episode, version=4))


def streams(episode: int, frames: int) -> list[Iterator[np.ndarray[Any, np.dtype[np.uint8]]]]:
    """The pictures of each camera in an episode; those of two episodes differ."""
    return [pictures(episode * len(CAMERAS) + camera, frames) for camera in range(len(CAMERAS))]


def record(folder: Path, frames: int, episode: int) -> None:
    """An episode as `ibrobot record` leaves it, with its own time, pictures and UUID."""
    from ibrobot_mcap.options import McapOptions
    from ibrobot_mcap.recorder import McapRecorder
    from ibrobot_testing.contexts import host_context

    from ibrobot_core.clock import SteppedClock
    from ibrobot_core.contract.specs import ActionPart, Contract, ObservationPart
    from ibrobot_core.interfaces import EpisodeEnd, EpisodeStart, Feature
    from ibrobot_core.messages import Float64MultiArray, Header, Image, JointState
    from ibrobot_core.schema import Align, ImageSpec

    recorder_clock = SteppedClock(start_ns := 1_700_000_000_000_000_000 + episode * 60_000_000_000)
    state = "sensor_msgs/msg/JointState"
    select = tuple(f"position.{joint}" for joint in JOINTS)
    parts = [
        ObservationPart("observation.state", "/joint_states", state, select, None, Align(), Feature("float32", (6,)))
    ]
    for camera in CAMERAS:
        feature = Feature("image", (HEIGHT, WIDTH, 3))
        align, key = Align("asof", tol_ms=100.0), f"observation.images.{camera}"
        parts.append(ObservationPart(key, f"/{camera}", "sensor_msgs/msg/Image", (), ImageSpec(), align, feature))
    action = ActionPart("arm", "/commands", "std_msgs/msg/Float64MultiArray", "hold", JOINTS)
    contract = Contract(float(FPS), tuple(parts), (action,))
    recorder = McapRecorder(McapOptions(), host_context(clock=recorder_clock))
    metadata = {
        "robot_type": "so101_follower",
        "prompt": "push the block",
        "contract": json.dumps(contract.canonical()),
        "fingerprint": contract.fingerprint(),
        "config": "{}",
        "calibration": "{}",
        "uuid": uuid_of(episode),
    }
    folder.parent.mkdir(parents=True, exist_ok=True)
    recorder.begin(EpisodeStart(folder, start_ns, contract.topics, metadata))
    for i, images in enumerate(zip(*streams(episode, frames), strict=True)):
        for sub in range(3):
            t_ns = start_ns + (3 * i + sub) * contract.step_ns // 3
            position = np.sin(np.arange(6) + t_ns % 10**10 / 1e9)
            recorder.write("/joint_states", JointState(Header(t_ns), JOINTS, position), t_ns)
            recorder.write("/commands", Float64MultiArray(position + 0.01), t_ns)
        for camera, image in zip(CAMERAS, images, strict=True):
            recorder.write(f"/{camera}", Image(Header(t_ns), HEIGHT, WIDTH, "rgb8", WIDTH * 3, image.ravel()), t_ns)
    recorder.end(EpisodeEnd(t_ns, "success"))
    recorder.close()


def measure(command: Sequence[str]) -> dict[str, float]:
    """Run a command: seconds, seconds of CPU, and the most memory of its processes together [MiB]."""
    begin = time.monotonic()
    environment = {**os.environ, "TQDM_DISABLE": "1", "SVT_LOG": "1", "HF_HUB_OFFLINE": "1"}
    if os.geteuid() == 0 and (setpriv := shutil.which("setpriv")):
        command = [setpriv, "--bounding-set", "-sys_nice", *command]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    peak, cpu, ended = 0.0, 0.0, threading.Event()

    def watch() -> None:
        nonlocal peak, cpu
        while not ended.wait(0.05):
            memory, used = _usage(process.pid)
            peak, cpu = max(peak, memory), max(cpu, used)

    watcher = threading.Thread(target=watch)
    watcher.start()
    out, err = process.communicate()
    seconds = time.monotonic() - begin
    ended.set()
    watcher.join()
    if process.returncode:
        sys.exit(f"{' '.join(command)}: exit {process.returncode}\n{err[-2000:]}")
    found = {"seconds": seconds, "cpu_s": cpu, "peak_mib": peak}
    last = out.strip().splitlines()[-1] if out.strip() else ""
    return found | (json.loads(last) if last.startswith("{") else {})


def _usage(pid: int) -> tuple[float, float]:
    """Of a process and all its children: proportional memory [MiB], and CPU time, that of ended children included [s].

    Sampled rather than asked for at the end, since a server that forks processes outlives the command.
    """
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        times = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:15]
    except OSError:
        return 0.0, 0.0
    memory = next((int(line.split()[1]) for line in lines if line.startswith("Pss:")), 0) / 1024
    cpu = sum(map(int, times)) / os.sysconf("SC_CLK_TCK")
    for child in children:
        more = _usage(int(child))
        memory, cpu = memory + more[0], cpu + more[1]
    return memory, cpu


def ours(episodes: Path, out: Path, *more: str) -> dict[str, float]:
    """`ibrobot convert`, the whole command."""
    shutil.rmtree(out, ignore_errors=True)
    program = "from ibrobot_core.cli.main import main; main()"
    command = [sys.executable, "-c", program, "convert", str(episodes), "--out", str(out), "--json", *more]
    found = measure(command)
    assert not found["passed_over"], "the episodes differ"
    return found | {"frames_s": found["frames"] / found["seconds"]}


def lerobot(mode: str, out: Path, frames: int, episodes: int) -> None:
    """LeRobot's writer, in a process of its own: `default` or `streaming`."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    vector = {"dtype": "float32", "shape": (6,), "names": list(JOINTS)}
    video = {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector}
    features |= {f"observation.images.{camera}": video for camera in CAMERAS}
    # As lerobot-record makes it: four threads a camera write the PNG files.
    options = {"streaming_encoding": True} if mode == "streaming" else {"image_writer_threads": 4 * len(CAMERAS)}
    stored = [[np.stack(list(stream)) for stream in streams(episode, frames)] for episode in range(1, episodes + 1)]
    dataset = LeRobotDataset.create("local/benchmark", FPS, features, root=out, robot_type="so101", **options)
    begin, cpu = time.monotonic(), _cpu()
    for pixels in stored:
        for i in range(frames):
            if mode == "streaming":
                _wait_for_encoders(dataset)
            row: dict[str, Any] = {"observation.state": np.full(6, i, np.float32), "action": np.zeros(6, np.float32)}
            row |= {f"observation.images.{camera}": pixels[n][i] for n, camera in enumerate(CAMERAS)}
            dataset.add_frame(row | {"task": "push the block"})
        dataset.save_episode()
    dataset.finalize()
    measured = {"measured": mode, "seconds": time.monotonic() - begin, "cpu_s": _cpu() - cpu}
    pictures_mib = sum(each.nbytes for pixels in stored for each in pixels) / 2**20
    print(json.dumps(measured | {"frames": frames * episodes, "pictures_mib": pictures_mib}))


def _wait_for_encoders(dataset: Any) -> None:
    """Its queues drop pictures when they are full."""
    queues = dataset.writer._streaming_encoder._frame_queues.values()
    while any(queue.qsize() >= queue.maxsize - 1 for queue in queues):
        time.sleep(0.001)


def _cpu() -> float:
    each = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in each)


def theirs(python: str, mode: str, out: Path, frames: int) -> dict[str, float]:
    """LeRobot's writer on two episodes."""
    shutil.rmtree(out, ignore_errors=True)
    found = measure([python, __file__, "--child", mode, "--out", str(out), "--frames", str(frames)])
    # What it was fed from is not its own.
    found["peak_mib"] -= found.pop("pictures_mib")
    return found | {"frames_s": found["frames"] / found["seconds"]}


def speed(python: str, folder: Path, frames: int, times: int) -> dict[str, float]:
    """Ours and LeRobot's, the same pictures, one after the other."""
    source = folder / "two"
    for number in (1, 2):
        record(source / f"episode_{number:06d}", frames, number)
    runs = {
        "ibrobot convert": lambda: ours(source, folder / "ours"),
        "LeRobot, streaming": lambda: theirs(python, "streaming", folder / "lerobot", frames),
        "LeRobot, default": lambda: theirs(python, "default", folder / "lerobot", frames),
    }
    found: dict[str, list[dict[str, float]]] = {name: [] for name in runs}
    for _ in range(times):
        for name, run in runs.items():
            found[name].append(run())
    for name, rows in found.items():
        frames_s, cpu_s, peak_mib = (median(row[each] for row in rows) for each in ("frames_s", "cpu_s", "peak_mib"))
        cpu_s *= 300 / rows[0]["frames"]
        print(f"{name:18} {frames_s:6.1f} frames/s  {cpu_s:6.1f} CPU s per 300 frames  {peak_mib:6.0f} MiB", flush=True)
    ratios = {
        mode: [own["frames_s"] / other["frames_s"] for own, other in zip(found["ibrobot convert"], rows, strict=True)]
        for mode, rows in found.items()
    }
    default, streaming = median(ratios["LeRobot, default"]), median(ratios["LeRobot, streaming"])
    print(f"{default:.2f} times LeRobot's default, {streaming:.2f} times its streaming (medians of {times} pairs)")
    own = median(row["frames_s"] for row in found["ibrobot convert"])
    return {"frames_per_s": own, "times_default": default, "times_streaming": streaming}


def memory(folder: Path) -> dict[str, float]:
    """Memory for one episode, and how much more longer or more episodes take."""
    found = {}
    record(folder / "short" / "episode_000001", 60, 1)
    record(folder / "long" / "episode_000001", 600, 1)
    for number in range(2, 51):
        copy = folder / f"short/episode_{number:06d}"
        shutil.copytree(folder / "short/episode_000001", copy, copy_function=os.link)
        metadata = (copy / "metadata.yaml").read_text()
        (copy / "metadata.yaml").unlink()  # a link
        (copy / "metadata.yaml").write_text(metadata.replace(uuid_of(1), uuid_of(number)))  # copies are passed over
    for count in (1, 10, 50):
        some = folder / f"some_{count}"
        for number in range(1, count + 1):
            name = f"episode_{number:06d}"
            shutil.copytree(folder / "short" / name, some / name, copy_function=os.link)
        found[f"{count} of 60 frames"] = ours(some, folder / "ours", "--jobs", "1")["peak_mib"]
    found["1 of 600 frames"] = ours(folder / "long", folder / "ours", "--jobs", "1")["peak_mib"]
    for name, mib in found.items():
        print(f"{name:16} {mib:6.0f} MiB", flush=True)
    least = found["1 of 60 frames"]
    return {"memory_mib": least, "memory_growth": max(found.values()) / least}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lerobot", default=sys.executable, metavar="PYTHON")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--only", choices=("speed", "memory"))
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.child:
        lerobot(asked.child, asked.out, asked.frames, 2)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        found = {} if asked.only == "memory" else speed(asked.lerobot, Path(folder), asked.frames, asked.times)
        found |= {} if asked.only == "speed" else memory(Path(folder))
    report(**found)
    fast = found.get("times_default", ENOUGH) >= ENOUGH and found.get("times_streaming", 1.0) >= 1.0
    return 0 if fast and found.get("memory_growth", 1.0) <= GROWTH else 1


if __name__ == "__main__":
    sys.exit(main())
