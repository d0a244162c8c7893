"""How long answers take: running quantiles of the newest latencies, and one to rely on."""

from __future__ import annotations

import math
from collections import deque

from ibrobot_core.units import NS_PER_S

_NEWEST = 100
_EXPIRE_NS = 10 * NS_PER_S
_UPPER = 0.98


class LatencyEstimate:
    """The latencies of the newest hundred answers, as far as they came within 10 s of the newest.

    Quantiles rather than a mean and a deviation: a model beside other work is fast mostly and slow now and then, and
    one answer that was held up for seconds must not count for more than one. Older answers expire by time, not by
    count: after a hiccup, a robot that asks seldom would rely on it for minutes.
    """

    def __init__(self) -> None:
        self._newest: deque[tuple[int, int]] = deque(maxlen=_NEWEST)
        """When each answer came, and its latency [ns]."""
        self._ordered: list[int] = []

    def add(self, now_ns: int, latency_ns: int) -> None:
        """Take in the latency [ns] of an answer that came at `now_ns` [ns]."""
        self._newest.append((now_ns, latency_ns))
        while self._newest[0][0] < now_ns - _EXPIRE_NS:
            self._newest.popleft()
        self._ordered = sorted(latency for _, latency in self._newest)

    def quantile_ns(self, share: float) -> int:
        """The latency that `share` (0..1) of the answers keep to [ns], interpolated; 0 before the first answer."""
        ordered = self._ordered
        if not ordered:
            return 0
        place = share * (len(ordered) - 1)
        low = math.floor(place)
        high = min(low + 1, len(ordered) - 1)
        return ordered[low] + round((place - low) * (ordered[high] - ordered[low]))

    @property
    def upper_ns(self) -> int:
        """What an answer hardly exceeds [ns]: the 98th percentile, the larger the fewer answers it rests on.

        Three times the first latency, twice after two, and so on towards the percentile itself: with few answers the
        slow ones have not been seen yet. 0 before the first.
        """
        count = len(self._ordered)
        return round(self.quantile_ns(_UPPER) * (1 + 2 / count)) if count else 0
