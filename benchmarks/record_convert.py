"""What `ibrobot record --convert` costs, and how long the dataset takes after the last episode.

    python benchmarks/record_convert.py [--episodes 20] [--seconds 15] [--pause 5] [--robot YAML]

The simulated SO-101 with two rendered 640x480 cameras at 30 Hz, in real time, in one run: a session (a) without and
(b) with `--convert`, each in processes of its own, with pauses in which somebody would reset the scene. Then `ibrobot
convert` of the episodes of (b) into another folder. The arm stands still.

Printed are the lateness of control, and the time from the end of the last episode to the finished dataset, of (b) and
of (a) with `ibrobot convert` after it; both say nothing on a busy machine. Exits with 1 if (b) lost a message or missed
more ticks than (a), or the dataset differs from that of the conversion afterwards.
"""

from __future__ import annotations

import argparse
import filecmp
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import attrs
from apparatus import report
from ibrobot_testing import ibrobot_command


@attrs.frozen
class Session:
    """A session that has ended."""

    summary: dict[str, Any]
    after_s: float
    """Time from the end of the last episode to the end of the command [s]."""
    lost: int
    """Messages that the conversion, if there was one, found lost."""


def record(folder: Path, asked: argparse.Namespace, *more: str) -> Session:
    """Record a session in a folder."""
    command = [
        *ibrobot_command(), "record", asked.robot, "--sim", "--mode", "still", "--headless", "--auto", "--prompt",
        "pick", "--events", "--json", "--set=control_modes.still={executors: [arm_position, gripper_position]}",
        f"--episodes={asked.episodes}", f"--reset-time={asked.pause}",
        f"--set=contract.max_duration_s={asked.seconds}", *more,
    ]  # fmt: skip
    summary: dict[str, Any] = {}
    ended_s, lost = 0.0, 0
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            try:
                told = json.loads(line)
            except ValueError:
                continue
            if "loop" in told:
                summary = told
            if told.get("saved") == asked.episodes and not ended_s:
                ended_s = time.monotonic()
            lost += told.get("lost_messages", 0)
    if process.returncode not in (0, 3):
        raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}")
    return Session(summary, time.monotonic() - ended_s, lost)


def convert(folder: Path, out: str) -> float:
    """Convert all episodes; returns how long that takes [s]."""
    begin = time.monotonic()
    subprocess.run(
        [*ibrobot_command(), "convert", "episodes/default", "--out", out], cwd=folder, check=True, stdout=sys.stderr
    )
    return time.monotonic() - begin


def equal(first: Path, second: Path) -> bool:
    """Whether two folders have the same files with the same bytes."""
    names = [
        sorted(str(path.relative_to(each)) for path in each.rglob("*") if path.is_file()) for each in (first, second)
    ]
    _, differ, missing = filecmp.cmpfiles(first, second, names[0], shallow=False)
    return names[0] == names[1] and not differ and not missing


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=15.0, help="of each episode")
    parser.add_argument("--pause", type=float, default=5.0, help="after each episode [s]")
    parser.add_argument("--robot", default="so101", help="robot YAML with the cameras top and wrist")
    asked = parser.parse_args()
    asked.robot = str(Path(asked.robot).resolve()) if Path(asked.robot).is_file() else asked.robot
    with tempfile.TemporaryDirectory() as made:
        without, beside = Path(made) / "without", Path(made) / "beside"
        for folder in (without, beside):
            folder.mkdir()
        plain = record(without, asked)
        afterwards_s = plain.after_s + convert(without, "later")
        converted = record(beside, asked, "--convert")
        convert(beside, "later")
        same = equal(beside / "datasets/default", beside / "later")
    for name, session in (("without", plain), ("--convert", converted)):
        loop = session.summary["loop"]
        print(
            f"{name:9} p50 {loop['lateness_p50_us']:5} us  p99 {loop['lateness_p99_us']:5} us  missed {loop['missed']}"
        )
    late = [each.summary["loop"]["lateness_p99_us"] for each in (plain, converted)]
    missed = [each.summary["loop"]["missed"] for each in (plain, converted)]
    ratio = late[1] / max(1, late[0])
    print(f"dataset {converted.after_s:.1f} s after the last episode, {afterwards_s:.1f} s by a conversion afterwards")
    print(
        f"p99 lateness with / without: {ratio:.2f}; {converted.lost} messages lost; "
        f"bytes {'equal' if same else 'DIFFER'}"
    )
    report(
        dataset_s=converted.after_s, afterwards_s=afterwards_s, p99_ratio=ratio, missed=missed[1],
        missed_without=missed[0], lost=converted.lost,
    )  # fmt: skip
    return 0 if same and not converted.lost and missed[1] <= missed[0] else 1


if __name__ == "__main__":
    sys.exit(main())
