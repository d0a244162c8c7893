"""Limits of an episode in a worker process: what hangs, or ends the process, is an error of that episode alone."""

from __future__ import annotations

import faulthandler
import os
import time
from pathlib import Path
from types import TracebackType
from typing import IO, Self

DEATHS = 2
"""Number of processes that may die with an episode; the next one reports an error instead of running it."""
_REARM_S = 1.0


class EpisodeTooLong(Exception):
    """The episode has taken longer than its limit."""


class Attempt:
    """One attempt at an episode, in a context. Its file tells the next process what became of this one.

    A watchdog ends the process if `beat` is not called in time. It needs neither Python nor the interpreter's lock, so
    that it also ends code in C that never returns.

    Args:
        file: a file of this episode; missing if it was never attempted.
        answer_s: longest time between two beats [s].
        episode_s: longest time of the whole attempt, and until the first beat, since a model may load for long [s].

    Attributes:
        error: why this episode must not be attempted again; empty if it may.
    """

    def __init__(self, file: Path, answer_s: float, episode_s: float) -> None:
        self._file = file
        self._answer_s = answer_s
        self._end_s = time.monotonic() + episode_s
        self._episode_s = episode_s
        self._armed_s = 0.0
        self._log: IO[str] | None = None
        text = file.read_text(encoding="utf-8", errors="replace") if file.exists() else ""
        self.error = ""
        if "Timeout (" in text:
            until = f"no step ended within {answer_s:g} s" if "ready" in text else f"no start within {episode_s:g} s"
            self.error = f"it hung: {until}{_innermost(text)}"
        elif text.count("begun") >= DEATHS:
            self.error = f"it ended its process, {text.count('begun')} times"

    def __enter__(self) -> Self:
        self._file.parent.mkdir(parents=True, exist_ok=True)
        self._log = self._file.open("a", encoding="utf-8")
        self._log.write("begun\n")
        self._log.flush()
        os.fsync(self._log.fileno())
        faulthandler.dump_traceback_later(self._episode_s + self._answer_s, exit=True, file=self._log)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        faulthandler.cancel_dump_traceback_later()
        assert self._log is not None
        self._log.close()
        if error is None or isinstance(error, Exception):
            self._file.unlink(missing_ok=True)

    def beat(self) -> None:
        """Note that the episode goes on.

        Raises:
            EpisodeTooLong: if it has taken longer than its limit.
        """
        now_s = time.monotonic()
        if now_s >= self._end_s:
            raise EpisodeTooLong(f"it did not end within {self._episode_s:g} s")
        if not self._armed_s and self._log is not None:
            self._log.write("ready\n")
            self._log.flush()
        if now_s - self._armed_s >= _REARM_S:
            self._arm(now_s)

    def _arm(self, now_s: float) -> None:
        """Have the watchdog wait from now [s] on."""
        assert self._log is not None
        self._armed_s = now_s
        faulthandler.dump_traceback_later(self._answer_s, exit=True, file=self._log)


def _innermost(text: str) -> str:
    """Where the main thread hung, from the traceback of the watchdog, which has it last."""
    lines = [line.strip() for line in text.splitlines()]
    threads = [number for number, line in enumerate(lines) if "hread 0x" in line]
    place = lines[threads[-1] + 1 :][:1] if threads else []
    return f" (at {place[0].removeprefix('File ')})" if place else ""
