"""View: jobs, with their output; and the forms of the commands that run as jobs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import IbrobotError, option
from ibrobot_core.app import Answer, Ask, Command, Failed, WireError, decode_event, installed_plugins
from ibrobot_web.pictures import Picture
from ibrobot_web.ui.context import Route, Ui
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.forms import arguments, form_of, in_page_words, job_commands, read_form, title_of
from ibrobot_web.ui.job_runner import Reader

_POINTS = 400
"""Points of a curve that are kept."""
_LONGEST_ANSWER = 500


def _short(instance: object, attribute: object, text: str) -> None:
    if len(text) > _LONGEST_ANSWER:
        raise ValueError(f"at most {_LONGEST_ANSWER} characters")


@attrs.frozen
class NamesJob:
    """A request about a job."""

    number: int = option(ge=1, help="its number")


@attrs.frozen
class NamesCommand:
    """A request about a command that runs as a job."""

    command: str = option(help="its name")


@attrs.frozen
class FilledForm(NamesCommand):
    """A filled form."""

    values: Mapping[str, Any] = option(help="value of each field")


@attrs.frozen(kw_only=True)
class GiveAnswer(NamesJob):
    """An answer to what a job asks."""

    ask: int = option(ge=1, help="number of the question")
    answer: str = option(validator=_short, help="key of the choice, or a text")


@attrs.frozen(kw_only=True)
class NamesSight(NamesJob):
    """A request for a picture beside a question."""

    ask: int = option(ge=1, help="number of the question")
    sight: int = option(ge=0, help="number of the camera in the question, from 0")
    which: str = option(choices=("wanted", "live"), help="which of its pictures")


def form(ui: Ui, request: NamesCommand) -> dict[str, Any]:
    """The form of a command."""
    return form_of(ui, request.command)


def start(ui: Ui, request: FilledForm) -> dict[str, int]:
    """Run a command with the values of its form."""
    if request.command not in job_commands():
        raise IbrobotError(f"{request.command[:40]!r} is no job; the jobs are: {', '.join(job_commands())}")
    command = installed_plugins().command(request.command)
    options = read_form(ui, command, request.values)
    what = ", ".join(ui.folders.name(each) for each in _paths(options))
    title = f"{title_of(command.name)} {what}"
    job = ui.jobs.start(
        command.name, title, [command.name, "--events", *arguments(options)],
        read=event_reader(ui.folders, command), asks=Ask in command.events,
    )  # fmt: skip
    return {"number": job.number}


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
            event = decode_event(line, (*command.events, Failed))
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


def cancel(ui: Ui, request: NamesJob) -> None:
    """End a job as Ctrl-C does; the second time at once."""
    ui.jobs.cancel(request.number)


def answer(ui: Ui, request: GiveAnswer) -> None:
    """Answer what a job asks."""
    ui.jobs.answer(request.number, Answer(ask=request.ask, answer=request.answer))


def sight(ui: Ui, request: NamesSight) -> Picture:
    """A picture beside the question of a job."""
    asked = ui.jobs.get(request.number).facts.get("ask")
    if asked is None or asked["ask"] != request.ask or request.sight >= len(asked["sights"]):
        raise IbrobotError("no such picture: the question was answered")
    name = asked["sights"][request.sight][request.which]
    try:
        return Picture(ui.folders.find(name).read_bytes(), "image/jpeg")
    except OSError as error:
        raise IbrobotError(f"{name}: cannot be read: {error.strerror}") from None


ROUTES: dict[str, Route[Any]] = {
    "GET /form": Route(form, NamesCommand),
    "POST /start": Route(start, FilledForm),
    "POST /cancel": Route(cancel, NamesJob),
    "POST /answer": Route(answer, GiveAnswer),
    "GET /sight": Route(sight, NamesSight),
}
