"""Services and actions of a run for ROS 2 nodes, and for other runs, that speak rmw_zenoh's dialect."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from typing import Any, Literal, override

import attrs
from ibrobot_ros2.calls import GoalRequest
from ibrobot_ros2.goals import Actions, with_goals
from ibrobot_ros2.interfaces import ActionType, ServiceType, action_type, fields_of, service_type, to_cdr
from ibrobot_ros2.offers import CHECK, Offer, Offers, refused, time_of
from ibrobot_ros2.workers import StopWay

from ibrobot_core.api import NS_PER_S, HardwareError, IbrobotError, NotSupported, did_you_mean
from ibrobot_core.app import CONTROL, GoalRun, SessionWorker
from ibrobot_zenoh.arrivals import Arrivals
from ibrobot_zenoh.network import Link, Reply, RosHandler, transport_of
from ibrobot_zenoh.options import Share
from ibrobot_zenoh.ros2 import absolute
from ibrobot_zenoh.ros_goals import Status

_ENDED_KEPT = 100
"""Number of ended goals whose results can still be asked for."""
_LOOK_S = 0.5
"""How often to look for services that a mode has brought."""
_CANCELED, _REJECTED, _UNKNOWN, _OVER = 0, 1, 2, 3
"""Return codes of action_msgs/srv/CancelGoal."""


@attrs.define(eq=False)
class _Goal:
    """A goal of a client."""

    number: int
    uuid: tuple[int, ...]
    stamp_ns: int
    server: _Server
    status: Status = Status.ACCEPTED
    accepted: bool = False
    canceling: bool = False
    result: Mapping[str, Any] | None = None
    waiting: list[Reply] = attrs.field(factory=list)
    """Clients that wait for the result."""


@attrs.define(eq=False)
class _Server:
    """The server of an action."""

    name: str
    type: ActionType
    executor: str
    service: str
    """It is for one of these two."""
    goals: OrderedDict[tuple[int, ...], _Goal] = attrs.field(factory=OrderedDict)
    """Goals by their ids, the oldest first."""


class RosSharing(SessionWorker):
    """Answers calls of the shared services under types of ROS, and offers executors and services as actions.

    An action has three services and two topics. The run decides about goals. Services that a mode brings appear with
    it.

    Args:
        session: the run.
        link: the network.
        share: what is shared.
        arrivals: refuses calls and goals that come too late.

    Raises:
        NotSupported: for an executor that takes no goals.
    """

    session: GoalRun

    def __init__(self, session: GoalRun, link: Link, share: Share, arrivals: Arrivals) -> None:
        super().__init__(session, "share:ros", "services and actions for ROS 2 nodes", (link.name, CONTROL))
        self._link = link
        self._arrivals = arrivals
        known = list(with_goals(session))
        for name in share.actions:
            if name not in known:
                hint = did_you_mean(name, known, "executors that do")
                raise NotSupported(f"transport.share.actions: {name} is no executor that takes goals{hint}")
        self._offers = Offers(session, share.offers, self._named)
        self._actions = Actions(session, share.actions, share.offers, self._named, "zenoh", share.gripper_action)
        self._way = StopWay(session, "services for ROS 2 nodes")
        self._served: set[str] = set()
        self._lock = threading.RLock()
        self._count = 0
        self._goals: dict[int, _Goal] = {}
        """Goals that have not ended, by number."""
        self._ends = ExitStack()

    def _named(self, name: str) -> str:
        return absolute(name, transport_of(self._link).namespace)

    @override
    def setup(self) -> None:
        self._transport = transport_of(self._link)
        self._actions.open()
        self._actions.declare(self)
        self._look()
        self._way.open()

    @override
    def work(self, timeout_s: float) -> None:
        self.session.finished.wait(min(timeout_s, _LOOK_S))
        self._actions.refresh(self)
        self._look()

    @override
    def teardown(self) -> None:
        self._way.close()
        self._ends.close()
        self._actions.close()

    def _look(self) -> None:
        """Serve the services that are new."""
        for name, offer in self._offers.found().items():
            if name not in self._served:
                self._served.add(name)
                check = partial(self._answer, CHECK) if offer.service == "/estop" else None
                way = self._way if offer.urgent else None
                self._serve(name, service_type(offer.type), partial(self._answer, offer), way, check)

    def _serve(
        self, name: str, kind: ServiceType, handler: RosHandler, way: StopWay | None = None,
        check: RosHandler | None = None,
    ) -> None:  # fmt: skip
        self._ends.callback(self._transport.serve_ros(name, kind, handler, way=way, check=check))

    def _answer(self, offer: Offer, request: dict[str, Any], reply: Reply) -> None:
        try:
            self._arrivals.check(offer.service, reply.sent_ns)
            answer = self._offers.answer(offer, request)
        except HardwareError as error:
            answer = refused(error)
        known = fields_of(service_type(offer.type).response)
        reply({name: value for name, value in answer.items() if name in known})

    def offer(self, name: str, type_name: str, *, executor: str = "", service: str = "") -> None:
        """Serve an action of the run."""
        server = _Server(name, action_type(type_name), executor, service)
        name, kind = f"{server.name}/_action", server.type
        self._serve(f"{name}/send_goal", kind.send_goal, partial(self._take_goal, server))
        self._serve(f"{name}/cancel_goal", kind.cancel_goal, partial(self._contain, self._cancel, server), self._way)
        self._serve(f"{name}/get_result", kind.get_result, partial(self._get_result, server))
        self._publish_status(server)

    def _contain(self, handle: Callable[..., None], server: _Server, request: dict[str, Any], reply: Reply) -> None:
        """Handle an urgent call other than an emergency stop: a bug in it does not end the run."""
        try:
            handle(server, request, reply)
        except Exception:
            self.session.log.exception("%s: a call failed", server.name)

    def _take_goal(self, server: _Server, request: dict[str, Any], reply: Reply) -> None:
        stops, now_ns = self.session.stops, self.session.clock.now_ns()
        uuid = tuple(request["goal_id"]["uuid"])
        with self._lock:
            if uuid in server.goals:
                reply({"accepted": False})
                return
            self._count += 1
            goal = server.goals[uuid] = self._goals[self._count] = _Goal(self._count, uuid, now_ns, server)
        asked = GoalRequest(goal.number, request["goal"], server.executor, server.service)
        try:
            self._arrivals.check(server.service, reply.sent_ns)
        except HardwareError as error:
            accepted = self._actions.refuse(self, asked, error)
        else:
            accepted = self._actions.take_goal(self, asked, stops)
        with self._lock:
            if accepted and goal.status is Status.ACCEPTED:
                goal.status = Status.EXECUTING
            elif not accepted:
                self._goals.pop(goal.number, None)
                server.goals.pop(uuid, None)
        reply({"accepted": accepted, "stamp": time_of(now_ns)})
        self._publish_status(server)

    def _cancel(self, server: _Server, request: dict[str, Any], reply: Reply) -> None:
        """Cancel one goal, or all, or all up to a time, as ROS's action servers."""
        info = request["goal_info"]
        uuid = tuple(info["goal_id"]["uuid"])
        until_ns = info["stamp"]["sec"] * NS_PER_S + info["stamp"]["nanosec"]
        with self._lock:
            one = server.goals.get(uuid)
            running = [each for each in server.goals.values() if each.result is None]
        if any(uuid) and one is None:
            reply({"return_code": _UNKNOWN})
            return
        if any(uuid) and not until_ns and one not in running:
            reply({"return_code": _OVER})
            return
        chosen = [each for each in running if self._is_meant(each, uuid, until_ns)]
        canceling = []
        for goal in chosen:
            if self._actions.cancel(self, goal.number):
                with self._lock:
                    if goal.result is None:
                        goal.status = Status.CANCELING
                canceling.append(_info(goal))
        reply({"return_code": _CANCELED if canceling else _REJECTED, "goals_canceling": canceling})
        self._publish_status(server)

    @staticmethod
    def _is_meant(goal: _Goal, uuid: tuple[int, ...], until_ns: int) -> bool:
        if until_ns and goal.stamp_ns <= until_ns:
            return True
        return goal.uuid == uuid if any(uuid) else not until_ns

    def _get_result(self, server: _Server, request: dict[str, Any], reply: Reply) -> None:
        with self._lock:
            goal = server.goals.get(tuple(request["goal_id"]["uuid"]))
            if goal is not None and goal.result is None:
                goal.waiting.append(reply)
                return
        if goal is None:
            reply({"status": Status.UNKNOWN})
        else:
            reply({"status": goal.status, "result": goal.result})

    def feed(self, goal: int, values: Mapping[str, Any]) -> None:
        """Publish feedback of a goal, by its number."""
        known = self._goals.get(goal)
        if known is None or known.result is not None:
            return
        server = known.server
        feedback = {"goal_id": {"uuid": list(known.uuid)}, "feedback": _fields(server, values, "feedback")}
        self._publish(f"{server.name}/_action/feedback", server.type.feedback, feedback)

    def end(self, goal: int, state: str, values: Mapping[str, Any]) -> None:
        """Answer those who wait for the result of a goal, by its number."""
        with self._lock:
            ended = self._goals.pop(goal, None)
            if ended is None:
                return
            server = ended.server
            ended.status, ended.result = Status[state.upper()], _fields(ended.server, values, "result")
            waiting, ended.waiting = ended.waiting, []
            over = [uuid for uuid, each in server.goals.items() if each.result is not None]
            for uuid in over[: max(0, len(over) - _ENDED_KEPT)]:
                del server.goals[uuid]
        for reply in waiting:
            reply({"status": ended.status, "result": ended.result})
        self._publish_status(server)

    def _publish_status(self, server: _Server) -> None:
        with self._lock:
            states = [{"goal_info": _info(each), "status": each.status} for each in server.goals.values()]
        self._publish(f"{server.name}/_action/status", server.type.status, {"status_list": states}, latched=True)

    def _publish(self, topic: str, type_name: str, message: Mapping[str, Any], *, latched: bool = False) -> None:
        try:
            self._transport.publish_cdr(topic, type_name, to_cdr(type_name, message), latched=latched)
        except IbrobotError as error:
            self.session.log.warning("%s: %s", topic, error)


def _fields(server: _Server, values: Mapping[str, Any], part: Literal["feedback", "result"]) -> dict[str, Any]:
    """The fields of feedback or a result, without those that its type lacks."""
    known = fields_of(f"{server.type.name}_{part.capitalize()}")
    return {name: value for name, value in values.items() if name in known}


def _info(goal: _Goal) -> dict[str, Any]:
    return {"goal_id": {"uuid": list(goal.uuid)}, "stamp": time_of(goal.stamp_ns)}
