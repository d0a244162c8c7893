"""A bounded queue that gives every robot its turn."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable


class FairQueue[T]:
    """Items by robot, taken round robin: a robot that asks often waits for itself, not the others for it.

    Args:
        depth: how many items may wait. Beyond, the oldest of the robot with the most waiting gives way.
    """

    def __init__(self, depth: int) -> None:
        self._depth = depth
        self._waiting: OrderedDict[str, deque[T]] = OrderedDict()
        self._count = 0
        self._changed = threading.Condition()
        self._ended = False

    def __len__(self) -> int:
        return self._count

    def put(self, robot: str, item: T) -> T | None:
        """Append an item; returns the one that had to give way."""
        with self._changed:
            self._waiting.setdefault(robot, deque()).append(item)
            self._count += 1
            gave_way = self._pop(max(self._waiting, key=self._length)) if self._count > self._depth else None
            self._changed.notify()
            return gave_way

    def take(self, most: int, alike: Callable[[T, T], bool], patience_s: float = 0.0) -> list[T]:
        """The next items, at most one of each robot, in turn; waits for the first.

        Args:
            most: how many items.
            alike: whether an item may go with the first.
            patience_s: for how long to wait for more than there are [s].

        Returns:
            Nothing after `end`, once the queue is empty.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._count or self._ended)
            if patience_s > 0:
                self._changed.wait_for(lambda: len(self._waiting) >= most or self._ended, patience_s)
            taken: list[T] = []
            for robot in list(self._waiting):
                if len(taken) < most and (not taken or alike(taken[0], self._waiting[robot][0])):
                    self._waiting.move_to_end(robot)
                    taken.append(self._pop(robot))
            return taken

    def end(self) -> None:
        """Wait no longer for what may come."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _length(self, robot: str) -> int:
        return len(self._waiting[robot])

    def _pop(self, robot: str) -> T:
        items = self._waiting[robot]
        item = items.popleft()
        self._count -= 1
        if not items:
            del self._waiting[robot]
        return item
