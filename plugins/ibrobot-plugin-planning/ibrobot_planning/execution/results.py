"""Results of the goals and tasks of a run."""

from __future__ import annotations

import threading
from typing import Literal
from weakref import WeakKeyDictionary

import attrs

from ibrobot_core.api import PlanCode, PlanningError
from ibrobot_core.app import RunView

type Outcome = Literal["SUCCEEDED", "REJECTED", "PLANNING_FAILED", "EXECUTION_FAILED", "CANCELLED"]


@attrs.frozen
class MoveResult:
    """Response of ibrobot_msgs/srv/MoveToPose, with MoveIt's code."""

    success: bool
    message: str
    """The error in one sentence; empty after a success."""
    execution_time_s: float
    outcome: Outcome
    code: PlanCode
    """`code.name` is MoveIt's, e.g. NO_IK_SOLUTION."""
    position_error_m: float = 0.0
    """Distance of the planned tool position from the requested one [m]."""
    orientation_error_rad: float = 0.0
    """Angle between the planned orientation, or axis, and the requested one [rad]."""
    fraction: float = 1.0
    """Fraction of a straight path that was planned."""
    alternative: int = 0
    """Index of the chosen goal, of several."""


class Results[T]:
    """Numbers and results of the goals or tasks of a run. Methods may be called from several threads.

    Args:
        what: what the results are of, for errors: `goal` or `task`.
        service: the service that answers with their numbers.
    """

    KEPT = 100
    """Number of results kept."""

    def __init__(self, what: str, service: str) -> None:
        self._what, self._service = what, service
        self._lock = threading.Lock()
        self._newest = 0
        self._present: set[int] = set()
        self._ended: dict[int, T] = {}

    def number(self) -> int:
        """A number for a new one."""
        with self._lock:
            self._newest += 1
            self._present.add(self._newest)
            return self._newest

    def end(self, number: int, result: T) -> None:
        """Keep a result."""
        with self._lock:
            self._present.discard(number)
            self._ended[number] = result
            while len(self._ended) > self.KEPT:
                del self._ended[next(iter(self._ended))]

    def of(self, number: int) -> T | None:
        """The result of a number; None before its goal or task has ended.

        Raises:
            PlanningError: for an unknown number, or a result that is no longer kept.
        """
        with self._lock:
            if number in self._present:
                return None
            if number in self._ended:
                return self._ended[number]
            if 0 < number <= self._newest:
                raise PlanningError(
                    f"the result of {self._what} {number} is no longer kept, only the last {self.KEPT} are"
                )
            raise PlanningError(f"no {self._what} {number}; {self._service} answers with the number of a {self._what}")


_RESULTS: WeakKeyDictionary[RunView, Results[MoveResult]] = WeakKeyDictionary()


def results_of(session: RunView) -> Results[MoveResult]:
    """The results of the goals of a run. Its modes share them, so that a number stays valid when the mode changes."""
    return _RESULTS.setdefault(session, Results("goal", "/planning/go_to"))
