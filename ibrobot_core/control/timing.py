"""How punctual a loop is: lateness of its ticks, and ticks missed."""

from __future__ import annotations

from typing import Any

import numpy as np

_KEPT = 1 << 17
"""Ticks that the percentiles look back on: 20 minutes at 100 Hz."""


class Punctuality:
    """Counts ticks and keeps the lateness of the last ones. Costs a microsecond a tick and allocates nothing."""

    def __init__(self) -> None:
        self._late_ns = np.zeros(_KEPT, dtype=np.int64)
        self._ticks = 0
        self._missed = 0
        self._first_ns = 0
        self._last_ns = 0

    def tick(self, deadline_ns: int, late_ns: int, missed: int) -> None:
        """Note a tick due at `deadline_ns` that began `late_ns` after it, and `missed` ticks skipped before it."""
        if not self._ticks:
            self._first_ns = deadline_ns
        self._late_ns[self._ticks % _KEPT] = late_ns
        self._ticks += 1
        self._missed += missed
        self._last_ns = deadline_ns + late_ns

    def summary(self) -> dict[str, Any]:
        """`ticks`, `rate_hz`, `lateness_p50_us`, `lateness_p99_us`, `missed`."""
        late = self._late_ns[: min(self._ticks, _KEPT)]
        p50, p99 = np.percentile(late, (50, 99)) / 1000.0 if len(late) else (0.0, 0.0)
        elapsed_s = (self._last_ns - self._first_ns) * 1e-9
        rate = (self._ticks - 1) / elapsed_s if elapsed_s > 0 else 0.0
        return {
            "ticks": self._ticks,
            "rate_hz": round(rate, 3),
            "lateness_p50_us": round(float(p50), 1),
            "lateness_p99_us": round(float(p99), 1),
            "missed": self._missed,
        }
