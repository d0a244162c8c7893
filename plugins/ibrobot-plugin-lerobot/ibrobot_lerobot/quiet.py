"""Hold back what LeRobot and the libraries below it print, warn and log while they load."""

from __future__ import annotations

import io
import logging
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from typing import TextIO, override

_DEBUG = "IBROBOT_DEBUG"
"""Environment variable that `ibrobot --debug` sets."""
_MOST = 20
"""Lines shown if an error follows."""


class _Stream(io.TextIOBase):
    """A standard stream, except for what one thread writes while it is held back."""

    def __init__(self, stream: TextIO, held: _Held) -> None:
        self._stream, self._held = stream, held

    @override
    def write(self, text: str, /) -> int:
        if not self._held.holds():
            return self._stream.write(text)
        self._held.text.append(text)
        return len(text)

    @override
    def flush(self) -> None:
        self._stream.flush()

    @override
    def fileno(self) -> int:
        return self._stream.fileno()

    @override
    def isatty(self) -> bool:
        return self._stream.isatty()


class _Held:
    """What a thread has written; also the filter of the handlers that libraries' records reach."""

    def __init__(self) -> None:
        self.text: list[str] = []
        self.open = True
        self._thread = threading.get_ident()

    def holds(self) -> bool:
        """Whether this thread's words are held back."""
        return self.open and threading.get_ident() == self._thread

    def filter(self, record: logging.LogRecord) -> bool:
        """Keep a record of a library; those of ibrobot pass."""
        if not self.holds() or record.name.partition(".")[0] == "ibrobot":
            return True
        self.text.append(f"{record.getMessage()}\n")
        return False

    def lines(self, error: str) -> list[str]:
        """The newest lines, each once, without those that the error repeats."""
        lines = [line.rpartition("\r")[2].strip() for line in "".join(self.text).splitlines()]
        return [line for line in dict.fromkeys(lines) if line and line not in error and error not in line][-_MOST:]


@contextmanager
def held_back(log: logging.Logger) -> Iterator[None]:
    """Hold back what libraries write to the terminal in this thread; it is logged if an error is raised.

    With `ibrobot --debug`, all of it appears at once, on standard error.

    Args:
        log: gets the text before an error.
    """
    with ExitStack() as stack:
        if os.environ.get(_DEBUG):
            stack.enter_context(redirect_stdout(sys.stderr))
            yield
            return
        held = _Held()
        for handler in _handlers():
            handler.addFilter(held)
            stack.callback(handler.removeFilter, held)
        stack.enter_context(redirect_stdout(_Stream(sys.stdout, held)))
        stack.enter_context(redirect_stderr(_Stream(sys.stderr, held)))
        try:
            yield
        except Exception as error:
            held.open = False
            if lines := held.lines(str(error)):
                log.warning("before the next error: %s", "; ".join(lines))
            raise
        finally:
            held.open = False  # a handler that a library has made meanwhile keeps the stream


def cause(error: BaseException) -> str:
    """What an error began with, in one line: libraries repeat it in each error that they raise from it."""
    while error.__cause__ is not None:
        error = error.__cause__
    return (str(error).strip() or type(error).__name__).partition("\n")[0]


def _handlers() -> set[logging.Handler]:
    """The handlers of all loggers, ibrobot's own among them."""
    loggers = [each for each in logging.root.manager.loggerDict.values() if isinstance(each, logging.Logger)]
    handlers = {handler for logger in (logging.root, *loggers) for handler in logger.handlers}
    return handlers | ({logging.lastResort} if logging.lastResort is not None else set())
