"""The executors of a mode and the joints that each owns: they take plans and goals and return setpoints."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.control.link import PlanRecord
from ibrobot_core.errors import GoalRejected
from ibrobot_core.interfaces import Executor, JointReading, Plan
from ibrobot_core.robot import Robot, Vector


@attrs.frozen(eq=False)
class _Owned:
    """An executor and the indices of its joints in robot order."""

    name: str
    executor: Executor
    columns: NDArray[np.intp]

    def reading(self, measured: JointReading) -> JointReading:
        return measured.of(self.columns)


class ActiveExecutors:
    """The active executors of a robot; joints without an active executor do not move.

    Args:
        robot: the robot.
        executors: name -> executor.
        report: called with a `goal` event whenever the state of a goal changes.

    Attributes:
        want_relax: whether an executor requested torque off at the last `update`.
    """

    def __init__(
        self, robot: Robot, executors: Mapping[str, Executor], report: Callable[[Mapping[str, Any]], None]
    ) -> None:
        self._all = {name: _Owned(name, each, robot.indices(each.joints)) for name, each in executors.items()}
        self._active: list[_Owned] = []
        self._report = report
        self.want_relax = False

    def __bool__(self) -> bool:
        return bool(self._active)

    def enter(self, names: Iterable[str], measured: JointReading) -> None:
        """Activate the executors of a mode at the measured positions."""
        self._active = [self._all[name] for name in names]
        for owned in self._active:
            owned.executor.activate(owned.reading(measured))

    def leave(self, measured: JointReading) -> None:
        """Deactivate all executors and cancel their goals."""
        for owned in self._active:
            owned.executor.cancel(owned.reading(measured))
            self._report_goals(owned)
            owned.executor.deactivate()
        self._active = []

    def set_plan(self, plan: PlanRecord) -> None:
        """Pass a plan to the active executors that accept plans and whose joints it contains."""
        for owned in self._active:
            if owned.executor.accepts_plans and plan.mask[owned.columns].all():
                owned.executor.set_plan(Plan(plan.start_ns, plan.step_ns, plan.positions[:, owned.columns]))

    def update(self, measured: JointReading) -> list[tuple[NDArray[np.intp], Vector]]:
        """Return the joint indices of each active executor and its setpoints for them [rad]."""
        setpoints = []
        self.want_relax = False
        for owned in self._active:
            setpoints.append((owned.columns, owned.executor.update(owned.reading(measured))))
            self.want_relax = self.want_relax or owned.executor.wants_relax
            self._report_goals(owned)
        return setpoints

    def set_goal(self, executor: str, goal_id: str, goal: Mapping[str, Any], measured: JointReading) -> None:
        """Pass a goal to an executor.

        Raises:
            GoalRejected: if the executor is not active or rejects the goal.
        """
        active = {owned.name: owned for owned in self._active}
        if executor not in active:
            raise GoalRejected(f"executor {executor!r} is not active; active: {', '.join(active) or 'none'}")
        try:
            active[executor].executor.set_goal(goal_id, goal, active[executor].reading(measured))
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            # A goal comes from outside, and an executor from a plugin: neither may end the loop.
            raise GoalRejected(f"{executor}: the goal is malformed: {type(error).__name__}: {error}") from error

    def cancel(self, measured: JointReading, executor: str = "") -> None:
        """Cancel the goal of an executor, or all goals if it is empty; the executors then hold."""
        for owned in self._active:
            if executor in ("", owned.name):
                owned.executor.cancel(owned.reading(measured))

    def counters(self) -> dict[str, dict[str, int]]:
        """The counters of all executors, including inactive ones."""
        return {name: dict(owned.executor.counters()) for name, owned in self._all.items()}

    def _report_goals(self, owned: _Owned) -> None:
        while (status := owned.executor.pop_status()) is not None:
            self._report(
                {
                    "event": "goal",
                    "executor": owned.name,
                    "goal": status.goal_id,
                    "state": str(status.state),
                    "message": status.message,
                    "result": dict(status.result),
                }
            )
