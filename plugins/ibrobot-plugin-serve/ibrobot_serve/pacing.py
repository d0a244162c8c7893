"""Pacing: limits each robot's request rate so that the model keeps up and queues stay short."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Iterable
from statistics import median

from ibrobot_core.api import NS_PER_S

_TARGET = 0.8
"""Maximum load of the model. At 0.8, random arrivals wait for the time of two requests on average."""
_GROWTH = 1.25
"""Assumed growth of each robot's demand, since a robot held to its pace may want to ask more often."""
_WINDOW_NS = 5 * NS_PER_S
_RENEWED_NS = NS_PER_S // 5
_BATCHES_KEPT = 64


class Pacing:
    """Minimum time between requests of each robot of a server.

    Max-min fairness divides the model's time: robots with a low demand get all of it, and the others share the rest.
    Below the model's capacity, no robot is limited. Demand is measured over 5 s, and the cost of a request by the
    median batch of the most efficient size, so that pauses of the model affect neither. Thread-safe.
    """

    def __init__(self) -> None:
        self._asked: OrderedDict[str, deque[int]] = OrderedDict()
        """Times of each robot's requests within the window, in the order of the last request."""
        self._batches: deque[tuple[int, int]] = deque(maxlen=_BATCHES_KEPT)
        self._pace_ns = 0
        self._renew_ns = 0
        self._lock = threading.Lock()

    def ask(self, robot: str, now_ns: int) -> None:
        """Count a request of a robot."""
        with self._lock:
            self._asked.setdefault(robot, deque()).append(now_ns)
            self._asked.move_to_end(robot)

    def work(self, requests: int, took_ns: int) -> None:
        """Record the size and the duration [ns] of a batch."""
        with self._lock:
            self._batches.append((requests, took_ns))

    def robots(self, now_ns: int) -> int:
        """Number of robots that asked within the last 5 s."""
        with self._lock:
            self._forget(now_ns - _WINDOW_NS)
            return len(self._asked)

    def pace_ns(self, now_ns: int) -> int:
        """Time to leave from one request to the next [ns]; 0: no limit."""
        with self._lock:
            if now_ns >= self._renew_ns:
                self._renew_ns = now_ns + _RENEWED_NS
                self._forget(now_ns - _WINDOW_NS)
                self._pace_ns = fair_pace_ns((len(asked) for asked in self._asked.values()), self._cost_ns())
            return self._pace_ns

    def _forget(self, before_ns: int) -> None:
        for robot, asked in list(self._asked.items()):
            while asked and asked[0] < before_ns:
                asked.popleft()
            if not asked:
                del self._asked[robot]

    def _cost_ns(self) -> float:
        """Model time per request [ns], in batches of the most efficient size."""
        sizes = {size for size, _ in self._batches}
        return min((median(ns for n, ns in self._batches if n == size) / size for size in sizes), default=0.0)


def fair_pace_ns(counts: Iterable[int], cost_ns: float) -> int:
    """Pace of the most demanding robots with which all robots together keep to the model's target load.

    Args:
        counts: number of requests of each robot within the window.
        cost_ns: model time per request [ns].

    Returns:
        The pace [ns]; 0 if no robot needs a limit, as with a single robot.
    """
    wanted = sorted(_GROWTH * count for count in counts)
    if len(wanted) < 2 or not cost_ns:
        return 0
    left = _TARGET * _WINDOW_NS / cost_ns
    for index, requests in enumerate(wanted):
        share = left / (len(wanted) - index)
        if requests > share:
            return round(_WINDOW_NS / share)
        left -= requests
    return 0
