"""`ibrobot eval merge`: join evaluations of the same policies on other seeds, and report on all episodes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
from ibrobot_provenance.ownership import Ownership

from ibrobot_core.api import DatasetError, option
from ibrobot_core.app import echo, wrong_input
from ibrobot_eval.episodes import Place, Result, write
from ibrobot_eval.evaluation import ASKED, differences, read_settings
from ibrobot_eval.options import SETTINGS
from ibrobot_eval.page import write_all
from ibrobot_eval.policies import Policy
from ibrobot_eval.report import Report


@attrs.frozen
class _Part:
    """An evaluation to merge."""

    folder: Path
    settings: Mapping[str, Any]
    policies: tuple[Policy, ...]
    results: Mapping[str, Mapping[int, Result]]
    """Label -> seed -> result."""

    @classmethod
    def of(cls, folder: Path) -> _Part:
        """Read an evaluation.

        Raises:
            DatasetError: if the folder has no evaluation, or one that cannot be merged.
        """
        try:
            settings = read_settings(folder / SETTINGS)
        except (FileNotFoundError, NotADirectoryError):
            raise DatasetError(f"{folder}: is not an evaluation: it has no {SETTINGS}") from None
        asked = settings.pop(ASKED, None)
        if settings.get("trials") or settings.get("until_decided") or asked is None:
            raise DatasetError(f"{folder}: only simulated evaluations of a fixed number of episodes can be merged")
        policies = tuple(Policy(**each) for each in asked)
        results = {
            policy.label: {
                result.seed: result
                for path in sorted(Place.of(folder, policy, 0).result.parent.glob("seed_*.json"))
                for result in (Result.read(path),)
            }
            for policy in policies
        }
        return cls(folder, settings, policies, results)


def merge_evaluations(folders: Sequence[Path], out: Path) -> Report:
    """Copy the episodes of evaluations into one, and write its report.

    Raises:
        DatasetError: if the evaluations differ in more than their seeds, have an episode twice or lack one, or if
            `out` exists.
    """
    parts = sorted(map(_Part.of, folders), key=lambda part: part.settings["seed"])
    first = parts[0]
    for part in parts[1:]:
        wrong = differences(first.settings, {**part.settings, "seed": first.settings["seed"]})
        if differing := list(wrong):
            raise DatasetError(f"{part.folder}: differs from {first.folder}: {'; '.join(differing)}")
    where: dict[tuple[str, int], Path] = {}
    for part in parts:
        for label, results in part.results.items():
            for seed in results:
                if (label, seed) in where:
                    raise DatasetError(f"{part.folder}: has {label}, seed {seed}, which {where[label, seed]} has too")
                where[label, seed] = part.folder
    seeds = sorted({seed for _, seed in where})
    labels = [policy.label for policy in first.policies]
    whole = range(first.settings["seed"], seeds[-1] + 1) if seeds else range(0)
    lacking = [f"{label}, seed {seed}" for seed in whole for label in labels if (label, seed) not in where]
    if lacking or not seeds:
        what = f"{', '.join(lacking[:3])}{' and more' if len(lacking) > 3 else ''}" if seeds else "all episodes"
        raise DatasetError(f"{first.folder}: these parts lack {what}: finish them, or name all of them")
    if out.exists() and any(out.iterdir()):
        raise DatasetError(f"{out}: exists already; choose a new folder")
    out.parent.mkdir(parents=True, exist_ok=True)
    with Ownership(out, "is being evaluated"):
        for part in parts:
            for name in ("episodes", "results", "videos"):
                if (part.folder / name).is_dir():
                    shutil.copytree(part.folder / name, out / name, dirs_exist_ok=True)
        asked = [attrs.asdict(policy) for policy in first.policies]
        write(out / SETTINGS, json.dumps({**first.settings, ASKED: asked}, indent=1) + "\n")
        joined = {label: [_result(parts, label, seed) for seed in whole] for label in labels}
        report = Report.of_simulation(first.policies, joined, first.settings["margin"], until_decided=False)
        write_all(out, report)
    return report


def _result(parts: Sequence[_Part], label: str, seed: int) -> Result:
    return next(part.results[label][seed] for part in parts if seed in part.results[label])


@attrs.frozen(kw_only=True)
class Merge:
    """Join evaluations of the same policies on other seeds, e.g. of --shard.

    The parts must agree in everything else, and no episode may be in two of them. The result equals that of one
    evaluation of all episodes, and the command without --shard can continue it.
    """

    folders: tuple[Path, ...] = option(typed="FOLDERS", help="the parts")
    out: Path = option(help="folder for the whole evaluation")

    @wrong_input()
    def __call__(self) -> None:
        report = merge_evaluations(self.folders, self.out)
        for line in report.lines():
            echo(line)
        echo(f"report: {self.out / 'report.html'}")
