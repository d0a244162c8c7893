"""Runs a command line in a pseudo-terminal, for tests of dialogues: reads the screen and types keys."""

from __future__ import annotations

import codecs
import os
import subprocess
import threading
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from ibrobot_testing.command import ibrobot_command

_START = """
import fcntl, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
{before}
"""
_TIMEOUT_S = 120.0


class Terminal:
    """`ibrobot ARGUMENTS` in a pseudo-terminal, which is its controlling terminal; a context manager.

    Args:
        arguments: arguments of the command.
        before: Python source that the process runs first.
        environment: additional environment variables.
        columns: width of the terminal.
    """

    def __init__(
        self, *arguments: str, before: str = "", environment: Mapping[str, str] | None = None, columns: int = 80
    ) -> None:
        self._master, slave = os.openpty()
        try:
            self._process = subprocess.Popen(
                [*ibrobot_command(_START.format(before=before)), *arguments],
                stdin=slave,
                stdout=slave,
                stderr=slave,
                start_new_session=True,
                env={**os.environ, "TERM": "xterm", "COLUMNS": str(columns), "LINES": "40", **(environment or {})},
            )
        finally:
            os.close(slave)
        self.screen = ""
        """The output so far."""
        self._seen = 0
        self._ended = False
        self._changed = threading.Condition()
        # Read continuously, because a program blocks if its terminal is not read.
        self._thread = threading.Thread(target=self._read, name="terminal", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        self._thread.join()
        os.close(self._master)

    def wait_for(self, text: str) -> None:
        """Wait until the text is printed, after the text of the previous wait.

        Raises:
            AssertionError: if it is not printed.
        """
        with self._changed:
            come = self._changed.wait_for(lambda: self._ended or text in self.screen[self._seen :], _TIMEOUT_S)
            if not come or text not in self.screen[self._seen :]:
                raise AssertionError(f"{text!r} did not appear; the screen was:\n{self.screen}")
            self._seen = self.screen.index(text, self._seen) + len(text)

    def type(self, text: str) -> None:
        """Press keys; Enter is a carriage return, Ctrl-C the character 3."""
        os.write(self._master, text.encode())

    def interrupt(self) -> None:
        """Press Ctrl-C, then Enter if it has no effect, and wait for the command to end.

        Python does not see a signal that arrives between its last check and the system call that reads a line, until
        the line is read. A second Ctrl-C is no solution, because it may arrive while the first one is handled.
        """
        with self._changed:
            self.type("\x03")
            if not self._changed.wait_for(lambda: self._ended, 3):
                self.type("\r")
                self._changed.wait_for(lambda: self._ended, _TIMEOUT_S)

    def end(self) -> int:
        """Wait for the end; returns the exit code.

        Raises:
            AssertionError: if it does not end.
        """
        try:
            code = self._process.wait(_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"it does not end; the screen was:\n{self.screen}") from None
        self._thread.join()
        return code

    def _read(self) -> None:
        decoder = codecs.getincrementaldecoder("utf-8")("replace")  # a character may arrive in two pieces
        while True:
            try:
                received = os.read(self._master, 65536)
            except OSError:  # the other end is closed
                received = b""
            with self._changed:
                self.screen += decoder.decode(received)
                self._ended = not received
                self._changed.notify_all()
            if self._ended:
                return
