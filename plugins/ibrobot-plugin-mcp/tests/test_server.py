"""What agents see and may do, by the client of the SDK."""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import sys
import threading
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from ibrobot_mcp.server import PIPES, Allowance, has_failed, key_of
from ibrobot_mcp.server import Client as Connected
from mcp import Client, MCPError
from mcp.server.auth.middleware.bearer_auth import AuthenticatedUser
from mcp.server.auth.provider import AccessToken
from mcp_types import EmptyResult

from .conftest import STATE, STOP, Rig

MODES = pytest.mark.parametrize("mode", ["auto", "legacy"])


def text(result: Any) -> str:
    return str(result.content[0].text)


def contents(result: Any) -> str:
    return str(result.contents[0].text)


@MODES
def test_tools_are_the_services_as_they_are_declared(rig: Rig, mode: str) -> None:
    tools = {each.name: each for each in rig.talk(lambda client: client.list_tools(), mode).tools}
    assert {"test_move", "test_state", "test_result", "stop", "state", "look", "wait", "authority"} <= set(tools)
    assert not {"test_forget", "agent_arm", "reset"} & set(tools), "services for persons"
    move = tools["test_move"]
    assert move.description == "Move. A person must grant it, see `authority`."
    assert move.input_schema["required"] == ["to"]
    assert move.input_schema["properties"]["to"] == {
        "type": "number", "description": "where to [rad]", "minimum": -1, "maximum": 1,
    }  # fmt: skip
    assert move.input_schema["properties"]["how"]["enum"] == ["gently", "fast"]
    assert (move.annotations.read_only_hint, tools["test_state"].annotations.read_only_hint) == (False, True)


@MODES
def test_agent_reads_and_stops_but_moves_nothing_without_a_grant(rig: Rig, mode: str) -> None:
    async def act(client: Client) -> None:
        assert (await client.call_tool("test_state", {})).structured_content == {"answer": 0.5}
        refused = await client.call_tool("test_move", {"to": 0.3})
        assert refused.is_error
        assert "may not move the robot: ask a person to grant it by /agent/arm" in text(refused)
        assert not (await client.call_tool("stop", {})).is_error

    rig.talk(act, mode)
    assert rig.moves == ["stop"]


@MODES
def test_granted_motion_answers_with_its_result(rig: Rig, mode: str) -> None:
    async def act(client: Client) -> None:
        await client.list_tools()
        rig.grant()
        moved = await client.call_tool("test_move", {"to": 0.3})
        assert moved.structured_content == {"number": 1, "result": "motion 1 has ended"}
        assert json.loads(text(moved)) == moved.structured_content
        waited = await client.call_tool("wait", {"tool": "test_move", "number": 1, "seconds": 0})
        assert waited.structured_content == moved.structured_content

    rig.talk(act, mode)
    assert rig.moves[0] == 0.3


@pytest.mark.parametrize(
    ("tool", "arguments", "why"),
    [
        ("test_move", {"to": 2}, "to: 2.0 is too large, must be at most 1"),
        ("test_move", {"to": "far"}, "to: expected a number, got 'far'"),
        ("test_move", {}, "to: required key is missing"),
        ("test_move", {"to": 0, "fsat": 1}, "fsat: unknown key"),
        ("wait", {"tool": "state", "number": 1}, "'state' answers with no number; these do: test_move"),
        ("look", {"camera": "top"}, "no camera 'top' sends pictures; these do: none"),
        ("look", {}, "the robot has no camera; `state` and `world` show the rest"),
        ("test_forget", {}, "there is no tool 'test_forget' in this mode; the tools are: authority, "),
        ("no\x1b[31m tool", {}, "there is no tool"),
    ],
)
def test_errors_say_what_would_be_right(rig: Rig, tool: str, arguments: Any, why: str) -> None:
    async def act(client: Client) -> None:
        await client.list_tools()
        rig.grant()
        result = await client.call_tool(tool, arguments)
        assert result.is_error
        assert why in text(result)

    rig.talk(act)
    assert not any(isinstance(each, float) for each in rig.moves)


@pytest.mark.parametrize(
    ("answer", "failed"),
    [
        ({"number": 2, "result": {"success": False, "outcome": "CANCELLED"}}, True),
        ({"number": 2, "result": {"success": True}}, False),
        ({"number": 2, "result": None, "next": "it is under way"}, False),
        ({"number": 2, "result": "ended"}, False),
        ({"answer": {"success": False}}, False),
        ([1], False),
    ],
)
def test_a_motion_that_did_not_succeed_is_an_error_to_the_agent(answer: Any, failed: bool) -> None:
    assert has_failed(answer) is failed


def test_agent_that_calls_too_often_is_refused_and_may_still_stop(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ibrobot_mcp.server.time.monotonic", lambda: 100.0)

    async def act(client: Client) -> None:
        results = [await client.call_tool("test_state", {}) for _ in range(150)]
        refused = [each for each in results if each.is_error]
        assert len(refused) == 50
        assert text(refused[0]) == "more than 50 calls per second: call less often"
        assert not (await client.call_tool("stop", {})).is_error

    rig.talk(act)
    assert rig.moves == ["stop"]


def test_agent_that_computes_much_is_refused_until_its_share_has_grown(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, used_s = [100.0], itertools.count(0.0, 6.0)  # each call takes 6 s of a processor
    monkeypatch.setattr("ibrobot_mcp.server.time.monotonic", lambda: now_s[0])
    monkeypatch.setattr("ibrobot_mcp.server.time.thread_time", lambda: next(used_s))

    async def act(client: Client) -> None:
        assert not (await client.call_tool("test_state", {})).is_error
        refused = await client.call_tool("test_state", {})
        assert text(refused) == "your calls have used more than 25% of a processor: call again in 4.0 s"
        for _ in range(9):
            assert not (await client.call_tool("stop", {})).is_error
        now_s[0] += 4.1 + 9 * 24.0  # stops are never refused, and count
        assert not (await client.call_tool("test_state", {})).is_error

    rig.talk(act)
    assert rig.moves == ["stop"] * 9


def test_a_flood_of_lists_is_refused_and_stops_and_calls_are_not(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ibrobot_mcp.server.time.monotonic", lambda: 100.0)

    async def act(client: Client) -> None:
        await client.list_tools()  # the client keeps them
        for _ in range(97):
            await client.list_resources()
        with pytest.raises(MCPError, match="more than 50 requests per second: ask less often"):
            [await client.list_resources() for _ in range(5)]
        assert not (await client.call_tool("test_state", {})).is_error
        assert not (await client.call_tool("stop", {})).is_error

    rig.talk(act)
    assert rig.moves == ["stop"]


def test_tools_are_made_again_only_when_the_services_have_changed(rig: Rig) -> None:
    tools = rig.server._tools
    assert tools.described() is tools.described()
    rig.session.bus.unserve(STATE)
    assert "test_state" not in {each.name for each in tools.described()}
    assert "test_state" not in tools.all()


class Slow:
    """A service that reads, and waits at each call until it may go on."""

    def __init__(self, rig: Rig) -> None:
        self.may_go_on = threading.Semaphore(0)
        self.under_way = self.most = 0
        self.begun = threading.Semaphore(0)
        self._lock = threading.Lock()
        rig.session.bus.unserve(STATE)
        rig.session.bus.serve(STATE, self.read)

    def read(self, request: Any) -> float:
        with self._lock:
            self.under_way += 1
            self.most = max(self.most, self.under_way)
        self.begun.release()
        self.may_go_on.acquire()
        self.under_way -= 1
        return 0.5


def test_reading_of_an_agent_is_one_after_the_other_and_holds_nobody_else_up(rig: Rig) -> None:
    slow = Slow(rig)

    async def connected(name: str) -> Any:
        return await rig.server._client(asked(name))

    async def both() -> None:
        tool = rig.server._tools.all()["test_state"]
        first, second = await connected("first"), await connected("second")

        def call(client: Any) -> asyncio.Task[Any]:
            run = partial(tool.run, client.agent, {})
            return asyncio.create_task(rig.server._carried_out(client, run, tool.way))

        calls = [call(first) for _ in range(5)]
        await asyncio.to_thread(slow.begun.acquire)
        calls.append(call(second))
        await asyncio.to_thread(slow.begun.acquire)
        assert slow.under_way == 2
        slow.may_go_on.release(6)
        await asyncio.gather(*calls)
        assert slow.most == 2

    asyncio.run(both())


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has priorities of threads")
def test_threads_that_read_leave_the_processor_to_others_and_stops_do_not(rig: Rig) -> None:
    nice: dict[str, int] = {}

    def note(name: str, answer: Any, request: Any) -> Any:
        nice[name] = os.getpriority(os.PRIO_PROCESS, 0)
        return answer

    for service, answer in ((STATE, 0.5), (STOP, None)):
        rig.session.bus.unserve(service)
        rig.session.bus.serve(service, partial(note, service.name, answer))

    async def act(client: Client) -> None:
        await client.call_tool("test_state", {})
        await client.call_tool("stop", {})

    rig.talk(act)
    own = os.getpriority(os.PRIO_PROCESS, 0)
    assert nice == {STATE.name: min(own + 10, 19), STOP.name: own}


def test_service_with_a_bug_is_reported_and_ends_nothing(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    rig.session.bus.unserve("/test/state")
    rig.session.bus.serve(STATE, lambda request: 1 / 0)

    async def act(client: Client) -> None:
        result = await client.call_tool("test_state", {})
        assert result.is_error
        assert "the tool failed: ZeroDivisionError" in text(result)
        assert not (await client.call_tool("state", {})).is_error

    rig.talk(act)
    assert not rig.session.finished.is_set()


def test_resources_and_prompts(rig: Rig) -> None:
    async def act(client: Client) -> None:
        found = {each.uri for each in (await client.list_resources()).resources}
        names = ("robot", "services", "episodes", "datasets", "evaluations", "documentation")
        assert found == {f"ibrobot://{name}" for name in names}
        templates = {each.uri_template for each in (await client.list_resource_templates()).resource_templates}
        assert templates == {"ibrobot://evaluations/{name}", "ibrobot://documentation/{name}"}
        packages = json.loads(contents(await client.read_resource("ibrobot://documentation")))["packages"]
        assert packages["ibrobot-plugin-mcp"].startswith("A robot for language models")
        assert "# ibrobot-plugin-mcp" in contents(
            await client.read_resource("ibrobot://documentation/ibrobot-plugin-mcp")
        )
        for wrong in ("documentation/pip", "documentation/../robot", "evaluations/none", "evaluations/"):
            with pytest.raises(MCPError, match="there is no "):
                await client.read_resource(f"ibrobot://{wrong}")
        services = json.loads(contents(await client.read_resource("ibrobot://services")))
        assert services["/test/forget"]["persons"] is True
        assert "no section `recording`" in contents(await client.read_resource("ibrobot://episodes"))
        with pytest.raises(MCPError, match="there is no resource 'file:///etc/passwd'"):
            await client.read_resource("file:///etc/passwd")
        prompts = {each.name for each in (await client.list_prompts()).prompts}
        assert prompts == {"pick", "look_around", "try_policy", "evaluate", "why_failed"}
        asked = await client.get_prompt("pick", {"object": "cube"})
        assert "Pick up the object named 'cube'" in str(asked.messages[0].content)
        with pytest.raises(MCPError, match="give the argument object"):
            await client.get_prompt("pick", {})

    rig.talk(act)


def test_pings_are_signs_of_life_of_clients_that_answer_them(rig: Rig) -> None:
    async def act(client: Client) -> None:
        await client.list_tools()
        (known,) = rig.server._clients.values()
        known.agent.heard_ns = -1
        await rig.server._ping(known)
        assert known.agent.heard_ns >= 0

    rig.talk(act, "legacy")


@pytest.mark.parametrize("answer", [{"_meta": 5}, {"_meta": []}, {"resultType": 5}])
def test_answers_to_pings_that_make_no_sense_end_nothing(rig: Rig, answer: Any) -> None:
    async def act(client: Client) -> None:
        await client.list_tools()
        (known,) = rig.server._clients.values()

        async def send_ping() -> None:
            EmptyResult.model_validate(answer)

        known.session = SimpleNamespace(send_ping=send_ping)
        known.agent.heard_ns = -1
        await rig.server._ping(known)
        assert known.agent.heard_ns == -1

    rig.talk(act, "legacy")


def test_schemas_are_made_once(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Agents may list the tools as often as they like."""

    async def act(client: Client) -> None:
        first = (await client.list_tools()).tools
        monkeypatch.setattr("ibrobot_mcp.tools.OptionSchemas", lambda: 1 / 0)
        assert (await client.list_tools()).tools == first

    rig.talk(act, "legacy")


def test_clients_of_the_protocol_without_pings_are_not_alive_by_them(rig: Rig) -> None:
    async def act(client: Client) -> None:
        await client.list_tools()
        (known,) = rig.server._clients.values()
        known.agent.heard_ns = -1
        await rig.server._ping(known)
        assert known.agent.heard_ns == -1

    rig.talk(act, "auto")


def test_calls_that_an_agent_cancels_keep_their_threads_until_they_are_done(rig: Rig) -> None:
    rig.session.bus.unserve(STATE.name)
    begun: list[float] = []
    release = threading.Event()

    def slow(_: Any) -> float:
        begun.append(0.0)
        release.wait(30)
        return 0.5

    rig.session.bus.serve(STATE, slow)

    async def act(client: Client) -> None:
        for _ in range(60):
            call = asyncio.create_task(client.call_tool("test_state", {}))
            await asyncio.sleep(0.001)
            call.cancel()
            await asyncio.gather(call, return_exceptions=True)
        assert not (await client.call_tool("stop", {})).is_error
        release.set()

    rig.talk(act)
    assert len(begun) <= 8
    assert rig.moves == ["stop"]


def asked(name: str = "", session: str = "") -> Any:
    """The context of a request: by HTTP with the token of `name`, or by the pipes."""
    known = SimpleNamespace(client_params=None)
    if not name:
        return SimpleNamespace(session=known, request=None)
    user = AuthenticatedUser(AccessToken(token=f"{name}.secret", client_id=name, scopes=[]))
    headers = {"mcp-session-id": session}
    return SimpleNamespace(session=known, request=SimpleNamespace(headers=headers, scope={"user": user}))


@pytest.mark.parametrize("session", ["", " ", "http", "x", PIPES])
@pytest.mark.parametrize("name", [PIPES, "http", "agent"])
def test_client_of_http_is_never_that_of_the_pipes(rig: Rig, name: str, session: str) -> None:
    async def both() -> None:
        piped, web = await rig.server._client(asked()), await rig.server._client(asked(name, session))
        assert piped.agent is not web.agent
        await rig.server.leave(key_of(name, session))
        assert rig.authority.status().agents == ("1:agent",)

    asyncio.run(both())


def test_connections_of_an_agent_are_bounded_and_the_silent_one_ends(rig: Rig) -> None:
    async def connect() -> None:
        for number in range(10):
            await rig.server._client(asked("claude", f"s{number}"))
        await rig.server._client(asked("codex", "s0"))

    asyncio.run(connect())
    names = [each.partition(":")[2] for each in rig.authority.status().agents]
    assert names == ["claude"] * 4 + ["codex"]


@MODES
def test_agent_that_leaves_blocks_nobody(rig: Rig, mode: str) -> None:
    """Control may let the end of a motion wait."""
    ended, answers = threading.Event(), []

    def hold(*command: Any, **more: Any) -> dict[str, Any]:
        ended.wait(10)
        return {}

    async def talk(client: Client) -> None:
        await client.list_tools()
        rig.grant()
        rig.session.control.call = hold  # type: ignore[method-assign]
        leaving = asyncio.create_task(rig.server.leave(PIPES))
        await asyncio.sleep(0)
        answers.append(await client.list_tools())
        assert not leaving.done()
        ended.set()
        await leaving

    rig.talk(talk, mode)
    assert answers
    assert rig.authority.status().armed == ""


def test_agent_that_answers_no_ping_takes_nothing_from_the_one_that_may_move(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a short lease, the grant of the other one would end while its answer is awaited."""
    monkeypatch.setattr("ibrobot_mcp.server._PING_S", 0.0)
    pings: list[str] = []

    def client(name: str, answers: bool) -> Connected:
        async def send_ping() -> None:
            pings.append(name)
            if not answers:
                await asyncio.Event().wait()

        session = SimpleNamespace(send_ping=send_ping)
        return Connected(rig.authority.join(name), Allowance(0.0), session=session)

    rig.server._clients = {"first": client("good", answers=True), "second": client("silent", answers=False)}
    rig.grant(agent="1:good", lease=1.0)

    async def pinged() -> None:
        asking = asyncio.create_task(rig.server.ping())
        while len(pings) < 5:
            await asyncio.sleep(0)
        asking.cancel()

    asyncio.run(pinged())
    assert pings == ["good"] * 5
