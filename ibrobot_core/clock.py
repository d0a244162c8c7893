"""The two clocks: `real` follows wall time; `lockstep` advances when the work of a tick is done."""

from __future__ import annotations

import sys
import time
from abc import ABC, abstractmethod
from typing import override

from ibrobot_core.units import NS_PER_S

_BOOTTIME = time.CLOCK_BOOTTIME if sys.platform == "linux" else time.CLOCK_MONOTONIC
"""Goes on while the computer is suspended, unlike CLOCK_MONOTONIC; only Linux has it."""
COMMAND_OFF_NS = NS_PER_S // 2
"""Largest difference between the time in a command's header and the present [ns]."""


class Clock(ABC):
    """The source of all time stamps, in integer nanoseconds."""

    @abstractmethod
    def now_ns(self) -> int:
        """The current time [ns]. Never runs backwards."""

    @abstractmethod
    def sleep_until(self, deadline_ns: int) -> None:
        """Return at `deadline_ns` [ns], or at once if it has passed."""

    def wall_ns(self) -> int:
        """The time of day [ns]. Unlike `now_ns` it may jump, e.g. when NTP sets the computer's clock."""
        return self.now_ns()

    def age_ns(self, stamp_ns: int) -> int:
        """Time since a stamp [ns]; negative for one in the future.

        Stamps of this run are times of `now_ns`, those of other computers times of day. The two differ after the
        computer's clock was set, and then the smaller age counts.
        """
        return min(self.now_ns() - stamp_ns, self.wall_ns() - stamp_ns, key=abs)

    def refusal(self, stamp_ns: int) -> str:
        """Why a command with this time in its header is refused; empty if it is not. A time of 0 stands for now.

        The one rule for every stream of commands that carries a time; ask when the command is about to be followed.
        """
        age_ns = self.age_ns(stamp_ns) if stamp_ns else 0
        if abs(age_ns) <= COMMAND_OFF_NS:
            return ""
        return "the time in its header is more than 0.5 s off: set the clocks, or leave the time 0"

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
    def wall_ns(self) -> int:
        return time.time_ns()

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
