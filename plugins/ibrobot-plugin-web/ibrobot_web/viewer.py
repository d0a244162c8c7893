"""Viewer `web`: starts the page's server, sends it states and pictures, and connects it with the commands of pages."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, override

import attrs
from ibrobot_terminal.agent_calls import AgentCalls

from ibrobot_core.api import Context, ContractError, IbrobotError, Viewer
from ibrobot_core.app import Child, ComponentFailed, RunView, Subscription, error_text
from ibrobot_web.commands import Commands, Receiver
from ibrobot_web.desktop import open_browser
from ibrobot_web.link import FIRST_PICTURE, PLAN, SAMPLES, STATE, STATUS, FrameSender
from ibrobot_web.messages import Pages
from ibrobot_web.objects import SceneObjects, mounts
from ibrobot_web.options import WebOptions
from ibrobot_web.pictures import PICTURES, to_payload
from ibrobot_web.status import LogLines, episode_json, numbers_of, plan_json, state_json, status_json

_MODULE = "ibrobot_web.server.process"
_START_S = 30.0
_END_S = 3.0
_SILENT_S = 5.0
"""Time without a sign of life of the server after which the run ends [s]."""
_STATUS_S, _SAMPLES_S, _TOPICS_S = 0.25, 0.1, 1.0
"""Periods of the status, of samples of topics, and of looking for new topics with pictures."""
_CAMERAS = 32
"""Most topics with pictures."""
_SAMPLED = 40
"""Most topics in plots."""
_PRIVATE_TOPICS = frozenset({"/robot_description", "/robot_description_semantic"})


class WebViewer(Viewer):
    """The run's side of the page. Without pages it sends nothing.

    Attributes:
        url: address of the page with its token, once open.
        watch_url: address of the page for watching only.
    """

    def __init__(self, options: WebOptions, ctx: Context) -> None:
        self._options = options
        self._ctx = ctx
        self.url = self.watch_url = ""
        self.pages = 0
        self.newest: dict[str, Any] | None = None
        """The newest joint state that pages were sent."""
        self._wanted: frozenset[int] | None = frozenset()
        self._child: Child | None = None
        self._finish = threading.Event()
        self._episode: Any = None
        """The newest state of recording."""
        self._dead: str = ""

    @override
    def open(self) -> None:
        if self._child is not None:
            return
        session, bus = self._ctx.session, self._ctx.bus
        if session is None or bus is None:
            raise IbrobotError("viewer type web shows a run: use it in `viewer:` or with --web")
        self._session: RunView = session
        self._finish.clear()
        self._dead = ""
        own, far = socket.socketpair()
        with far:
            self._child = Child(_MODULE, self._order(session), far.fileno(), end_s=_END_S)
        self._frames = FrameSender(own)
        try:
            self.url, self.watch_url = self._await_ready(self._child)
        except BaseException:
            self.close()
            raise
        self._log = LogLines()
        self._agents = AgentCalls(session)
        self._ctx.log.parent.addHandler(self._log) if self._ctx.log.parent else None
        self._states = session.watch_states()
        self._objects = SceneObjects(session)
        self._pictures: dict[str, Subscription] = {}
        self._samples: dict[str, Subscription] = {}
        self._due: dict[int, float] = {}
        self._next_s = 0.0
        self._commands = Commands(session, self.finish, self._child.channel.send, self._fail)
        self._receiver = Receiver(self._child, session, self._commands, self._take_pages, self._fail)
        if self._options.browser:
            open_browser(self.url)

    @override
    def update(self) -> bool:
        if self._child is None or self._finish.is_set():
            return False
        now_s = time.monotonic()
        dead = self._dead or self._receiver.death
        if not dead and now_s - self._receiver.alive_s > _SILENT_S:
            dead = f"the page's server has been silent for {_SILENT_S:g} s: its STOP would not be heard"
        if dead:
            raise ComponentFailed(dead)
        if now_s < self._next_s:
            self._frames.flush()
            return True
        self._next_s = now_s + 0.8 / self._options.rate_hz
        self._send_state()
        if self.pages:
            self._episode = episode_json(self._session) or self._episode
            self._send_pictures(now_s)
            self._send_slower(now_s)
        self._frames.flush()
        return True

    def finish(self) -> None:
        """End the run, at the next `update`."""
        self._finish.set()

    @override
    def close(self) -> None:
        child, self._child = self._child, None
        if child is None:
            return
        if self.url:
            self._receiver.open = False
        try:
            if self.url and self.pages:
                self._send(STATUS, {**self._status(), "ended": True})
        finally:
            self._shut(child)

    def _shut(self, child: Child) -> None:
        """End the server, and what was opened for it."""
        if self.url:
            if self._ctx.log.parent is not None:
                self._ctx.log.parent.removeHandler(self._log)
            for subscription in (*self._pictures.values(), *self._samples.values()):
                subscription.close()
            self._objects.close()
            self._agents.close()
            self._commands.close(_END_S)
        self._frames.close()
        child.channel.close()
        child.end()
        if self.url:
            self._receiver.join()
        self.url = self.watch_url = ""
        self.pages = 0

    @override
    def where(self) -> str:
        return f"{self.url}  (to watch only: {self.watch_url})" if self.url else ""

    def _order(self, session: RunView) -> dict[str, Any]:
        """The order of the server's process."""
        options, robot = attrs.asdict(self._options), session.config.robot.description
        described = {"tip": robot.tip, "arms": dict(robot.arms), "mjcf": robot.mjcf, "urdf": robot.urdf}
        order = {"options": options, "description": {**described, "mounts": mounts(session.config.peripherals)}}
        for facts in order.values():
            facts |= {name: str(value) for name, value in facts.items() if isinstance(value, Path)}
        return order

    @staticmethod
    def _await_ready(child: Child) -> tuple[str, str]:
        try:
            message = child.wait(_START_S)
        except ComponentFailed as death:
            raise IbrobotError(str(death)) from None
        if message is None:
            raise ComponentFailed(f"the page's server was not ready after {_START_S:g} s")
        return message["url"], message["watch_url"]

    def _take_pages(self, pages: Pages) -> None:
        self._wanted, self.pages = pages.wanted, pages.count
        self._due = {}

    def _fail(self, error: Exception) -> None:
        """End the run, whose page can no longer stop the robot."""
        self._dead = f"the page can no longer stop the robot: {error_text(error)}"

    def _shows(self, channel: int) -> bool:
        return self.pages > 0 and (self._wanted is None or channel in self._wanted)

    def _send(self, channel: int, value: Mapping[str, Any]) -> None:
        self._frames.send(channel, json.dumps(value, separators=(",", ":"), allow_nan=False).encode())

    def _is_due(self, channel: int, period_s: float, now_s: float) -> bool:
        if not self._shows(channel) or now_s < self._due.get(channel, 0.0):
            return False
        self._due[channel] = now_s + period_s
        return True

    def _send_state(self) -> None:
        state = self._states.get()
        if state is None:
            return
        self.newest = state_json(state)
        if self._shows(STATE):
            self._send(STATE, self.newest)

    def _send_pictures(self, now_s: float) -> None:
        if now_s >= self._due.get(-1, 0.0):
            self._due[-1] = now_s + _TOPICS_S
            bus = self._session.bus
            for topic, (kind, _) in bus.topics().items():
                if kind in PICTURES and topic not in self._pictures and len(self._pictures) < _CAMERAS:
                    self._pictures[topic] = bus.subscribe(topic, 1)
        for i, subscription in enumerate(self._pictures.values()):
            arrived = subscription.drain()
            if not arrived or not self._shows(FIRST_PICTURE + i):
                continue
            try:
                payload = to_payload(arrived[-1].message)
            except ContractError as error:
                self._ctx.log.debug("%s: %s", subscription.topic, error)
                continue
            if payload is not None:
                self._frames.send(FIRST_PICTURE + i, payload)

    def _send_slower(self, now_s: float) -> None:
        session = self._session
        if self._is_due(STATUS, _STATUS_S, now_s):
            self._send(STATUS, self._status())
        if self._is_due(PLAN, _STATUS_S, now_s):
            self._send(PLAN, plan_json(session, session.clock.now_ns()))
        if self._wanted is None or not self._shows(SAMPLES):  # pages that show all want pictures and states
            for subscription in self._samples.values():
                subscription.close()
            self._samples.clear()
        elif self._is_due(SAMPLES, _SAMPLES_S, now_s):
            self._send(SAMPLES, {"stamp": session.clock.now_ns(), "topics": self._sampled()})

    def _status(self) -> dict[str, Any]:
        """Everything about the run that changes, except joint states."""
        cameras = [{"channel": FIRST_PICTURE + i, "topic": topic} for i, topic in enumerate(self._pictures)]
        status = status_json(self._session, self._log, self._agents, self.pages)
        if status["episode"] is None:  # at the end, recording has ended before the page
            status["episode"] = self._episode
        return {**status, "cameras": cameras, "objects": self._objects.json(), "ended": False}

    def _sampled(self) -> dict[str, dict[str, float]]:
        """The newest numbers of every topic that has any."""
        bus = self._session.bus
        for topic, (kind, _) in bus.topics().items():
            if kind not in PICTURES and topic not in _PRIVATE_TOPICS | set(self._samples):
                if len(self._samples) >= _SAMPLED:
                    break
                self._samples[topic] = bus.subscribe(topic, 1)
        sampled = {}
        for topic, subscription in self._samples.items():
            arrived = subscription.drain()
            numbers = numbers_of(arrived[-1].message) if arrived else {}
            if numbers:
                sampled[topic] = numbers
        return sampled
