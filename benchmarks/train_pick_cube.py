"""The whole path of a policy: record demonstrations, convert them, train on them, run the result, and count.

    python benchmarks/train_pick_cube.py [--episodes 100] [--steps 5000] [--trials 100] [--work pick_cube] [--onnx]

1. `ibrobot record`: the scripted pick in simulation, in lockstep, without cameras; the cube's pose is an observation.
2. `ibrobot convert`: a LeRobot dataset of the successes.
3. `lerobot-train`: a small ACT (0.5 million parameters) on the CPU; the rate of learning falls to nothing.
4. `ibrobot eval`: the trained policy in the same simulation, with cubes at places that were in no demonstration; with
   --onnx, also what `ibrobot export` makes of it, with the same seeds.

Needs LeRobot in the same environment: `pip install 'lerobot[dataset,training]'`. A stage whose result is in
the folder `--work` is not done again. Prints one JSON object with the successes and their 95 % interval, and with
--onnx the successes of the exported policy and the number of seeds with different outcomes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from time import perf_counter

CONFIG = Path(__file__).parents[1] / "configs" / "so101_pick_cube.yaml"
FIRST_TRAINING_SEED = 1000
"""Trials have the seeds from 0 on."""
NOT_ALL_SUCCEEDED = 3
"""Exit code of `ibrobot record` when an episode failed."""
NORMALISED = json.dumps(dict.fromkeys(("STATE", "ENV", "ACTION"), "MEAN_STD"))
"""ACT's own choice lacks ENV, `observation.environment_state`: metres, which hardly vary beside joints."""


def run(*command: str | Path, **environment: str) -> str:
    """Run a command of this environment and return its last line; empty where it prints none, as `lerobot-train`."""
    program = Path(sys.executable).with_name(str(command[0]))
    print(f"$ {' '.join(str(word) for word in command)}", file=sys.stderr)
    found = subprocess.run(
        [program, *command[1:]], stdout=subprocess.PIPE, text=True, check=False, env={**os.environ, **environment}
    )
    if found.returncode not in (0, NOT_ALL_SUCCEEDED):
        raise SystemExit(f"{command[0]} ended with {found.returncode}")
    return found.stdout.strip().rpartition("\n")[2]


def train(dataset: Path, out: Path, steps: int) -> None:
    """Train ACT on what `ibrobot convert` wrote."""
    # Threads that spin, or more of them than cores that are free, cost a multiple.
    run(
        "lerobot-train", "--dataset.repo_id=local/pick_cube", f"--dataset.root={dataset}",
        "--policy.type=act", "--policy.use_vae=false", "--policy.dim_model=128", "--policy.n_heads=4",
        "--policy.dim_feedforward=256", "--policy.n_encoder_layers=2", "--policy.dropout=0.0",
        "--policy.chunk_size=30", "--policy.n_action_steps=30", f"--policy.normalization_mapping={NORMALISED}",
        "--policy.device=cpu", "--policy.push_to_hub=false", "--use_policy_training_preset=false",
        "--optimizer.type=adamw", "--optimizer.lr=5e-4", "--optimizer.weight_decay=1e-4",
        "--scheduler.type=cosine_annealing_with_warmup", "--scheduler.num_warmup_steps=100", "--batch_size=32",
        f"--steps={steps}", f"--save_freq={steps}", "--num_workers=1", "--wandb.enable=false", f"--output_dir={out}",
        HF_HUB_OFFLINE="1", OMP_WAIT_POLICY="PASSIVE", OMP_NUM_THREADS="1",
    )  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100, help="demonstrations")
    parser.add_argument("--steps", type=int, default=5000, help="of training")
    parser.add_argument("--trials", type=int, default=100, help="runs of the trained policy")
    parser.add_argument("--work", type=Path, default=Path("pick_cube"), help="folder of all that comes to be")
    parser.add_argument("--onnx", action="store_true", help="also run the exported policy")
    arguments = parser.parse_args()
    work = arguments.work.absolute()
    episodes, dataset, trained, onnx = work / "episodes", work / "dataset", work / "train", work / "onnx"
    policy = trained / "checkpoints/last/pretrained_model"
    times_s = {}
    stages = {
        "record": (
            episodes,
            lambda: run(
                "ibrobot", "record", CONFIG, "--sim", "--lockstep", "--headless", "--episodes",
                str(arguments.episodes), "--seed", str(FIRST_TRAINING_SEED), "--root", episodes, "--dataset", "pick",
                "--prompt", "put the cube into the bin",
            ),
        ),
        "convert": (
            dataset,
            lambda: run("ibrobot", "convert", episodes / "pick", "--out", dataset, "--outcome", "success"),
        ),
        "train": (trained, lambda: train(dataset, trained, arguments.steps)),
    }  # fmt: skip
    models: tuple[str | Path, ...] = ("--model", "act", "--set", f"models.act.path={policy}")
    if arguments.onnx:
        stages["export"] = (onnx, lambda: run("ibrobot", "export", policy, "--to", "onnx", "--out", onnx))
        models += ("--model", "onnx", "--set", f"models.onnx={{type: onnx, path: {onnx}}}")
    for name, (result, work_on) in stages.items():
        if not result.exists():
            begin = perf_counter()
            work_on()
            times_s[name] = round(perf_counter() - begin)
    begin = perf_counter()
    printed = run(
        "ibrobot", "eval", CONFIG, "--sim", "--mode", "learned", "--episodes", str(arguments.trials), "--json",
        *models, "--videos", "0", "--out", work / "evaluation",
    )  # fmt: skip
    report = json.loads(printed)
    found, *exported = report["policies"]
    times_s["run"] = round(perf_counter() - begin)
    ends = [round(found["wilson"][end], 3) for end in ("low", "high")]
    result = {"successes": found["successes"], "trials": found["episodes"], "interval": ends, "s": times_s}
    for other in exported:
        outcomes: dict[int, set[bool]] = {}
        for episode in report["episodes"]:
            outcomes.setdefault(episode["seed"], set()).add(episode["success"])
        result["onnx_successes"] = other["successes"]
        result["seeds_with_different_outcomes"] = sum(len(each) == 2 for each in outcomes.values())
    print(json.dumps(result))
    report(successes=found["successes"], trials=found["episodes"])
    return 0


if __name__ == "__main__":
    sys.exit(main())
