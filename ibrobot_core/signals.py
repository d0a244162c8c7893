"""The signals that end a command, and what they set off."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable


def end_signals() -> tuple[signal.Signals, ...]:
    """The signals that end a command in order: SIGINT, SIGTERM, and SIGHUP unless the caller ignores it (nohup)."""
    hangup = [] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [signal.SIGHUP]
    return (signal.SIGINT, signal.SIGTERM, *hangup)


def on_signals(act: Callable[[], object]) -> None:
    """Have `act` called at each of the `end_signals`, in a thread of its own.

    A handler comes in the middle of what the main thread does. Where that waits for an event it may hold the lock that
    setting the event takes, and no more would ever happen.
    """
    for number in end_signals():
        signal.signal(number, lambda *_: threading.Thread(target=act, name="signal", daemon=True).start())
