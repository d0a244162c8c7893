"""Episodes of the scripted experts, in lockstep and without cameras.

    python benchmarks/experts.py scenes|tool|guard [--episodes N] [--seed N] [--modes NAME …] [--policy CHECKPOINT]

`scenes`: the expert of each scene, 100 episodes; the first ten seeds twice more, since equal seeds have to give equal
bytes. Exits with 1 when an expert succeeds in fewer than 95 % of the episodes.
`tool`: the pick with poses of the tool as actions, `tool.position`, `tool.rotation_6d` and the gripper, which inverse
kinematics turns into positions, beside the same with the joints' positions, seed by seed. Exits with 1 when fewer than
95 % of the former succeed.
`guard`: the experts, also with the objects of the scene in the section `world`, with the guard of the robot YAML and
with `control.guard=null`, 20 episodes each. `--policy` adds a policy that LeRobot has trained on the pick, e.g. of the
tutorial "Train a policy". Exits with 1 if they succeed less often with the guard, or take more than 1 % longer.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from time import process_time
from typing import Any

import attrs
from apparatus import CONFIGS, report, running

from ibrobot_core.app import load_config

SCENES = {
    **{name: ("so101_scenes", f"simulation.scene={name}") for name in ("pick_cube", "push", "stack", "sort", "drawer")},
    "handover": ("bi_so101_handover", "simulation.scene=handover"),
}
"""Mode -> robot YAML and setting."""
TOOL = ("contract.actions.0.select=[tool.position, tool.rotation_6d]", "models.scripted_pick.actions=tool")
REPEATED, ENOUGH, MOST_SLOWER = 10, 0.95, 0.01


@attrs.frozen
class Came:
    """What became of the episodes of a run."""

    won: tuple[bool, ...]
    digest: str
    """Of all states."""
    summary: dict[str, Any]
    cpu_s: float

    @property
    def ticks(self) -> int:
        """Of the whole run."""
        return int(self.summary["loop"]["ticks"])

    @property
    def interventions(self) -> dict[str, int]:
        """Of the safety layer, by their kind."""
        return {kind: count for kind, count in self.summary["counters"]["safety"].items() if count}


def run(robot: str, mode: str | None, overrides: Sequence[str], seed: int, episodes: int) -> Came:
    """Run episodes; their seeds count up."""
    config = load_config(CONFIGS / f"{robot}.yaml", sim=True, mode=mode, overrides=overrides)
    digest, won, successes, begin = hashlib.sha256(), list[bool](), 0, process_time()
    with running(config, lockstep=True, seed=seed, episodes=episodes) as runtime:
        session, is_over = runtime.session, False
        while not is_over:
            is_over = runtime.step()
            assert session.state is not None
            for values in (
                session.state.position,
                session.state.velocity,
                session.state.command,
                session.state.signals,
            ):
                digest.update(values.tobytes())
            if session.outcome.episodes > len(won):
                won.append(session.outcome.successes > successes)
                successes = session.outcome.successes
    return Came(tuple(won), digest.hexdigest()[:16], dict(runtime.summary()), process_time() - begin)


def scenes(asked: argparse.Namespace) -> bool:
    """The experts of the scenes, as a table."""
    episodes, good, figures = asked.episodes or 100, True, {}
    print("| scene | successes | simulated s per episode | CPU s per episode | equal seeds, equal bytes |")
    print("|---|---|---|---|---|")
    for scene in asked.modes or SCENES:
        robot, *changes = SCENES[scene]
        came = run(robot, scene, changes, asked.seed, episodes)
        again = {run(robot, scene, changes, asked.seed, min(REPEATED, episodes)).digest for _ in range(2)}
        good &= sum(came.won) >= ENOUGH * episodes and len(again) == 1
        seconds, equal = came.summary["duration_s"] / episodes, "yes" if len(again) == 1 else "NO"
        rate = f"{sum(came.won)} of {episodes}"
        print(f"| {scene} | {rate} | {seconds:.2f} | {came.cpu_s / episodes:.3f} | {equal} |", flush=True)
        failed = [asked.seed + i for i, won in enumerate(came.won) if not won]
        print(f"failed seeds {failed}; corrected {came.interventions}; digest {came.digest}", file=sys.stderr)
        figures[scene] = sum(came.won)
    report(**figures)
    return good


def tool(asked: argparse.Namespace) -> bool:
    """The pick through poses of the tool, beside the pick through joints."""
    episodes = asked.episodes or 100
    joints, poses = (run("so101_blind", None, changes, asked.seed, episodes) for changes in ((), TOOL))
    for name, came in (("joints", joints), ("tool", poses)):
        print(f"{name}: {sum(came.won)} of {episodes}, corrected {came.interventions}, {came.cpu_s:.1f} s")
    pairs = list(zip(joints.won, poses.won, strict=True))
    report(
        joints=sum(joints.won), tool=sum(poses.won), unreachable=poses.summary["unreachable"],
        only_joints=pairs.count((True, False)), only_tool=pairs.count((False, True)),
    )  # fmt: skip
    return sum(poses.won) >= ENOUGH * episodes


def guard(asked: argparse.Namespace) -> bool:
    """All experts with the guard and without."""
    episodes, totals = asked.episodes or 20, dict.fromkeys(("with", "without", "lost", "won"), 0)
    runs = {**SCENES, "scripted": ("so101_pick_cube",)}
    if asked.modes:
        runs = {mode: runs[mode] for mode in asked.modes}
    if asked.policy is not None:
        os.environ["IBROBOT_POLICY"] = str(asked.policy)
        runs["learned"] = ("so101_pick_cube",)
    ticks = [0, 0]
    for mode, (robot, *changes) in runs.items():
        guarded, free = (
            run(robot, mode, (*changes, *more), asked.seed, episodes) for more in ((), ("control.guard=null",))
        )
        pairs = list(zip(guarded.won, free.won, strict=True))
        lost, won = pairs.count((False, True)), pairs.count((True, False))
        for name, count in zip(totals, (sum(guarded.won), sum(free.won), lost, won), strict=True):
            totals[name] += count
        ticks = [ticks[0] + guarded.ticks, ticks[1] + free.ticks]
        print(
            f"{mode:10} of {episodes}: with the guard {sum(guarded.won)}, without {sum(free.won)};"
            f" only without {lost}, only with {won}; {guarded.ticks} and {free.ticks} ticks",
            flush=True,
        )
    slower = ticks[0] / ticks[1] - 1
    report(
        episodes=episodes * len(runs), successes=totals["with"], successes_without=totals["without"],
        lost=totals["lost"], won=totals["won"], slower_percent=100 * slower,
    )  # fmt: skip
    return totals["with"] >= totals["without"] and slower <= MOST_SLOWER


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = {"scenes": scenes, "tool": tool, "guard": guard}
    parser.add_argument("part", choices=parts)
    parser.add_argument("--episodes", type=int, help="of each expert")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; later ones count up")
    parser.add_argument("--modes", nargs="+", choices=(*SCENES, "scripted"), help="some of the experts")
    parser.add_argument("--policy", type=Path, help="a checkpoint of LeRobot's, for `guard`")
    asked = parser.parse_args()
    return 0 if parts[asked.part](asked) else 1


if __name__ == "__main__":
    sys.exit(main())
