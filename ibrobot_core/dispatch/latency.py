"""How long answers take: running quantiles of the newest latencies, and one to rely on."""

from __future__ import annotations

import math
from collections import deque

_NEWEST = 100
_UPPER = 0.98


class LatencyEstimate:
    """The latencies of the newest hundred answers.

    Quantiles rather than a mean and a deviation: a model beside other work is fast mostly and slow now and then, and
    one answer that was held up for seconds must not count for more than one.
    """

    def __init__(self) -> None:
        self._newest: deque[int] = deque(maxlen=_NEWEST)

    def add(self, latency_ns: int) -> None:
        """Take in one more [ns]."""
        self._newest.append(latency_ns)

    def quantile_ns(self, share: float) -> int:
        """The latency that `share` (0..1) of the answers keep to [ns], interpolated; 0 before the first answer."""
        if not self._newest:
            return 0
        ordered = sorted(self._newest)
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
        count = len(self._newest)
        return round(self.quantile_ns(_UPPER) * (1 + 2 / count)) if count else 0
