"""The plugin's hooks: the command `ibrobot eval`, its reports for pages, and evaluations that a run offers."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import attrs
from ibrobot_provenance.reports import ReportDescriptor
from ibrobot_provenance.work import Work, Workplace, some_options

from ibrobot_core.api import Late, hookimpl
from ibrobot_core.app import Command
from ibrobot_eval.options import EVENTS, KIND, SETTINGS, EvalOptions


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot eval`."""
    summary = "Count the successes of policies, and compare them."
    yield Command("eval", Late("ibrobot_eval.command:Evaluate"), summary, EVENTS)
    yield Command("eval merge", Late("ibrobot_eval.merge:Merge"))


def _is_evaluation(folder: Path) -> bool:
    return (folder / SETTINGS).is_file()


def _in_simulation(wanted: Any, place: Workplace) -> EvalOptions:
    stated = attrs.asdict(wanted, recurse=False)
    return EvalOptions(config=(str(place.robot),), sim=True, jobs=1, videos=0, out=place.out, **stated)


@hookimpl
def ibrobot_reports() -> Iterable[ReportDescriptor]:
    """Evaluations."""
    yield ReportDescriptor(
        KIND,
        summary="Successes of policies, and their comparison.",
        label="Results",
        command="eval",
        reads=_is_evaluation,
        lines=Late("ibrobot_eval.contents:lines_of"),
        make=Late("ibrobot_eval.contents:read_contents"),
        work=Work(
            "evaluate",
            "Count the successes of the robot's policies in simulation; the robot itself does not move.",
            some_options(EvalOptions, "mode", "model", "episodes", "seed", "margin"),
            _in_simulation,
            keeps="evaluations",
        ),
    )
