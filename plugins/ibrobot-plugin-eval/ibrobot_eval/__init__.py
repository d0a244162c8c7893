"""The plugin's hooks: the command `ibrobot eval`, and its reports for pages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ibrobot_core.api import hookimpl
from ibrobot_core.app import Command, ReportDescriptor
from ibrobot_eval.options import EVENTS, KIND, SETTINGS, EvalOptions

if TYPE_CHECKING:
    import click

    from ibrobot_core.app import ReportSection


def _evaluate() -> click.Command:
    from ibrobot_eval.command import evaluate

    return evaluate


EVAL = Command("eval", "Count the successes of policies, and compare them.", _evaluate, EvalOptions, EVENTS)


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot eval`."""
    yield EVAL


def _is_evaluation(folder: Path) -> bool:
    return (folder / SETTINGS).is_file()


def _lines(folder: Path) -> Sequence[str]:
    from ibrobot_eval.contents import lines_of

    return lines_of(folder)


def _report(folder: Path) -> Sequence[ReportSection]:
    from ibrobot_eval.contents import read_contents

    return read_contents(folder)


@hookimpl
def ibrobot_reports() -> Iterable[ReportDescriptor]:
    """Evaluations."""
    yield ReportDescriptor(KIND, "Evaluations", _is_evaluation, _lines, _report)
