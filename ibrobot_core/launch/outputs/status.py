"""Status: publishes the robot's state on `/robot_status` and all counters on `/diagnostics`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, override

from ibrobot_core.component import SessionWorker
from ibrobot_core.interfaces.hardware import Severity
from ibrobot_core.interfaces.run import RunView
from ibrobot_core.messages import (
    DIAGNOSTICS,
    ROBOT_STATUS,
    DiagnosticArray,
    DiagnosticStatus,
    Header,
    KeyValue,
    RobotStatus,
)
from ibrobot_core.units import NS_PER_S

_PERIOD_NS = NS_PER_S // 5
_OF_DISPATCH = (
    "plan_length", "latency_ms", "strategy", "smoothing", "latency_p50_ms", "latency_p99_ms", "requests", "holds",
    "failures", "timeouts", "late_chunks",
)  # fmt: skip


class Status(SessionWorker):
    """Publishes the reports of control and the dispatcher, five times a second."""

    urgent = True

    def __init__(self, session: RunView, needs: tuple[str, ...]) -> None:
        super().__init__(session, "status", "/robot_status and /diagnostics", needs)
        self._next_ns = 0

    @override
    def setup(self) -> None:
        self._next_ns = self.session.clock.now_ns()

    @override
    def work(self, timeout_s: float) -> None:
        session = self.session
        now_ns = session.clock.now_ns()
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + _PERIOD_NS
            session.bus.publish(ROBOT_STATUS, self._status(now_ns))
            session.bus.publish(DIAGNOSTICS, self._diagnostics(now_ns))
        if timeout_s > 0:
            self.pause(timeout_s)

    def _status(self, now_ns: int) -> RobotStatus:
        session = self.session
        dispatch = {name: getattr(session.acting.dispatch, name) for name in _OF_DISPATCH} if session.acting else {}
        return RobotStatus(
            Header(now_ns),
            session.config.robot.name,
            session.mode,
            active_executors=session.config.control_modes[session.mode].executors,
            estop=session.state is not None and session.state.estop,
            faults=session.faults,
            episode=session.outcome.episodes + 1,
            **dispatch,
        )

    def _diagnostics(self, now_ns: int) -> DiagnosticArray:
        session = self.session
        groups = session.counts()
        level = DiagnosticStatus.ERROR if session.faults else DiagnosticStatus.OK
        robot = session.config.robot.name
        statuses = [
            DiagnosticStatus(level if name == "loop" else DiagnosticStatus.OK, name, "", robot, _values(values))
            for name, values in groups.items()
        ]
        statuses += [_of_joint(each, robot) for each in session.conditions]
        return DiagnosticArray(Header(now_ns), tuple(statuses))


def _of_joint(condition: Mapping[str, Any], robot: str) -> DiagnosticStatus:
    """A condition of a joint, as control reports it."""
    level = DiagnosticStatus.ERROR if condition["severity"] == Severity.FAULT else DiagnosticStatus.WARN
    values = {condition["quantity"]: f"{condition['value']:.4g} {condition['unit']}".rstrip()}
    return DiagnosticStatus(level, f"joint {condition['joint']}", condition["message"], robot, _values(values))


def _values(counts: Mapping[str, Any]) -> tuple[KeyValue, ...]:
    return tuple(KeyValue(key, str(value)) for key, value in counts.items())
