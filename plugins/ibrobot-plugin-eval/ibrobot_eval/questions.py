"""Questions to an operator who answers by another program, e.g. a page: events out, lines of standard input in."""

from __future__ import annotations

import json
import os
import select
import time
from collections.abc import Sequence
from types import NoneType

from ibrobot_provenance.asking import Answer, Ask, Choice, Sight

from ibrobot_core.app import ComponentFailed, RequestError, Service, WireError

_ANSWER = Service("answer", Answer, NoneType)


class Questions:
    """Reads the answers to the questions of a command: lines of standard input.

    Args:
        fd: where they come from.
    """

    def __init__(self, fd: int = 0) -> None:
        self._fd = fd
        self._read = b""
        self._last = Ask(ask=0, text="")

    def next(self, text: str, choices: Sequence[Choice] = (), sights: Sequence[Sight] = ()) -> Ask:
        """The event for the next question, which the command prints. Answers to earlier ones are ignored."""
        self._last = Ask(ask=self._last.ask + 1, text=text, choices=tuple(choices), sights=tuple(sights))
        return self._last

    def answer(self, timeout_s: float) -> str | None:
        """The answer to the last question: the key of a choice, or a text; None if it does not come in time.

        Raises:
            ComponentFailed: if nobody can answer any more.
            WireError: for a line that is no answer.
        """
        until_s = time.monotonic() + timeout_s
        while True:
            line, end, rest = self._read.partition(b"\n")
            if end:
                self._read = rest
                try:
                    given = _ANSWER.read(json.loads(line))
                except (ValueError, RequestError) as error:
                    raise WireError(f"malformed {error}: {line[:200]!r}") from None
                keys = [each.key for each in self._last.choices]
                if given.ask == self._last.ask and (given.answer in keys or not keys):
                    return given.answer
                continue
            if not select.select([self._fd], [], [], max(0.0, until_s - time.monotonic()))[0]:
                return None
            if not (data := os.read(self._fd, 65_536)):
                raise ComponentFailed("nobody can answer: standard input has ended")
            self._read += data
