"""Results of tasks and their steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import attrs

type TaskOutcome = Literal["SUCCEEDED", "FAILED", "CANCELLED"]
type StepOutcome = Literal["SUCCEEDED", "FAILED", "CANCELLED", "NOT_RUN"]


@attrs.frozen
class StepResult:
    """The result of a step."""

    number: int
    """Number of the step, from 1."""
    kind: str
    """E.g. `move`."""
    name: str
    outcome: StepOutcome
    message: str = ""
    """The error in one sentence; empty after a success."""
    code: str = ""
    """MoveIt's name of the error of a motion, e.g. NO_IK_SOLUTION."""
    duration_s: float = 0.0
    facts: Mapping[str, Any] = attrs.field(factory=dict)
    """E.g. `position` of an object [m], or `position_error_m` of a motion; JSON values."""

    @property
    def why(self) -> str:
        """The error with MoveIt's name of it; empty after a success."""
        return f"{self.code}: {self.message}" if self.code else self.message


@attrs.frozen
class TaskResult:
    """The result of a task."""

    name: str
    outcome: TaskOutcome
    message: str
    """The error of the step that failed, or why the task was cancelled; empty after a success."""
    duration_s: float
    steps: tuple[StepResult, ...]

    @property
    def success(self) -> bool:
        """Whether all steps succeeded."""
        return self.outcome == "SUCCEEDED"

    def as_json(self) -> dict[str, Any]:
        """The result as JSON values."""
        return {**attrs.asdict(self), "success": self.success}
