"""Timing statistics of a loop: lateness of its ticks, and missed ticks."""

from __future__ import annotations

from typing import Any

import numpy as np

from ibrobot_core.units import NS_PER_S

REPORT_TICKS = 20
"""Ticks between two reports of timing and counters to the host."""
TOO_BUSY = "this machine is too busy to simulate in real time: with `--lockstep`, simulated time waits for it"
"""What to say of a process of a simulation that was silent, without having been stopped."""
_LEAST_SHARE = 0.9
"""Share of the rate below which a loop is slow."""
_BINS = 20_001
"""Resolution of lateness in microseconds; more than 20 ms counts as 20 ms."""


class Punctuality:
    """A histogram of the ticks' lateness in microseconds, of constant size; takes about 1 us per tick."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, dtype=np.int64)
        self._ticks = 0
        self._missed = 0
        self._first_ns = 0
        self._last_ns = 0

    def tick(self, deadline_ns: int, late_ns: int, missed: int) -> None:
        """Count a tick due at `deadline_ns` that began `late_ns` later, and the `missed` ticks skipped before it."""
        if not self._ticks:
            self._first_ns = deadline_ns
        self._counts[min(max(late_ns // 1000, 0), _BINS - 1)] += 1
        self._ticks += 1
        self._missed += missed
        self._last_ns = deadline_ns

    def summary(self) -> dict[str, Any]:
        """`ticks`, `rate_hz`, `lateness_p50_us`, `lateness_p99_us`, `missed`."""
        elapsed_s = (self._last_ns - self._first_ns) * 1e-9
        rate = (self._ticks - 1) / elapsed_s if elapsed_s > 0 else 0.0
        below = self._counts.cumsum()
        p50, p99 = (int(np.searchsorted(below, q * self._ticks)) if self._ticks else 0 for q in (0.5, 0.99))
        return {
            "ticks": self._ticks,
            "rate_hz": round(rate, 3),
            "lateness_p50_us": p50,
            "lateness_p99_us": p99,
            "missed": self._missed,
        }


class Pace:
    """Notices, second by second, that a loop keeps missing ticks.

    Args:
        period_ns: control period [ns].
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._ticks = self._periods = self._reading_ns = 0
        self._slow = False
        self.slow_seconds = 0
        """Seconds in which the loop ran slower than `_LEAST_SHARE` of its rate."""

    def tick(self, periods: int, reading_ns: int) -> str:
        """Count a tick.

        Args:
            periods: periods since the last tick.
            reading_ns: how long the hardware was read [ns].

        Returns:
            A warning when slowness begins; empty otherwise.
        """
        self._ticks += 1
        self._periods += periods
        self._reading_ns += reading_ns
        if self._periods * self._period_ns < NS_PER_S:
            return ""
        share, reading_s = self._ticks / self._periods, self._reading_ns / self._ticks / NS_PER_S
        self._ticks = self._periods = self._reading_ns = 0
        before, self._slow = self._slow, share < _LEAST_SHARE
        self.slow_seconds += self._slow
        if before or not self._slow:
            return ""
        asked_hz = NS_PER_S / self._period_ns
        reading = f"reading the joints takes {reading_s * 1e3:.1f} ms of {self._period_ns / 1e6:.1f} ms"
        if reading_s * NS_PER_S < self._period_ns / 2:
            reading = f"the machine is busy with other work ({reading}); `ibrobot doctor` says how to get priority"
        return f"the control loop runs at {share * asked_hz:.0f} Hz instead of {asked_hz:.0f} Hz: {reading}"
