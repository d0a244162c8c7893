"""The executors of a mode and the joints that each owns: they take plans and goals and return setpoints."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.errors import GoalRejected, PluginError
from ibrobot_core.interfaces import Executor, JointReading, Plan
from ibrobot_core.interfaces.executor import ExecutorGoal, SlowDown
from ibrobot_core.interfaces.run_state import PlanRecord
from ibrobot_core.robot import Robot, Vector


@attrs.frozen(eq=False)
class _Owned:
    """An executor and the indices of its joints in robot order."""

    name: str
    executor: Executor
    columns: NDArray[np.intp]


class ActiveExecutors:
    """The active executors of a robot; joints without an active executor do not move.

    Args:
        robot: the robot.
        executors: name -> executor.
        report: called with a `goal` event whenever the state of a goal changes.
        rest: returns where the joints come to rest if they brake now [rad], shape (J,); without torque, where they are.

    Attributes:
        want_relax: whether an executor requested torque off at the last `update`.
    """

    def __init__(
        self, robot: Robot, executors: Mapping[str, Executor], report: Callable[[Mapping[str, Any]], None],
        rest: Callable[[], Vector],
    ) -> None:  # fmt: skip
        self._all = {name: _Owned(name, each, robot.indices(each.joints)) for name, each in executors.items()}
        self._active: list[_Owned] = []
        self._streamed: set[str] = set()
        """The active executors that were given a plan, and have not been stopped since."""
        self._rest: Callable[[], Vector] = rest
        self._report = report
        self.want_relax = False

    def __bool__(self) -> bool:
        return bool(self._active)

    def enter(self, names: Iterable[str], measured: JointReading) -> None:
        """Activate the executors of a mode where the joints come to rest.

        Those are not the measured positions: a loaded arm would sink a little each time, and a gripper let go.
        """
        self._active = [self._all[name] for name in names]
        for owned in self._active:
            self._brake(owned, measured)

    def leave(self, measured: JointReading) -> None:
        """Deactivate all executors and cancel their goals."""
        for owned in self._active:
            owned.executor.cancel(measured.of(owned.columns))
            self._report_goals(owned)
            owned.executor.deactivate()
        self._active = []

    def set_plan(self, plan: PlanRecord, measured: JointReading) -> None:
        """Pass a plan to the active executors that accept plans and whose joints it contains; stop the others."""
        for owned in self._active:
            if owned.executor.accepts_plans and plan.mask[owned.columns].all():
                owned.executor.set_plan(Plan(plan.start_ns, plan.step_ns, plan.positions[:, owned.columns]))
                self._streamed.add(owned.name)
            elif owned.name in self._streamed:
                self._brake(owned, measured)

    def update(self, measured: JointReading) -> list[tuple[NDArray[np.intp], Vector]]:
        """Return the joint indices of each active executor and its setpoints for them [rad].

        Raises:
            PluginError: if an executor returns something else.
        """
        setpoints = []
        self.want_relax = False
        for owned in self._active:
            setpoint = owned.executor.update(measured.of(owned.columns))
            shape = owned.columns.shape
            if not isinstance(setpoint, np.ndarray) or setpoint.dtype != np.float64 or setpoint.shape != shape:
                wanted = f"expected setpoints [rad]: a float64 array of shape {shape}"
                raise PluginError(f"{owned.name}: update of {type(owned.executor)} returned {setpoint!r}; {wanted}")
            setpoint = self._brake(owned, measured) if owned.executor.is_stale else setpoint
            setpoints.append((owned.columns, setpoint))
            self.want_relax = self.want_relax or owned.executor.wants_relax
            self._report_goals(owned)
        return setpoints

    def note_guard(self, overruled: str, changed: NDArray[np.bool_]) -> None:
        """Tell the executors of changed joints, shape (J,), what the guard kept them from."""
        for owned in self._active:
            if changed[owned.columns].any():
                owned.executor.note_guard(overruled)

    def set_goal(self, executor: str, goal_id: str, goal: ExecutorGoal, measured: JointReading) -> None:
        """Pass a goal to an executor.

        Raises:
            GoalRejected: if the executor is not active or rejects the goal.
        """
        owned = next((each for each in self._active if each.name == executor), None)
        if owned is None:
            active = ", ".join(each.name for each in self._active)
            raise GoalRejected(f"executor {executor!r} is not active; active: {active or 'none'}")
        reading = self._at_rest(owned, measured) if isinstance(goal, SlowDown) else measured.of(owned.columns)
        try:
            owned.executor.set_goal(goal_id, goal, reading)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            # A goal comes from outside, and an executor from a plugin: neither may end the loop.
            raise GoalRejected(f"{executor}: the goal is malformed: {type(error).__name__}: {error}") from error

    def cancel(self, measured: JointReading, executor: str = "") -> None:
        """Cancel the goal of an executor, or all goals if it is empty; the executors then hold."""
        for owned in self._active:
            if executor in ("", owned.name):
                owned.executor.cancel(measured.of(owned.columns))

    def counters(self) -> dict[str, dict[str, int]]:
        """The counters of all executors, including inactive ones."""
        return {name: dict(owned.executor.counters()) for name, owned in self._all.items()}

    def _brake(self, owned: _Owned, measured: JointReading) -> Vector:
        """Let the joints of an executor brake at once and hold; returns where they come to rest [rad]."""
        reading = self._at_rest(owned, measured)
        owned.executor.activate(reading)
        self._streamed.discard(owned.name)
        return reading.position

    def _at_rest(self, owned: _Owned, measured: JointReading) -> JointReading:
        """A reading whose positions are those of `rest`."""
        return attrs.evolve(measured.of(owned.columns), position=self._rest()[owned.columns])

    def _report_goals(self, owned: _Owned) -> None:
        while (status := owned.executor.pop_status()) is not None:
            told = {"state": str(status.state), "message": status.message, "result": dict(status.result)}
            self._report({"event": "goal", "executor": owned.name, "goal": status.goal_id, **told})
