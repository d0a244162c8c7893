"""Command lines from the declarations of commands: parameters, checks, results, events and shell completion."""

from __future__ import annotations

import inspect
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol, get_args, override, runtime_checkable

import attrs
import click

from ibrobot_core.convert import Converter, Faults, error_message, is_sequence, is_union
from ibrobot_core.descriptors import Command, ViewerDescriptor
from ibrobot_core.errors import IbrobotError, RequestError, Unsuccessful
from ibrobot_core.events import Event, Failed, encode_event
from ibrobot_core.options import default_of, fields
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.safe_output import echo


class EpisodePath(click.Path):
    """A recorded episode or a folder of them: a path, or a short name such as `pick:1`; see `EpisodeAddress.find`."""

    @override
    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        from ibrobot_core.interfaces.reader import EpisodeAddress

        return EpisodeAddress.find(Path(os.fsdecode(super().convert(value, param, ctx))))


@runtime_checkable
class _Shows(Protocol):
    """A command that prints its result."""

    def show(self, result: Any) -> None: ...


def click_command(command: Command) -> click.Command:
    """The command line of a command that has a class."""
    kind = command.options
    known = fields(kind)
    names = {name: flag_of(name, field) for name, field in known.items()}
    params = [each for name, field in known.items() for each in _parameters(name, field)]
    if command.events:
        params.append(click.Option(["--events", "_events"], is_flag=True, help="Print the progress as JSON lines."))
    if issubclass(kind, _Shows):
        params.append(click.Option(["--json", "_json"], is_flag=True, help="Print JSON."))
    params.sort(key=lambda each: isinstance(each, click.Option) or not each.required)  # as one types arguments

    def run(**given: Any) -> None:
        parsed = {name: value for name in known if (value := given[name]) is not None}
        plain = json.loads(json.dumps(parsed, default=str))  # no tuples and paths
        emit = partial(_emit, command) if given.get("_events") else None
        try:
            made = read_options(kind, plain, Path, names)
            result, code = made(*([emit] if command.events else [])), 0
        except Unsuccessful as error:
            result, code = error.result, error.exit_code
        except IbrobotError as error:
            if emit is None:
                raise
            emit(Failed(str(error)))
            raise SystemExit(error.exit_code) from error
        if given.get("_json") and result is not None:
            echo(json.dumps(result, indent=2, default=_plain))
        elif isinstance(made, _Shows) and result is not None:
            made.show(result)
        if code:
            raise SystemExit(code)

    name, text = command.name.rpartition(" ")[2], inspect.cleandoc(kind.__doc__ or "")
    foreign = any(field.metadata["names"] == "options" for field in known.values())
    settings = {"ignore_unknown_options": foreign}
    return click.Command(name, settings, params=params, callback=run, help=text, hidden=command.hidden)


def viewer_flags() -> dict[str, str]:
    """Type of an installed viewer -> its flag."""
    viewers = installed_plugins().of_kind("viewer")
    return {each.type: each.flag for each in viewers if isinstance(each, ViewerDescriptor) and each.flag}


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
    flags, value = _typed(name, field)
    return flags[-1] if flags else value


def _typed(name: str, field: attrs.Attribute[Any]) -> tuple[list[str], str]:
    """The flags of an option, the long one last, and what stands for its value; without flags, it is an argument."""
    words = field.metadata["typed"].split()
    flags, value = [word for word in words if word[0] == "-"], " ".join(word for word in words if word[0] != "-")
    if (flags or not value) and not any(flag.startswith("--") for flag in flags):
        flags.append(f"--{name.replace('_', '-')}")
    return flags, value


def _emit(command: Command, event: Event) -> None:
    """Print an event for the program that started the command; one that it does not declare is a bug."""
    if not isinstance(event, (*command.events, Failed)):
        raise TypeError(f"ibrobot {command.name} does not declare the event {type(event).__name__}")
    echo(encode_event(event))


def _plain(value: Any) -> Any:
    """A part of a result for JSON."""
    return attrs.asdict(value) if attrs.has(type(value)) else str(value)


def _parameters(name: str, field: attrs.Attribute[Any]) -> Iterator[click.Parameter]:
    """The parameters of click for an option. Its value is checked by `read_options`."""
    metadata, default = field.metadata, default_of(field)
    kind: Any = get_args(field.type)[0] if is_union(field.type) else field.type
    several, required = is_sequence(kind), default is attrs.NOTHING
    item = get_args(kind)[0] if several else kind
    plain: Any = get_args(item) or (item if item in (int, float) else click.Path() if item is Path else str)
    choices = [str(choice) for choice in metadata["choices"] or ()]
    flags, value = _typed(name, field)
    more: dict[str, Any] = {"type": EpisodePath() if metadata["names"] == "episodes" else plain, "required": required}
    if choices:
        more["shell_complete"] = lambda ctx, param, begun: [each for each in choices if each.startswith(begun)]
    if not required:
        more["default"] = default
    if not flags:
        dots = "..." if several and value[0] != "[" else ""
        metavar = f"{value if required or value[0] == '[' else f'[{value}]'}{dots}"
        yield click.Argument([name], nargs=-1 if several else 1, metavar=metavar, **more)
        return
    words = "; ".join(f"{value}: {text}" for value, text in metadata["words"].items() if text != value)
    more["help"] = f"{metadata['help'][:1].upper()}{metadata['help'][1:]}{f' ({words})' if words else ''}."
    more["show_default"] = default not in (None, "", ()) and kind is not bool
    listed = "|".join([*choices, *("…" if choices and metadata["open"] else ())])
    more["metavar"] = value or listed or metadata["unit"].upper() or ("PATH" if item is Path else None)
    if kind is bool:
        yield click.Option([*flags, name], is_flag=True, **{**more, "type": None, "metavar": None})
        return
    if (bare := re.fullmatch(r"\[\w+=(.+)\]", value)) is not None:
        more |= {"is_flag": False, "flag_value": plain(bare[1])}
    yield click.Option([*flags, name], multiple=several, **more)
    for type_, flag in (viewer_flags() if metadata["names"] == "viewer" else {}).items():
        yield click.Option([flag, name], flag_value=type_, help=f"As {flags[-1]} {type_}.")
