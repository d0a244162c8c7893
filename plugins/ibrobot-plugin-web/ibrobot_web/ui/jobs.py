"""View: jobs, with their output; and the forms of the commands that run as jobs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
from ibrobot_provenance.asking import Answer, Ask, read_event
from ibrobot_provenance.processes import Reader, arguments

from ibrobot_core.api import IbrobotError, option
from ibrobot_core.app import Command, Failed, WireError, fields, installed_plugins
from ibrobot_web.pictures import Picture
from ibrobot_web.ui.context import Routes, Ui
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.forms import form_of, in_page_words, job_commands, read_form, title_of
from ibrobot_web.ui.robots import read_address

_POINTS = 400
"""Points of a curve that are kept."""
_LONGEST_ANSWER = 500


def _short(instance: object, attribute: object, text: str) -> None:
    if len(text) > _LONGEST_ANSWER:
        raise ValueError(f"at most {_LONGEST_ANSWER} characters")


def start(ui: Ui, command: str, values: Mapping[str, Any]) -> dict[str, int]:
    """Run a command with the values of its form."""
    if command not in job_commands():
        raise IbrobotError(f"{command[:40]!r} is no job; the jobs are: {', '.join(job_commands())}")
    declared = installed_plugins().command(command)
    options = read_form(ui, declared, values)
    what = ", ".join([*_robots(ui, options), *(ui.folders.name(each) for each in _paths(options))])
    # A command that may run a robot shows it on a page, which can stop it.
    viewed = any(each.metadata["names"] == "viewer" for each in fields(declared.options).values())
    event_of = event_reader(ui.folders, declared)
    job = ui.jobs.start(
        command, f"{title_of(command)} {what}",
        [command, "--events", *(ui.run_options if viewed else ()), *arguments(options)],
        read=lambda line: event if (event := event_of(line)) is not None else read_address(line),
        asks=Ask in declared.events,
    )  # fmt: skip
    return {"number": job.number}


def _robots(ui: Ui, options: Any) -> list[str]:
    """The robots in options, as the page calls them."""
    named = [
        getattr(options, name) for name, each in fields(type(options)).items() if each.metadata["names"] == "robot"
    ]
    return [ui.folders.name(Path(each)) for each in named if isinstance(each, str)]


def _paths(options: Any) -> list[Path]:
    """The paths in options."""
    values = attrs.asdict(options, recurse=False).values()
    return [
        each for value in values for each in (value if isinstance(value, tuple) else (value,)) if isinstance(each, Path)
    ]


def event_reader(folders: Folders, command: Command) -> Reader:
    """A function that reads the events of a command into facts: text, progress, problems, points, made and error.

    It returns None for lines that are no events.
    """
    problems: list[str] = []
    points: list[list[float]] = []
    made: list[dict[str, str]] = []

    def words(text: str) -> str:
        return in_page_words(text, command).replace(f"{folders.first}/", "")

    def read(line: str) -> Mapping[str, Any] | None:
        try:
            event = read_event(line, command.events)
        except WireError as error:
            return {"error": f"the page does not understand an event of this job: {error}"}
        if event is None:
            return None
        shown, facts = event.shown(), dict[str, Any]()
        if isinstance(event, Failed):
            facts["error"] = words(event.error)
        elif isinstance(event, Ask):
            facts["ask"] = {**attrs.asdict(event), "text": words(event.text)}
        elif shown.text:
            facts["text"] = words(shown.text)
        if shown.progress is not None:
            facts["progress"] = shown.progress
        if shown.problem:
            problems.append(words(shown.problem))
            facts["problems"] = list(problems)
        if shown.point:
            points.append(list(shown.point.values()))
            del points[:-_POINTS]
            facts |= {"points": list(points), "axes": list(shown.point)}
        for kind, path in shown.made.items():
            thing = {"kind": kind, "path": folders.name((folders.first / path).resolve())}
            made.extend([thing] * (thing not in made))
            facts["made"] = list(made)
        return facts

    return read


def cancel(ui: Ui, number: int) -> None:
    """End a job as Ctrl-C does; the second time at once."""
    ui.jobs.cancel(number)


def answer(ui: Ui, number: int, ask: int, answer: str = option(validator=_short)) -> None:
    """Answer what a job asks."""
    ui.jobs.answer(number, Answer(ask=ask, answer=answer))


def sight(
    ui: Ui, number: int, ask: int, sight: int = option(ge=0), which: str = option(choices=("wanted", "live"))
) -> Picture:
    """A picture beside question number `ask` of a job, of a camera by its number in the question."""
    asked = ui.jobs.get(number).facts.get("ask")
    if asked is None or asked["ask"] != ask or sight >= len(asked["sights"]):
        raise IbrobotError("no such picture: the question was answered")
    name = asked["sights"][sight][which]
    try:
        return Picture(ui.folders.find(name).read_bytes(), "image/jpeg")
    except OSError as error:
        raise IbrobotError(f"{name}: cannot be read: {error.strerror}") from None


ROUTES: Routes = {
    "GET /form": form_of,
    "POST /start": start,
    "POST /cancel": cancel,
    "POST /answer": answer,
    "GET /sight": sight,
}
