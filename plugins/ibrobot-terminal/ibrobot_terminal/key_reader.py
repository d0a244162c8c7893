"""Keys of the terminal: one reader of standard input decodes the typed keys and sends them to all subscribers."""

from __future__ import annotations

import logging
import os
import queue
import re
import select
import signal
import termios
import threading
import tty
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Self

from ibrobot_core.api import TeleopError
from ibrobot_terminal.held_keys import RELEASE, REPEAT

_ESCAPE_S = 0.05
"""Time after which a lone escape is the key, not the start of a sequence [s]."""

_NAMED = {" ": "space", "\r": "enter", "\n": "enter", "\t": "tab", "\x7f": "backspace", "\b": "backspace"}
_LETTERS = {
    "A": "up", "B": "down", "C": "right", "D": "left", "H": "home", "F": "end",
    "P": "f1", "Q": "f2", "R": "f3", "S": "f4",
}  # fmt: skip
"""Last letter of a sequence -> key."""
_NUMBERS = {
    "1": "home", "2": "insert", "3": "delete", "4": "end", "5": "page_up", "6": "page_down", "7": "home", "8": "end",
    "11": "f1", "12": "f2", "13": "f3", "14": "f4", "15": "f5", "17": "f6", "18": "f7", "19": "f8", "20": "f9",
    "21": "f10", "23": "f11", "24": "f12",
}  # fmt: skip
"""First parameter of a sequence that ends with `~` -> key."""

_ASK, _REPORT_ALL, _REPORT_NO_MORE = b"\x1b[?u", b"\x1b[>27u", b"\x1b[<u"
"""Of kitty's keyboard protocol: ask whether the terminal has it; have it report presses, repeats and releases of all
keys with the text that they type; and as before."""
_ANSWER = re.compile(r"\?\d{1,5}")
_REPORT = re.compile(r"(\d{1,7})(?::[\d:]*)?(?:;(\d{0,5})(?::([123]))?)?(?:;(\d{1,7})[\d:]*)?")
"""Report of a key in that protocol: its code, its modifiers, the kind of the event, and the first character typed."""
_PLAIN = {27: "esc", 13: "enter", 9: "tab", 127: "backspace", 57414: "enter"} | dict(
    enumerate(("left", "right", "up", "down", "page_up", "page_down", "home", "end", "insert", "delete"), 57417)
)
"""Code -> key; the last ones are those of the keypad."""
_FUNCTIONAL = range(57344, 63744)
"""Codes of keys that type nothing, e.g. modifiers."""
_CTRL, _OTHERS = 4, 0b111010
"""Bits of modifiers: Control; Alt, Super, Hyper and Meta, with which no key means anything here."""
_KINDS = {"2": REPEAT, "3": RELEASE}
_HAS_REPORTS = "\x05"
"""Instead of a key: the terminal has said that it can report releases."""
_SIGNALS = {termios.VINTR: signal.SIGINT, termios.VQUIT: signal.SIGQUIT, termios.VSUSP: signal.SIGTSTP}
"""Which signal a control character sends; a terminal that reports all keys leaves that to the program."""
_log = logging.getLogger("ibrobot.keys")

_SEQUENCE = re.compile(rb"\x1b(?:\[\[([A-E])|\[([0-?]*)[ -/]*([@-Z\\-~])|O([A-Za-z]))")
"""An escape sequence: f1 to f5 of the Linux console, a control sequence, or a key in application mode."""
_BEGINNING = re.compile(rb"\x1b(?:\[(?:\[|[0-?]*[ -/]*)|O)?")
"""An incomplete escape sequence."""


def decode(typed: bytes, *, final: bool, down: dict[int, str] | None = None) -> tuple[list[str], bytes]:
    """Decode the bytes sent by a terminal into keys.

    Keys are printable characters, and `space`, `enter`, `tab`, `backspace`, `esc`, `up`, `down`, `left`,
    `right`, `home`, `end`, `insert`, `delete`, `page_up`, `page_down`, `f1` to `f12`; modifiers of the named ones are
    ignored. Unknown sequences, control characters and invalid UTF-8 are ignored. An escape that starts no sequence is
    `esc`. A terminal that reports all keys (kitty's protocol) also sends `repeat:KEY` and `release:KEY`, and a control
    character for a key pressed with Control.

    Args:
        typed: the bytes, starting at a key.
        final: whether no more bytes follow for now, so that a lone escape is the key.
        down: the keys that a terminal has reported as pressed, by code, kept from call to call: a release does not say
            what the key typed.

    Returns:
        The keys, and the bytes of an incomplete last key, to be continued by the next bytes; empty if `final`.
    """
    keys: list[str] = []
    down = {} if down is None else down
    while typed:
        if typed[0] != 0x1B:
            length = _character_length(typed[0])
            if len(typed) < length and not final:
                break
            try:
                character = typed[:length].decode()
            except UnicodeDecodeError:
                typed = typed[1:]
                continue
            typed = typed[length:]
            if character in _NAMED or character.isprintable():
                keys.append(_NAMED.get(character, character))
        elif sequence := _SEQUENCE.match(typed):
            typed = typed[sequence.end() :]
            keys += _sequence_key(down, *(group.decode() if group else "" for group in sequence.groups()))
        elif _BEGINNING.fullmatch(typed):
            if not final:
                break
            keys.append("esc")
            typed = b""
        else:
            keys.append("esc")
            typed = typed[1:]
    return keys, typed


def _character_length(first: int) -> int:
    """Length of a UTF-8 character in bytes, by its first byte; 1 for an invalid first byte."""
    return 2 if 0xC2 <= first < 0xE0 else 3 if 0xE0 <= first < 0xF0 else 4 if 0xF0 <= first < 0xF5 else 1


def _sequence_key(down: dict[int, str], console: str, parameters: str, last: str, application: str) -> list[str]:
    """The key of a sequence, from the groups of `_SEQUENCE`, or none."""
    if console:
        return [f"f{ord(console) - ord('A') + 1}"]
    report = _REPORT.fullmatch(parameters)
    if last == "u":
        return [_HAS_REPORTS] if _ANSWER.fullmatch(parameters) else _reported_key(report, down) if report else []
    key = _NUMBERS.get(parameters.partition(";")[0]) if last == "~" else _LETTERS.get(last or application)
    return [_KINDS.get(report[3] or "", "") + key if report else key] if key else []


def _reported_key(report: re.Match[str], down: dict[int, str]) -> list[str]:
    """The key of a report of kitty's protocol, or none."""
    code, modifiers, kind = int(report[1]), int(report[2] or 1) - 1, _KINDS.get(report[3] or "", "")
    if kind == RELEASE:
        released = down.pop(code, None)
        return [RELEASE + released] if released else []
    key = _PLAIN.get(code)
    if key is None and modifiers & _CTRL:
        return [chr(code & 0x1F)] if 0x40 <= code < 0x80 and not kind else []
    if key is None and not modifiers & _OTHERS:
        character = chr(min(int(report[4] or code), 0x10FFFF))
        key = _NAMED.get(character) or (character if character.isprintable() and code not in _FUNCTIONAL else None)
    if key is None:
        return []
    down[code] = key
    return [kind + key]


class KeyReader:
    """Reads keys from a terminal while open, and sends each to every subscriber.

    Meanwhile the terminal does not echo typed characters; Ctrl-C and similar keys still send signals. A terminal with
    kitty's keyboard protocol reports repeats and releases, which `HeldKeys` understands. Use it as a context manager,
    which always restores the terminal.

    Args:
        fd: the terminal; standard input by default.

    Attributes:
        beat: called by the thread that reads, at least 20 times per second.
        gone: called by it when it ends because the terminal is gone.
    """

    def __init__(self, fd: int = 0) -> None:
        self._fd = fd
        self.beat: Callable[[], None] = lambda: None
        self.gone: Callable[[], None] = lambda: None
        self._lock = threading.Lock()
        self._subscribers: weakref.WeakSet[queue.SimpleQueue[str]] = weakref.WeakSet()
        self._thread: threading.Thread | None = None
        self._saved: list[Any] = []
        self._reports = False
        """Whether the terminal reports all keys."""
        self._wake: tuple[int, int] = (-1, -1)

    def open(self) -> None:
        """Start reading.

        Raises:
            TeleopError: if standard input is not a terminal.
        """
        if not os.isatty(self._fd):
            raise TeleopError(
                "keys need a terminal, but standard input is not one: start it in a terminal, without a pipe or '<'"
            )
        self._saved = termios.tcgetattr(self._fd)
        self._wake = os.pipe()
        tty.setcbreak(self._fd)
        self._say(_ASK)
        self._thread = threading.Thread(target=self._read, name="keys", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop reading, drop unread keys and restore the terminal. Safe to call twice."""
        if self._thread is None:
            return
        thread, self._thread = self._thread, None
        try:
            os.write(self._wake[1], b"x")
            thread.join()
        finally:
            self._restore()
            for end in self._wake:
                os.close(end)

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Leave the terminal to other programs for a while, e.g. to the shell after Ctrl-Z."""
        if self._thread is None:
            yield
            return
        self._restore()
        try:
            yield
        finally:
            with suppress(termios.error):
                tty.setcbreak(self._fd, termios.TCSANOW)
            self._say(_ASK)

    def _say(self, text: bytes) -> None:
        """Write to the terminal, but never wait for one that is paused."""
        with suppress(OSError):
            terminal = os.open(os.ttyname(self._fd), os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
            try:
                os.write(terminal, text)
            finally:
                os.close(terminal)

    def _restore(self) -> None:
        if self._reports:
            self._reports = False
            self._say(_REPORT_NO_MORE)
        # At once: to wait until all output is written, as TCSAFLUSH does, takes forever on a terminal that is paused.
        with suppress(termios.error):  # the terminal is gone
            termios.tcsetattr(self._fd, termios.TCSANOW, self._saved)
            termios.tcflush(self._fd, termios.TCIFLUSH)

    def subscribe(self) -> queue.SimpleQueue[str]:
        """A new queue of the keys typed from now on, filled while a reference to it exists."""
        subscriber: queue.SimpleQueue[str] = queue.SimpleQueue()
        with self._lock:
            self._subscribers.add(subscriber)
        return subscriber

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _read(self) -> None:
        typed, down = b"", dict[int, str]()
        while True:
            self.beat()
            ready, _, _ = select.select([self._fd, self._wake[0]], [], [], _ESCAPE_S)
            if self._wake[0] in ready:
                return
            if ready:
                try:
                    read = os.read(self._fd, 1024)
                except OSError:
                    read = b""
                if not read:
                    self.gone()
                    return
                typed += read
            keys, typed = decode(typed, final=not ready, down=down)
            keys = [key for key in keys if not self._handle(key)]
            with self._lock:
                for subscriber in self._subscribers:
                    for key in keys:
                        subscriber.put(key)

    def _handle(self, key: str) -> bool:
        """Act on what is no key: an answer of the terminal, and control characters."""
        if key == _HAS_REPORTS:
            if not self._reports:
                self._reports = True
                self._say(_REPORT_ALL)
                _log.info("this terminal reports when keys are released")
        elif key < " ":
            for index, number in _SIGNALS.items():
                if self._saved[6][index] == key.encode():
                    os.kill(0, number)  # to the process group, as the terminal does
        return key < " "
