"""Planning of a big conversion: 1,000 and 10,000 small recordings are listed and planned, by their summaries alone.

A process of its own plans each number, and reports seconds and the growth of its memory. The recordings are copies
of one with UUIDs of their own, and with random bytes in place of messages, which planning must not read.

    python benchmarks/plan_conversion.py [--bags 1000,10000]
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import uuid
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests/shared"))
from recordings import record


def make(folder: Path, bags: int) -> None:
    """Write `bags` recordings, as `ibrobot record` names them, with distinct UUIDs."""
    template = folder / "template"
    record(template, 1, 0.3, uuid=str(uuid.UUID(int=0, version=4)))
    text = (template / "metadata.yaml").read_text()
    (file,) = template.glob("*.mcap")
    damage(file)
    for number in range(1, bags + 1):
        bag = folder / f"big/episodes/episode_{number:06d}"
        bag.mkdir(parents=True)
        own = text.replace(str(uuid.UUID(int=0, version=4)), str(uuid.UUID(int=number, version=4)))
        (bag / "metadata.yaml").write_text(own)
        (bag / file.name).hardlink_to(file)
    shutil.rmtree(template)


def damage(file: Path) -> None:
    """Overwrite the first half of a file of messages, so that whatever reads them finds the damage."""
    content = file.read_bytes()
    middle = len(content) // 2
    file.write_bytes(content[:64] + bytes(middle - 64) + content[middle:])


def plan(folder: Path) -> None:
    """List and plan them; print seconds and MiB as JSON."""
    from ibrobot_data.request import ConversionRequest
    from ibrobot_data.run import find_episodes, plan_conversion
    from ibrobot_lerobot.options import LeRobotOptions

    from ibrobot_core.app import installed_plugins

    installed_plugins()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin, begin_cpu = time.perf_counter(), time.process_time()
    found = find_episodes([folder / "big"])
    listed = time.perf_counter() - begin
    planned = plan_conversion(ConversionRequest(folder / "set", LeRobotOptions(), "lerobot"), found)
    seconds = time.perf_counter() - begin
    cpu = time.process_time() - begin_cpu
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(json.dumps({"bags": len(planned), "listed_s": listed, "planned_s": seconds, "cpu_s": cpu, "mib": grown}))


def main() -> None:
    """Measure each number of recordings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bags", default="1000,10000")
    parser.add_argument("--plan", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.plan:
        plan(arguments.plan)
        return
    for bags in map(int, arguments.bags.split(",")):
        with tempfile.TemporaryDirectory() as name:
            make(Path(name), bags)
            command = [sys.executable, __file__, "--plan", name]
            done = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        print(
            f"{done['bags']} recordings: listed {done['listed_s']:.1f} s, planned {done['planned_s']:.1f} s, "
            f"of these {done['cpu_s']:.1f} s of a core, memory {done['mib']:.0f} MiB"
        )


if __name__ == "__main__":
    main()
