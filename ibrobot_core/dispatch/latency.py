"""Running quantiles of recent latencies, and an upper estimate."""

from __future__ import annotations

import math
from collections import deque

from ibrobot_core.units import NS_PER_S

_NEWEST = 100
_EXPIRE_NS = 10 * NS_PER_S
_UPPER = 0.98


class LatencyEstimate:
    """Latencies of the last hundred answers, limited to the 10 s before the newest.

    Quantiles are used instead of mean and deviation because a model on a shared machine is usually fast and
    occasionally slow, and one answer delayed by seconds must not dominate the estimate. Answers expire by time as well
    as by count; otherwise a robot with infrequent requests would be affected by one slow answer for minutes.
    """

    def __init__(self) -> None:
        self._newest: deque[tuple[int, int]] = deque(maxlen=_NEWEST)
        """Arrival time and latency of each answer [ns]."""
        self._ordered: list[int] = []

    def add(self, now_ns: int, latency_ns: int) -> None:
        """Add the latency [ns] of an answer that arrived at `now_ns` [ns]."""
        self._newest.append((now_ns, latency_ns))
        while self._newest[0][0] < now_ns - _EXPIRE_NS:
            self._newest.popleft()
        self._ordered = sorted(latency for _, latency in self._newest)

    def quantile_ns(self, share: float) -> int:
        """The quantile `share` (0..1) of the latencies [ns], interpolated; 0 before the first answer."""
        ordered = self._ordered
        if not ordered:
            return 0
        place = share * (len(ordered) - 1)
        low = math.floor(place)
        high = min(low + 1, len(ordered) - 1)
        return ordered[low] + round((place - low) * (ordered[high] - ordered[low]))

    @property
    def upper_ns(self) -> int:
        """An upper estimate of the latency [ns]: the 98th percentile with a margin that shrinks with more answers.

        Three times the latency after one answer, twice after two, and so on towards the percentile itself, because a
        small sample may not contain a slow answer yet. 0 before the first.
        """
        count = len(self._ordered)
        return round(self.quantile_ns(_UPPER) * (1 + 2 / count)) if count else 0
