"""Authority of agents: programs, e.g. language models, that move the robot only within what a person has granted.

A person grants it for a time and a scope. An emergency stop, a fault, a mode switch or reset by anybody else, an
operator's takeover, silence of the agent, and anybody who wishes end it; the arm then holds until a person goes on.
"""

from __future__ import annotations

import itertools
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from contextvars import Context, copy_context
from functools import partial
from json import dumps
from typing import Any, ClassVar, override

import attrs
import numpy as np

from ibrobot_core.api import (
    HardwareError,
    Header,
    IbrobotError,
    JointState,
    NotSupported,
    String,
    Vector,
    documented,
    ns,
    option,
    seconds,
)
from ibrobot_core.app import MotionScope, NoRequest, RequestError, RunView, Service, joint_selection

AGENT_LOG = "/agent/log"
"""std_msgs/msg/String: JSON with what agents ask for, who grants it, and how it ends."""
MOVING = ("/planning/go_to", "/move_action", "/task/step", "/task/run")
"""What a person grants by default, of what a run serves."""
_MOST_KEPT, _MOST_REQUEST, _MOST_SHOWN = 20_000, 2_000, 300
"""Longest text in the log of what may have moved the robot and of the rest, and in the terminal, where it could hide
the rest of the panel, in characters."""
_NOTES_PER_S, _NOTES = 0.2, 50.0
"""Events of the log that move nothing and give nothing, e.g. refused calls and stops: on average, and at once."""
_asking = threading.Lock()
_TOLERANCE = 1e-3
"""How far a number may be outside of the region, in its unit, and a speed above that granted, as a fraction."""


@documented
@attrs.frozen
class Grant:
    """A request to `/agent/arm`."""

    seconds: float = option(unit="s", gt=0, le=3600, help="how long the agent may move the robot")
    services: tuple[str, ...] = option(MOVING, help="what it may call, beside services that read or stop")
    speed: float = option(0.25, ge=0.01, le=1, help="fraction of the velocity limits that nothing exceeds meanwhile")
    region: Mapping[str, tuple[tuple[float, float], ...]] = option(
        factory=dict, help="path as in `select` -> its bounds"
    )
    lease: float = option(10.0, unit="s", ge=1, le=120, help="longest silence of the agent's client")
    agent: str = option("", help="the agent; by default the only one that is connected")
    by: str = option("", help="who grants it, for the log")

    def __attrs_post_init__(self) -> None:
        if not all(low < high for low, high in self.bounds):
            raise ValueError("region: give [least, greatest] for each number")

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Least and greatest value of each number of the region."""
        return [each for bounds in self.region.values() for each in bounds]


@attrs.frozen
class AgentStatus:
    """The answer of `/agent/status`."""

    agents: tuple[str, ...]
    """The connected agents."""
    ended: str
    """How the last authority ended; empty before."""
    armed: str = ""
    """The agent that may move the robot; empty if there is none."""
    left_s: float = 0.0
    """For how long it may do so [s]."""
    grant: Grant | None = None


ARM = Service("/agent/arm", Grant, str, "Let an agent move the robot, for a time and within a scope.", persons=True)
DISARM = Service("/agent/disarm", NoRequest, type(None), "End an agent's authority: the arm holds.", urgent=True)
STATUS = Service("/agent/status", NoRequest, AgentStatus, "Agents, and what they may do.", reads=True)


@attrs.define(eq=False)
class Agent:
    """A connected agent. Its name is new in each connection, so that nobody inherits what was granted to another."""

    name: str
    heard_ns: int


@attrs.frozen(eq=False)
class Scope:
    """What an agent may do now."""

    agent: Agent
    grant: Grant
    until_ns: int
    numbers: Any
    """Reads those of the region, as `joint_selection` makes it; None without one."""


class Authority(MotionScope):
    """What agents may do in a run, and what they did. Doors for agents share that of the session.

    Args:
        session: the run, a `Session`.
    """

    usual: ClassVar[tuple[str, ...]] = MOVING
    """What a person grants by default, of what a run serves."""

    def __init__(self, session: Any) -> None:
        super().__init__(session)
        self._agents: list[Agent] = []
        self._scope: Scope | None = None
        self._called: dict[str, tuple[Service[NoRequest, Any] | None, Context]] = {}
        """Services that the agent has called in this scope -> what cancels them, and the context of the call."""
        self._left = ""
        """How a plan would have left the region."""
        self._numbers = itertools.count(1)
        self._ended = ""
        self.told: list[Callable[[Mapping[str, Any]], object]] = []
        """Called with each event of the log, which others cannot forge, as they can messages on a topic."""
        self._noting = threading.Lock()
        self._room: dict[str, tuple[float, int]] = {}
        """Name of an agent, the same in each connection -> how many bounded events of it may come at once, and when."""
        self._left_out: Counter[str] = Counter()
        """Events that had no room since the last one of the log."""

    @property
    @override
    def grant(self) -> Grant | None:
        return None if self._scope is None else self._scope.grant

    def open(self) -> None:
        """Serve `/agent/arm`, `/agent/disarm` and `/agent/status`, for a door that calls `check` at least at 20 Hz."""
        self._session.bus.serve(ARM, self.arm)
        self._session.bus.serve(DISARM, lambda _: self.end("disarmed"))
        self._session.bus.serve(STATUS, lambda _: self.status())

    def close(self) -> None:
        """End the authority, and serve no more."""
        for service in (ARM, DISARM, STATUS):
            self._session.bus.unserve(service)
        self.end("the door for agents closes")
        if self._left_out:
            self._note("closed", Agent("", 0), kept=True)

    def join(self, name: str) -> Agent:
        """Connect an agent, which may then read and stop; its name keeps ASCII letters, digits, `-_.`, at most 40."""
        plain = "".join(each for each in name if each.isascii() and (each.isalnum() or each in "-_."))[:40]
        agent = Agent(f"{next(self._numbers)}:{plain or 'agent'}", self._session.clock.now_ns())
        self._agents.append(agent)
        self._note("joined", agent)
        return agent

    def leave(self, agent: Agent) -> None:
        """Disconnect an agent, whose authority ends."""
        self._agents = [each for each in self._agents if each is not agent]
        self._note("left", agent)
        self.check()

    def renew(self, agent: Agent) -> None:
        """Note a sign of life of the agent's client."""
        agent.heard_ns = self._session.clock.now_ns()

    def status(self) -> AgentStatus:
        """What agents may do now."""
        scope, now_ns = self._scope, self._session.clock.now_ns()
        armed = () if scope is None else (scope.agent.name, seconds(max(0, scope.until_ns - now_ns)), scope.grant)
        return AgentStatus(tuple(each.name for each in self._agents), self._ended, *armed)

    def arm(self, grant: Grant) -> str:
        """Grant authority, in place of what was granted before; answers with what was granted.

        Raises:
            IbrobotError: if there is no such agent, or the robot is stopped, moves, or is outside of the region.
        """
        session = self._session
        chosen = [each for each in self._agents if grant.agent in ("", each.name)]
        if len(chosen) != 1:
            names = ", ".join(self.status().agents) or "none"
            raise RequestError(f"{ARM.name}: name one agent by `agent`; connected: {names}")
        if session.faults:
            raise HardwareError(f"{ARM.name}: refused before a reset: {session.faults[-1]}")
        with session.changing:
            numbers = joint_selection(session.config.robot, tuple(grant.region)) if grant.region else None
            for path, bounds in grant.region.items():
                if (size := joint_selection(session.config.robot, (path,)).size) != len(bounds):
                    raise RequestError(f"{ARM.name}: region: {path} are {size} numbers")
            scope = Scope(chosen[0], grant, session.clock.now_ns() + ns(grant.seconds), numbers)
            if outside := self._outside(scope):
                raise HardwareError(f"{ARM.name}: the robot is not in the region: {outside}; drive it there first")
            self.end("another grant replaces it")
            session.limit_speed(grant.speed)  # before the mode goes on, which may be that of a policy
            try:
                if session.held:
                    session.bus.call("/set_mode", session.mode)
            except BaseException:
                session.limit_speed(self.speed)
                raise
            self.renew(scope.agent)
            self._called, self._left, self.speed, self._scope = {}, "", grant.speed, scope
        self._note("armed", scope.agent, kept=True, grant=attrs.asdict(grant))
        return f"{scope.agent.name} may move the robot for {grant.seconds:g} s at {grant.speed:.0%} of its speed"

    def call(self, agent: Agent, name: str, request: Any = None) -> Any:
        """Call a service of the run for an agent.

        Raises:
            IbrobotError: if the agent may not, or as the service does.
        """
        self.renew(agent)
        service = self._session.bus.services().get(name)
        facts = {"service": name, "request": dumps(request, default=str)}
        grant: Grant | None = None
        token = self.acting.set(agent)
        try:
            if service is not None and not (service.reads or service.urgent):
                if service.persons:
                    raise NotSupported(f"{name} is for persons only: ask one")
                if name not in (granted := self._granted(agent, name)).services:
                    raise HardwareError(f"{name} is not granted; granted: {', '.join(granted.services) or 'nothing'}")
                grant, self._called[name] = granted, (service.cancel, copy_context())
            answer = self._session.bus.call(name, request)
            if grant is not None and self.status().grant is not grant:
                if service is not None and service.cancel:  # it began after `end` has cancelled what was there
                    self._session.bus.call(service.cancel)
                raise HardwareError(f"{name}: the authority ended during the call: {self._ended}")
        except Exception as error:
            began = grant is not None and not isinstance(error, RequestError)
            self._note("refused", agent, kept=began, **facts, why=str(error))
            raise
        finally:
            self.acting.reset(token)
        if service is None or not service.reads:
            self._note("called", agent, kept=grant is not None, **facts)
        return answer

    def _granted(self, agent: Agent, what: str) -> Grant:
        """What is granted to an agent.

        Raises:
            HardwareError: if that is nothing, and so `what` is refused.
        """
        self.check()
        scope = self._scope
        if scope is None or scope.agent is not agent:
            raise HardwareError(f"{what}: {agent.name} may not move the robot: ask a person to grant it by {ARM.name}")
        return scope.grant

    def check(self) -> None:
        """End an authority whose time, lease or conditions are over."""
        session, scope = self._session, self._scope
        if scope is None:
            return
        now_ns = session.clock.now_ns()
        if session.faults or session.commander == "operator":  # an emergency stop is a fault
            self.end((*session.faults, "the operator has taken over")[0], hold=False)
        elif scope.agent not in self._agents:
            self.end("the agent is gone")
        elif now_ns >= scope.until_ns:
            self.end("its time is over")
        elif (silent_s := seconds(now_ns - scope.agent.heard_ns)) > scope.grant.lease:
            self.end(f"the agent's client has been silent for {silent_s:.1f} s")
        elif why := self._left or self._outside(scope):
            self.end(f"not within the region: {why}")

    @override
    def taken_over(self, what: str, policy: bool = False) -> None:
        """Note that the mode is entered or reset, which ends the authority unless its agent does it.

        Args:
            what: what happens, for messages.
            policy: whether it starts a policy, which even a task of an agent may do only if `/set_mode` is granted.

        Raises:
            HardwareError: if an agent does it that may not.
        """
        if (agent := self.acting.get()) is None:
            self.end(f"{what} by another")
        elif "/set_mode" not in self._granted(agent, what).services and policy:
            raise HardwareError(f"{what} starts a policy, and /set_mode is not granted: ask a person to grant it")

    def end(self, why: str, *, hold: bool = True) -> None:
        """End the authority, if there is one; the robot then holds until a person goes on, if `hold`."""
        session = self._session
        with self.lock:
            scope, self._scope = self._scope, None
            if scope is None:
                return
            session.held, self.speed, self._ended = session.held or hold, 1.0, why
        self._note("ended", scope.agent, kept=True, why=why)
        acts: list[Callable[[], object]] = [session.hold] if hold else []
        # As the agent, so that what others have begun since goes on.
        acts += [partial(ctx.run, session.bus.call, cancel) for cancel, ctx in list(self._called.values()) if cancel]
        for act in acts:
            with suppress(IbrobotError):  # the service is of another mode, or the run ends
                act()
        with suppress(IbrobotError), session.changing:  # another grant may have been given meanwhile
            session.limit_speed(self.speed)

    @override
    def check_path(self, positions: Vector, fastest: float) -> None:
        """Check the path of a goal of anybody against the present scope.

        Args:
            positions: of all joints, at short intervals [rad], shape (N, J).
            fastest: greatest fraction of the velocity limits on it.

        Raises:
            HardwareError: if it leaves the region, or is too fast.
        """
        scope = self._scope
        if scope is not None and fastest > scope.grant.speed * (1 + _TOLERANCE):
            raise HardwareError(f"refused: {fastest:.0%} of the speed, {scope.grant.speed:.0%} is granted")
        if scope is not None and (outside := self._outside(scope, positions)):
            raise HardwareError(f"refused: the path leaves the region that is granted: {outside}")

    @override
    def admits_plan(self, joints: tuple[str, ...], positions: Vector) -> bool:
        """Whether a plan of anybody stays within the present scope; one that does not ends the authority."""
        scope, state = self._scope, self._session.state
        if scope is None or state is None:
            return not self._session.held
        rows = np.tile(state.command, (len(positions), 1))
        rows[:, self._session.config.robot.indices(joints)] = positions
        self._left = self._left or self._outside(scope, rows)
        return not self._left

    def _outside(self, scope: Scope, rows: Vector | None = None) -> str:
        """The first number of the region that positions of all joints exceed, by default the commands; or empty.

        Args:
            scope: the scope.
            rows: positions [rad], shape (N, J).
        """
        numbers, state, names = scope.numbers, self._session.state, self._session.config.robot.joint_names
        if numbers is None or state is None:
            return ""
        for row in rows if rows is not None else (state.command,):
            values = numbers(JointState(Header(0), names, row))
            for name, value, (low, high) in zip(numbers.names, values, scope.grant.bounds, strict=True):
                if not low - _TOLERANCE <= value <= high + _TOLERANCE:
                    return f"{name} would be {value:.3f}, granted is {low:g} to {high:g}"
        return ""

    def _note(self, event: str, agent: Agent, *, kept: bool = False, **facts: Any) -> None:
        """Log an event: on the topic, which recordings have, in the terminal, and for those who keep it.

        What may have moved the robot is `kept` whatever comes. Others are left out in a flood, and counted.
        """
        most = _MOST_KEPT if kept else _MOST_REQUEST
        texts = {key: _cut(value, most) if isinstance(value, str) else value for key, value in facts.items()}
        now_ns, name = self._session.clock.now_ns(), agent.name.partition(":")[2]
        entry = {"stamp_ns": now_ns, "event": event, "agent": agent.name, **texts}
        with self._noting:
            room, noted_ns = self._room.get(name, (_NOTES, 0))
            room = min(_NOTES, room + seconds(now_ns - noted_ns) * _NOTES_PER_S)
            self._room[name] = room - (not kept and room >= 1.0), now_ns
            if not kept and room < 1.0:
                self._left_out[event] += 1
                return
            if self._left_out:
                entry["left_out"], self._left_out = dict(self._left_out), Counter()
        # Episodes that begin later have who granted what, too.
        self._session.bus.publish(AGENT_LOG, String(dumps(entry, default=str)), latched=event in ("armed", "ended"))
        shown = " ".join(f"{key}={_cut(' '.join(str(value).split()), _MOST_SHOWN)}" for key, value in facts.items())
        self._session.log.info("agent %s: %s %s", agent.name, event, shown)
        for call in tuple(self.told):  # one that stops listening meanwhile keeps nothing from the others
            call(entry)


def authority_of(session: RunView) -> Authority:
    """The authority of a run: who asks first puts it in the place of a scope without agents."""
    run: Any = session
    with _asking:
        if not isinstance(run.authority, Authority):
            made = Authority(session)
            made.lock = run.authority.lock  # those who send now hold it
            run.authority = made
    authority: Authority = run.authority
    return authority


def _cut(text: str, most: int) -> str:
    """The beginning of a text, which says how much is missing."""
    return text if len(text) <= most else f"{text[:most]}… and {len(text) - most} characters more"
