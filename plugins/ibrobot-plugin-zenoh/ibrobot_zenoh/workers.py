"""Worker threads: process items in the order of arrival with a bounded number of threads."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

_log = logging.getLogger("ibrobot.zenoh")

_END_S = 1.0


class Workers[T]:
    """Calls `work` with each item, in at most `count` threads, which start when needed.

    An exception in `work` is logged and does not affect other items.

    Args:
        work: function to call with each item.
        name: name for the log and the threads, e.g. `a subscriber of topic`.
        count: maximum number of threads; one preserves the order of completion.
        depth: maximum number of waiting items; None: unlimited.
    """

    def __init__(self, work: Callable[[T], object], name: str, count: int = 1, depth: int | None = None) -> None:
        self._work = work
        self._name = name
        self._count = count
        self._depth = depth
        self._waiting: deque[T] = deque()
        self._arrived = threading.Condition()
        self._threads: list[threading.Thread] = []
        self._idle = 0
        self._ended = False

    def put(self, item: T) -> T | None:
        """Queue `item`.

        Returns:
            The item that will not be processed: the oldest one if the queue is full, or `item` itself after `end`;
            otherwise None.
        """
        with self._arrived:
            if self._ended:
                return item
            full = self._depth is not None and len(self._waiting) >= self._depth
            dropped = self._waiting.popleft() if full else None
            self._waiting.append(item)
            if len(self._waiting) > self._idle and len(self._threads) < self._count:
                thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._threads.append(thread)
                thread.start()
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

    def _run(self) -> None:
        while True:
            with self._arrived:
                self._idle += 1
                self._arrived.wait_for(lambda: self._ended or self._waiting)
                self._idle -= 1
                if self._ended:
                    return
                item = self._waiting.popleft()
            try:
                self._work(item)
            except Exception:  # noqa: BLE001 - one item's fault must not affect the others
                _log.exception("%s failed", self._name)
            del item  # it may hold memory, or a caller may wait for its end
