"""The plugin's hook: the command `ibrobot eval`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import hookimpl
from ibrobot_core.app import Command
from ibrobot_eval.options import EVENTS, EvalOptions

if TYPE_CHECKING:
    import click


def _evaluate() -> click.Command:
    from ibrobot_eval.command import evaluate

    return evaluate


EVAL = Command("eval", "Count the successes of policies, and compare them.", _evaluate, EvalOptions, EVENTS)


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot eval`."""
    yield EVAL
