"""The component of the section: a node beside the run, which it starts, feeds, watches and starts again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, override

import attrs
from ibrobot_ros2.calls import GoalRequest
from ibrobot_ros2.goals import Actions, with_goals

from ibrobot_core.api import DIAGNOSTICS, DiagnosticArray, DiagnosticStatus, Header, KeyValue, NotSupported
from ibrobot_core.app import CONTROL, Channel, ChannelMessage, Component, ComponentFailed, GoalRun, Pulse, error_text
from ibrobot_ros.options import RosOptions
from ibrobot_ros.process import NodeProcess
from ibrobot_ros.services import Services
from ibrobot_ros.topics import Topics, ros_name

_NICE = 5
"""The node comes after the run itself where the processor is short."""
_GLANCE_S = 0.1
_PING_S = 0.5
_SILENT_S = 2.0
"""Silence after which the node counts as stopped, and its goals are canceled [s]."""
_SETUP_S = 10.0
"""Time that a new node has until its first sign of life, in addition [s]."""
_BLOCKED_S = 6.0
"""Time without a sign of life of the thread that receives calls after which the run ends [s]; it may wait for control,
which may take 5 s to answer."""
_FIRST_WAIT_S, _LONGEST_WAIT_S = 1.0, 30.0
_STATUS_S = 1.0
_STOP_S = 5.0
_END_S = 1.0
"""Longest time for sending the rest at the end [s]."""


@attrs.frozen
class _Node:
    """Passes what the run says of its actions to the node's process."""

    channel: Channel

    def offer(self, name: str, type_name: str, *, executor: str = "", service: str = "") -> None:
        address = {"executor": executor} if executor else {"service": service}
        self.channel.send({"op": "action", "name": name, "type": type_name, **address})

    def feed(self, goal: int, values: Mapping[str, Any]) -> None:
        self.channel.send({"op": "feedback", "goal": goal, "values": values})

    def end(self, goal: int, state: str, values: Mapping[str, Any]) -> None:
        self.channel.send({"op": "ended", "goal": goal, "state": state, "values": values})


class RosNode(Component):
    """Runs the node. Its death does not end the run: goals from ROS are canceled, and a new node is started."""

    sends_stops = True

    def __init__(self, options: RosOptions, session: GoalRun) -> None:
        super().__init__("ros", f"node /{options.name} in a process of its own", (CONTROL,))
        if session.request.lockstep and options.subscribe:
            raise NotSupported("ros.subscribe: a lockstep run cannot receive topics of ROS")
        self._options = options
        self._session = session
        self._lockstep = session.request.lockstep
        self.topics = Topics(options, session)
        self._actions = Actions(
            session, with_goals(session) if options.actions else (), options.offers,
            lambda name: ros_name(name, options.namespace), "ros", options.gripper_action,
        )  # fmt: skip
        self._services = Services(options, session)
        self._node: NodeProcess | None = None
        self._channel: Channel | None = None
        self._ending = threading.Event()
        self._threads: list[threading.Thread] = []
        self._restarts = 0
        self._pulse = Pulse("calls from ROS", _BLOCKED_S)
        self._trouble = ""
        """What is wrong with the node now; empty while it works."""
        self._pinged_s = self._heard_s = 0.0
        self._published_s = 0.0

    @property
    def pid(self) -> int | None:
        """The process id of the node; None while there is none."""
        return self._node.pid if self._node is not None else None

    @property
    def state(self) -> str:
        """What the node does, on one line."""
        if self._trouble:
            return self._trouble
        return str(self._node.hello) if self._node is not None else "not started"

    @property
    def counts(self) -> dict[str, int]:
        """What was lost, and how often the node was started again."""
        return {"restarts": self._restarts, **self.topics.counts}

    @override
    def start(self) -> None:
        session = self._session
        self._ending.clear()
        self._node = self._new_node(session.finished)
        self._trouble = ""
        session.log.info("ros: node /%s: %s", self._options.name, self._node.hello)
        self.topics.open()
        self._services.open()
        if not self._lockstep:
            self._actions.open()
        self._declare(self._node.channel)
        if self._lockstep:
            return
        for name, work in (("ros", self._receive), ("ros topics", self._send)):
            thread = threading.Thread(target=work, name=name, daemon=True)
            self._threads.append(thread)
            thread.start()
        self._session.pulses.add(self._pulse)

    @override
    def step(self, now_ns: int) -> None:
        channel = self._channel
        if channel is None:
            return
        while self.topics.send_next(channel, 0.0):
            pass
        for head in channel.receive(0.0):
            self._take(channel, head)
        if not channel.flush(_STOP_S):
            assert self._node is not None
            raise ComponentFailed(f"the ROS node is gone: {self._node.cause()}")

    @override
    def stop(self) -> None:
        self._session.pulses.discard(self._pulse)
        self._ending.set()
        if self._channel is not None and not self._channel.closed:
            self._channel.wake()
        for thread in self._threads:
            thread.join(_STOP_S)
        self._threads.clear()
        channel, self._channel = self._channel, None
        if channel is not None:
            self._send_rest(channel)
        self.topics.close()
        self._services.close()
        self._actions.close()
        if channel is not None:
            channel.send({"op": "end"})
            channel.flush(1.0)
        node, self._node = self._node, None
        if node is not None:
            node.close()

    def _new_node(self, given_up: threading.Event) -> NodeProcess:
        return NodeProcess(self._options, self._options.name, niceness=_NICE, given_up=given_up.is_set)

    def _declare(self, channel: Channel) -> None:
        """Tell a new node what the run has."""
        self._pinged_s = time.monotonic()
        self._heard_s = self._pinged_s + _SETUP_S
        self.topics.declare(channel)
        self._services.declare(channel)
        if not self._lockstep:
            self._actions.declare(_Node(channel))
        self._channel = channel

    def _send(self) -> None:
        """Send messages of the bus, in a thread of its own."""
        while not self._ending.is_set():
            channel = self._channel
            if channel is None or channel.closed:
                self._ending.wait(_GLANCE_S)
            else:
                self.topics.send_next(channel, _GLANCE_S)

    def _send_rest(self, channel: Channel) -> None:
        """Flush, so external recordings are complete."""
        deadline_s = time.monotonic() + _END_S
        while not channel.closed and time.monotonic() < deadline_s and self.topics.send_next(channel, 0.0):
            pass

    def _receive(self) -> None:
        """Take what the node sends, watch it, and start it again, in a thread of its own."""
        wait_s = _FIRST_WAIT_S
        while not self._ending.is_set():
            channel = self._channel
            self._pulse.beat()
            if channel is not None and not channel.closed:
                for head in channel.receive(_GLANCE_S):
                    self._take(channel, head)
                self._watch(channel)
                if self._restarts and time.monotonic() - self._begun_s > _LONGEST_WAIT_S:
                    wait_s = _FIRST_WAIT_S
            else:
                if self._node is not None:
                    self._lose(self._node, wait_s)
                with self._pulse.paused():  # nobody can call without a node
                    if not self._ending.wait(wait_s):
                        wait_s = min(2 * wait_s, _LONGEST_WAIT_S)
                        self._restart()
            self._publish_status()

    def _watch(self, channel: Channel) -> None:
        """Ask the node for a sign of life, and offer services that are new."""
        now_s = time.monotonic()
        if now_s - self._pinged_s >= _PING_S:
            self._pinged_s = now_s
            channel.send({"op": "ping"})
            self._services.refresh(channel)
            self._actions.refresh(_Node(channel))
        silent_s = now_s - self._heard_s
        if silent_s > _SILENT_S and not self._trouble:
            assert self._node is not None
            self._trouble = f"the ROS node {self._node.pid} does not answer"
            self._session.log.error("ros: %s; the robot does not depend on it", self._trouble)
            self._actions.abandon(self._trouble)
        elif silent_s <= _SILENT_S and self._trouble:
            self._trouble = ""
            self._session.log.warning("ros: the node answers again")

    def _lose(self, node: NodeProcess, wait_s: float) -> None:
        """Report the death of the node."""
        self._trouble = f"the ROS node died ({node.cause().splitlines()[-1]})"
        node.close()
        self._node = self._channel = None
        self._session.log.error("ros: %s; starting it again in %g s", self._trouble, wait_s)
        self._actions.abandon(self._trouble)

    def _restart(self) -> None:
        self._restarts += 1
        try:
            self._node = self._new_node(self._ending)
        except Exception as error:  # noqa: BLE001 - reported, and tried again
            self._trouble = f"the ROS node does not start: {error_text(error, '; ')}"
            self._session.log.error("ros: %s", self._trouble)
            return
        self._begun_s = time.monotonic()
        self._trouble = ""
        self._session.log.warning("ros: the node was started again")
        self._declare(self._node.channel)

    def _take(self, channel: Channel, head: ChannelMessage) -> None:
        self._heard_s = time.monotonic()
        takes: dict[str, Callable[[], None]] = {
            "message": lambda: self.topics.take(head["topic"], head.payload),
            "matched": lambda: self.topics.take_subscribers(head["topic"], head["subscribers"]),
            "dropped": lambda: self._note_flood(head["topic"], head["count"]),
            "trouble": lambda: self.topics.tell(f"{head['topic']}: {head['what']}"),
            "goal": lambda: self._submit(channel, head),
            "cancel": lambda: self._submit(channel, head),
            "call": lambda: self._services.take_call(channel, head),
            "pong": lambda: None,
        }  # fmt: skip
        takes[head["op"]]()

    def _submit(self, channel: Channel, head: dict[str, Any]) -> None:
        """Decide about a goal or a cancel in another thread; refuse it if there is none."""
        if not self._services.submit(partial(self._decide, channel, head, self._session.stops)):
            self._session.log.warning("ros: a %s is refused: too many calls wait", head["op"])
            channel.send({"op": "decided", "goal": head["goal"], "accepted": False})

    def _decide(self, channel: Channel, head: dict[str, Any], stops: int) -> None:
        """Answer a goal, or a cancel, which was received after `stops` emergency stops."""
        number, node = head["goal"], _Node(channel)
        if head["op"] == "cancel":
            accepted = self._actions.cancel(node, number)
        else:
            address = {key: head[key] for key in ("executor", "service") if key in head}
            accepted = self._actions.take_goal(node, GoalRequest(number, head["fields"], **address), stops)
        channel.send({"op": "decided", "goal": number, "accepted": accepted})

    def _note_flood(self, topic: str, count: int) -> None:
        self.topics.counts[f"dropped {topic}"] += count
        self.topics.tell(f"{topic}: messages come faster than rate_hz, {self._options.rate_hz:g}; the rest is dropped")

    def _publish_status(self) -> None:
        """Publish the node's state on /diagnostics, once a second."""
        now_s = time.monotonic()
        if now_s - self._published_s < _STATUS_S:
            return
        self._published_s, now_ns = now_s, self._session.clock.now_ns()
        level = DiagnosticStatus.WARN if self._trouble else DiagnosticStatus.OK
        values = tuple(KeyValue(name, str(count)) for name, count in sorted(self.counts.items()))
        status = DiagnosticStatus(level, "ros", self.state, self._session.config.robot.name, values)
        self._session.bus.publish(DIAGNOSTICS, DiagnosticArray(Header(now_ns), (status,)))
