"""How well `ibrobot datasets check` finds faulty demonstrations, and how long it takes.

    python benchmarks/datasets_check.py [--episodes 200] [--each 3] [--work datasets_check]

Records short demonstrations of a made-up arm as bags (`tests/shared/made_runs.py`): `--each` with every fault of
`planted_faults.py`, of seeds on which no threshold was chosen, among good ones. Prints a table with the recall and the
precision of each kind (a finding of a kind in an episode of another kind counts against it), and one JSON object. With
lerobot-doctor and lerobot-lint in the environment (`uv pip install lerobot-doctor`, `uv pip install --no-deps
lerobot-lint`) it also counts what these flag, in the same episodes.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path
from time import perf_counter
from typing import Any

from apparatus import report

FIRST_SEED = 70_000
CONSEQUENCES = {
    "idle_start": {"odd_length"}, "idle_end": {"odd_length"}, "stall": {"odd_length"},
    "jerk": {"other_speed", "odd_path"}, "other_speed": {"odd_length", "idle_end"},
    "arm_not_following": {"odd_path", "unseen_states"}, "saturated": {"arm_not_following", "odd_path", "joint_zero"},
    "unseen_start": {"unseen_states"}, "picture_black": {"picture_frozen"},
}  # fmt: skip
"""Kind -> other kinds that are true of its episodes, too."""


def make(folder: Path, episodes: int, each: int) -> dict[str, str]:
    """Record the episodes; name -> kind of its fault, empty for a good one."""
    from made_runs import Run, record_run
    from planted_faults import DEMONSTRATED

    kinds = [kind for kind in DEMONSTRATED for _ in range(each)]
    kinds += [""] * (episodes - len(kinds))
    order = sorted(range(len(kinds)), key=lambda i: (i * 7919) % 10_007)  # mixed, but the same each time
    truth: dict[str, str] = {}
    copied = dict[int, str]()  # seed -> the one of an original and its copy that comes first
    for number, i in enumerate(order, 1):
        kind, name = kinds[i], f"episode_{number:06d}"
        options: dict[str, Any] = {"seed": FIRST_SEED + i, "seconds": 6.6 + 0.1 * (i % 5), "camera_hz": 5.0}
        options |= {"cameras": ("top",), **DEMONSTRATED.get(kind, {})}
        if kind == "duplicate":  # of a good one
            options["seed"] = FIRST_SEED + len(kinds) - 1 - i % each
            options["seconds"] = 6.6 + 0.1 * ((options["seed"] - FIRST_SEED) % 5)
        record_run(folder / "episodes" / name, Run(acts=False, **options))
        first = copied.setdefault(options["seed"], name)
        truth[name] = "duplicate" if first != name else "" if kind == "duplicate" else kind  # the later one is the copy
    return truth


def flagged(folder: Path) -> dict[str, set[str]]:
    """Tool of others -> the names of the episodes that it flags; empty for tools that are not installed."""
    from ibrobot_diagnose.cause import Reference
    from ibrobot_diagnose.causes import others
    from ibrobot_diagnose.diagnosis import diagnose
    from ibrobot_diagnose.references import find_episodes, read_episode

    tools = [each() for each in others.TOOLS if each in others.CAUSES]
    names: dict[str, set[str]] = {each.name: set() for each in tools}
    for episode in find_episodes([folder]) if tools else ():
        for finding in diagnose(read_episode(episode), Reference(), tools).findings:
            names[finding.name].add(episode.name)
    return names


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=200, help="in all")
    parser.add_argument("--each", type=int, default=3, help="with each fault")
    parser.add_argument("--work", type=Path, default=Path("datasets_check"), help="folder of the episodes")
    arguments = parser.parse_args()
    folder, kept = arguments.work.absolute() / "demos", arguments.work.absolute() / "truth.json"
    if not kept.exists():
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(make(folder, arguments.episodes, arguments.each)), encoding="utf-8")
    truth: dict[str, str] = json.loads(kept.read_text(encoding="utf-8"))
    command = [Path(sys.executable).with_name("ibrobot"), "datasets", "check", folder, "--json"]
    begin = perf_counter()
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    seconds = perf_counter() - begin
    checked = json.loads(done.stdout)
    tools = flagged(folder)
    named = {
        Path(each["episode"]).name: [one["name"] for one in each["causes"] if one["name"] not in tools]
        for each in checked["listed"]
    }
    named = {name: causes for name, causes in named.items() if causes}
    right, planted, wrong = Counter[str](), Counter(kind for kind in truth.values() if kind), Counter[str]()
    for name, kind in truth.items():
        for one in named.get(name, ()):
            if one == kind:
                right[one] += 1
            elif one not in CONSEQUENCES.get(kind, ()):
                wrong[one] += 1
    good = [name for name, kind in truth.items() if not kind]
    print(json.dumps({name: [truth[name], each] for name, each in named.items()}), file=sys.stderr)
    accused = sum(name in named for name in good)
    of_kind = {kind: {name for name, each in truth.items() if each == kind} for kind in ("", *planted)}
    print(f"{'kind':20}{'recall':>10}{'precision':>12}{''.join(f'{tool:>16}' for tool in tools)}")
    for kind in (*planted, *(each for each in wrong if each not in planted)):
        of = right[kind] + wrong[kind]
        theirs = "".join(f"{f'{len(of_kind.get(kind, set()) & each)}/{planted[kind]}':>16}" for each in tools.values())
        print(f"{kind:20}{f'{right[kind]}/{planted[kind]}':>10}{f'{right[kind]}/{of}' if of else '-':>12}{theirs}")
    theirs = "".join(f"{f'{len(of_kind[""] & each)}/{len(good)}':>16}" for each in tools.values())
    print(f"{'good, listed':20}{f'{accused}/{len(good)}':>10}{'':>12}{theirs}")
    recall = sum(right.values()) / sum(planted.values())
    precision = sum(right.values()) / max(1, sum(right.values()) + sum(wrong.values()))
    result: dict[str, float] = {
        "recall": recall, "precision": precision, "good": len(good), "good_listed": accused,
        "seconds_per_1000": 1000 * seconds / len(truth),
    }  # fmt: skip
    for tool, each in tools.items():
        result[f"{tool}_recall"] = len(each - of_kind[""]) / sum(planted.values())
        result[f"{tool}_good_listed"] = len(of_kind[""] & each)
    print(json.dumps(result))
    report(**result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
