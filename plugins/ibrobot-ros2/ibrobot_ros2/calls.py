"""Services of a run that take their time, as actions of ROS: the request is the goal, and the answer is the result.

They are offered, fed and ended as those of executors, see `goals`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import attrs

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import RunView, Service
from ibrobot_ros2.offers import answered, refused, with_ns
from ibrobot_ros2.services import plain

_FEEDBACK_S = 0.5
_MOST = 8
"""Most goals under way; further ones are rejected."""
_END_S = 5.0


class Wire(Protocol):
    """Speaks to clients of actions."""

    def offer(self, name: str, type_name: str, *, executor: str = "", service: str = "") -> None:
        """Offer an action of an executor, or of a service."""

    def feed(self, goal: int, values: Mapping[str, Any]) -> None:
        """Send feedback of a goal, by its number."""

    def end(self, goal: int, state: str, values: Mapping[str, Any]) -> None:
        """Send the result of a goal: `succeeded`, `aborted` or `canceled`."""


@attrs.frozen
class GoalRequest:
    """A goal of a client."""

    number: int
    fields: Mapping[str, Any]
    executor: str = ""
    service: str = ""
    """It is for one of these two."""


@attrs.define(eq=False)
class _Goal:
    """A call under way."""

    wire: Wire
    number: int
    service: Service[Any, Any]
    canceled: bool = False
    ended: threading.Event = attrs.field(factory=threading.Event)


def is_action(service: Service[Any, Any]) -> bool:
    """Whether a service is an action in ROS."""
    return "/action/" in service.ros_type


class Calls:
    """Passes goals to services, and their progress and answers back.

    Args:
        session: the run.
        is_offered: whether a service of the bus is offered.
        named: the full name of a service in ROS, from that on the bus.
        who: where goals come from, for the log.

    A goal is accepted at once. It ends as `succeeded`; as `aborted`, with the error as its `message`, if the service
    raises or says that it had no success; as `canceled`, with the service's answer, if its client canceled it.
    """

    def __init__(
        self, session: RunView, is_offered: Callable[[str], bool], named: Callable[[str], str], who: str
    ) -> None:  # fmt: skip
        self._session = session
        self._is_offered = is_offered
        self._named = named
        self._who = who
        self._lock = threading.Lock()
        self._declared: set[str] = set()
        self._goals: dict[tuple[Wire, int], _Goal] = {}
        self._threads: set[threading.Thread] = set()

    def declare(self, wire: Wire) -> None:
        """Tell a new node which actions it offers."""
        self._declared.clear()
        self.refresh(wire)

    def refresh(self, wire: Wire) -> None:
        """Tell the node which actions are new."""
        for name, service in self._session.bus.services().items():
            if is_action(service) and name not in self._declared and self._is_offered(name):
                self._declared.add(name)
                wire.offer(self._named(name), service.ros_type, service=name)

    def take_goal(self, wire: Wire, request: GoalRequest) -> bool:
        """Call a service, in a thread of its own; returns whether the goal is accepted."""
        number, service = request.number, self._session.bus.services().get(request.service)
        with self._lock:
            goal = _Goal(wire, number, service) if service is not None and len(self._goals) < _MOST else None
            if goal is not None:
                self._goals[wire, number] = goal
        if goal is None:
            why = f"{_MOST} goals are under way" if service is not None else "nobody serves it now"
            self._session.log.warning("%s: goal for %s rejected: %s", self._who, request.service, why)
            return False
        self._start(self._call, goal, with_ns(request.fields))
        if goal.service.progress is not None:
            self._start(self._report, goal, goal.service.progress)
        return True

    def refuse(self, wire: Wire, request: GoalRequest, error: IbrobotError) -> bool:
        """Accept a goal only to say why it is refused."""
        self._session.log.warning("%s: %s", self._who, error)
        wire.end(request.number, "aborted", refused(error))
        return True

    def cancel(self, wire: Wire, number: int) -> bool:
        """Cancel a goal for its client; returns whether it is canceled."""
        with self._lock:
            goal = self._goals.get((wire, number))
            if goal is None or goal.service.cancel is None:
                return False
            goal.canceled = True
        try:
            self._session.bus.call(goal.service.cancel)
        except IbrobotError as error:
            with self._lock:
                # One that has ended meanwhile has ended as canceled.
                goal.canceled = goal.ended.is_set()
            self._session.log.warning("%s: %s: cancel failed: %s", self._who, goal.service.name, error)
        return goal.canceled

    def close(self) -> None:
        """Wait for the calls under way, which end with the run."""
        for thread in list(self._threads):
            thread.join(_END_S)

    def _start(self, work: Callable[..., None], *arguments: Any) -> None:
        def run() -> None:
            try:
                work(*arguments)
            finally:
                self._threads.discard(threading.current_thread())

        thread = threading.Thread(target=run, name=f"{self._who} goal", daemon=True)
        self._threads.add(thread)
        thread.start()

    def _call(self, goal: _Goal, request: Mapping[str, Any]) -> None:
        values = answered(self._session, goal.service.name, request)
        state = "succeeded" if values.get("success", True) else "aborted"
        with self._lock:
            del self._goals[goal.wire, goal.number]
            goal.ended.set()
            if goal.canceled:
                state = "canceled"
        goal.wire.end(goal.number, state, values)

    def _report(self, goal: _Goal, progress: Service[Any, Any]) -> None:
        """Send feedback until the call has ended."""
        while not goal.ended.wait(_FEEDBACK_S):
            try:
                values = plain(self._session.bus.call(progress))
            except IbrobotError:  # it ends just now
                return
            goal.wire.feed(goal.number, values)
