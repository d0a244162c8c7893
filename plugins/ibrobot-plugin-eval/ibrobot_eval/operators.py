"""The operator of blinded trials: at a terminal, or at the page that started the command."""

from __future__ import annotations

import queue
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import override

from ibrobot_provenance.asking import Choice, Sight
from ibrobot_terminal import KeyReader

from ibrobot_core.api import TeleopError
from ibrobot_core.app import Event, echo
from ibrobot_eval.options import Told
from ibrobot_eval.questions import Questions

QUIT = Choice(key="q", text="stop for now")
_POLL_S = 0.5
_GONE = ""


class Quit(Exception):
    """The operator interrupts the trials."""


class Operator(ABC):
    """Asks the operator, one question at a time.

    Attributes:
        sees: whether pictures can be shown.
    """

    sees = False

    @abstractmethod
    def say(self, text: str) -> None:
        """Show a text."""

    @abstractmethod
    def put(self, text: str, choices: Sequence[Choice] = (), sights: Sequence[Sight] = ()) -> None:
        """Ask a question in place of the previous one; without choices, the answer is a text."""

    @abstractmethod
    def answer(self, timeout_s: float) -> str | None:
        """The key of the choice, or the text; None if there is no answer within `timeout_s` [s].

        Raises:
            IbrobotError: if the terminal or page has closed.
        """

    @abstractmethod
    def present(self) -> AbstractContextManager[object]:
        """A context in which the operator can be asked.

        Raises:
            IbrobotError: if nobody can be asked.
        """

    def ask(self, text: str, choices: Sequence[Choice] = (), sights: Sequence[Sight] = ()) -> str:
        """Ask a question, and wait for the answer.

        Raises:
            Quit: if the operator interrupts the trials.
        """
        self.put(text, choices, sights)
        while (given := self.answer(_POLL_S)) is None:
            pass
        if choices and given == QUIT.key:
            raise Quit
        return given


class AtTerminal(Operator):
    """An operator at a terminal, who answers with keys."""

    def __init__(self) -> None:
        self._keys = KeyReader()
        self._pressed: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._possible: set[str] = set()
        """Keys that answer; empty if the answer is a text."""
        self._line = ""

    @contextmanager
    @override
    def present(self) -> Iterator[None]:
        if not sys.stdin.isatty():
            raise TeleopError("blinded trials need a terminal, since the operator begins and judges them by key")
        self._pressed = self._keys.subscribe()
        self._keys.gone = lambda: self._pressed.put(_GONE)
        with self._keys:
            yield

    @override
    def say(self, text: str) -> None:
        echo(text)

    @override
    def put(self, text: str, choices: Sequence[Choice] = (), sights: Sequence[Sight] = ()) -> None:
        while not self._pressed.empty():  # keys typed before the question do not answer it
            self._check(self._pressed.get())
        self._possible = {each.key for each in choices}
        self._line = ""
        for each in sights:
            if each.wanted:
                echo(f"{each.camera}: {each.wanted}")
        keys = ", ".join(f"{each.key.capitalize() if len(each.key) > 1 else each.key} {each.text}" for each in choices)
        echo(f"{text}: {keys}", nl=bool(choices))

    @override
    def answer(self, timeout_s: float) -> str | None:
        try:
            key = self._check(self._pressed.get(timeout=timeout_s))
        except queue.Empty:
            return None
        if self._possible:
            return key if key in self._possible else None
        if key == "enter":
            echo(self._line)
            return self._line
        if key == "backspace":
            self._line = self._line[:-1]
        else:
            self._line += " " if key == "space" else key if len(key) == 1 else ""
        return None

    def _check(self, key: str) -> str:
        if key == _GONE:
            self._pressed.put(_GONE)
            raise TeleopError("the terminal has closed")
        return key


class AtPage(Operator):
    """An operator at a page: questions are events of the command, answers arrive on standard input."""

    sees = True

    def __init__(self, emit: Callable[[Event], None]) -> None:
        self._emit = emit
        self._questions = Questions()

    @override
    def present(self) -> AbstractContextManager[object]:
        return nullcontext()

    @override
    def say(self, text: str) -> None:
        self._emit(Told(text=text))

    @override
    def put(self, text: str, choices: Sequence[Choice] = (), sights: Sequence[Sight] = ()) -> None:
        self._emit(self._questions.next(text, choices, sights))

    @override
    def answer(self, timeout_s: float) -> str | None:
        return self._questions.answer(timeout_s)
