"""Agents on the panel: who asks for what, the path that it would take, and the keys by which a person decides."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

from ibrobot_core.app import RunView
from ibrobot_terminal.agent_calls import AgentCall, AgentCalls, AskedPath, planned_path
from ibrobot_terminal.authority import authority_of

ALLOW, REFUSE, TIME, SPEED = "Y", "N", "T", "V"
_ARM, _DISARM = "/agent/arm", "/agent/disarm"
_SECONDS = (120.0, 300.0, 600.0, 30.0)
_SPEEDS = (0.25, 0.5, 1.0, 0.1)
"""What `TIME` and `SPEED` choose from, beginning with the first."""
_READ_S = 1.0
"""For how long a request must have been shown before a key allows it, so that nobody allows one that has just taken the
place of another [s]."""
_REST = 9.0
"""Rest between two plans, as a multiple of what the last one took: agents ask in floods."""
_LONGEST = 120
"""Longest request on the panel, in characters."""


class AgentKeys:
    """Lets a person at the panel allow what an agent asks for, refuse it, and take authority back.

    Args:
        session: the run.
    """

    def __init__(self, session: RunView) -> None:
        self._session, self._authority = session, authority_of(session)
        self._calls = AgentCalls(session)
        self._seconds, self._speed = list(_SECONDS), list(_SPEEDS)
        self._shown: AgentCall | None = None
        self._read_s = 0.0
        """When the shown request may be allowed, by `time.monotonic` [s]."""
        self._answered = 0
        """Number of the last request that a person has answered."""
        self._paths = ThreadPoolExecutor(1, "paths of agents")
        self._path: tuple[AgentCall, Future[AskedPath]] | None = None
        self._plan_s = 0.0
        """When the next plan may begin [s]."""
        self._taken = sorted(
            {
                key
                for each in session.config.teleoperation.values()
                for key in each.options.terminal_keys(session.config.robot)
            }
            & {ALLOW, REFUSE, TIME, SPEED}
        )

    def close(self) -> None:
        """Listen no more, and plan no more."""
        self._calls.close()
        self._paths.shutdown(wait=False, cancel_futures=True)

    def rows(self) -> list[tuple[str, str]]:
        """Rows for the panel: heading and text."""
        if not self._session.bus.serves(_ARM):
            return []
        status = self._authority.status()
        rows = []
        if status.grant is not None:
            more = "" if self._taken else f"; {REFUSE} takes it back"
            rows.append(
                (
                    "agent",
                    f"{status.armed} may move the robot for {status.left_s:.0f} s at {status.grant.speed:.0%}{more}",
                )
            )
        asked = self._asked()
        if asked != self._shown:
            self._read_s = time.monotonic() + _READ_S
        self._shown = asked
        if asked is not None:
            rows += self._request(asked)
            return rows
        self._path = None  # the robot may have moved when it is asked for again
        if not rows and status.agents:
            rows.append(("agents", f"{', '.join(status.agents)} may look, plan and stop"))
        return rows

    def key(self, key: str) -> Callable[[], object] | None:
        """What a pressed key does; None for a key that means nothing here."""
        acts: dict[str, Callable[[], object]] = {}
        if not self._taken and self._session.bus.serves(_ARM):
            if (asked := self._shown) is not None:
                grant = partial(self._session.bus.call, _ARM, self._grant(asked))
                acts = {TIME: partial(_turn, self._seconds), SPEED: partial(_turn, self._speed), ALLOW: grant}
            if asked is not None or self._authority.status().armed:
                acts[REFUSE] = self._refuse
            if key == ALLOW and asked is not None and not self._is_read(asked):
                return self._too_soon
        return acts.get(key)

    def _grant(self, asked: AgentCall) -> dict[str, Any]:
        services = list(dict.fromkeys([*self._authority.usual, asked.service]))
        scope = {"seconds": self._seconds[0], "services": services, "speed": self._speed[0]}
        return {**scope, "agent": asked.agent, "by": "panel"}

    def _is_read(self, asked: AgentCall) -> bool:
        """Whether a person has had the time to read the request, which is then answered; a key that repeats has not."""
        now_s = time.monotonic()
        if now_s < self._read_s or not self._is_planned(asked):
            self._read_s = now_s + _READ_S
            return False
        self._answered = asked.number
        return True

    def _is_planned(self, asked: AgentCall) -> bool:
        """Whether the panel shows the path that is asked for, or why there is none."""
        return self._path is not None and self._path[0] == asked and self._path[1].done()

    def _too_soon(self) -> None:
        self._session.log.warning("%s came too soon: read the request and its path, and press it again", ALLOW)

    def _refuse(self) -> None:
        """Refuse what is asked for, and take back what is granted: an agent that goes on asking keeps none of it."""
        if self._shown is not None:
            self._answered = self._shown.number
            self._session.log.info("%s by %s is refused", self._shown.service, self._shown.agent)
        if self._authority.status().armed:
            self._session.bus.call(_DISARM)

    def _asked(self) -> AgentCall | None:
        """What a person has to decide on now."""
        call, status = self._calls.newest, self._authority.status()
        if call is None or not call.refused or call.number <= self._answered or call.agent not in status.agents:
            return None
        granted = status.grant is not None and status.armed == call.agent and call.service in status.grant.services
        return None if granted else call

    def _request(self, asked: AgentCall) -> list[tuple[str, str]]:
        grant = self._grant(asked)
        scope = f"{grant['seconds']:g} s, {grant['speed']:.0%} of the speed limits, {', '.join(grant['services'])}"
        keys = f"{ALLOW} lets it move   {REFUSE} refuses   {TIME} time   {SPEED} speed"
        if self._taken:
            keys = f"{', '.join(self._taken)} moves the robot in this YAML: use `ibrobot agent arm`"
        request = " ".join(asked.request.split())
        return [
            ("agent", f"{asked.agent} asks for {asked.service}"),
            ("path", self._path_of(asked, grant["speed"])),
            ("grant", scope),
            ("keys", keys),
            ("request", request if len(request) <= _LONGEST else f"{request[:_LONGEST]} …"),
        ]

    def _path_of(self, asked: AgentCall, speed: float) -> str:
        """A summary of the path that is asked for, once it is planned."""
        another = self._path is None or (self._path[0] != asked and self._path[1].done())
        if another and time.monotonic() >= self._plan_s:
            self._path = asked, self._paths.submit(self._planned, asked)
        if self._path is None or not self._is_planned(asked):
            return "is being planned"
        return self._path[1].result().at(speed)

    def _planned(self, asked: AgentCall) -> AskedPath:
        begun_s = time.monotonic()
        try:
            return planned_path(self._session, asked)
        finally:
            now_s = time.monotonic()
            self._plan_s = now_s + _REST * (now_s - begun_s)


def _turn(choices: list[float]) -> None:
    """Let the next one be the first."""
    choices.append(choices.pop(0))
