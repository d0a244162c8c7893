"""Keys typed in a terminal: their decoding, and a pseudo-terminal that types them."""

from __future__ import annotations

import gc
import os
import queue
import select
import signal
import termios
import threading
import weakref
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_terminal import HeldKeys, KeyReader
from ibrobot_terminal.key_reader import decode

from ibrobot_core.api import TeleopError, ns

TIMEOUT_S = 30

SENT = {
    b"a": "a", b"Z": "Z", b"+": "+", "ü".encode(): "ü", "€".encode(): "€", "🤖".encode(): "🤖",
    b" ": "space", b"\r": "enter", b"\n": "enter", b"\t": "tab", b"\x7f": "backspace",
    b"\x1b[A": "up", b"\x1bOA": "up", b"\x1b[1;5A": "up", b"\x1b[B": "down", b"\x1b[C": "right", b"\x1bOD": "left",
    b"\x1b[H": "home", b"\x1bOH": "home", b"\x1b[1~": "home", b"\x1b[7~": "home", b"\x1b[F": "end", b"\x1b[4~": "end",
    b"\x1b[2~": "insert", b"\x1b[3~": "delete", b"\x1b[5~": "page_up", b"\x1b[6;2~": "page_down",
    b"\x1bOP": "f1", b"\x1bOS": "f4", b"\x1b[11~": "f1", b"\x1b[[A": "f1", b"\x1b[[E": "f5", b"\x1b[15~": "f5",
    b"\x1b[17~": "f6", b"\x1b[21~": "f10", b"\x1b[23~": "f11", b"\x1b[24;5~": "f12", b"\x1b[1;2P": "f1",
}  # fmt: skip
"""What terminals send -> the key: xterm, rxvt, the Linux console; with modifiers; in application mode."""
PASSED_OVER = [b"\x00", b"\x01", b"\xff", b"\xc2\x80", b"\xe2\x82", b"\x1b[200~", b"\x1b[?1;2c", b"\x1b[Z", b"\x1bOx"]


@pytest.mark.parametrize(("typed", "key"), SENT.items())
def test_a_key_is_known_by_what_terminals_send(typed, key):
    assert decode(typed, final=True) == ([key], b"")


@pytest.mark.parametrize("typed", PASSED_OVER)
def test_bytes_without_a_key_are_ignored(typed):
    assert decode(typed + b"a", final=True) == (["a"], b"")


REPORTS = [
    (b"\x1b[97;;97u", ["a"]), (b"\x1b[97;1:2;97u", ["repeat:a"]), (b"\x1b[97;1:3u", ["release:a"]),
    (b"\x1b[61;2;43u", ["+"]), (b"\x1b[61;1:3u", ["release:+"]),  # shift was released first
    (b"\x1b[32;1:1;32u\x1b[32;1:2;32u\x1b[32;1:3u", ["space", "repeat:space", "release:space"]),
    (b"\x1b[27u", ["esc"]), (b"\x1b[27;5u", ["esc"]), (b"\x1b[27;1:2u", ["repeat:esc"]), (b"\x1b[13;1:1u", ["enter"]),
    (b"\x1b[1;1:1A", ["up"]), (b"\x1b[1;1:2A", ["repeat:up"]), (b"\x1b[1;1:3A", ["release:up"]),
    (b"\x1b[57419u", ["up"]),
    (b"\x1b[21;1:3~", ["release:f10"]), (b"\x1b[13~", ["f3"]), (b"\x1b[P", ["f1"]),
    (b"\x1b[57441;2u", []), (b"\x1b[119;3u", []), (b"\x1b[98;1:3u", []),  # shift; with alt; a press before the start
    (b"\x1b[99;5u", ["\x03"]), (b"\x1b[99;5:2u", []), (b"\x1b[?0u", ["\x05"]),
    (b"\x1b[55296;;55296u\x1b[9999999;;9999999u\x1b[;;u\x1b[97;9999999u\x1b[" + b"9" * 5000 + b"u", []),
]  # fmt: skip
"""What terminals with kitty's protocol send, one after the other -> the keys."""


def test_reports_of_keys_say_which_are_pressed_repeated_and_released():
    down: dict[int, str] = {}
    for typed, keys in REPORTS:
        assert decode(typed, final=True, down=down) == (keys, b""), typed


@given(st.lists(st.sampled_from(list(SENT.items()))))
def test_keys_typed_at_once_come_in_order(keys):
    assert decode(b"".join(typed for typed, _ in keys), final=False) == ([key for _, key in keys], b"")


pieces = st.sampled_from([*SENT, *PASSED_OVER, b"\x1b", b"\x1b[", b"\x1b[1;", b"\x1bO", b"\xf0\x9f"]) | st.binary(
    max_size=4
)


@given(st.lists(pieces).map(b"".join), st.lists(st.integers(1, 5)))
def test_it_does_not_matter_how_the_bytes_arrive(typed, sizes):
    keys, rest, remaining = [], b"", typed
    for size in [*sizes, len(typed)]:
        found, rest = decode(rest + remaining[:size], final=False)
        keys += found
        remaining = remaining[size:]
    found, rest = decode(rest, final=True)
    assert (keys + found, rest) == decode(typed, final=True)
    assert rest == b""


@given(st.lists(pieces).map(b"".join))
def test_every_key_has_a_name_and_none_is_made_up(typed):
    keys, _ = decode(typed, final=True)
    for key in keys:
        name = key.removeprefix("repeat:").removeprefix("release:") or key
        assert name in {*SENT.values(), "esc"} or (
            len(name) == 1 and (name in typed.decode(errors="ignore") or b"u" in typed)
        )


@given(st.lists(pieces).map(b"".join))
def test_an_escape_at_the_end_is_never_lost(typed):
    keys, rest = decode(typed + b"\x1b", final=True)
    assert (keys[-1], rest) == ("esc", b"")


@pytest.mark.parametrize(
    ("typed", "keys"),
    [
        (b"\x1b", ["esc"]),
        (b"\x1b\x1b", ["esc", "esc"]),
        (b"\x1ba", ["esc", "a"]),
        (b"\x1b\x1b[A", ["esc", "up"]),
        (b"\x1b[", ["esc"]),
        (b"\x1b[1;5", ["esc"]),
        (b"\x1b[[x", ["esc", "[", "[", "x"]),
        (b"\x1b[" + b"9" * 5000 + b"~a", ["a"]),
    ],
)
def test_an_escape_that_begins_no_sequence_is_the_key(typed, keys):
    assert decode(typed, final=True) == (keys, b"")


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """Two ends of a pseudo-terminal: where a person types, and where the program reads."""
    person, program = os.openpty()
    yield person, program
    os.close(person)
    os.close(program)


def test_what_is_typed_reaches_every_subscriber(terminal):
    person, program = terminal
    with KeyReader(program) as keys:
        first, second = keys.subscribe(), keys.subscribe()
        os.write(person, b"w\x1b[A \x1bOP")
        for subscriber in (first, second):
            assert [subscriber.get(timeout=TIMEOUT_S) for _ in range(4)] == ["w", "up", "space", "f1"]


def test_a_lone_escape_comes_without_a_further_key(terminal):
    person, program = terminal
    with KeyReader(program) as keys:
        subscriber = keys.subscribe()
        os.write(person, b"\x1b")
        assert subscriber.get(timeout=TIMEOUT_S) == "esc"


def test_later_subscribers_get_later_keys_only(terminal):
    person, program = terminal
    with KeyReader(program) as keys:
        first = keys.subscribe()
        os.write(person, b"a")
        assert first.get(timeout=TIMEOUT_S) == "a"
        second = keys.subscribe()
        os.write(person, b"b")
        assert second.get(timeout=TIMEOUT_S) == "b"


def test_a_queue_that_nobody_keeps_is_fed_no_more(terminal):
    _, program = terminal
    keys = KeyReader(program)
    subscriber = weakref.ref(keys.subscribe())
    gc.collect()
    assert subscriber() is None


def test_keys_come_unechoed_without_enter_and_the_terminal_is_restored(terminal):
    _, program = terminal
    before = termios.tcgetattr(program)
    threads = threading.active_count()
    keys = KeyReader(program)

    def fail_while_open() -> None:
        with keys:
            local = termios.tcgetattr(program)[3]
            assert not local & (termios.ECHO | termios.ICANON)
            assert local & termios.ISIG
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_while_open()
    assert termios.tcgetattr(program) == before
    assert threading.active_count() == threads
    keys.close()


def said(person: int, wanted: bytes) -> None:
    """Wait until the program has written this to the terminal."""
    text = b""
    while not text.endswith(wanted):
        assert select.select([person], [], [], TIMEOUT_S)[0], text
        text += os.read(person, 100)


def received(subscriber: queue.SimpleQueue[str], number: int) -> queue.SimpleQueue[str]:
    """A queue with the next keys, which may still be on their way."""
    keys: queue.SimpleQueue[str] = queue.SimpleQueue()
    for _ in range(number):
        keys.put(subscriber.get(timeout=TIMEOUT_S))
    return keys


def test_whatever_comes_switches_a_toggle_off_and_nothing_on_later():
    held, on, states = HeldKeys(0.2), False, []
    keys: queue.SimpleQueue[str] = queue.SimpleQueue()
    for typed_s, then_s in ((0.0, 0.2), (3.0, 3.2), (6.0, 6.2)):
        keys.put("space")
        for now_s in (typed_s, then_s):
            held.take(keys, ns(now_s))
            on = held.toggled("space", on)
            states.append(on)
    assert states == [False, True, False, False, False, True]


def test_a_terminal_that_can_reports_repeats_and_releases_until_the_end(terminal, caplog):
    caplog.set_level("INFO", "ibrobot.keys")
    person, program = terminal
    with KeyReader(program) as keys:
        said(person, b"\x1b[?u")
        subscriber = keys.subscribe()
        os.write(person, b"\x1b[?0u")
        said(person, b"\x1b[>27u")
        held = HeldKeys(0.2)
        os.write(person, b"\x1b[32;1:1;32u\x1b[32;1:2;32u")
        held.take(received(subscriber, 2), 0)
        assert held.held("space")
        os.write(person, b"\x1b[32;1:3u")
        held.take(received(subscriber, 1), 1)
        assert held.events == [("release", "space")]
        with keys.suspended():
            said(person, b"\x1b[<u")
        said(person, b"\x1b[?u")
        os.write(person, b"\x1b[?0u")
        said(person, b"\x1b[>27u")
    said(person, b"\x1b[<u")
    assert "this terminal reports when keys are released" in caplog.text


def test_a_terminal_that_reports_all_keys_still_sends_signals(terminal, monkeypatch):
    person, program = terminal
    sent: queue.SimpleQueue[tuple[int, int]] = queue.SimpleQueue()
    monkeypatch.setattr(os, "kill", lambda *arguments: sent.put(arguments))
    with KeyReader(program) as keys:
        subscriber = keys.subscribe()
        os.write(person, b"\x1b[99;5u\x1b[122;5:1u\x1b[92;5u\x1b[120;5ua")
        assert [sent.get(timeout=TIMEOUT_S) for _ in range(3)] == [
            (0, signal.SIGINT),
            (0, signal.SIGTSTP),
            (0, signal.SIGQUIT),
        ]
        assert subscriber.get(timeout=TIMEOUT_S) == "a"


def test_a_paused_terminal_holds_nothing_up(terminal):
    _, program = terminal
    termios.tcflow(program, termios.TCOOFF)
    with KeyReader(program) as keys, keys.suspended():
        pass
    termios.tcflow(program, termios.TCOON)


def test_it_can_be_opened_again(terminal):
    person, program = terminal
    keys = KeyReader(program)
    subscriber = keys.subscribe()
    for character in "ab":
        with keys:
            os.write(person, character.encode())
            assert subscriber.get(timeout=TIMEOUT_S) == character


def test_a_terminal_that_goes_away_ends_quietly():
    person, program = os.openpty()
    try:
        with KeyReader(program):
            os.close(person)
    finally:
        os.close(program)


def test_without_a_terminal_it_says_what_to_do():
    out, into = os.pipe()
    try:
        with pytest.raises(TeleopError, match="need a terminal, but standard input is not one: start it in a terminal"):
            KeyReader(out).open()
    finally:
        os.close(out)
        os.close(into)
