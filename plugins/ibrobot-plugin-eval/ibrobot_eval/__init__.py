"""The plugin's hooks: the command `ibrobot eval`, and its reports for pages."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ibrobot_provenance.reports import ReportDescriptor

from ibrobot_core.api import Late, hookimpl
from ibrobot_core.app import Command
from ibrobot_eval.options import EVENTS, KIND, SETTINGS


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot eval`."""
    summary = "Count the successes of policies, and compare them."
    yield Command("eval", Late("ibrobot_eval.command:Evaluate"), summary, EVENTS)
    yield Command("eval merge", Late("ibrobot_eval.merge:Merge"))


def _is_evaluation(folder: Path) -> bool:
    return (folder / SETTINGS).is_file()


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
    )
