"""Commands with mistakes in them."""

from __future__ import annotations

from pathlib import Path

import attrs

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Command, Late
from ibrobot_core.errors import Unsuccessful
from ibrobot_core.options import option


@attrs.frozen
class Bug:
    """Divide by zero."""

    def __call__(self):
        return 1 // 0


@attrs.frozen
class Read:
    """Read a file."""

    file: Path = option(typed="FILE", help="the file")

    def __call__(self):
        self.file.open().read()  # a mistake on purpose


@attrs.frozen
class Refuse:
    """Print a result that is not good."""

    def __call__(self):
        raise Unsuccessful(["not today"])

    def show(self, result):
        from ibrobot_core.safe_output import echo

        echo(result[0])


@attrs.frozen
class Ask:
    """Be interrupted."""

    def __call__(self):
        raise KeyboardInterrupt


@attrs.frozen
class Say:
    """Fail after some output."""

    def __call__(self):
        from ibrobot_core.safe_output import echo

        echo("größer … ✓")
        raise ValueError("größer … ✓")


def __getattr__(name):
    raise RuntimeError("cannot be loaded") if name == "Broken" else AttributeError(name)


@hookimpl
def ibrobot_commands():
    yield Command("odd", summary="Fail in every way.")
    for kind in (Bug, Read, Refuse, Ask, Say):
        yield Command(f"odd {kind.__name__.lower()}", kind)
    yield Command("broken", Late(f"{__name__}:Broken"), "Cannot be loaded.")
