"""Recent results of a server's model: whether it fails, and how long its answers take."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from statistics import median

from ibrobot_core.api import NS_PER_S

_FAILURES = 3
"""Number of failures without an answer between them after which the model counts as failing."""
_ANSWERED_NS = 5 * NS_PER_S
"""While a robot's last answer is younger, a failure may be due to the requests of another robot [ns]."""
_OFFERED_NS = 30 * NS_PER_S
"""Time for which an offer states a failure: afterwards robots may try again [ns]."""
_LATENCIES_KEPT = 32
_LATENCY_NS = 60 * NS_PER_S
"""Latencies expire after this time, so that a server that was slow is tried again [ns]."""


class Results:
    """Tells a model that fails from a robot whose requests are wrong.

    A model fails if its last three results were errors, and no robot was answered in the last 5 s, other than those
    whose newest request failed. Until the next answer, it stays failing. Thread-safe.
    """

    def __init__(self) -> None:
        self._newest: OrderedDict[str, tuple[int, bool]] = OrderedDict()
        """The time of each robot's newest result [ns], and whether it was an answer."""
        self._failures = 0
        self._failed_ns = 0
        self._error = ""
        self._latencies: deque[tuple[int, int]] = deque(maxlen=_LATENCIES_KEPT)
        self._lock = threading.Lock()

    def answer(self, robot: str, now_ns: int) -> None:
        """Count an answer."""
        with self._lock:
            self._note(robot, now_ns, answered=True)
            self._failures, self._error = 0, ""

    def fail(self, robot: str, now_ns: int, error: str) -> None:
        """Count an error of the model."""
        with self._lock:
            self._note(robot, now_ns, answered=False)
            self._failures += 1
            self._failed_ns, self._error = now_ns, error

    def took(self, latency_ns: int, now_ns: int) -> None:
        """Record how long a request took that was answered, or that expired."""
        with self._lock:
            self._latencies.append((now_ns, latency_ns))

    def failing(self, now_ns: int) -> str:
        """The newest error of a model that fails; empty for one that works."""
        with self._lock:
            answered = any(good and now_ns - at_ns < _ANSWERED_NS for at_ns, good in self._newest.values())
            return self._error if self._failures >= _FAILURES and not answered else ""

    def offered_failing(self, now_ns: int) -> bool:
        """Whether robots should prefer other servers because the model fails."""
        return bool(self.failing(now_ns)) and now_ns - self._failed_ns < _OFFERED_NS

    def latency_ns(self, now_ns: int) -> float:
        """Median time from a request to its answer [ns]; 0: unknown."""
        with self._lock:
            return median([ns for at_ns, ns in self._latencies if now_ns - at_ns < _LATENCY_NS] or [0])

    def _note(self, robot: str, now_ns: int, *, answered: bool) -> None:
        self._newest[robot] = (now_ns, answered)
        self._newest.move_to_end(robot)
        while next(iter(self._newest.values()))[0] < now_ns - _ANSWERED_NS:
            self._newest.popitem(last=False)
