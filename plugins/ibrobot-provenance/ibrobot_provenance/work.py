"""Work that a run offers as services, e.g. to agents: some of the options of a command."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import Options
from ibrobot_core.app import fields


@attrs.frozen
class Workplace:
    """What work knows of the run that it is for."""

    robot: Path
    """The robot YAML of the run, with its changes."""
    out: Path
    """The folder for its results, which is not there yet."""


@attrs.frozen
class Work:
    """Work that makes a report, for those who use a run, e.g. agents.

    Callers may be programs that nobody trusts. So the options have no address, no command, and no file but as a `Path`,
    which the run confines to its recordings and results.
    """

    name: str
    """As the service is called, e.g. `evaluate`."""
    help: str
    """One sentence that says what it does."""
    options: type[Any]
    """The class of what callers may state."""
    make: Callable[[Any, Workplace], Any]
    """What callers state, and the place -> the options of the command that writes such reports, which has events."""
    keeps: str = ""
    """The folder in which its results are kept, e.g. `evaluations`. Without one they are only shown to the caller, so
    that anybody may ask for them."""


def some_options(kind: type[Any], *names: str) -> type[Options]:
    """A class with some of the options of a command, as they are declared there."""
    known = fields(kind)
    chosen = {
        name: attrs.field(
            default=field.default, validator=field.validator, metadata=field.metadata, type=field.type, kw_only=True
        )
        for name in names
        for field in (known[name],)
    }
    made: type[Options] = attrs.make_class(f"Some{kind.__name__}", chosen, bases=(Options,), frozen=True)
    made.__doc__ = kind.__doc__
    return made
