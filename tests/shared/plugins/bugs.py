"""A command with mistakes in it."""

from __future__ import annotations

import click

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Command


@click.group()
def odd():
    """Fail in every way."""


@odd.command()
def bug():
    return 1 // 0


@odd.command()
@click.argument("file")
def read(file):
    open(file).read()  # noqa: SIM115 - a mistake on purpose


@odd.command()
@click.argument("file", type=click.File())
def take(file):
    pass


@odd.command()
def refuse():
    raise click.ClickException("not today")


@odd.command()
def ask():
    raise click.Abort()


@odd.command()
def say():
    from ibrobot_core.safe_output import echo

    echo("größer … ✓")
    raise ValueError("größer … ✓")


def _broken():
    raise RuntimeError("cannot be loaded")


@hookimpl
def ibrobot_commands():
    yield Command("odd", "Fail in every way.", lambda: odd)
    yield Command("broken", "Cannot be loaded.", _broken)
