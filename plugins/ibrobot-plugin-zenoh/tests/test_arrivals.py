"""What was sent before a stop and arrives after its reset, as a stalled network delivers it, is refused."""

from __future__ import annotations

import itertools
import queue
import sys
import time
from functools import partial
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

import attrs
import pytest
import zenoh
from ibrobot_ros2.interfaces import action_type, from_cdr, service_type, to_cdr
from ibrobot_ros2.services import SERVICES, Answer, Call, decode_answer, encode_call
from ibrobot_ros2.workers import StopWay
from ibrobot_testing import stand_in
from ibrobot_testing.section import make_session
from ibrobot_zenoh import ros_calls
from ibrobot_zenoh.network import Reply
from ibrobot_zenoh.ros2 import actions_of, attachment, service_key
from ibrobot_zenoh.ros_goals import SentGoal, Status
from ibrobot_zenoh.transport import ZenohTransport

from ibrobot_core.api import NS_PER_S, IbrobotError, Payload
from ibrobot_core.app import NoRequest, Service

from .pair import WAIT_S, client, free_endpoint, router, settle, wait_for
from .test_topics import raw_config

if TYPE_CHECKING:
    from fake_runs import Runs
    from ibrobot_testing.site import Site

MOVING = (
    "/planning/go_to", "/move_action", "/execute_trajectory", "/moveit_gateway/move_to_pose",
    "/moveit_gateway/move_to_configuration", "/task/run", "/web_teleop/jog", "/intervene", "/record_episode/start",
    "/of_a_foreign_plugin",
)  # fmt: skip
"""Services that move a robot, or may."""
CORE = ("/set_mode", "/reset")
STALLS_S = (0.001, 0.1, 0.7, 1.6, 5.0, 60.0, 86_400.0)
"""How long before a stop, or its reset, a request was sent."""
READING = Service("/reading", NoRequest, str, reads=True)
URGENT = Service("/halt", NoRequest, str, urgent=True)
TRIGGER, SET = service_type("std_srvs/srv/Trigger"), service_type("rcl_interfaces/srv/SetParameters")


@attrs.frozen
class Prompt:
    """A request."""

    prompt: str = ""


@attrs.frozen
class Ended:
    """An answer."""

    success: bool
    message: str


_SHARED = (*MOVING, *CORE, READING.name, URGENT.name, "/estop", "/record_episode/start/")
SHARE = f"share: {{services: [{', '.join(_SHARED)}]}}"


@attrs.define
class Robot:
    """A run that shares its services."""

    runtime: Any
    calls: list[str] = attrs.field(factory=list)
    """Requests that were carried out."""

    def serve(self) -> None:
        """Serve what moves, and what does not."""
        for name in MOVING:
            self.runtime.session.bus.serve(stand_in(name), partial(self.carry_out, name, "done"))
        for service in (READING, URGENT):
            self.runtime.session.bus.serve(service, lambda request: "done")

    def carry_out(self, name: str, answer: Any, request: object) -> Any:
        """Note a request, and answer it."""
        self.calls.append(name)
        return answer

    def stop(self, cause: str) -> int:
        """Stop the robot; returns a time of day before [ns]."""
        before_ns, session = self._pass_states(), self.runtime.session
        if cause == "STOP":
            session.emergency_stop()
        else:
            session.raise_fault(cause)
        wait_for(lambda: session.faults and session.stopped_by)
        return before_ns

    def reset(self) -> int:
        """Reset the robot as soon as it has come to rest; returns a time of day when it was stopped [ns]."""
        before_ns = self._pass_states()
        wait_for(self._is_reset)
        return before_ns

    def _pass_states(self) -> int:
        """Wait until a state was taken in; returns a time of day before [ns]."""
        before_ns, states = time.time_ns(), self.runtime.session.watch_states()
        for _ in range(3):  # the first ones may have been on their way
            assert states.get(WAIT_S) is not None
        return before_ns

    def _is_reset(self) -> bool:
        try:
            self.runtime.reset()
        except IbrobotError:  # it still brakes
            return False
        return True


@pytest.fixture
def robot(site: Site, runs: Runs) -> Robot:
    """One on the transport `network`, which takes the time at which a request was sent from the test."""
    site.add("a-network", "recording_network.py")
    made = Robot(runs.start(f"transport={{type: network, {SHARE}}}", mode="idle", lockstep=False))
    made.serve()
    return made


def ask(service: str, sent_ns: int, request: Any = None) -> Answer:
    """The answer to a request that was sent then."""
    network = sys.modules["a_network"].MADE[-1]
    network.sent_ns = sent_ns
    return decode_answer(network.request("services", encode_call(Call(service, request)), WAIT_S))


def is_too_old(answer: Answer, service: str) -> bool:
    return not answer.result and str(answer.values).startswith(
        f"{service}: refused, it was sent before the robot was last stopped or reset, "
    )


@pytest.mark.parametrize("cause", ["STOP", "a fault"])
def test_what_was_sent_before_a_stop_or_its_reset_moves_nothing(robot: Robot, cause: str):
    for stall_s in STALLS_S:
        assert ask(MOVING[0], time.time_ns() - round(stall_s * NS_PER_S)).result, "nothing has stopped it yet"
    robot.calls.clear()
    stopped_ns = robot.stop(cause)
    reset_ns = robot.reset()
    siblings = list(itertools.product((*MOVING, *CORE), STALLS_S, (stopped_ns, reset_ns)))
    assert len(siblings) == 168
    request = {"/set_mode": {"mode": "teleop"}}
    for service, stall_s, end_ns in siblings:
        answer = ask(service, end_ns - round(stall_s * NS_PER_S), request.get(service))
        assert is_too_old(answer, service), (service, stall_s, answer)
    assert robot.calls == []
    assert robot.runtime.session.mode == "idle"
    for service in MOVING:
        for sent_ns in (time.time_ns(), 0, time.time_ns() + NS_PER_S):  # now, of a sender without a time, of one ahead
            assert ask(service, sent_ns) == Answer("done")
    assert ask("/set_mode", time.time_ns(), {"mode": "idle"}).result


def test_what_stops_or_reads_is_answered_however_old_it_is(robot: Robot):
    robot.stop("STOP")
    robot.reset()
    refused = ask(MOVING[0], time.time_ns() - 3600 * NS_PER_S).values
    assert "s too early; send it again. If it is refused again, set the clock of its sender, which is behind" in refused
    for stall_s in STALLS_S:
        sent_ns = time.time_ns() - round((stall_s + 60.0) * NS_PER_S)
        for service in (READING.name, URGENT.name, SERVICES):
            assert ask(service, sent_ns).result, service
        assert ask("/estop", sent_ns).result
        wait_for(lambda: robot.runtime.session.stopped_by)
        robot.reset()


def test_a_reset_clears_no_stop_that_came_after_it_was_sent(robot: Robot):
    session = robot.runtime.session
    for _ in range(2):  # the second one comes while the robot is stopped
        before_ns = robot.stop("STOP")
        wait_for(lambda: session.state.stops == session.stops)
        for stall_s in STALLS_S:
            assert is_too_old(ask("/reset", before_ns - round(stall_s * NS_PER_S)), "/reset")
            assert session.faults
    wait_for(lambda: ask("/reset", time.time_ns()).result)
    assert not session.faults
    assert ask(MOVING[0], time.time_ns()).result, "sent just after the answer"


@pytest.fixture
def near(runs: Runs) -> tuple[Robot, ZenohTransport, zenoh.Session]:
    """A run on Zenoh, a client, and a session of another make."""
    runs.installed += list(entry_points(group="ibrobot", name="zenoh"))
    endpoint = free_endpoint()
    options = f"type: zenoh, mode: router, listen: [{endpoint}], shared_memory: false, "
    share = SHARE.replace("share: {", "share: {parameters: true, ")
    robot = Robot(runs.start(f"transport={{{options}{share}}}", mode="idle", lockstep=False))
    robot.serve()
    return robot, client(endpoint), zenoh.open(raw_config(endpoint))


def test_over_zenoh(near: tuple[Robot, ZenohTransport, zenoh.Session]):
    robot, own, foreign = near
    wait_for(lambda: {*CORE[1:], *MOVING} <= {each.name for each in own.shared_services(WAIT_S)})
    names = [each.name for each in own.shared_services(WAIT_S)]
    (parameters,) = [name for name in names if name.endswith("/set_parameters")]
    with foreign:

        def json(name: str, attached: bytes | None) -> tuple[bool, str]:
            key = "ibrobot/service/somebody/services"
            (reply,) = foreign.get(key, payload=encode_call(Call(name)), attachment=attached, timeout=WAIT_S)
            assert reply.ok is not None
            answer = decode_answer(reply.ok.payload.to_bytes())
            return answer.result, str(answer.values)

        def ros(name: str, attached: bytes | None) -> tuple[bool, str]:
            key, payload = service_key(0, name, TRIGGER, hashed=True), to_cdr(TRIGGER.request, {})
            (reply,) = foreign.get(key, payload=payload, attachment=attached, timeout=WAIT_S)
            assert reply.ok is not None
            answer = from_cdr(TRIGGER.response, reply.ok.payload.to_bytes())
            return answer["success"], answer["message"]

        def mode(name: str, attached: bytes | None) -> tuple[bool, str]:
            value = {"name": "mode", "value": {"type": 4, "string_value": "idle"}}
            key, payload = service_key(0, parameters, SET, hashed=True), to_cdr(SET.request, {"parameters": [value]})
            (reply,) = foreign.get(key, payload=payload, attachment=attached, timeout=WAIT_S)
            assert reply.ok is not None
            (result,) = from_cdr(SET.response, reply.ok.payload.to_bytes())["results"]
            return result["successful"], result["reason"]

        ways = [
            *((json, name) for name in (*MOVING, "/reset")),
            *((ros, name) for name in (*MOVING, "/reset", "/set_mode/idle")),
            (mode, "/set_mode"),
        ]
        stopped_ns = robot.stop("STOP")
        robot.reset()
        siblings = list(itertools.product(ways, STALLS_S))
        assert len(siblings) == 168
        for (call, name), stall_s in siblings:
            done, why = call(name, attachment(1, stopped_ns - round(stall_s * NS_PER_S), bytes(16)))
            assert not done
            assert "refused, it was sent before the robot was last stopped or reset, " in why
        assert robot.calls == []
        for call, name in ways:
            for attached in (None, attachment(1, time.time_ns(), bytes(16))):
                assert call(name, attached)[0], name
    assert decode_answer(own.request("services", encode_call(Call(MOVING[0])), WAIT_S)).result
    assert own.call_ros(MOVING[0], TRIGGER, {}, WAIT_S)["success"]


def test_actions_over_zenoh(near: tuple[Robot, ZenohTransport, zenoh.Session], monkeypatch: pytest.MonkeyPatch):
    robot, own, foreign = near
    foreign.close()
    kind = action_type("ibrobot_msgs/action/RecordEpisode")
    service = Service("/record_episode/start/it", Prompt, Ended, ros_type=kind.name)
    robot.runtime.session.bus.serve(service, partial(robot.carry_out, "it", Ended(True, "recorded")))
    wait_for(lambda: (service.name, kind.name) in actions_of(own.shared_services(WAIT_S)))
    stopped_ns = robot.stop("STOP")
    robot.reset()
    with monkeypatch.context() as patch:
        patch.setattr(ros_calls, "sent_now", lambda: attachment(1, stopped_ns - NS_PER_S, bytes(16)))
        ended = SentGoal(own, service.name, kind, {"prompt": "pick"}).result(WAIT_S)
    assert (ended.status, ended.result["success"]) == (Status.ABORTED, False)
    assert "/record_episode/start/it: refused, it was sent before the robot was last" in ended.result["message"]
    assert robot.calls == []
    assert SentGoal(own, service.name, kind, {"prompt": "pick"}).result(WAIT_S).status is Status.SUCCEEDED


def test_requests_say_when_they_were_sent():
    endpoint = free_endpoint()
    far, near = router(endpoint), client(endpoint)
    sent = queue.SimpleQueue[int]()

    def take(payload: Payload, sender: str | None, sent_ns: int) -> bytes:
        sent.put(sent_ns)
        return b""

    def answer(request: dict[str, Any], reply: Reply) -> None:
        sent.put(reply.sent_ns)
        reply({"success": True})

    far.serve_with_urgent("services", take, lambda payload: payload == b"stop", 100, StopWay(make_session(), "a test"))
    far.serve_ros("/lamp", TRIGGER, answer)
    settle(near, far)
    for send in (
        lambda: near.request("services", b"", WAIT_S),
        lambda: near.request("services", b"stop", WAIT_S),
        lambda: near.call_ros("/lamp", TRIGGER, {}, WAIT_S),
    ):
        before_ns = time.time_ns()
        send()
        assert before_ns <= sent.get(timeout=WAIT_S) <= time.time_ns()
