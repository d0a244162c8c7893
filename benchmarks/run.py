"""Run the benchmarks, each of which guards a claim of the documentation, and compare with the last figures.

    python benchmarks/run.py [NAME ...] [--list] [--save] [--page]

Prints a row per figure: the last one, this one, and their ratio. Exits with 1 if a benchmark missed its limit. `--save`
writes the figures of those that met it to `figures.json` and to the table in `docs/reference/benchmarks.md`, with date,
commit and machine; `--page` only writes the table anew. `--list` shows the claims and takes no measurement.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import attrs
from apparatus import reported

FOLDER = Path(__file__).parent
ROOT = FOLDER.parent
LAST = FOLDER / "figures.json"
PAGE = ROOT / "docs/reference/benchmarks.md"
BEGIN, END = "<!-- table: python benchmarks/run.py --page -->\n", "<!-- end of the table -->\n"


@attrs.frozen
class Claim:
    """What a benchmark guards."""

    name: str
    text: str
    page: str
    """The page that makes the claim, from the root of the repository."""
    command: str
    """The script and its options."""
    needs: str = ""
    """What must be installed besides the packages here."""

    @property
    def script(self) -> Path:
        """The program."""
        return FOLDER / self.command.split()[0]


CLAIMS = (
    Claim(
        "control_loop",
        "cameras, a policy, a busy thread or three pages do not delay control: p99 of the lateness at most twice that"
        " of a bare loop, no tick missed",
        "docs/explanation/control-process.md",
        "control_loop.py",
    ),
    Claim(
        "safety",
        "a tick of the safety layer for six joints takes at most 60 µs (p50)",
        "docs/explanation/safety.md",
        "safety.py",
    ),
    Claim(
        "guard_experts",
        "the guard leaves motion alone that harms nothing: experts of seven scenes succeed as often as without it, and"
        " take at most 1 % longer",
        "docs/explanation/safety.md",
        "experts.py guard --episodes 5 --seed 200",
    ),
    Claim(
        "guard_cost",
        "with the guard and 20 objects around the arm, the p99 of the loop's lateness is at most 1.3 times as large",
        "docs/explanation/safety.md",
        "guard_cost.py --parts lateness checks --pairs 8",
    ),
    Claim(
        "record",
        "recording 83 MB/s loses nothing, misses no tick, and leaves p99 of the lateness within 1.5x",
        "docs/decisions/0015-recordings-beside-the-page-cache.md",
        "record.py",
    ),
    Claim(
        "convert",
        "`ibrobot convert` is three times as fast as LeRobot's default, as fast as its streaming, in constant memory",
        "docs/decisions/0012-own-writer-of-lerobot-datasets.md",
        "convert.py",
        "`lerobot[dataset]`, or `--lerobot PYTHON`",
    ),
    Claim(
        "record_convert",
        "`ibrobot record --convert` loses no message, misses no more ticks, and gives the bytes of a later conversion",
        "docs/how-to/record.md",
        "record_convert.py",
    ),
    Claim(
        "scenes",
        "the scripted policies solve 95 of 100 seeds of each scene; equal seeds give equal bytes",
        "docs/how-to/use-scenes.md",
        "experts.py scenes",
    ),
    Claim(
        "cartesian_pick",
        "the scripted pick through poses of the tool succeeds on at least 95 of 100 seeds",
        "docs/how-to/use-poses-of-the-tool.md",
        "experts.py tool",
    ),
    Claim(
        "train_pick_cube",
        "a small ACT learns the pick from 100 demonstrations in ten minutes on the CPU",
        "docs/tutorials/train-a-policy.md",
        "train_pick_cube.py",
        "LeRobot",
    ),
    Claim(
        "inverse_kinematics",
        "all exact targets solved, median below 0.3 ms; refused within 20 ms with the nearest point",
        "docs/reference/kinematics.md",
        "inverse_kinematics.py",
    ),
    Claim(
        "planning",
        "plans around obstacles keep the clearance and the limits; 95 % take at most 1 s of processor time,"
        " in a cage 10 s",
        "docs/how-to/plan-around-obstacles.md",
        "planning.py",
    ),
    Claim(
        "path_constraints",
        "200 held-out problems with a cup upright to 10 degrees are solved within 5 s, and no millisecond is beyond",
        "docs/how-to/keep-a-cup-upright.md",
        "path_constraints.py --kinds upright",
    ),
    Claim(
        "feetech_bus",
        "a sync read of six servos takes 1.3x a bare round trip, and a fifth of LeRobot's CPU time",
        "docs/decisions/0011-own-packing-for-the-servo-bus.md",
        "feetech_bus.py",
        "`lerobot[feetech]`, for its rows",
    ),
    Claim(
        "can_arm",
        "a read of eight CAN motors takes at most 1.25x the same frames by python-can alone",
        "docs/decisions/0070-what-drivers-of-arms-share.md",
        "can_arm.py",
    ),
    Claim(
        "inference_transport",
        "from request to chunk, each way to a model is at least five times as fast as LeRobot's",
        "docs/decisions/0051-robots-choose-their-server.md",
        "inference_transport.py --lerobot PYTHON",
        "`lerobot[async]==0.6.1`, in the interpreter PYTHON",
    ),
    Claim(
        "lerobot_server",
        "from observation to chunk, the policy `lerobot_server` takes no longer than LeRobot's own client (median of"
        " pairs)",
        "docs/how-to/run-from-policy-servers.md",
        "lerobot_async.py",
        "`lerobot[async]==0.6.1`",
    ),
    Claim(
        "smoothness",
        "with slow and lossy models no command exceeds a limit, and `rtc` halves the jerk",
        "docs/explanation/dispatch.md",
        "smoothness.py",
    ),
    Claim(
        "stepped_fleet",
        "`watermark: auto` is within 10 % of the best fixed watermark, before and after the model stood still",
        "docs/explanation/dispatch.md",
        "stepped_fleet.py",
    ),
    Claim(
        "moving_fleet",
        "robots of a server that is killed, stopped or drained have an answer from another one within 1 s",
        "docs/explanation/fleet.md",
        "moving_fleet.py",
    ),
    Claim(
        "agents_door",
        "an agent that floods the run with plans makes control miss no tick, and its stop is latched within 100 ms",
        "docs/decisions/0064-agents-have-authority-from-persons.md",
        "agents_door.py",
    ),
    Claim(
        "explain",
        "`ibrobot explain` names most strong faults that are planted in simulated runs first, and seldom accuses a"
        " healthy run or a weak policy's set-up",
        "docs/how-to/explain-a-failure.md",
        "explain.py",
        "`lerobot[dataset,diffusion,training]`",
    ),
    Claim(
        "explain_real",
        "of faults that are added to recordings of a real robot, `ibrobot explain` names most first, and nothing where"
        " there is none",
        "docs/how-to/explain-a-failure.md",
        "explain_real.py DATASET --data 10 --held 6",
        "a LeRobot dataset of a real arm: `run.py --dataset DATASET`",
    ),
    Claim(
        "explain_cost",
        "an episode with two cameras at 30 Hz is explained in less time than it lasts, with at most 300 MB",
        "docs/how-to/explain-a-failure.md",
        "explain_cost.py",
    ),
    Claim(
        "datasets_check",
        "`ibrobot datasets check` lists demonstrations with a planted fault, and seldom a good one",
        "docs/how-to/explain-a-failure.md",
        "datasets_check.py --episodes 1000 --each 6",
    ),
    Claim(
        "preflight",
        "`ibrobot preflight` finds a camera that moved by 20 pixels or 3 degrees, or says that it cannot tell, whatever"
        " the arm, the light and the objects do, and accuses none of 200 rigs that are as they were",
        "docs/how-to/check-a-rig.md",
        "preflight.py",
    ),
    Claim(
        "preflight_photographs",
        "on photographs of real scenes that were not looked at before, `ibrobot preflight` accuses at most 1 in 200"
        " unchanged ones, and calls none unmoved that moved by 20 pixels or 3 degrees",
        "docs/how-to/check-a-rig.md",
        "preflight_photographs.py PHOTOGRAPHS/fresh --unchanged 5",
        "the photographs that the script names: `run.py --photographs FOLDER`",
    ),
)


def last() -> dict[str, dict[str, Any]]:
    """Name of a claim -> its last figures, with date, commit and machine."""
    figures: dict[str, dict[str, Any]] = json.loads(LAST.read_text(encoding="utf-8"))
    return figures


def machine() -> str:
    """This machine, in a few words."""
    text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    model = re.search(r"^model name\s*: (.*)$", text, re.MULTILINE)
    return f"{os.cpu_count()} cores of {model[1] if model else platform.machine()}"


def table() -> str:
    """The table of the page: a row per claim."""
    rows = ["| claim | command | figures | measured |", "|---|---|---|---|"]
    for claim in CLAIMS:
        if (of_claim := last().get(claim.name)) is None:  # it was never measured, or missed its limit
            continue
        figures = ", ".join(f"{name} {value:g}" for name, value in of_claim["figures"].items())
        link = os.path.relpath(ROOT / claim.page, PAGE.parent)
        needs = f"; needs {claim.needs}" if claim.needs else ""
        measured = f"{of_claim['date']}, `{of_claim['commit']}`, {of_claim['machine']}"
        rows.append(f"| [{claim.text}]({link}) | `python benchmarks/{claim.command}`{needs} | {figures} | {measured} |")
    return "\n".join(rows) + "\n"


def page() -> str:
    """The page, with the table as it should be."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    return before + BEGIN + "\n" + table() + "\n" + END + rest.partition(END)[2]


def compared(claim: Claim, now: dict[str, float]) -> list[str]:
    """A row per figure: the last one, this one, their ratio."""
    before = last().get(claim.name, {}).get("figures", {})
    rows = []
    for name, value in now.items():
        old = before.get(name)
        ratio = f"{value / old:.2f}" if old else "-"
        rows.append(f"{claim.name:20} {name:28} {'-' if old is None else f'{old:g}':>10} {value:>10g} {ratio:>7}")
    return rows


def measure(claim: Claim, extra: list[str]) -> tuple[bool, dict[str, float]]:
    """Run a benchmark, whose output appears as it comes; whether it met its limit, and its figures."""
    command = [sys.executable, str(FOLDER / claim.command.split()[0]), *claim.command.split()[1:], *extra]
    print(f"\n$ python benchmarks/{' '.join([claim.command, *extra])}", flush=True)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        output = ""
        for line in process.stdout:
            print(line, end="", flush=True)
            output += line
    return process.returncode == 0, reported(output)


def save(measured: dict[str, dict[str, float]]) -> None:
    """Keep figures as the last ones, and write the table of the page."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()
    today = datetime.now(UTC).date().isoformat()
    kept = last()
    for name, figures in measured.items():
        kept[name] = {"date": today, "commit": commit, "machine": machine(), "figures": figures}
    kept = {claim.name: kept[claim.name] for claim in CLAIMS if claim.name in kept}
    LAST.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")


def main() -> int:
    """Run those that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="of claims; all when left out")
    parser.add_argument("--list", action="store_true", help="show the claims")
    parser.add_argument("--save", action="store_true", help="keep the figures as the last ones")
    parser.add_argument("--page", action="store_true", help="write the table of the page")
    parser.add_argument("--lerobot", metavar="PYTHON", help="an interpreter with LeRobot")
    parser.add_argument("--dataset", metavar="DATASET", help="recordings of a real arm")
    parser.add_argument("--photographs", metavar="FOLDER", help="with the folder `fresh`")
    asked = parser.parse_args()
    known = {claim.name: claim for claim in CLAIMS}
    if unknown := [name for name in asked.names if name not in known]:
        parser.error(f"no benchmark {', '.join(unknown)}; known: {', '.join(known)}")
    if asked.page:
        PAGE.write_text(page(), encoding="utf-8")
        return 0
    claims = [known[name] for name in asked.names] or list(CLAIMS)
    if asked.list:
        for claim in claims:
            print(f"{claim.name:20} {claim.text} ({claim.page})" + (f"; needs {claim.needs}" if claim.needs else ""))
        return 0
    rows, missed, good = [], [], {}
    for claim in claims:
        command = claim.command
        given = {
            "PYTHON": ("--lerobot", asked.lerobot), "DATASET": ("--dataset", asked.dataset),
            "PHOTOGRAPHS": ("--photographs", asked.photographs),
        }  # fmt: skip
        words = {word: each for word, each in given.items() if word in command}
        if lacking := [option for option, value in words.values() if not value]:
            missed.append(f"{claim.name}: not measured, {lacking[0]} is missing")
            continue
        for word, (_, value) in words.items():
            command = command.replace(word, value)
        met, figures = measure(attrs.evolve(claim, command=command), [])
        rows += compared(claim, figures)
        if met and figures:
            good[claim.name] = figures
        else:
            missed.append(f"{claim.name}: {'printed no figures' if met else 'missed its limit'}")
    print(f"\n{'benchmark':20} {'figure':28} {'last':>10} {'now':>10} {'ratio':>7}", *rows, *missed, sep="\n")
    if asked.save:
        save(good)
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
