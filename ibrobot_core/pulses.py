"""Signs of life of the threads between a STOP and control: one that no longer reacts ends the run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

import attrs


@attrs.define(eq=False)
class Pulse:
    """The signs of life of one thread.

    Attributes:
        name: what hangs if they stay away, e.g. `the keys of the terminal`.
        longest_s: time without a sign after which the thread counts as blocked [s].
    """

    period_s: ClassVar[float] = 0.1
    """Longest wait of a thread between two signs of life [s]."""
    name: str
    longest_s: float
    _beats: int = 0
    _seen: int = -1
    _silent_s: float = 0.0
    _paused: int = 0

    def beat(self) -> None:
        """Give a sign of life."""
        self._beats += 1

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Expect no signs during something that may take long, e.g. until a device is connected again."""
        self._paused += 1
        try:
            yield
        finally:
            self._paused -= 1
            self.beat()

    def is_late(self, passed_s: float) -> bool:
        """Whether signs have stayed away for too long, `passed_s` [s] after the last call.

        Time in which nobody asked does not count, since then the whole process may have been stopped.
        """
        beats = self._beats
        self._silent_s = 0.0 if beats != self._seen or self._paused else self._silent_s + min(passed_s, self.period_s)
        self._seen = beats
        return self._silent_s > self.longest_s
