"""A writer thread with a bounded queue; producers never wait."""

from __future__ import annotations

import threading
from collections import deque

from ibrobot_core.api import RecorderError
from ibrobot_mcap.bagfile import Item
from ibrobot_mcap.storage import Storage

_OVERHEAD = 256
"""Approximate overhead of an item [bytes]."""


class WriterThread:
    """Passes items to a storage in a background thread.

    Args:
        storage: the storage, for exclusive use until `stop`.
        limit: maximum size of waiting data [bytes]. An item that would exceed it is dropped and counted.
    """

    def __init__(self, storage: Storage, limit: int) -> None:
        self.dropped: dict[str, int] = {}
        """Topic -> number of dropped messages."""
        self.cut: set[str] = set()
        """Topics whose newest message was dropped."""
        self._storage = storage
        self._limit = limit
        self._items: deque[Item] = deque()
        self._size = 0
        self._changed = threading.Condition()
        self._ending = False
        self._failure: RecorderError | None = None
        self._thread = threading.Thread(target=self._run, name="mcap-writer", daemon=True)
        self._thread.start()

    @property
    def size(self) -> int:
        """Size of the items that wait or are being written [bytes]."""
        return self._size

    def put(self, item: Item) -> None:
        """Queue an item, or drop it if the queue is full.

        Raises:
            RecorderError: after an error of the storage; nothing more is written.
        """
        with self._changed:
            if self._failure is not None:
                raise self._failure
            size = len(item.data) + _OVERHEAD
            if self._size + size > self._limit:
                self._drop(item)
                return
            self.cut.discard(item.topic.name)
            self._items.append(item)
            self._size += size
            self._changed.notify()

    def stop(self, *, discard: bool = False) -> RecorderError | None:
        """Write (or discard) waiting items and end the thread; returns the error of the storage, if any."""
        with self._changed:
            self._ending = True
            if discard:
                self._items.clear()
            self._changed.notify()
        self._thread.join()
        self._drop_all()  # what came after the thread had died
        return self._failure

    def _run(self) -> None:
        taken: Item | None = None
        try:
            while (taken := self._next()) is not None:
                self._storage.write(taken)
                with self._changed:
                    self._size -= len(taken.data) + _OVERHEAD
                taken = None
                self._storage.flush_due()
        except RecorderError as error:
            self._failure = error
        finally:
            if taken is not None:
                self._items.appendleft(taken)
            self._drop_all()

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

    def _drop_all(self) -> None:
        """Drop the items that nobody will write."""
        with self._changed:
            for left in self._items:
                self._drop(left)
            self._items.clear()
            self._size = 0

    def _drop(self, item: Item) -> None:
        self.dropped[item.topic.name] = self.dropped.get(item.topic.name, 0) + 1
        self.cut.add(item.topic.name)
