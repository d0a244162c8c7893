"""What recording costs the control loop, and what it loses: three raw 640x480 cameras, joint states, actions.

    python benchmarks/record.py [--repetitions 1] [--seconds 120] [--root FOLDER]

Interleaved, in one run: `ibrobot launch` of the simulated SO-101 with `scripted_pick`, physics and control at 100 Hz,
three cameras at 30 Hz (synthetic pictures, so that rendering does not hide what recording costs), (a) without and
(b) with the contract's topics recorded into MCAP, 83 MB/s. Each in a process of its own. Exits with 1 when a message
was lost, when a bag does not have what its metadata counts, when the median ratio of p99 lateness (b)/(a) is above 1.5,
or when (b) missed more ticks than (a). With --root on a memory disk it shows what recording itself costs, without the
kernel's writing to a real one.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import yaml
from apparatus import CONFIGS, ended, in_a_process, report, running

from ibrobot_core.app import load_config
from ibrobot_core.interfaces import Context, Sensor
from ibrobot_core.messages import Header, Image
from ibrobot_core.plugins import Registry, discover

CONFIG = CONFIGS / "so101.yaml"
ALLOWED_RATIO = 1.5


class Camera(Sensor):
    """A camera of 30 Hz whose pictures cost next to nothing to make."""

    message_type = Image

    def __init__(self, ctx: Context) -> None:
        self.topic = f"/camera/{ctx.name}/image_raw"
        self._clock = ctx.clock
        self._picture = np.random.default_rng(0).integers(0, 255, 480 * 640 * 3, np.uint8)
        self._next_ns = 0

    @override
    def open(self) -> None:
        self._next_ns = self._clock.now_ns()

    @override
    def read(self, timeout_s: float) -> Image:
        self._next_ns += 1_000_000_000 // 30
        self._clock.sleep_until(self._next_ns)
        return Image(Header(self._clock.now_ns(), "camera"), 480, 640, "rgb8", 640 * 3, self._picture.copy())

    @override
    def close(self) -> None:
        pass


def registry() -> Registry:
    """What is installed, with the synthetic camera in place of the rendered one."""
    found = discover()
    entry = found.entries["sensor", "mujoco"]
    camera = attrs.evolve(entry.descriptor, make=lambda options, ctx: Camera(ctx), summary="synthetic")
    found.entries["sensor", "mujoco"] = attrs.evolve(entry, descriptor=camera)
    return found


def run(seconds: float, root: Path | None) -> dict[str, Any]:
    """One run; recorded where there is a root."""
    document = yaml.safe_load(CONFIG.read_text())
    document["peripherals"].append({**document["peripherals"][0], "name": "side"})
    image = next(o for o in document["contract"]["observations"] if o.get("peripheral") == "top")
    side = {**image, "key": "observation.images.side", "peripheral": "side"}
    document["contract"]["observations"].append(side)
    if root is not None:
        document["recording"] = {"type": "mcap", "root": str(root)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "so101.yaml"
        path.write_text(yaml.safe_dump(document, sort_keys=False))
        found = registry()
        with running(load_config(path, sim=True, registry=found), found, duration_s=seconds) as runtime:
            summary = ended(runtime)
    if root is not None:
        summary["kept"] = [bag(path) for path in sorted(root.glob("*/episodes/*"))]
    return summary


def bag(path: Path) -> dict[str, Any]:
    """What an episode says of itself, and how many messages a reading of it finds."""
    reader = discover().open_episode(path)
    said = reader.summary()
    read = sum(1 for _ in reader.messages())
    reader.close()
    return {
        "finished": said.finished,
        "seconds": (said.end_ns - said.start_ns) * 1e-9,
        "messages": sum(topic.count for topic in said.topics.values()),
        "read": read,
        "dropped": sum(topic.dropped for topic in said.topics.values()),
        "bytes": sum(file.stat().st_size for file in path.iterdir()),
    }


def pairs(repetitions: int, seconds: float, root: Path | None) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Measurements without and with recording; what was recorded is removed."""
    for number in range(repetitions):
        off = in_a_process(__file__, "--only", "off", "--seconds", seconds)
        with tempfile.TemporaryDirectory(dir=root) as folder:
            on = in_a_process(__file__, "--only", "on", "--seconds", seconds, "--root", folder)
        for name, result in (("without", off), ("recorded", on)):
            loop = result["loop"]
            rates = ", ".join(f"{camera} {rate:.1f}" for camera, rate in result["rates_hz"].items())
            print(
                f"{number + 1}  {name:8} p50 {loop['lateness_p50_us']:5} us  p99 {loop['lateness_p99_us']:5} us  "
                f"missed {loop['missed']}  cameras {rates} Hz",
                flush=True,
            )
        kept = {key: sum(episode[key] for episode in on["kept"]) for key in on["kept"][0]}
        print(
            f"   {len(on['kept'])} episodes of {kept['seconds']:.1f} s together, {kept['messages']} messages, "
            f"{kept['bytes'] / 1e9:.2f} GB, {kept['dropped']} dropped",
            flush=True,
        )
        yield off, on


def compare(repetitions: int, seconds: float, root: Path | None) -> int:
    """Measure in turn, print what was found, and return the exit status."""
    failed, ratios, missed = False, [], [0, 0]
    for off, on in pairs(repetitions, seconds, root):
        missed = [before + result["loop"]["missed"] for before, result in zip(missed, (off, on), strict=True)]
        late_off, late_on = (result["loop"]["lateness_p99_us"] for result in (off, on))
        ratios.append(late_on / max(1, late_off))
        failed |= any(e["dropped"] or not e["finished"] or e["messages"] != e["read"] for e in on["kept"])
        lost, faults = on["drops"].get("*", 0), on["faults"]
        if lost or faults:
            print(f"   lost on the way to the recorder: {lost}; faults: {'; '.join(faults) or 'none'}")
            failed = True
    ratio = statistics.median(ratios)
    # What the loop misses without recording is the machine's doing.
    failed |= ratio > ALLOWED_RATIO or missed[1] > missed[0]
    print(f"p99 lateness recorded / without: {ratio:.2f}; ticks missed: {missed[1]} recorded, {missed[0]} without")
    print("FAILED" if failed else "passed")
    report(p99_ratio=ratio, missed=missed[1], missed_without=missed[0])
    return int(failed)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=120.0, help="of each measurement")
    parser.add_argument("--root", type=Path, help="where to record; a temporary folder when left out")
    parser.add_argument("--only", choices=("off", "on"), help="one measurement, printed as JSON")
    arguments = parser.parse_args()
    if arguments.only is None:
        return compare(arguments.repetitions, arguments.seconds, arguments.root)
    print(json.dumps(run(arguments.seconds, arguments.root if arguments.only == "on" else None)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
