"""Services of a run for work that packages offer, e.g. `/evaluate` and `/explain`: processes beside the run."""

from __future__ import annotations

import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Any

import attrs
from ibrobot_provenance.asking import read_event
from ibrobot_provenance.processes import Job, Jobs, arguments
from ibrobot_provenance.reports import Case, Cases, Plots, ReportSection, Table, Text, kinds_of_reports
from ibrobot_provenance.work import Work, Workplace
from ibrobot_terminal.authority import authority_of

from ibrobot_core.api import EpisodeAddress, IbrobotError, MissingDependency, option
from ibrobot_core.app import (
    Command,
    Failed,
    NoRequest,
    RequestError,
    RunView,
    Service,
    dump_yaml,
    error_text,
    installed_plugins,
)
from ibrobot_mcp.audit import states_folder
from ibrobot_mcp.options import SECTION

_MOST_RESULTS = 1000
"""Most folders of results of each kind."""
_LARGEST = 32 * 1024 * 1024
"""Largest file of results that is read [bytes]."""
_LINES = 20
"""Last lines of output that a failure shows."""
_IDLE = (
    sys.executable,
    "-c",
    "import os\n"
    "if hasattr(os, 'SCHED_IDLE'): os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))\n"
    "else: os.nice(19)\n"
    "from ibrobot_core.cli.command import main; main()",
)  # fmt: skip
"""The command `ibrobot`, which computes only while nothing else wants the processor."""


@attrs.frozen
class Numbered:
    """A request for the result of work."""

    number: int = option(ge=0, help="the number that it was answered with")


@attrs.frozen
class WorkProgress:
    """How far the work of a kind is."""

    running: bool
    text: str = ""
    done: float | None = None
    """Share of the work that is done, 0 to 1; None if it is not known."""


@attrs.frozen
class WorkResult:
    """What work has found."""

    success: bool
    """Whether it was done; not whether what it looked at is good."""
    lines: tuple[str, ...]
    """The result in words."""
    folder: str
    """Where it is kept; empty if it is not."""
    report: tuple[str, ...] = ()
    """Its report, line by line."""


class Places:
    """The files that the work of a run reads and writes.

    Args:
        session: the run.
    """

    def __init__(self, session: RunView) -> None:
        self._session = session
        recording = session.config.recording
        root = None if recording is None else Path(recording.root).resolve()
        self.root = root
        """The folder of all datasets; None if the run records nothing."""
        self.results = states_folder() if root is None else root.parent
        """The folder of folders with results."""
        self._tops = [self.results]
        if recording is not None and root is not None:
            self._tops += [root, root / recording.dataset, root / recording.dataset / "episodes"]

    def find(self, text: str) -> Path:
        """The recording, dataset or result that a request names.

        Raises:
            ValueError: if there is none, or it is elsewhere.
        """
        open_to_all = [*self.kept(), *([] if self.root is None else [self.root])]
        for top in self._tops:
            with suppress(OSError, RuntimeError):  # a name that is too long, or links in a circle
                path = EpisodeAddress.find(top / text).resolve()
                there = path.exists() or path.with_name(path.name.rpartition(":")[0] or path.name).exists()
                if there and any(path.is_relative_to(each) for each in open_to_all):
                    return path
        known = "its YAML has no section `recording`" if self.root is None else "see ibrobot://episodes"
        raise ValueError(f"{text[:80]!r} is no recording, dataset or result of this run; {known}")

    def kept(self) -> list[Path]:
        """The folders of results that are kept, one for each kind of work."""
        return [self.results / each for each in sorted({work.keeps for work, _ in kinds_of_work()} - {""})]

    def new(self, kind: str) -> Path:
        """A folder for the next results of a kind, which is not there yet.

        Raises:
            RequestError: if there are too many.
        """
        for number in range(1, _MOST_RESULTS + 1):
            folder = self.results / kind / f"{self._session.config.robot.name}-{number}"
            if not folder.exists():
                return folder
        raise RequestError(f"{self.results / kind} has {_MOST_RESULTS} results: a person must remove some")


def kinds_of_work() -> list[tuple[Work, str]]:
    """The work that installed packages offer, each with its command."""
    return [(each.work, each.command) for each in kinds_of_reports().values() if each.work is not None]


class WorkServices:
    """Serves `/NAME`, `/NAME/progress`, `/NAME/result` and `/NAME/cancel` for the work that packages offer.

    One of them works at a time, in a process of its own, with the processor time that nothing else wants.

    Args:
        session: the run.
    """

    def __init__(self, session: RunView) -> None:
        self._session = session
        self._agent = authority_of(session).acting
        self._places = Places(session)
        self._scratch = Path(tempfile.mkdtemp(prefix="ibrobot-work-"))
        self._jobs = Jobs(self._scratch)
        self._lock = threading.Lock()
        self._found: dict[int, WorkResult] = {}
        """Number -> the result of ended work."""
        self._served: list[Service[Any, Any]] = []
        for work, command in kinds_of_work():
            self._serve(work, installed_plugins().command(command))

    def close(self) -> None:
        """Serve no more, and end what runs. Safe to call twice."""
        for service in self._served:
            self._session.bus.unserve(service)
        self._jobs.close()
        shutil.rmtree(self._scratch, ignore_errors=True)

    def _serve(self, work: Work, command: Command) -> None:
        name, what = f"/{work.name}", command.name
        progress = Service(f"{name}/progress", NoRequest, WorkProgress, f"How far `{what}` is.", reads=True)
        result = Service(
            f"{name}/result", Numbered, WorkResult | NoneType, f"What `{what}` has found.", "number", reads=True
        )
        cancel = Service(f"{name}/cancel", NoRequest, NoneType, f"End `{what}` early.", urgent=True)
        start = Service(
            name, work.options, int, work.help, reads=not work.keeps, progress=progress, result=result, cancel=cancel
        )
        handlers: Mapping[Service[Any, Any], Callable[[Any], Any]] = {
            start: partial(self._start, work, command),
            progress: lambda _: self._progress(work.name),
            result: lambda request: self._result(work.name, request.number),
            cancel: lambda _: self._cancel(work.name),
        }
        for service, handler in handlers.items():
            self._session.bus.serve(service, handler, self._places.find)
            self._served.append(service)

    def _start(self, work: Work, command: Command, request: Any) -> int:
        with self._lock:
            if (running := self._running()) is not None:
                raise RequestError(f"/{work.name}: {running.kind} works already, see /{running.kind}/progress")
            try:
                command.check()
            except MissingDependency as error:
                raise RequestError(f"/{work.name}: {error}") from error
            robot = self._scratch / f"{self._session.config.robot.name}.yaml"
            document = {key: value for key, value in self._session.config.document.items() if key != SECTION}
            robot.write_text(dump_yaml(document), encoding="utf-8")
            for each in self._jobs.all():
                self._collect(each)
            out = self._places.new(work.keeps) if work.keeps else self._scratch / "results"
            try:
                options = work.make(request, Workplace(robot, out))
            except ValueError as error:
                raise RequestError(f"/{work.name}: {error}") from error
            words = [*command.name.split(), "--events", *arguments(options)]
            job = self._jobs.start(
                work.name, work.help, words, read=partial(_facts, command), program=_IDLE, done_codes=(0,)
            )
            job.facts |= {"out": str(out) if work.keeps else "", "by_agent": self._agent.get() is not None}
            return job.number

    def _running(self, kind: str = "") -> Job | None:
        return next((each for each in self._jobs.all() if each.state == "running" and kind in ("", each.kind)), None)

    def _progress(self, kind: str) -> WorkProgress:
        if (job := self._running(kind)) is None:
            return WorkProgress(running=False)
        return WorkProgress(True, str(job.facts.get("text", "")), job.facts.get("progress"))

    def _cancel(self, kind: str) -> None:
        if (job := self._running(kind)) is None:
            return
        if self._agent.get() is not None and not job.facts["by_agent"]:
            raise RequestError(f"/{kind}/cancel: a person began it: ask a person to end it")
        self._jobs.cancel(job.number)

    def _result(self, kind: str, number: int) -> WorkResult | None:
        known = [each.number for each in self._jobs.all() if each.kind == kind]
        if number not in known:
            raise RequestError(f"/{kind}/result: there is no {kind} {number}; these are known: {known or 'none'}")
        job = self._jobs.get(number)
        with self._lock:
            self._collect(job)
            return self._found.get(number)

    def _collect(self, job: Job) -> None:
        """Read the result of work that has ended, and remove what is not kept."""
        if job.state == "running" or job.number in self._found:
            return
        known = {each.number for each in self._jobs.all()}
        self._found = {number: each for number, each in self._found.items() if number in known}
        self._found[job.number] = _found(job)
        if not job.facts["out"]:
            shutil.rmtree(self._scratch / "results", ignore_errors=True)


def _facts(command: Command, line: str) -> Mapping[str, Any] | None:
    """What an event in a line of output says; None for other lines."""
    event = read_event(line, command.events)
    if event is None:
        return None
    shown = event.shown()
    facts: dict[str, Any] = {"error": event.error} if isinstance(event, Failed) else {}
    if shown.text:
        facts["text"] = shown.text
    if shown.progress is not None:
        facts["progress"] = shown.progress
    if shown.made:
        facts["made"] = dict(shown.made)
    return facts


def _found(job: Job) -> WorkResult:
    """The result of work that has ended."""
    folder, text = job.facts["out"], str(job.facts.get("text", ""))
    if job.state != "done":
        why = str(job.facts.get("error") or f"ended with exit code {job.exit_code}")
        what = "cancelled" if job.state == "cancelled" else why
        more = () if "error" in job.facts or job.state == "cancelled" else tuple(list(job.lines)[-_LINES:])
        return WorkResult(False, (what, *more), folder)
    report: list[str] = []
    for kind, path in job.facts.get("made", {}).items():
        report += report_lines(kind, Path(path))
    return WorkResult(True, (text,), folder, tuple(report))


def unreadable(folder: Path) -> str:
    """Why a folder of results is not read: a foreign file could fill the memory, which would end the run."""
    for each in sorted(folder.glob("*.json*")):
        if not each.is_file() or each.stat().st_size > _LARGEST:
            return f"{each}: is not a file of at most {_LARGEST >> 20} MiB"
    return ""


def report_lines(kind: str, folder: Path) -> list[str]:
    """A report on a folder, as text."""
    descriptor = kinds_of_reports().get(kind)
    if descriptor is None:
        return []
    if why := unreadable(folder):
        return [why]
    try:
        return [line for section in descriptor.make(folder) for line in _of_section(section)]
    except IbrobotError as error:
        return [error_text(error)]


def _of_section(section: ReportSection) -> Iterator[str]:
    if section.title:
        yield f"# {section.title}"
    for block in section.blocks:
        match block:
            case Text():
                yield block.text
            case Table():
                yield from (" | ".join(row) for row in (block.columns, *block.rows))
            case Cases():
                yield from map(_of_case, block.cases)
            case Plots():
                pass  # their numbers are in tables


def _of_case(case: Case) -> str:
    return ": ".join(each for each in (case.title, case.text, case.command) if each)
