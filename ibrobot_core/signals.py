"""Handling of the signals that end a command."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable


def end_signals() -> tuple[signal.Signals, ...]:
    """The signals that end a command in an orderly way: SIGINT, SIGTERM, and SIGHUP unless ignored (nohup)."""
    hangup = [] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [signal.SIGHUP]
    return (signal.SIGINT, signal.SIGTERM, *hangup)


def on_signals(act: Callable[[], object]) -> None:
    """Call `act` in a new thread at each of the `end_signals`.

    A signal handler interrupts the main thread. If the main thread waits for an event, it may hold the event's lock,
    and setting the event in the handler would deadlock.
    """
    for number in end_signals():
        signal.signal(number, lambda *_: threading.Thread(target=act, name="signal", daemon=True).start())
