"""Jobs: commands that run as child processes, with their output, progress and result."""

from __future__ import annotations

import json
import os
import re
import select
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import attrs

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import default_of, fields, flag_of
from ibrobot_provenance.asking import Answer

IBROBOT = (sys.executable, "-c", "from ibrobot_core.cli.command import main; main()")
"""The command `ibrobot` of this environment, whatever PATH says."""
LINES = 2000
"""Lines of output that are kept of a job."""
_ENDED = 50
"""Ended jobs that are kept."""
_END_S = 20.0
"""Time that jobs get to end by themselves when what runs them ends [s]."""
_POLL_S = 0.5
"""Period of checking whether a silent job has ended [s]."""
_CHUNK = 65536
_LONGEST = 4000
"""Longest line [characters]; the rest of a longer one is left out."""

_CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|[\x00-\x08\x0b-\x1f\x7f]")
"""Colours, motions of the cursor and other control characters."""

_END = re.compile(rb"\r\n|\n|\r(?!\Z)")
"""The end of a line; whether a final CR is one shows in what follows it."""
Reader = Callable[[str], Mapping[str, Any] | None]
"""Reads facts from a line of output, e.g. `{"progress": 0.5}`; None for a line that is for people."""
State = Literal["running", "done", "failed", "cancelled"]


@attrs.define(eq=False)
class Job:
    """A command that runs or has run."""

    number: int
    kind: str
    """Kind of the job, by which views select it, e.g. `run` or `convert`."""
    title: str
    command: tuple[str, ...]
    """Arguments of the command, for the page."""
    process: subprocess.Popen[bytes] = attrs.field(repr=False)
    done_codes: tuple[int, ...] = (0,)
    """Exit codes of a job that did what it was started for."""
    facts: dict[str, Any] = attrs.field(factory=dict)
    """What is known about the job: `progress` is between 0 and 1; a job with an `error` has failed."""
    state: State = "running"
    exit_code: int | None = None
    started_s: float = attrs.field(factory=time.time)
    ended_s: float | None = None
    count: int = 0
    """Number of lines so far."""
    lines: deque[str] = attrs.field(factory=lambda: deque[str](maxlen=LINES), repr=False)
    version: int = 0
    cancelling: bool = False

    def json(self, *, drives: bool = True) -> dict[str, Any]:
        """The job for a page, without its lines; pages that only watch get `watch_url` in place of `url`."""
        facts = {name: value for name, value in self.facts.items() if name not in ("url", "watch_url")}
        if url := self.facts.get("url" if drives else "watch_url"):
            facts["url"] = url
        return {
            "number": self.number, "kind": self.kind, "title": self.title, "command": " ".join(self.command),
            "facts": facts, "state": self.state, "exit_code": self.exit_code, "started_s": self.started_s,
            "ended_s": self.ended_s, "cancelling": self.cancelling,
        }  # fmt: skip


class Jobs:
    """Starts, lists and ends jobs. Thread-safe.

    Args:
        folder: the working directory of jobs.
        clean: what is kept of a line of output.
    """

    def __init__(self, folder: Path, clean: Callable[[str], str] = lambda line: line) -> None:
        self._folder, self._clean = folder, clean
        self._jobs: dict[int, Job] = {}
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._closed = False
        self.version = 0
        """Counts changes; a job's `version` is that of its newest change."""
        self.listeners: set[Callable[[], None]] = set()
        """Called after every change, in any thread."""

    def start(
        self, kind: str, title: str, arguments: Sequence[str], *, read: Reader | None = None,
        program: Sequence[str] = IBROBOT, done_codes: tuple[int, ...] = (0,), asks: bool = False,
    ) -> Job:  # fmt: skip
        """Start a job.

        Args:
            kind: what the views look for.
            title: its name on the page.
            arguments: of the program, e.g. `["convert", …]`.
            read: reads facts from each line of its output.
            program: the program; the command `ibrobot` by default.
            done_codes: exit codes of a job that did what it was started for.
            asks: whether it asks questions, the fact `ask`, and reads the answers.

        Raises:
            IbrobotError: if the program cannot be started.
        """
        with self._lock:
            if self._closed:
                raise IbrobotError("no job can be started any more: what runs them is ending")
            try:
                process = subprocess.Popen(
                    [*program, *arguments], cwd=self._folder, stdin=subprocess.PIPE if asks else subprocess.DEVNULL,
                    stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
                    env={**os.environ, "PYTHONUNBUFFERED": "1"},
                )  # fmt: skip
            except OSError as error:
                raise IbrobotError(f"{program[0]} cannot be started: {error.strerror}") from None
            name = "ibrobot" if tuple(program) == IBROBOT else Path(program[0]).name
            number = max(self._jobs, default=0) + 1
            job = Job(number, kind, title, (name, *arguments), process, done_codes)
            self._jobs[number] = job
            self._forget()
            thread = threading.Thread(target=self._follow, args=(job, read), name=f"job {number}", daemon=True)
            self._threads = [each for each in self._threads if each.is_alive()] + [thread]
            thread.start()
        self._change(job)
        return job

    def all(self) -> list[Job]:
        """The jobs, oldest first."""
        with self._lock:
            return list(self._jobs.values())

    def get(self, number: int) -> Job:
        """The job with a number.

        Raises:
            IbrobotError: if there is none.
        """
        with self._lock:
            job = self._jobs.get(number)
        if job is None:
            raise IbrobotError(f"no job {number}")
        return job

    def cancel(self, number: int) -> None:
        """End a job as Ctrl-C does; the second time at once.

        Raises:
            IbrobotError: if there is no such job.
        """
        job = self.get(number)
        _signal(job, signal.SIGKILL if job.cancelling else signal.SIGINT)
        job.cancelling = True
        self._change(job)

    def answer(self, number: int, answer: Answer) -> None:
        """Answer what a job asks.

        Raises:
            IbrobotError: if there is no such job, or it does not ask this any more, or the answer is not possible.
        """
        job = self.get(number)
        with self._lock:
            asked = job.facts.get("ask")
            if job.state != "running" or asked is None or asked["ask"] != answer.ask:
                raise IbrobotError("this question was answered already")
            keys = [each["key"] for each in asked["choices"]]
            if keys and answer.answer not in keys:
                raise IbrobotError(f"{answer.answer[:40]!r} is no answer; the answers are: {', '.join(keys)}")
            assert job.process.stdin is not None
            try:
                os.write(job.process.stdin.fileno(), json.dumps(attrs.asdict(answer)).encode() + b"\n")
            except BrokenPipeError:
                raise IbrobotError("the job has ended") from None
            job.facts["ask"] = None
        self._change(job)

    def close(self) -> None:
        """End all jobs, and wait for them."""
        with self._lock:
            self._closed = True
            running = [job for job in self._jobs.values() if job.state == "running"]
            threads = list(self._threads)
        for job in running:
            job.cancelling = True
            _signal(job, signal.SIGINT)
        deadline_s = time.monotonic() + _END_S
        for job in running:
            try:
                job.process.wait(max(0.0, deadline_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                _signal(job, signal.SIGKILL)
        for thread in threads:
            thread.join()

    def lines_after(self, job: Job, count: int) -> tuple[int, list[str]]:
        """The lines of a job after the first `count`, as far as they are kept, and the number of lines in all."""
        with self._lock:
            new = min(job.count - count, len(job.lines))
            return job.count, list(job.lines)[len(job.lines) - new :] if new > 0 else []

    def _follow(self, job: Job, read: Reader | None) -> None:
        """Take the output of a job until it ends."""
        output = job.process.stdout
        assert output is not None
        rest = b""
        while chunk := _read(job.process, output.fileno()):
            *lines, rest = _END.split(rest + chunk)
            self._take(job, lines, read)
            rest = rest[-_LONGEST:]
        self._take(job, [rest.rstrip(b"\r")] if rest else [], read)
        output.close()
        code = job.process.wait()
        with self._lock:
            job.facts.pop("ask", None)
            if job.process.stdin is not None:
                job.process.stdin.close()
            job.exit_code, job.ended_s = code, time.time()
            done = code in job.done_codes and "error" not in job.facts
            job.state = "done" if done else "cancelled" if job.cancelling else "failed"
        self._change(job)

    def _take(self, job: Job, lines: Sequence[bytes], read: Reader | None) -> None:
        with self._lock:
            for line in lines:
                text = _CONTROL.sub("", line.decode(errors="replace"))
                event = read(text) if read is not None else None
                job.facts.update(event or {})
                if event is None or not text.startswith("{"):
                    job.lines.append(self._clean(text[:_LONGEST]))
                    job.count += 1
        if lines:
            self._change(job)

    def _change(self, job: Job) -> None:
        with self._lock:
            self.version += 1
            job.version = self.version
            listeners = list(self.listeners)
        for listener in listeners:
            listener()

    def _forget(self) -> None:
        ended = [number for number, job in self._jobs.items() if job.state != "running"]
        for number in ended[: max(0, len(ended) - _ENDED)]:
            del self._jobs[number]


def arguments(options: Any) -> list[str]:
    """The arguments of a command line that give these options."""
    flags: list[str] = []
    operands: list[str] = []
    values = attrs.asdict(options, recurse=False)
    for name, field in fields(type(options)).items():
        value = values[field.name]
        items = value if isinstance(value, tuple) else (value,)
        if (flag := flag_of(name, field))[0] != "-":
            operands += [str(item) for item in items if item is not None]
        elif value != default_of(field):
            flags += [flag if item is True else f"{flag}={item}" for item in items]
    return [*flags, "--", *operands]


def _read(process: subprocess.Popen[bytes], output: int) -> bytes:
    """The next output; empty once the process has ended, even if its own children keep the output open."""
    while not select.select([output], [], [], _POLL_S)[0]:
        if process.poll() is not None and not select.select([output], [], [], 0)[0]:
            return b""
    return os.read(output, _CHUNK)


def _signal(job: Job, number: signal.Signals) -> None:
    if job.state == "running":
        try:
            os.killpg(job.process.pid, number)
        except ProcessLookupError:
            return
