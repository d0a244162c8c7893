"""Forms for commands: their fields, checks and words derive from the declarations of their owners."""

from __future__ import annotations

import re
import subprocess
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args, get_origin

import attrs
from ibrobot_provenance.asking import read_event
from ibrobot_provenance.processes import IBROBOT, arguments

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import (
    Command,
    Event,
    Failed,
    default_of,
    fields,
    flag_of,
    installed_plugins,
    read_options,
)
from ibrobot_web.ui.context import Ui
from ibrobot_web.ui.recordings import Episodes, find_policies, find_recordings
from ibrobot_web.ui.robots import robot_names, robot_of

_FLAG = re.compile(r"(?<![\w.])(?P<tick>`?)(?P<flag>--[a-z][a-z-]*)(?![\w.-])(?: (?P<value>[\w-]+))?(?P=tick)")
_COMMAND = re.compile(r"`ibrobot ([a-z]+(?: [a-z]+)?)[^`]*`")
_COMMAND_S = 600.0
_TITLES = {"eval": "Evaluate"}
"""Command -> what the page calls it, where that is not its last word."""
_KINDS = {"episodes", "dataset", "policy", "robot"}
"""What forms offer of the opened folders."""
_OUTCOMES = {"success": "success", "failure": "failure", "unknown": "not judged"}
"""Outcome of an episode -> what a form calls it, in the order in which they are counted."""
WITH_ROBOT = frozenset({"record"})
"""Commands that run a robot, with a view of their own in which it is chosen."""


def job_commands() -> list[str]:
    """The commands that run by a form: those with events, and those that packages not installed here would add."""
    declared = {name for name, each in installed_plugins().commands.items() if each.events and " " not in name}
    return sorted(declared.union(installed_plugins().official("job")) - WITH_ROBOT)


def title_of(name: str) -> str:
    """What the page calls a command, e.g. `Trim` for `episodes trim`."""
    return _TITLES.get(name) or name.rpartition(" ")[2].capitalize()


def label_of(name: str, field: attrs.Attribute[Any]) -> str:
    """What the page calls an option."""
    return str(field.metadata["label"] or name.replace("_", " ").capitalize())


def form_of(ui: Ui, command: str) -> dict[str, Any]:
    """The form of a command, for browsers. `missing` says what the machine lacks for it."""
    form: dict[str, Any] = {"title": title_of(command), "summary": "", "missing": "", "fields": [], "known": {}}
    try:
        declared = installed_plugins().command(command)
    except IbrobotError as error:
        return {**form, "missing": str(error)}
    shown = _shown(declared)
    wanted = {field.metadata["names"] for field in shown.values()}
    form["summary"] = declared.summary
    form["known"] = {names: _known(ui, names) for names in sorted(wanted & _KINDS)}
    form["fields"] = [_field_json(name, field) for name, field in shown.items()]
    try:
        declared.check()
    except IbrobotError as error:
        form["missing"] = str(error)
    return form


def takes(name: str) -> dict[str, str]:
    """Inputs of a command, as its arguments name them, e.g. `dataset` -> the field; empty if it is not installed."""
    command = installed_plugins().commands.get(name)
    if command is None:
        return {}
    return {
        field.metadata["names"]: key
        for key, field in _shown(command).items()
        if not flag_of(key, field).startswith("-") and field.metadata["names"]
    }


def read_form(ui: Ui, command: Command, values: Mapping[str, Any]) -> Any:
    """The options of a command from the values of its form. Paths are confined to the opened folders.

    Raises:
        IbrobotError: for values that do not fit, in the words of the form.
    """
    shown = _shown(command)
    plain = {name: value for name, value in values.items() if value not in (None, "")}
    if unknown := [name for name in plain if name not in shown]:
        raise IbrobotError(f"the form of {title_of(command.name)} has no field {unknown[0]}")
    for name, value in plain.items():
        if shown[name].metadata["names"] == "robot":
            several = isinstance(value, list)
            plain[name] = [robot_of(ui, str(each)) for each in value] if several else robot_of(ui, str(value))
        elif isinstance(value, str) and "/" in value and shown[name].metadata["names"] == "calibration":
            raise IbrobotError(f"{label_of(name, shown[name])}: {value!r} is no name")
    labels = {name: label_of(name, field) for name, field in shown.items()}
    return read_options(command.options, plain, ui.folders.find, labels)


def in_page_words(text: str, command: Command | None = None) -> str:
    """A text of a command with labels in place of its flags, e.g. `--missing skip`, and of commands of a terminal."""
    declared = installed_plugins().commands
    options = fields(command.options) if command is not None else {}
    known = {flag_of(name, field): (name, field) for name, field in options.items()}

    def labelled(match: re.Match[str]) -> str:
        if match["flag"] not in known:
            return match[0]
        name, field = known[match["flag"]]
        label, value = label_of(name, field), match["value"] or ""
        words = field.metadata["words"].get(value)
        return f"“{label}: {words}”" if words else f"“{label}”{f' {value}' if value else ''}"

    text = _COMMAND.sub(lambda match: f"“{title_of(match[1])}”" if match[1] in declared else match[0], text)
    return _FLAG.sub(labelled, text)


def run_command(ui: Ui, name: str, **values: Any) -> list[Event]:
    """Run a command in the first folder with values of its options; return its events.

    Raises:
        IbrobotError: with its error, if it fails.
    """
    command = installed_plugins().command(name)
    words = [*name.split(), "--events", *arguments(read_form(ui, command, values))]
    try:
        done = subprocess.run(
            [*IBROBOT, *words], cwd=ui.folders.first, stdin=subprocess.DEVNULL, capture_output=True,
            timeout=_COMMAND_S, start_new_session=True, check=False, text=True, errors="replace",
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise IbrobotError(f"“{title_of(name)}” did not end within {_COMMAND_S:g} s") from None
    events = [event for line in done.stdout.splitlines() if (event := read_event(line, command.events)) is not None]
    if errors := [event.error for event in events if isinstance(event, Failed)]:
        raise IbrobotError(in_page_words("; ".join(errors), command).replace(f"{ui.folders.first}/", ""))
    if done.returncode:
        raise IbrobotError(done.stderr.strip().removeprefix("error: ") or f"exit code {done.returncode}")
    return events


def choices_of(name: str, option: str) -> list[list[str]]:
    """The choices of a command's option, each with its words; none if the command is not installed."""
    command = installed_plugins().commands.get(name)
    if command is None:
        return []
    choices: list[list[str]] = _field_json(option, fields(command.options)[option])["choices"]
    return choices


def _shown(command: Command) -> dict[str, attrs.Attribute[Any]]:
    """The options in the form."""
    return {name: each for name, each in fields(command.options).items() if each.metadata["label"] is not None}


def _known(ui: Ui, names: str) -> list[dict[str, str]]:
    """Paths of a kind in the opened folders: the value of each, and its text."""
    if names == "episodes":
        outcomes: dict[str, Counter[str]] = {}
        for path in find_recordings(ui.folders).episodes:
            name = ui.folders.name(_dataset_of(ui, path))
            outcomes.setdefault(name, Counter())[ui.keep(Episodes).row(ui, path)["outcome"]] += 1
        words = {
            name: ", ".join(f"{of[each]} {words}" for each, words in _OUTCOMES.items() if of[each])
            for name, of in outcomes.items()
        }
        return [{"value": name, "text": f"{name}: {text}"} for name, text in words.items()]
    if names == "dataset":
        known = [ui.folders.name(path) for path in find_recordings(ui.folders).datasets]
    elif names == "policy":
        known = [ui.folders.name(path) for path, _ in find_policies(ui)]
    else:
        known = robot_names(ui)
    return [{"value": name, "text": name} for name in known]


def _dataset_of(ui: Ui, episode: Path) -> Path:
    """The folder that one gives to work on all episodes of a dataset, which are in its folder `episodes`."""
    folder = episode.parent
    return folder.parent if folder.name == "episodes" and folder.parent not in ui.folders.paths else folder


def _field_json(name: str, field: attrs.Attribute[Any]) -> dict[str, Any]:
    """A field for browsers."""
    metadata, kind, default = field.metadata, _without_none(field.type), default_of(field)
    several = get_origin(kind) is tuple
    item = get_args(kind)[0] if several else kind
    choices = [[value, metadata["words"].get(value, str(value))] for value in metadata["choices"] or ()]
    return {
        "name": name, "label": label_of(name, field), "help": metadata["help"], "unit": metadata["unit"],
        "kind": {bool: "flag", int: "whole", float: "number"}.get(item, "text"), "several": several,
        "required": default is attrs.NOTHING, "default": None if default is attrs.NOTHING else default,
        "choices": choices, "open": metadata["open"], "min": metadata["ge"], "max": metadata["le"],
        "more": metadata["more"], "names": metadata["names"], "suggest": metadata["suggest"],
    }  # fmt: skip


def _without_none(kind: Any) -> Any:
    """The type of an option that may be left out, without None."""
    members = [member for member in get_args(kind) if member is not type(None)]
    return members[0] if type(None) in get_args(kind) else kind
