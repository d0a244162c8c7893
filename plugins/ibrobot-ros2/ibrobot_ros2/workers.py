"""Worker threads: process items in the order of arrival with a bounded number of threads; those of emergency stops."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from ibrobot_core.api import TransportError
from ibrobot_core.app import Pulse, RunView

_END_S = 1.0
_STOP_BLOCKED_S = 6.0
"""Time without a sign of life of the threads of a way after which the run ends [s]; control may take 5 s to answer."""
_log = logging.getLogger("ibrobot.workers")


class StopWay:
    """A way by which emergency stops come from outside: what it needs exists from its start, and its loss ends the run.

    Args:
        session: the run.
        name: what hangs if its threads give no signs of life, e.g. `services for other machines`.
    """

    def __init__(self, session: RunView, name: str) -> None:
        self._session = session
        self._pulse = Pulse(name, _STOP_BLOCKED_S)
        self.beat = self._pulse.beat
        """Gives a sign of life."""

    def open(self) -> None:
        """Expect signs of life from now on."""
        self._session.pulses.add(self._pulse)

    def close(self) -> None:
        """Expect no more signs of life. Safe to call twice."""
        self._session.pulses.discard(self._pulse)

    def lose(self, error: BaseException) -> None:
        """Stop the robot and end the run, since something failed that may have been an emergency stop."""
        try:
            with suppress(Exception):  # the end of the run stops the robot, too
                self._session.emergency_stop()
        finally:
            self._session.fail(self._pulse.name, error)


class Workers[T]:
    """Calls `work` with each item, in at most `count` threads, which start when needed, or at once with `way`.

    An exception in `work` is logged and does not affect other items.

    Args:
        work: function to call with each item.
        name: name for the log and the threads, e.g. `a subscriber of topic`.
        count: maximum number of threads; one preserves the order of completion.
        depth: maximum number of waiting items; None: unlimited.
        way: for emergency stops: all threads start now, and give it signs of life; it is lost with an exception in
            `work`.

    Raises:
        TransportError: if the threads that start now cannot.
    """

    def __init__(
        self, work: Callable[[T], object], name: str, count: int = 1, depth: int | None = None,
        way: StopWay | None = None,
    ) -> None:  # fmt: skip
        self._work = work
        self._name = name
        self._count = count
        self._depth = depth
        self._way = way
        self._waiting: deque[T] = deque()
        self._arrived = threading.Condition()
        self._threads: list[threading.Thread] = []
        self._idle = 0
        self._ended = False
        self._is_short = False
        """Whether the last attempt to start a thread failed."""
        if way is not None and not all([self._start() for _ in range(count)]):
            self.end()
            raise TransportError(f"{name}: its threads cannot start: too many threads, or too little memory")

    def put(self, item: T) -> T | None:
        """Queue `item`.

        Returns:
            The item that will not be processed: the oldest one if the queue is full, or `item` itself after `end`, or
            if all threads are busy and no further one can start now; otherwise None.
        """
        with self._arrived:
            if self._ended:
                return item
            if len(self._waiting) >= self._idle and len(self._threads) < self._count and not self._start():
                return item
            full = self._depth is not None and len(self._waiting) >= self._depth
            dropped = self._waiting.popleft() if full else None
            self._waiting.append(item)
            self._arrived.notify()
        return dropped

    def end(self) -> None:
        """Stop processing. Waits briefly for running items, unless called from one of them."""
        with self._arrived:
            self._ended = True
            self._waiting.clear()
            self._arrived.notify_all()
        if threading.current_thread() not in self._threads:
            deadline = time.monotonic() + _END_S
            for thread in self._threads:
                thread.join(max(0.0, deadline - time.monotonic()))

    def _start(self) -> bool:
        """Start a thread; return whether the system permits it."""
        try:
            thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            thread.start()
        except (RuntimeError, MemoryError) as error:
            if not self._is_short:
                self._is_short = True
                _log.error("%s: a thread cannot start (%s): calls are refused", self._name, error)
            return False
        self._threads.append(thread)
        self._is_short = False
        return True

    def _run(self) -> None:
        while (item := self._next()) is not None:
            try:
                self._work(item)
            except BaseException as error:  # noqa: BLE001 - one item's fault must not affect the others
                if self._way is not None:
                    self._way.lose(error)
                _log.exception("%s failed", self._name)
            del item  # it may hold memory, or a caller may wait for its end

    def _next(self) -> T | None:
        """The next item; None after `end`."""
        with self._arrived:
            self._idle += 1
            try:
                while not (self._ended or self._waiting):
                    if self._way is not None:
                        self._way.beat()
                    self._arrived.wait(None if self._way is None else Pulse.period_s)
            finally:
                self._idle -= 1
            return None if self._ended else self._waiting.popleft()
