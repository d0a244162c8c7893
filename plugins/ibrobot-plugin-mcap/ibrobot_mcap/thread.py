"""The thread that writes: what is given to it never waits, and finds a bounded queue."""

from __future__ import annotations

import threading
from collections import deque

from ibrobot_core.api import RecorderError
from ibrobot_mcap.bagfile import Item
from ibrobot_mcap.storage import Storage

_OVERHEAD = 256
"""What an item costs beside its data [bytes], roughly."""


class WriterThread:
    """Hands items to a storage in a thread of its own.

    Args:
        storage: used by nobody else until `stop`.
        limit: of the data that waits [bytes]. An item that would exceed it is dropped and counted.
    """

    def __init__(self, storage: Storage, limit: int) -> None:
        self.dropped: dict[str, int] = {}
        """Topic -> messages that were dropped."""
        self._storage = storage
        self._limit = limit
        self._items: deque[Item] = deque()
        self._size = 0
        """Of what waits and what is being written [bytes]."""
        self._changed = threading.Condition()
        self._ending = False
        self._failure: RecorderError | None = None
        self._thread = threading.Thread(target=self._run, name="mcap-writer", daemon=True)
        self._thread.start()

    @property
    def size(self) -> int:
        """Of what waits and is being written [bytes]."""
        return self._size

    def put(self, item: Item) -> None:
        """Queue an item, or drop it where there is no room.

        Raises:
            RecorderError: what the storage raised; nothing is written any more.
        """
        with self._changed:
            if self._failure is not None:
                raise self._failure
            size = len(item.data) + _OVERHEAD
            if self._size + size > self._limit:
                self._drop(item)
                return
            self._items.append(item)
            self._size += size
            self._changed.notify()

    def stop(self, *, discard: bool = False) -> RecorderError | None:
        """Write what waits (or drop it), end the thread, and tell what the storage raised, if it did."""
        with self._changed:
            self._ending = True
            if discard:
                self._items.clear()
            self._changed.notify()
        self._thread.join()
        return self._failure

    def _run(self) -> None:
        try:
            while (item := self._next()) is not None:
                self._storage.write(item)
                with self._changed:
                    self._size -= len(item.data) + _OVERHEAD
                self._storage.flush_due()
        except RecorderError as error:
            with self._changed:
                self._failure = error
                for left in self._items:
                    self._drop(left)
                self._items.clear()

    def _next(self) -> Item | None:
        """The next item; None at the end."""
        while True:
            with self._changed:
                if not self._items and not self._ending:
                    self._changed.wait(self._storage.due_in_s())
                if self._items:
                    return self._items.popleft()
                if self._ending:
                    return None
            self._storage.flush_due()

    def _drop(self, item: Item) -> None:
        self.dropped[item.topic.name] = self.dropped.get(item.topic.name, 0) + 1
