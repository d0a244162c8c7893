"""A bounded queue that gives every robot its turn."""

from __future__ import annotations

import threading
from collections.abc import Callable


class FairQueue[T]:
    """The newest item of each robot, taken in turn, so that frequent requests of one robot do not delay the others.

    Args:
        depth: maximum number of waiting robots.
    """

    def __init__(self, depth: int) -> None:
        self._depth = depth
        self._waiting: dict[str, T] = {}
        """Robot -> its request, in the order of their turns."""
        self._changed = threading.Condition()
        self._ended = False

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, robot: str, item: T) -> T | None:
        """Queue an item: in place of the robot's earlier item if that is still queued, otherwise at the end.

        Returns:
            The item dropped: the earlier one, or this one if the queue is full; None if none was.
        """
        with self._changed:
            earlier = self._waiting.get(robot)
            if earlier is None and len(self._waiting) >= self._depth:
                return item
            self._waiting[robot] = item
            self._changed.notify()
            return earlier

    def take(self, most: int, alike: Callable[[T, T], bool], patience_s: float = 0.0) -> list[T]:
        """The next items, in turn; waits for the first.

        Args:
            most: maximum number of items.
            alike: whether an item may join a batch with the first one.
            patience_s: maximum time to wait for `most` items [s].

        Returns:
            The items; empty after `end`, once the queue is empty.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._ended)
            if patience_s > 0:
                self._changed.wait_for(lambda: len(self._waiting) >= most or self._ended, patience_s)
            taken: list[T] = []
            for robot, item in list(self._waiting.items()):
                if len(taken) < most and (not taken or alike(taken[0], item)):
                    taken.append(self._waiting.pop(robot))
            return taken

    def clear(self) -> list[T]:
        """Take all waiting items, in turn."""
        with self._changed:
            taken = list(self._waiting.values())
            self._waiting.clear()
            return taken

    def end(self) -> None:
        """Make `take` stop waiting for items."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
