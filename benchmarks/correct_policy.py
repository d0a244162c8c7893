"""The loop of corrections: train a policy, let an operator correct it, train it on, and count successes.

    python benchmarks/correct_policy.py [--demonstrations 20] [--corrected 60] [--trials 100] [--work corrections]

1. `ibrobot record`: the scripted pick demonstrates. `ibrobot convert` makes a dataset; `lerobot-train` trains an ACT.
2. `ibrobot record` with `inference: {intervene: …}`: the policy picks, and a scripted operator, who knows where the
   cube is, takes the robot when the policy is about to fail.
3. `ibrobot convert --append --only interventions`: what the operator commanded joins the demonstrations.
4. `lerobot-train --policy.path=…` trains the policy on with both. A control is trained on for as long with the
   demonstrations alone.
5. `ibrobot eval` runs the three policies with cubes at the same places, which were in no training data.

Needs LeRobot in the same environment, as `train_pick_cube.py`. A stage whose result is in the folder `--work` is not
done again. Prints one JSON object with the success rates and their 95 % intervals (Wilson), whatever they are.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path

import scripted_operator
from made_up import plugin
from train_pick_cube import CONFIG, NORMALISED, run

DEMONSTRATIONS, CORRECTIONS = 1000, 2000
"""Seeds of the first demonstration and of the first corrected episode; trials begin at 0."""
ARCHITECTURE = (
    "--policy.type=act",
    "--policy.use_vae=false",
    "--policy.dim_model=128",
    "--policy.n_heads=4",
    "--policy.dim_feedforward=256",
    "--policy.n_encoder_layers=2",
    "--policy.dropout=0.0",
    "--policy.chunk_size=30",
    "--policy.n_action_steps=30",
    f"--policy.normalization_mapping={NORMALISED}",
    "--policy.device=cpu",
)
OPERATOR = (
    "--set",
    "control_modes.learned.inference={model: act, intervene: operator}",
    "--set",
    "teleoperation={operator: {type: scripted_operator}}",
)
LOCKSTEP = ("--sim", "--lockstep", "--headless")


def train(dataset: Path, out: Path, steps: int, rate: float, start: tuple[str, ...]) -> None:
    """Train ACT, from the beginning or from a checkpoint."""
    run(
        "lerobot-train", "--dataset.repo_id=local/pick_cube", f"--dataset.root={dataset}", *start,
        "--policy.push_to_hub=false", "--use_policy_training_preset=false", "--optimizer.type=adamw",
        f"--optimizer.lr={rate}", "--optimizer.weight_decay=1e-4", "--scheduler.type=cosine_annealing_with_warmup",
        f"--scheduler.num_warmup_steps={min(100, steps // 10)}", "--batch_size=32", f"--steps={steps}",
        f"--save_freq={steps}",
        "--num_workers=0", "--wandb.enable=false", f"--output_dir={out}",
        HF_HUB_OFFLINE="1", OMP_WAIT_POLICY="PASSIVE", OMP_NUM_THREADS="1",
    )  # fmt: skip


def checkpoint(out: Path) -> Path:
    """Where `lerobot-train` leaves the last policy."""
    return out / "checkpoints" / "last" / "pretrained_model"


def record(work: Path, dataset: str, mode: str, episodes: int, seed: int, *more: str | Path) -> None:
    """Record episodes in lockstep."""
    run(
        "ibrobot", "record", CONFIG, *LOCKSTEP, "--mode", mode, "--episodes", str(episodes), "--seed", str(seed),
        "--root", work / "episodes", "--dataset", dataset, "--prompt", "put the cube into the bin", *more,
    )  # fmt: skip


def trial(policy: Path, trials: int, out: Path) -> dict[str, object]:
    """The success rate of a policy, with its interval."""
    printed = run(
        "ibrobot", "eval", CONFIG, "--sim", "--mode", "learned", "--episodes", str(trials), "--json", "--videos", "0",
        "--set", f"models.act.path={policy}", "--out", out,
    )  # fmt: skip
    (found,) = json.loads(printed)["policies"]
    ends = [round(found["wilson"][end], 3) for end in ("low", "high")]
    return {"successes": found["successes"], "trials": found["episodes"], "interval": ends}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demonstrations", type=int, default=20)
    parser.add_argument("--steps", type=int, default=1000, help="of the first training")
    parser.add_argument("--corrected", type=int, default=60, help="episodes with the operator")
    parser.add_argument("--more-steps", type=int, default=1000, help="of the second training")
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--work", type=Path, default=Path("corrections"), help="folder of all results")
    arguments = parser.parse_args()
    work = arguments.work.absolute()
    demonstrations, both = work / "demonstrations", work / "with_corrections"
    base, corrected, control = work / "base", work / "corrected", work / "control"
    going_on = (f"--policy.path={checkpoint(base)}",)

    def append_corrections() -> None:
        shutil.copytree(demonstrations, both)
        run(
            "ibrobot", "convert", work / "episodes/corrections", "--out", both, "--append", "--only", "interventions",
            "--context", "0", "--outcome", "success",
        )  # fmt: skip

    with plugin("scripted_operator", Path(scripted_operator.__file__).read_text()):
        stages = (
            (work / "episodes/pick", lambda: record(
                work, "pick", "scripted", arguments.demonstrations, DEMONSTRATIONS)),
            (demonstrations, lambda: run("ibrobot", "convert", work / "episodes/pick", "--out", demonstrations)),
            (base, lambda: train(demonstrations, base, arguments.steps, 5e-4, ARCHITECTURE)),
            (work / "episodes/corrections", lambda: record(
                work, "corrections", "learned", arguments.corrected, CORRECTIONS, *OPERATOR,
                "--set", f"models.act.path={checkpoint(base)}")),
            (both, append_corrections),
            (corrected, lambda: train(both, corrected, arguments.more_steps, 2e-4, going_on)),
            (control, lambda: train(demonstrations, control, arguments.more_steps, 2e-4, going_on)),
        )  # fmt: skip
        for result, make in stages:
            if not result.exists():
                make()
        before, after, without = (
            trial(checkpoint(each), arguments.trials, work / f"{each.name}_evaluation")
            for each in (base, corrected, control)
        )
    print(json.dumps({"before": before, "after": after, "control": without}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
