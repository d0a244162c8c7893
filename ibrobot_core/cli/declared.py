"""Command lines from the declarations of their commands: parameters, checks and events."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

import attrs
import click

from ibrobot_core.cli.options import EpisodePath
from ibrobot_core.convert import Converter, Faults, error_message, is_sequence, is_union
from ibrobot_core.descriptors import Command
from ibrobot_core.errors import IbrobotError, RequestError
from ibrobot_core.events import Event, Failed, encode_event
from ibrobot_core.options import default_of, fields
from ibrobot_core.safe_output import echo


def declared[C: Callable[..., Any]](command: Command) -> Callable[[C], C]:
    """The parameters of a command line, from the declaration of its command.

    Returns:
        A decorator for the function of a click command. The function gets an object of `Command.options`. If the
        command has events, it also gets `events`: whether to print them by `emit`. Errors are then printed as `Failed`.
    """
    known = fields(command.options)
    names = {name: flag_of(name, field) for name, field in known.items()}

    def add(function: C) -> C:
        @functools.wraps(function)
        def run(**given: Any) -> Any:
            parsed = {name: value for name in known if (value := given.pop(name)) is not None}
            plain = json.loads(json.dumps(parsed, default=str))  # no tuples and paths
            try:
                return function(read_options(command.options, plain, Path, names), **given)
            except (IbrobotError, click.ClickException) as error:
                if not given.get("events"):
                    raise
                emit(command, Failed(error.message if isinstance(error, click.ClickException) else str(error)))
                raise SystemExit(error.exit_code) from error

        events = click.option("--events", is_flag=True, help="Print the progress as JSON lines.")
        decorated: Any = events(run) if command.events else run
        for name, field in reversed(list(known.items())):
            decorated = _parameter(name, field)(decorated)
        return decorated  # type: ignore[no-any-return]

    return add


def emit(command: Command, event: Event) -> None:
    """Print an event of a command for the program that started it.

    Raises:
        TypeError: if the command does not declare it.
    """
    if not isinstance(event, (*command.events, Failed)):
        raise TypeError(f"ibrobot {command.name} does not declare the event {type(event).__name__}")
    echo(encode_event(event))


def read_options(
    kind: type[Any], plain: Mapping[str, Any], files: Callable[[str], Path], names: Mapping[str, str]
) -> Any:
    """The options of a command from plain data.

    Args:
        kind: their class.
        plain: values by the keys of the class.
        files: finds the file that a text names; raises ValueError or IbrobotError for files that it may not name.
        names: key -> what errors call the option.

    Raises:
        RequestError: for data that does not fit.
    """
    try:
        return Converter(files).structure(plain, kind)
    except Faults as faults:
        texts = [f"{names.get(str(key[0]), key[0])}: {text}" for key, text in faults.found]
    except ValueError as error:  # values that exclude each other
        texts = [error_message(error)]
    raise RequestError("; ".join(texts))


def flag_of(name: str, field: attrs.Attribute[Any]) -> str:
    """What the command line calls an option, e.g. `--norm-mode`, or `EPISODES` for an argument."""
    return name.upper() if field.metadata["argument"] else field.metadata["flag"] or f"--{name.replace('_', '-')}"


def _parameter(name: str, field: attrs.Attribute[Any]) -> Callable[[Any], Any]:
    """The parameter of click for an option. Its value is checked by `read_options`."""
    metadata, default = field.metadata, default_of(field)
    kind: Any = get_args(field.type)[0] if is_union(field.type) else field.type
    several, required = is_sequence(kind), default is attrs.NOTHING
    item = get_args(kind)[0] if several else kind
    type_ = EpisodePath() if metadata["names"] == "episodes" else item if item in (int, float) else str
    if metadata["argument"]:
        return click.argument(name, nargs=-1 if several else 1, required=required, type=type_)
    words = "; ".join(f"{value}: {text}" for value, text in metadata["words"].items() if text != value)
    text = f"{metadata['help'][:1].upper()}{metadata['help'][1:]}{f' ({words})' if words else ''}."
    choices = "|".join(map(str, metadata["choices"] or ())) + ("|…" if metadata["choices"] and metadata["open"] else "")
    metavar = choices or metadata["unit"].upper() or ("PATH" if item is Path else None)
    more: dict[str, Any] = {"required": required, "show_default": default not in (None, "", ()), "metavar": metavar}
    if not required:
        more["default"] = default
    more |= {"is_flag": True, "show_default": False} if kind is bool else {"type": type_, "multiple": several}
    return click.option(flag_of(name, field), name, help=text, **more)
