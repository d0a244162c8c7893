"""The two clocks: `real` follows wall time; `lockstep` advances when the work of a tick is done."""

from __future__ import annotations

import sys
import time
from abc import ABC, abstractmethod
from typing import override

from ibrobot_core.units import NS_PER_S

_BOOTTIME = time.CLOCK_BOOTTIME if sys.platform == "linux" else time.CLOCK_MONOTONIC
"""Goes on while the computer is suspended, unlike CLOCK_MONOTONIC; only Linux has it."""


class Clock(ABC):
    """The source of all time stamps, in integer nanoseconds."""

    @abstractmethod
    def now_ns(self) -> int:
        """The current time [ns]. Never runs backwards."""

    @abstractmethod
    def sleep_until(self, deadline_ns: int) -> None:
        """Return at `deadline_ns` [ns], or at once if it has passed."""

    def asleep_ns(self) -> int:
        """Time for which the computer was suspended since it was started [ns], which `now_ns` does not count."""
        return 0


class RealClock(Clock):
    """Monotonic time shifted to the Unix epoch once, so that stamps are dates and never jump.

    Args:
        epoch_offset_ns: epoch time minus monotonic time [ns]. All processes of a run use the host's value.
    """

    def __init__(self, epoch_offset_ns: int | None = None) -> None:
        self.epoch_offset_ns = time.time_ns() - time.monotonic_ns() if epoch_offset_ns is None else epoch_offset_ns

    @override
    def now_ns(self) -> int:
        return time.monotonic_ns() + self.epoch_offset_ns

    @override
    def sleep_until(self, deadline_ns: int) -> None:
        remaining = deadline_ns - self.now_ns()
        if remaining > 0:
            time.sleep(remaining / NS_PER_S)

    @override
    def asleep_ns(self) -> int:
        return time.clock_gettime_ns(_BOOTTIME) - time.monotonic_ns()  # in this order: it may be too low, not too high


class SteppedClock(Clock):
    """Time that moves only by `advance`: for lockstep runs and tests."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._asleep_ns = 0

    @override
    def now_ns(self) -> int:
        return self._now_ns

    @override
    def asleep_ns(self) -> int:
        return self._asleep_ns

    def suspend(self, duration_ns: int) -> None:
        """Act as if the computer had been suspended for `duration_ns` [ns]."""
        self._asleep_ns += duration_ns

    @override
    def sleep_until(self, deadline_ns: int) -> None:
        """Move time to `deadline_ns` if that is in the future."""
        self._now_ns = max(self._now_ns, deadline_ns)

    def advance(self, step_ns: int) -> int:
        """Advance time by `step_ns` [ns] and return the new time.

        Raises:
            ValueError: for a negative step, because clocks never run backwards.
        """
        if step_ns < 0:
            raise ValueError(f"step_ns must not be negative, got {step_ns}")
        self._now_ns += step_ns
        return self._now_ns
