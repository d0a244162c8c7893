"""The whole path of a policy: record demonstrations, convert them, train on them, run the result, and count.

    python benchmarks/train_pick_cube.py [--episodes 100] [--steps 5000] [--trials 100] [--work pick_cube] [--onnx]
        [--device cpu]

1. `ibrobot record`: the scripted pick in simulation, in lockstep, without cameras; the cube's pose is an observation.
2. `ibrobot convert`: a LeRobot dataset of the successes.
3. `ibrobot train`: its small ACT (0.5 million parameters) on the CPU, or on a GPU with `--device cuda`.
4. `ibrobot eval`: the trained policy in the same simulation, with cubes at places that were in no demonstration; with
   --onnx, also what `ibrobot export` makes of it, with the same seeds.

Needs LeRobot in the same environment: `pip install 'lerobot[dataset,training]'`. A stage whose result is in
the folder `--work` is not done again. Prints one JSON object with the successes and their 95 % interval, and with
--onnx the successes of the exported policy and the number of seeds with different outcomes.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from time import perf_counter

from apparatus import CONFIGS, ibrobot, report

CONFIG = CONFIGS / "so101_pick_cube.yaml"
FIRST_TRAINING_SEED = 1000
"""Trials have the seeds from 0 on."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100, help="demonstrations")
    parser.add_argument("--steps", type=int, default=5000, help="of training")
    parser.add_argument("--trials", type=int, default=100, help="runs of the trained policy")
    parser.add_argument("--work", type=Path, default=Path("pick_cube"), help="folder of all that comes to be")
    parser.add_argument("--onnx", action="store_true", help="also run the exported policy")
    parser.add_argument("--device", default="cpu", help="of training, and of the trained policy")
    arguments = parser.parse_args()
    work = arguments.work.absolute()
    episodes, dataset, trained, onnx = work / "episodes", work / "dataset", work / "train", work / "onnx"
    policy = trained / "checkpoints/last/pretrained_model"
    times_s = {}
    models: tuple[str | Path, ...] = ("--model", "act", "--set", f"models.act.path={policy}")
    models += ("--set", f"models.act.device={arguments.device}")
    stages: dict[str, tuple[Path, tuple[object, ...]]] = {
        "record": (
            episodes,
            (
                CONFIG, "--sim", "--lockstep", "--headless", "--episodes", arguments.episodes, "--seed",
                FIRST_TRAINING_SEED, "--root", episodes, "--dataset", "pick", "--prompt", "put the cube into the bin",
            ),
        ),
        "convert": (dataset, (episodes / "pick", "--out", dataset, "--outcome", "success")),
        "train": (trained, (dataset, "--out", trained, "--steps", arguments.steps, "--device", arguments.device)),
    }  # fmt: skip
    if arguments.onnx:
        stages["export"] = (onnx, (policy, "--to", "onnx", "--out", onnx))
        models += ("--model", "onnx", "--set", f"models.onnx={{type: onnx, path: {onnx}}}")
    for name, (made, words) in stages.items():
        if not made.exists():
            begin = perf_counter()
            ibrobot(name, *words, good=(0, 3))  # not all episodes succeeded
            times_s[name] = round(perf_counter() - begin)
    begin = perf_counter()
    printed = ibrobot(
        "eval", CONFIG, "--sim", "--mode", "learned", "--episodes", arguments.trials, "--json",
        *models, "--videos", 0, "--out", work / "evaluation",
    )  # fmt: skip
    evaluation = json.loads(printed.strip().rpartition("\n")[2])
    found, *exported = evaluation["policies"]
    times_s["run"] = round(perf_counter() - begin)
    ends = [round(found["wilson"][end], 3) for end in ("low", "high")]
    result = {"successes": found["successes"], "trials": found["episodes"], "interval": ends, "s": times_s}
    for other in exported:
        outcomes: dict[int, set[bool]] = {}
        for episode in evaluation["episodes"]:
            outcomes.setdefault(episode["seed"], set()).add(episode["success"])
        result["onnx_successes"] = other["successes"]
        result["seeds_with_different_outcomes"] = sum(len(each) == 2 for each in outcomes.values())
    print(json.dumps(result))
    report(successes=found["successes"], trials=found["episodes"])
    return 0


if __name__ == "__main__":
    sys.exit(main())
