"""Results of the goals of a run."""

from __future__ import annotations

import threading
from typing import Literal
from weakref import WeakKeyDictionary

import attrs

from ibrobot_core.api import PlanningError
from ibrobot_core.app import PlanCode, RunView

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


class Results:
    """Numbers and results of the goals of a run, whatever its mode. Methods may be called from several threads."""

    KEPT = 100
    """Number of results kept."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest = 0
        self._moving: set[int] = set()
        self._ended: dict[int, MoveResult] = {}

    def number(self) -> int:
        """A number for a new goal."""
        with self._lock:
            self._newest += 1
            self._moving.add(self._newest)
            return self._newest

    def end(self, number: int, result: MoveResult) -> None:
        """Keep the result of a goal."""
        with self._lock:
            self._moving.discard(number)
            self._ended[number] = result
            while len(self._ended) > self.KEPT:
                del self._ended[next(iter(self._ended))]

    def of(self, number: int) -> MoveResult | None:
        """The result of a goal; None before it has ended.

        Raises:
            PlanningError: for an unknown goal, or one whose result is no longer kept.
        """
        with self._lock:
            if number in self._moving:
                return None
            if number in self._ended:
                return self._ended[number]
            if 0 < number <= self._newest:
                raise PlanningError(f"the result of goal {number} is no longer kept, only the last {self.KEPT} are")
            raise PlanningError(f"no goal {number}; /planning/go_to answers with the number of a goal")


_RESULTS: WeakKeyDictionary[RunView, Results] = WeakKeyDictionary()


def results_of(session: RunView) -> Results:
    """The results of a run. Its modes share them, so that a number stays valid when the mode changes."""
    return _RESULTS.setdefault(session, Results())
