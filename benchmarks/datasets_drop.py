"""Whether dropping what `ibrobot datasets check` lists makes a policy better.

    python benchmarks/datasets_drop.py [--good 60] [--bad 20] [--steps 3000] [--trials 40] [--work datasets_drop]

1. `ibrobot record`: the scripted pick in simulation, in lockstep, without cameras, as in `train_pick_cube.py`; and bad
   demonstrations of it: a person who waits at first, who stops in the middle, whose hand trembles, or who never shuts
   the gripper. Nobody has dropped the failures among them.
2. `ibrobot datasets check` of all.
3. `ibrobot convert` and `ibrobot train`, twice: with all of them, and without those that are listed. Both trainings
   have the same number of steps and the same seed.
4. `ibrobot eval` of both policies with the same seeds, which no demonstration has; the verdict is that of its report.

Needs LeRobot in the same environment. What is in the folder `--work` is not done again. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from figures import report
from numpy.typing import NDArray

CONFIG = Path(__file__).parents[1] / "configs" / "so101_pick_cube.yaml"
FIRST_SEED = 1000
"""Of the demonstrations. Trials have the seeds from 0 on."""
NOT_ALL_SUCCEEDED = 3
"""Exit code of `ibrobot record` when an episode failed."""
GRIPPER = 5

type Array = NDArray[np.float64]
type Change = Callable[[Callable[[Array], Array], Array], Array]
"""Makes actions, shape (N, J), of the right ones at any times, and the times of the actions [s]."""


def waiting(at: Callable[[Array], Array], times_s: Array) -> Array:
    """Nothing moves for 3 s."""
    return at(np.maximum(0.0, times_s - 3.0))


def stopping(at: Callable[[Array], Array], times_s: Array) -> Array:
    """The motion pauses for 3 s."""
    return at(np.where(times_s < 1.0, times_s, np.maximum(1.0, times_s - 3.0)))


def trembling(at: Callable[[Array], Array], times_s: Array) -> Array:
    """The arm trembles, the same at the same times."""
    noise = [np.random.default_rng(round(1000 * each)).normal(0, 0.06, GRIPPER) for each in times_s]
    actions = at(times_s).copy()
    actions[:, :GRIPPER] += noise
    return actions


def open_handed(at: Callable[[Array], Array], times_s: Array) -> Array:
    """The gripper stays as it is at the beginning."""
    actions = at(times_s).copy()
    actions[:, GRIPPER] = at(np.zeros(1))[0, GRIPPER]
    return actions


BAD: Mapping[str, Change] = {
    "waiting": waiting, "stopping": stopping, "trembling": trembling, "open_handed": open_handed,
}  # fmt: skip


def plant(change: Change) -> None:
    """Make the scripted policy of this process demonstrate badly."""
    from ibrobot_mujoco.experts.expert import ACTION, STAMP, ScriptedExpert

    plain = ScriptedExpert.infer

    def infer(self: ScriptedExpert, tensors: Any) -> Any:
        answer = dict(plain(self, tensors))
        episode, rate = self._episode, self._options.rate_hz
        assert episode is not None
        begin = round((int(tensors[STAMP][0]) - episode.start_ns) / 1e9 * rate)
        times_s = (begin + np.arange(len(answer[ACTION]))) / rate
        return {**answer, ACTION: change(episode.trajectory.at, times_s)}

    ScriptedExpert.infer = infer  # type: ignore[method-assign]


def record(folder: Path, kind: str, episodes: int, seed: int) -> None:
    """Record demonstrations; changes this process."""
    from ibrobot_core.cli.main import main

    if kind in BAD:
        plant(BAD[kind])
    words = (
        "record", CONFIG, "--sim", "--lockstep", "--headless", "--episodes", episodes, "--seed", seed, "--root", folder,
        "--dataset", kind, "--prompt", "put the cube into the bin",
    )  # fmt: skip
    with patch.object(sys, "argv", ["ibrobot", *map(str, words)]):
        main()


def command(*words: object) -> str:
    """Run a command of this environment, and return what it printed."""
    print(f"$ ibrobot {' '.join(map(str, words))[:160]}", file=sys.stderr, flush=True)
    program = Path(sys.executable).with_name("ibrobot")
    done = subprocess.run([program, *map(str, words)], stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode not in (0, NOT_ALL_SUCCEEDED):
        raise SystemExit(f"{words[0]} ended with {done.returncode}")
    return done.stdout


def demonstrate(folder: Path, good: int, bad: int) -> None:
    """Record what is not there yet, each kind in a process of its own."""
    counts = {"good": good, **{kind: bad // len(BAD) + (i < bad % len(BAD)) for i, kind in enumerate(BAD)}}
    for number, (kind, count) in enumerate(counts.items()):
        if count and not (folder / kind).exists():
            part = folder.with_name(f"{folder.name}-{kind}")
            arguments = (part, kind, count, FIRST_SEED + 1000 * number)
            child = multiprocessing.get_context("fork").Process(target=record, args=arguments)
            child.start()
            child.join()
            folder.mkdir(parents=True, exist_ok=True)
            (part / kind).rename(folder / kind)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--good", type=int, default=60, help="good demonstrations")
    parser.add_argument("--bad", type=int, default=20, help="bad ones")
    parser.add_argument("--steps", type=int, default=3000, help="of each training")
    parser.add_argument("--trials", type=int, default=40, help="runs of each policy")
    parser.add_argument("--work", type=Path, default=Path("datasets_drop"), help="folder of all that comes to be")
    arguments = parser.parse_args()
    work = arguments.work.absolute()
    demos, kept = work / "episodes", work / "check.json"
    demonstrate(demos, arguments.good, arguments.bad)
    if not kept.exists():
        kept.write_text(command("datasets", "check", demos, "--json"), encoding="utf-8")
    listed = {Path(each["episode"]) for each in json.loads(kept.read_text(encoding="utf-8"))["listed"]}
    episodes = sorted(demos.glob("*/episodes/episode_*"))
    models: list[object] = []
    for name, chosen in (("all", episodes), ("checked", [each for each in episodes if each not in listed])):
        dataset, trained = work / f"dataset-{name}", work / f"train-{name}"
        if not dataset.exists():
            command("convert", *chosen, "--out", dataset)
        if not (trained / "checkpoints/last").exists():
            command("train", dataset, "--out", trained, "--steps", arguments.steps, "--device", "cpu")
        path = trained / "checkpoints/last/pretrained_model"
        models += ["--model", name, "--set", f"models.{name}={{type: lerobot, path: {path}}}"]
    printed = command(
        "eval", CONFIG, "--sim", "--mode", "learned", "--episodes", arguments.trials, *models, "--videos", 0, "--json",
        "--out", work / "evaluation",
    )  # fmt: skip
    evaluation = json.loads(printed.strip().rpartition("\n")[2])
    successes = [each["successes"] for each in evaluation["policies"]]
    (compared,) = evaluation["comparisons"]
    bad = [each for each in episodes if each.parts[-3] in BAD]
    result = {
        "bad": len(bad), "bad_listed": len(listed.intersection(bad)), "good": len(episodes) - len(bad),
        "good_listed": len(listed.difference(bad)), "trials": arguments.trials, "successes_all": successes[0],
        "successes_checked": successes[1], "mcnemar_p": compared["mcnemar_p"],
    }  # fmt: skip
    print(json.dumps({**result, "verdict": compared["words"]}))
    report(**result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
