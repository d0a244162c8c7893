"""How often `ibrobot explain` names the right cause: faults planted in simulated runs of policies trained for it.

    python benchmarks/explain.py [--work explain] [--healthy 100] [--trials 1] [--tune] [--only CAUSE ...]

1. Demonstrations of the pick in lockstep, with two small cameras, and policies trained on them: a small ACT on the
   joints and the cube's pose, one on the pictures, and a small Diffusion policy; each has its card beside it.
2. Each fault of `explain_faults.py` in three strengths, `--trials` seeds each: a run of at most 6 s, recorded, and
   explained with the card of the policy's training. The first line must name the fault.
3. Healthy runs of all policies, successes and failures: nothing may be named.

Demonstrations, trials, and the trials of `--tune`, on which thresholds may be chosen, have seeds of their own. A stage
whose result is in the folder `--work` is not done again, nor is a run. Needs LeRobot in the same environment. Prints a
table and one JSON object with the shares of right first lines, and the false accusations.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

from explain_faults import FAULTS, Fault
from figures import report

CONFIG = Path(__file__).parents[1] / "configs" / "so101_pick_cube.yaml"
DEMOS, TUNED, REPORTED = 1000, 3000, 5000
"""First seeds of the demonstrations, of the runs on which thresholds may be chosen, and of those that count."""
STRENGTHS = ("mild", "medium", "strong")
SECONDS = 6
PROMPT = "put the cube into the bin"
POLICIES = ("state", "pictures", "diffusion", "scripted")
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


def command(*words: str | Path) -> None:
    """Run a command of this environment."""
    print(f"$ {' '.join(map(str, words))}", file=sys.stderr)
    done = subprocess.run([Path(sys.executable).with_name("ibrobot"), *words], stdout=subprocess.DEVNULL, check=False)
    if done.returncode not in (0, 3):
        raise SystemExit(f"{words[0]} ended with {done.returncode}")


def prepare(work: Path, episodes: int, policies: Sequence[str]) -> None:
    """Demonstrations, datasets and policies, where they are not there yet."""
    work.mkdir(parents=True, exist_ok=True)
    cube = work / "cube.yaml"
    cube.write_text(robot(), encoding="utf-8")
    demos = work / "episodes"
    if not demos.exists():
        command(
            "record", cube, "--sim", "--lockstep", "--headless", "--episodes", str(episodes), "--seed", str(DEMOS),
            "--root", demos, "--dataset", "pick", "--prompt", PROMPT,
        )  # fmt: skip
    listed = sorted(demos.glob("pick/episodes/episode_*"))
    small = ("--policy.down_dims=[64,128]", "--policy.horizon=32", "--policy.n_action_steps=24",
             "--policy.num_inference_steps=5")  # fmt: skip
    state, pictures = work / "dataset-state", work / "dataset-pictures"
    if not state.exists():
        command("convert", *listed, "--out", state, "--config", CONFIG, "--force-contract")
    if not pictures.exists():
        command("convert", *listed[: len(listed) // 2], "--out", pictures, "--codec", "h264")
    for name, dataset, words in (
        ("state", state, ("--steps", "240")),
        ("diffusion", state, ("--policy", "diffusion", "--steps", "200", *small)),
        ("pictures", pictures, ("--steps", "160", "--batch-size", "8", "--policy.pretrained_backbone_weights=null")),
    ):
        if name in policies and not (work / name / "checkpoints/last").exists():
            command("train", dataset, "--out", work / name, "--device", "cpu", *words)
    if not (work / "reference.json").exists():
        command("datasets", "card", demos, "--out", work / "reference.json")


def explained(work: Path, policy: str, fault: Fault | None, strength: Any, seed: int) -> dict[str, Any]:
    """A run with a fault, and what is said of it; changes this process."""
    from ibrobot_diagnose.cause import Reference
    from ibrobot_diagnose.diagnosis import diagnose
    from ibrobot_diagnose.references import card_of, read_episode
    from ibrobot_diagnose.report import Explanation

    from ibrobot_core.cli.main import main

    root = work / "runs" / f"{policy}-{seed}"
    shutil.rmtree(root, ignore_errors=True)
    root.mkdir(parents=True)
    words = list(fault.options(strength)) if fault is not None else []
    config = root / "cube.yaml"
    velocity = words[1] if words[:1] == ["velocity"] else "3.0"
    config.write_text(robot(velocity, sees=policy in ("pictures", "scripted")), encoding="utf-8")
    words = words[2:] if words[:1] == ["velocity"] else words
    if policy == "scripted":
        words += ["--mode", "scripted"]
    else:
        words += [
            "--mode",
            "learned",
            "--set",
            f"models.act.path={work / policy / 'checkpoints/last/pretrained_model'}",
        ]
        words += ["--set", "models.act.threads=1"]
    words += ["--set", f"contract.max_duration_s={SECONDS}", "--set", f"recording.root={root / 'episodes'}"]
    always = ("--sim", "--headless", "--lockstep", "--episodes", "1", "--set", "recording.type=mcap")
    line = ["ibrobot", "launch", str(config), *always, "--seed", str(seed), *words]
    if fault is not None:
        fault.plant(strength)
    with (root / "log").open("w") as log, patch.object(sys, "argv", line), redirect_stdout(log), redirect_stderr(log):
        try:
            main()
        except SystemExit as end:
            print(end)
    (episode,) = root.glob("episodes/*/episodes/episode_*")
    window = read_episode(episode)
    card = card_of(work / policy if fault is not None and fault.trained else work / "reference.json")
    reference = Reference(card)
    explanation = Explanation.of(window, reference, diagnose(window, reference))
    findings = explanation.diagnosis.findings
    shutil.rmtree(root)
    return {
        "outcome": window.outcome, "first": "" if findings and findings[0].cause.weak else explanation.diagnosis.first,
        "text": explanation.first, "all": [(each.name, round(each.evidence.likelihood, 3)) for each in findings],
    }  # fmt: skip


def _into(queue: Any, *arguments: Any) -> None:
    try:
        queue.put(explained(*arguments))
    except Exception as error:  # noqa: BLE001 - one run does not end the others
        queue.put({"error": f"{type(error).__name__}: {error}"})


def in_child(*arguments: Any) -> dict[str, Any]:
    """As `explained`, in a process of its own."""
    context = multiprocessing.get_context("fork")
    with closing(context.SimpleQueue()) as queue:
        child = context.Process(target=_into, args=(queue, *arguments))
        child.start()
        result: dict[str, Any] = queue.get()
        child.join()
    return result


def runs(arguments: argparse.Namespace) -> Iterator[tuple[str, str, str, Any, int]]:
    """Cause (empty for a healthy run), strength, policy, argument and seed of each run."""
    first = TUNED if arguments.tune else REPORTED
    for number in range(3 * arguments.trials):  # strong ones first
        place = 2 - number % 3
        for row, (name, fault) in enumerate(FAULTS.items()):
            if fault.policy in arguments.policies and (not arguments.only or name in arguments.only):
                yield name, STRENGTHS[place], fault.policy, fault.strengths[place], first + 100 * number + row
        for healthy in range(number, arguments.healthy, 3 * arguments.trials):
            yield "", "", arguments.policies[healthy % len(arguments.policies)], None, first + 10_000 + healthy


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("explain"), help="folder of all that comes to be")
    parser.add_argument("--episodes", type=int, default=40, help="demonstrations")
    parser.add_argument("--healthy", type=int, default=100, help="runs without a fault")
    parser.add_argument("--trials", type=int, default=1, help="runs of each fault and strength")
    parser.add_argument("--tune", action="store_true", help="the seeds on which thresholds may be chosen")
    parser.add_argument("--only", nargs="*", help="some causes")
    parser.add_argument("--policies", nargs="*", default=POLICIES, help="some of these")
    arguments = parser.parse_args()
    work = arguments.work.absolute()
    prepare(work, arguments.episodes, arguments.policies)
    for module in ("ibrobot_core.cli.main", "ibrobot_diagnose.causes", "ibrobot_lerobot.model"):
        import_module(module)  # each run would import it again
    done = work / ("tuned.jsonl" if arguments.tune else "reported.jsonl")
    known = [json.loads(line) for line in done.read_text().splitlines()] if done.exists() else []
    results = {tuple(each["run"]): each for each in known}
    for name, strength, policy, argument, seed in runs(arguments):
        key = (name, strength, policy, seed)
        if key not in results:
            result = in_child(work, policy, FAULTS[name] if name else None, argument, seed)
            results[key] = {"run": key, **result}
            with done.open("a") as file:
                file.write(json.dumps(results[key]) + "\n")
            print(*key, result.get("first", result.get("error")), file=sys.stderr, flush=True)
    return show(results)


def show(results: dict[tuple[Any, ...], dict[str, Any]]) -> int:
    """Print the table, and the figures."""
    right, all_of = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
    for (name, strength, _, _), each in results.items():
        if name:
            all_of[name, strength] += 1
            right[name, strength] += each.get("first") == name
    print(f"{'cause':20}{''.join(f'{strength:>10}' for strength in STRENGTHS)}")
    for name in dict.fromkeys(key[0] for key in all_of):
        cells = [f"{right[name, each]}/{all_of[name, each]}" for each in STRENGTHS]
        print(f"{name:20}{''.join(f'{cell:>10}' for cell in cells)}")
    healthy = [each for key, each in results.items() if not key[0]]
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
