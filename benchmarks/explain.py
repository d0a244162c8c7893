"""How often `ibrobot explain` names the right cause: faults planted in simulated runs of policies trained for it.

    python benchmarks/explain.py [--work explain] [--healthy 100] [--trials 1] [--tune] [--only CAUSE ...]

1. Demonstrations of the pick in lockstep, with two small cameras, and policies trained on them: an ACT on the joints
   and the cube's pose, three that were stopped early, one on the pictures, three like it that see nothing in those of a
   camera, and a small Diffusion policy; each has its card beside it.
2. Each fault of `explain_faults.py` in three strengths, `--trials` seeds each: a run of at most 6 s, recorded, and
   explained with the card of the policy's training. The first line must name the fault. Some also with Diffusion.
3. Healthy runs of all policies, successes and failures: nothing may be named.

Demonstrations, trials, and the trials of `--tune`, on which thresholds may be chosen, have seeds of their own. The
folder `--work` keeps demonstrations, trained policies and recorded runs for the next call; runs are explained anew each
time. Needs LeRobot in the same environment. Prints a table and one JSON object with the shares of right first lines,
and the false accusations.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import shutil
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import attrs
import numpy as np
from apparatus import CONFIGS, ibrobot, report
from explain_faults import BLIND, DIFFUSED, EARLY, FAULTS, Fault
from safetensors.numpy import load_file, save_file

CONFIG = CONFIGS / "so101_pick_cube.yaml"
DEMOS, TUNED, REPORTED = 1000, 3000, 5000
"""First seeds of the demonstrations, of the runs on which thresholds may be chosen, and of those that count."""
STRENGTHS = ("mild", "medium", "strong")
SECONDS = 6
PROMPT = "put the cube into the bin"
EARLY_ONES, BLIND_ONES = tuple(f"early-{steps}" for steps in EARLY), tuple(f"blind-{times}" for times in BLIND)
POLICIES = ("state", *EARLY_ONES, "pictures", *BLIND_ONES, "diffusion", "scripted")
HEALTHY = ("state", f"early-{EARLY[0]}", "pictures", "diffusion", "scripted")
"""Policies of the runs without a fault: some succeed, some fail."""
_CAMERAS = "".join(
    f"\n  - {{name: {name}, kind: camera, type: opencv, device: {name}, width: 96, height: 72, fps: 15}}"
    for name in ("top", "wrist")
)
_OBSERVED = "".join(
    f"    - {{key: observation.images.{name}, peripheral: {name}, image: {{resize: [72, 96]}}, "
    "align: {strategy: asof, stamp: header, tol_ms: 200}}\n"
    for name in ("top", "wrist")
)


def robot(velocity: str = "3.0", *, sees: bool = True) -> str:
    """The robot YAML with another velocity limit, and with two cameras."""
    text = CONFIG.read_text(encoding="utf-8").replace("max_velocity: 3.0", f"max_velocity: {velocity}")
    if not sees:
        return text
    text = text.replace("\nexecutors:", f"\nperipherals:{_CAMERAS}\n\nexecutors:", 1)
    return text.replace(
        "    - {key: observation.environment_state", f"{_OBSERVED}    - {{key: observation.environment_state", 1
    )


def prepare(work: Path, episodes: int, policies: Sequence[str]) -> None:
    """Demonstrations, datasets and policies, where they are not there yet."""
    work.mkdir(parents=True, exist_ok=True)
    cube = work / "cube.yaml"
    cube.write_text(robot(), encoding="utf-8")
    demos = work / "episodes"
    if not demos.exists():
        ibrobot(
            "record", cube, "--sim", "--lockstep", "--headless", "--episodes", str(episodes), "--seed", str(DEMOS),
            "--root", demos, "--dataset", "pick", "--prompt", PROMPT, good=(0, 3),
        )  # fmt: skip
    listed = sorted(demos.glob("pick/episodes/episode_*"))
    small = ("--policy.down_dims=[64,128]", "--policy.horizon=32", "--policy.n_action_steps=24",
             "--policy.num_inference_steps=5", "--policy.pretrained_backbone_weights=null",
             "--policy.scheduler_warmup_steps=50", "--policy.optimizer_lr=5e-4")  # fmt: skip
    least = ("--policy.dim_model=256", "--policy.dim_feedforward=512", "--policy.pretrained_backbone_weights=null")
    state, pictures = work / "dataset-state", work / "dataset-pictures"
    if not state.exists():
        ibrobot("convert", *listed, "--out", state, "--config", CONFIG, "--force-contract")
    if not pictures.exists():
        ibrobot("convert", *listed[: len(listed) // 2], "--out", pictures, "--codec", "h264")
    for name, dataset, words in (
        ("state", state, ("--steps", "900", *least, "--policy.optimizer_lr=1e-4")),
        *((f"early-{steps}", state, ("--steps", str(steps), *least)) for steps in EARLY),
        ("diffusion", state, ("--policy", "diffusion", "--steps", "300", *small)),
        ("pictures", pictures, ("--steps", "300", "--batch-size", "8", *least)),
    ):
        if name in policies and not (work / name / "checkpoints/last").exists():
            ibrobot("train", dataset, "--out", work / name, "--device", "cpu", *words)
    for times, name in zip(BLIND, BLIND_ONES, strict=True):
        if name in policies and "pictures" in policies and not (work / name).exists():
            blind(work / "pictures/checkpoints/last/pretrained_model", work / name, times)
    if not (work / "reference.json").exists():
        ibrobot("datasets", "card", demos, "--out", work / "reference.json")


def blind(checkpoint: Path, out: Path, times: int) -> None:
    """A copy of a policy to which all pictures of `top` look grey."""
    part = out.with_suffix(".part")
    shutil.rmtree(part, ignore_errors=True)
    copy = shutil.copytree(checkpoint, part / "checkpoints/last/pretrained_model")
    (file,) = copy.glob("policy_preprocessor*.safetensors")
    numbers, name = load_file(file), "observation.images.top.std"
    save_file({**numbers, name: numbers[name] * np.float32(times)}, file)
    part.rename(out)


@attrs.frozen
class Trial:
    """A run with a fault, or without one."""

    cause: str
    """Empty for a healthy run."""
    strength: str
    policy: str
    argument: Any
    seed: int

    @property
    def row(self) -> str:
        """Its row in the table."""
        usual = self.fault is None or self.policy != "diffusion"
        return self.cause if usual else f"{self.cause} ({self.policy})"

    @property
    def fault(self) -> Fault | None:
        """None for a healthy run."""
        return FAULTS.get(self.cause)

    def folder(self, work: Path) -> Path:
        """Where its recording is kept."""
        parts = (self.cause or "healthy", self.strength, self.policy, str(self.seed))
        return work / "runs" / "-".join(filter(None, parts))


def act(work: Path, trial: Trial) -> None:
    """Record a run; changes this process."""
    from ibrobot_core.cli.main import main

    fault, policy = trial.fault, trial.policy
    root = trial.folder(work).with_suffix(".part")
    shutil.rmtree(root, ignore_errors=True)
    root.mkdir(parents=True)
    words = list(fault.options(trial.argument)) if fault is not None else []
    config = root / "cube.yaml"
    velocity = words[1] if words[:1] == ["velocity"] else "3.0"
    sees = policy in ("pictures", "scripted", *BLIND_ONES)
    config.write_text(robot(velocity, sees=sees), encoding="utf-8")
    words = words[2:] if words[:1] == ["velocity"] else words
    if policy == "scripted":
        words += ["--mode", "scripted"]
    else:
        checkpoint = work / policy / "checkpoints/last/pretrained_model"
        words += ["--mode", "learned", "--set", f"models.act.path={checkpoint}", "--set", "models.act.threads=1"]
    words += ["--set", f"contract.max_duration_s={SECONDS}", "--set", f"recording.root={root / 'episodes'}"]
    always = ("--sim", "--headless", "--lockstep", "--episodes", "1", "--set", "recording.type=mcap")
    line = ["ibrobot", "launch", str(config), *always, "--seed", str(trial.seed), *words]
    if fault is not None:
        fault.plant(trial.argument)
    with (root / "log").open("w") as log, patch.object(sys, "argv", line), redirect_stdout(log), redirect_stderr(log):
        try:
            main()
        except SystemExit as end:
            print(end)
    episodes = list(root.glob("episodes/*/episodes/episode_*"))
    if len(episodes) != 1:
        raise RuntimeError(f"{root / 'log'}: recorded {len(episodes)} episodes")
    root.rename(trial.folder(work))


def explained(work: Path, trial: Trial) -> dict[str, Any]:
    """What is said of a recorded run."""
    from ibrobot_diagnose.ask_again import examine, model_of
    from ibrobot_diagnose.cause import Reference
    from ibrobot_diagnose.diagnosis import diagnose
    from ibrobot_diagnose.references import card_of, read_episode
    from ibrobot_diagnose.report import Explanation

    (episode,) = trial.folder(work).glob("episodes/*/episodes/episode_*")
    window = read_episode(episode)
    trained = trial.fault is not None and trial.fault.trained
    model = examine(model_of(window, episode, "")) if trial.fault is not None and trial.fault.asked else None
    reference = Reference(card_of(work / trial.policy if trained else work / "reference.json"), model)
    explanation = Explanation.of(window, reference, diagnose(window, reference))
    findings = explanation.diagnosis.findings
    return {
        "outcome": window.outcome, "first": "" if findings and findings[0].cause.weak else explanation.diagnosis.first,
        "text": explanation.first, "all": [(each.name, round(each.evidence.likelihood, 3)) for each in findings],
    }  # fmt: skip


def tried(work: Path, trial: Trial) -> dict[str, Any]:
    """The result of a trial; its run is recorded in a process of its own, and only once."""
    if not trial.folder(work).exists():
        child = multiprocessing.get_context("fork").Process(target=act, args=(work, trial))
        child.start()
        child.join()
    try:
        return explained(work, trial)
    except Exception as error:  # noqa: BLE001 - one run does not end the others
        return {"error": f"{type(error).__name__}: {error}"}


def trials(arguments: argparse.Namespace) -> Iterator[Trial]:
    """Each run; strong faults first, then mild ones."""
    first = TUNED if arguments.tune else arguments.seeds
    for number in range(3 * arguments.trials):
        place = (2, 0, 1)[number % 3]
        for row, (name, fault) in enumerate(FAULTS.items()):
            strength = fault.strengths[place]
            if STRENGTHS[place] not in arguments.strengths or (arguments.only and name not in arguments.only):
                continue
            for policy in (fault.policy.format(strength), *(("diffusion",) if name in DIFFUSED else ())):
                if policy in arguments.policies:
                    yield Trial(name, STRENGTHS[place], policy, strength, first + 100 * number + row)
        policies = [each for each in HEALTHY if each in arguments.policies]
        for healthy in range(number, arguments.healthy, 3 * arguments.trials):
            policy = policies[healthy % len(policies)]
            yield Trial("", "", policy, None, first + 10_000 + healthy)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("explain"), help="folder of all that comes to be")
    parser.add_argument("--episodes", type=int, default=40, help="demonstrations")
    parser.add_argument("--healthy", type=int, default=100, help="runs without a fault")
    parser.add_argument("--trials", type=int, default=1, help="runs of each fault and strength")
    parser.add_argument("--seeds", type=int, default=REPORTED, help="first seed of the runs that count")
    parser.add_argument("--tune", action="store_true", help="the seeds on which thresholds may be chosen")
    parser.add_argument("--only", nargs="*", help="some causes")
    parser.add_argument("--strengths", nargs="*", default=STRENGTHS, choices=STRENGTHS, help="some of these")
    parser.add_argument("--policies", nargs="*", default=POLICIES, help="some of these")
    arguments = parser.parse_args()
    work = arguments.work.absolute()
    prepare(work, arguments.episodes, arguments.policies)
    for module in ("ibrobot_core.cli.main", "ibrobot_diagnose.causes", "ibrobot_lerobot.model"):
        import_module(module)  # each run would import it again
    results: dict[Trial, dict[str, Any]] = {}
    for trial in trials(arguments):
        results[trial] = result = tried(work, trial)
        right = result.get("first") == trial.cause
        why = "" if right else f" {result.get('all', '')} {result.get('text', result.get('error'))}"
        said = result.get("first", "error")
        named = (trial.cause or "healthy", trial.strength, trial.policy, trial.seed)
        print(*named, said or "-", why, file=sys.stderr, flush=True)
    return show(results)


def show(results: Mapping[Trial, dict[str, Any]]) -> int:
    """Print the table, and the figures."""
    right, all_of = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
    for trial, each in results.items():
        if trial.cause:
            all_of[trial.row, trial.strength] += 1
            right[trial.row, trial.strength] += each.get("first") == trial.cause
    print(f"{'cause':32}{''.join(f'{strength:>10}' for strength in STRENGTHS)}")
    for name in dict.fromkeys(key[0] for key in all_of):
        cells = [f"{right[name, each]}/{all_of[name, each]}" for each in STRENGTHS]
        print(f"{name:32}{''.join(f'{cell:>10}' for cell in cells)}")
    healthy = [each for trial, each in results.items() if not trial.cause]
    accused = [each for each in healthy if each.get("first") != ""]
    weak = [each for each in healthy if each.get("outcome") != "success"]
    said = sum(each.get("text", "").startswith("Nothing is wrong with the set-up") for each in weak)
    shares = {
        each: sum(right[key] for key in right if key[1] == each)
        / max(1, sum(all_of[k] for k in all_of if k[1] == each))
        for each in STRENGTHS
    }
    false = Counter(each.get("first", "error") for each in accused)
    print(
        json.dumps({"right": shares, "healthy": len(healthy), "accused": dict(false), "weak": len(weak), "said": said})
    )
    report(**shares, healthy=len(healthy), accused=len(accused), weak=len(weak), weak_named_so=said)
    return 0


if __name__ == "__main__":
    sys.exit(main())
