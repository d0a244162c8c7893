"""The component of the section: HTTP, pipes, the socket of this machine's user, and the log beside the recordings."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import socket
import stat
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast, override

import httpx2
import pytest
from ibrobot_mcp import audit, commands, ibrobot_commands, ibrobot_sections, persons, stdio
from ibrobot_mcp.commands import AddAgent, ArmAgent, DisarmAgent, ListAgents, RemoveAgent, ShowAgents
from ibrobot_mcp.door import AgentDoor
from ibrobot_mcp.options import McpOptions
from ibrobot_mcp.persons import ask, running, sockets_folder
from ibrobot_mcp.stdio import Pipes, serve_pipes
from ibrobot_mcp.tokens import add_token, agent_of, remove_token
from ibrobot_terminal.authority import authority_of
from ibrobot_testing import SectionSuite, check_descriptor, make_session, stand_in
from mcp import Client
from mcp.client.streamable_http import streamable_http_client
from mcp_types import Implementation

from ibrobot_core.api import HardwareError, IbrobotError
from ibrobot_core.app import Component, RequestError, Session

from .conftest import Rig


def session_with_control() -> Session:
    session = make_session()
    control = {
        "report": {"loop": {}, "counters": {}},
        "running": True,
        "call": lambda do: {},
        "write_plan": lambda plan: None,
    }
    session.control = cast("Any", SimpleNamespace(**control, stops=0))
    session.bus.serve(stand_in("/set_mode"), lambda request: None)
    return session


@pytest.fixture(autouse=True)
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "states"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path


class TestAgentDoor(SectionSuite):
    @override
    def session(self) -> Session:
        return session_with_control()

    @override
    def component(self, session: Session) -> Component:
        return AgentDoor(McpOptions(), session)


def test_descriptor_is_complete() -> None:
    (descriptor,) = ibrobot_sections()
    check_descriptor(descriptor, McpOptions())
    assert {each.name for each in ibrobot_commands()} == {"mcp", "agent"} | {
        f"agent {verb}" for verb in ("add", "remove", "list", "arm", "disarm", "status")
    }


@pytest.fixture
def door() -> Iterator[AgentDoor]:
    made = AgentDoor(McpOptions(), session_with_control())
    made.start()
    yield made
    made.stop()


@pytest.fixture
def token() -> str:
    return add_token("claude")


def client(http: httpx2.AsyncClient, door: AgentDoor, mode: str, name: str = "mcp") -> Client:
    """A client that says that it has a name."""
    info = Implementation(name=name, version="1")
    return Client(streamable_http_client(door.url, http_client=http), mode=mode, client_info=info)


def bearer(token: str) -> httpx2.AsyncClient:
    return httpx2.AsyncClient(headers={"Authorization": f"Bearer {token}"})


OTHERS = [
    "", ".", "claude", "claude.", "codex.{secret}", "claude.{secret}x", "CLAUDE.{secret}", "../claude.{secret}",
    "claude\u0000.{secret}", "claude.{secret}\ud800", "claude/../claude.{secret}", "{secret}", "x" * 10_000,
]  # fmt: skip
"""Texts that are not the token `claude.{secret}`."""


@pytest.mark.parametrize("other", OTHERS)
def test_no_other_text_is_a_token(token: str, other: str) -> None:
    assert agent_of(token) == "claude"
    assert agent_of(other.format(secret=token.partition(".")[2])) == ""


@pytest.mark.parametrize("name", ["", ".", "..", "a.b", "../x", "a/b", "-x", "é", "a" * 41, "a\n"])
def test_names_that_are_no_names_are_refused(name: str) -> None:
    with pytest.raises(RequestError, match="a name has letters, digits"):
        add_token(name)
    with pytest.raises(RequestError, match="has no token; these have one: none"):
        remove_token(name)


def test_person_makes_names_and_takes_away_tokens(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    add, known = AddAgent(name="claude"), ListAgents()
    add.show(add())
    token = capsys.readouterr().out.strip()
    add_token("codex")
    known.show(known())
    assert capsys.readouterr().out == "claude\ncodex\n"
    with pytest.raises(RequestError, match="agent claude has a token; `ibrobot agent remove claude` takes it away"):
        AddAgent(name="claude")()
    kept = folders / "config" / "ibrobot" / "agents"
    assert stat.S_IMODE((kept / "claude").stat().st_mode) == 0o600
    assert not any(token.partition(".")[2] in each.read_text() for each in kept.iterdir())
    RemoveAgent(name="claude")()
    assert agent_of(token) == ""
    with pytest.raises(RequestError, match="agent 'claude' has no token; these have one: codex"):
        RemoveAgent(name="claude")()
    assert agent_of(add_token("claude")) == "claude"
    assert agent_of(token) == "", "the old token stays taken away"


@pytest.mark.parametrize("method", ["GET", "POST", "DELETE"])
@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 401),
        ({"Authorization": "Bearer claude.another-secret-of-this-length"}, 401),
        ({"Authorization": "Bearer {token}", "Origin": "http://evil.example"}, 403),
        ({"Authorization": "Bearer {token}", "Host": "evil.example"}, 403),
        ({"Authorization": "Bearer {token}", "Sec-Fetch-Site": "cross-site"}, 403),
        ({"Authorization": "Bearer {token}"}, 406),
    ],
)
def test_http_needs_a_token_and_its_own_origin(
    door: AgentDoor, token: str, method: str, headers: dict[str, str], status: int
) -> None:
    given = {name: value.format(token=token) for name, value in headers.items()}
    answer = httpx2.request(method, door.url, headers=given, timeout=30)
    # A request that may enter is refused by the protocol for what it lacks.
    assert answer.status_code == status or (status == 406 and answer.status_code in (400, 404, 405, 406, 415))


@pytest.mark.parametrize("mode", ["auto", "legacy"])
def test_agent_over_http_is_named_by_its_token(door: AgentDoor, token: str, mode: str) -> None:
    async def talk() -> None:
        async with bearer(token) as http, client(http, door, mode) as agent:
            assert "state" in {each.name for each in (await agent.list_tools()).tools}
            state = await agent.call_tool("state", {})
            assert state.structured_content["authority"]["agents"] == ["1:claude"]

    asyncio.run(talk())


@pytest.mark.parametrize("hostile_mode", ["auto", "legacy"])
@pytest.mark.parametrize("mode", ["auto", "legacy"])
def test_agent_cannot_take_the_name_or_the_grant_of_another(
    door: AgentDoor, token: str, mode: str, hostile_mode: str
) -> None:
    door.session.bus.serve(stand_in("/test/move"), lambda request: "moves")
    other = add_token("hostile")

    async def talk() -> Any:
        async with bearer(token) as http, client(http, door, mode) as armed:
            await armed.list_tools()
            ask(next(running()), "/agent/arm", {"seconds": 60, "services": ["/test/move"]})
            async with bearer(other) as bad, client(bad, door, hostile_mode, name="claude") as hostile:
                stolen = await hostile.call_tool("test_move", {})
                status = (await hostile.call_tool("state", {})).structured_content["authority"]
            return stolen, status, await armed.call_tool("test_move", {})

    stolen, status, own = asyncio.run(talk())
    assert stolen.is_error
    assert "2:hostile may not move the robot" in stolen.content[0].text
    assert (status["agents"], status["armed"]) == (["1:claude", "2:hostile"], "1:claude")
    assert own.structured_content == {"answer": "moves"}


def test_session_of_another_agent_is_of_no_use(door: AgentDoor, token: str) -> None:
    """Somebody who has read the session's number, and has a token of his own."""
    other = add_token("hostile")
    sessions: list[str] = []

    async def note(response: httpx2.Response) -> None:
        sessions.extend(filter(None, [response.headers.get("mcp-session-id")]))

    async def talk() -> None:
        headers = {"Authorization": f"Bearer {token}"}
        async with (
            httpx2.AsyncClient(headers=headers, event_hooks={"response": [note]}) as http,
            client(http, door, "legacy") as armed,
        ):
            await armed.list_tools()
            ask(next(running()), "/agent/arm", {"seconds": 60, "services": ["/set_mode"]})
            stolen = {"Authorization": f"Bearer {other}", "mcp-session-id": sessions[0]}
            call = {"jsonrpc": "2.0", "id": 9, "method": "tools/call", "params": {"name": "state", "arguments": {}}}
            more = {"Accept": "application/json, text/event-stream"}
            async with httpx2.AsyncClient(headers={**stolen, **more}) as hostile:
                for answer in (
                    await hostile.post(door.url, json=call),
                    await hostile.delete(door.url),
                    await hostile.get(door.url),
                ):
                    assert answer.status_code == 404
            state = await armed.call_tool("state", {})
            assert state.structured_content["authority"]["armed"] == "1:claude"

    asyncio.run(talk())


@pytest.mark.parametrize("mode", ["auto", "legacy"])
def test_agent_whose_token_is_taken_away_is_disconnected_and_its_authority_ends(
    door: AgentDoor, token: str, mode: str
) -> None:
    authority = authority_of(door.session)

    async def talk() -> None:
        async with bearer(token) as http, client(http, door, mode) as armed:
            await armed.list_tools()
            ask(next(running()), "/agent/arm", {"seconds": 60, "services": ["/set_mode"], "lease": 100})
            remove_token("claude")
            while authority.status().agents:
                await asyncio.sleep(0.01)
            assert authority.status().ended == "the agent is gone"
            answer = await http.post(door.url, json={})
            assert answer.status_code == 401

    asyncio.run(talk())


def test_token_is_taken_away_though_pings_have_no_answer(door: AgentDoor, token: str) -> None:
    authority = authority_of(door.session)

    pinged = threading.Event()

    async def never(server: Any, client: Any) -> None:
        pinged.set()
        await asyncio.Event().wait()

    async def talk() -> None:
        async with bearer(token) as http, client(http, door, "legacy") as armed:
            await armed.list_tools()
            ask(next(running()), "/agent/arm", {"seconds": 60, "services": ["/set_mode"], "lease": 100})
            await asyncio.to_thread(pinged.wait)
            remove_token("claude")
            while authority.status().agents:
                await asyncio.sleep(0.01)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ibrobot_mcp.server.AgentServer._ping", never)
        asyncio.run(asyncio.wait_for(talk(), 10))


def test_folder_that_others_may_enter_has_no_tokens_and_ends_no_run(door: AgentDoor, token: str, folders: Path) -> None:
    authority = authority_of(door.session)

    async def talk() -> None:
        async with bearer(token) as http, client(http, door, "legacy") as agent:
            await agent.list_tools()
            (folders / "config" / "ibrobot" / "agents").chmod(0o755)
            while authority.status().agents:
                await asyncio.sleep(0.01)
            assert (await http.post(door.url, json={})).status_code == 401

    asyncio.run(asyncio.wait_for(talk(), 20))
    assert cast("Session", door.session).failure is None
    second = AgentDoor(McpOptions(), session_with_control())
    with pytest.raises(IbrobotError, match="other users may enter it: chmod 700"):
        second.start()
    second.stop()


def test_agent_has_a_few_connections_and_those_of_others_stay(door: AgentDoor, token: str) -> None:
    other = add_token("hostile")
    authority = authority_of(door.session)

    async def talk() -> None:
        async with bearer(token) as http, client(http, door, "legacy") as armed:
            await armed.list_tools()
            for _ in range(6):
                async with bearer(other) as bad, client(bad, door, "legacy") as hostile:
                    await hostile.list_tools()
            names = [each.partition(":")[2] for each in authority.status().agents]
            assert names.count("claude") == 1
            assert names.count("hostile") <= 4

    asyncio.run(talk())


def test_tokens_are_in_no_log(door: AgentDoor, token: str, caplog: pytest.LogCaptureFixture, folders: Path) -> None:
    async def talk() -> None:
        async with bearer(token) as http, client(http, door, "legacy") as agent:
            await agent.list_tools()
            await agent.call_tool("nothing", {"a": 1})
        async with bearer(f"{token}x") as http:
            await http.post(door.url, json={})

    with caplog.at_level("DEBUG"):
        asyncio.run(talk())
    door.stop()
    secret = token.partition(".")[2]
    assert secret not in caplog.text
    assert not any(secret in each.read_text() for each in folders.rglob("*.jsonl"))


def test_large_request_is_refused(door: AgentDoor, token: str) -> None:
    with contextlib.suppress(httpx2.TransportError):  # it may close the connection before all of it was sent
        answer = httpx2.post(
            door.url, content=b"[" * 2_000_000, headers={"Authorization": f"Bearer {token}"}, timeout=30
        )
        assert answer.status_code == 413


class PipedAgent:
    """An agent at the pipes of a server that runs in a thread."""

    def __init__(self, rig: Rig) -> None:
        source, self.to_server = os.pipe()
        self.from_server, sink = os.pipe()
        pipes = Pipes(source, sink)
        self._thread = threading.Thread(target=lambda: asyncio.run(serve_pipes(rig.server.protocol, pipes)))
        self._thread.start()
        self._answers = os.fdopen(self.from_server, "rb")

    def write(self, line: bytes) -> None:
        view = memoryview(line)
        while view:
            view = view[os.write(self.to_server, view) :]

    def read(self) -> Any:
        return json.loads(self._answers.readline())

    def close(self) -> None:
        with contextlib.suppress(OSError):
            os.close(self.to_server)
        self._thread.join()
        self._answers.close()


@pytest.fixture
def piped(rig: Rig) -> Iterator[PipedAgent]:
    agent = PipedAgent(rig)
    yield agent
    agent.close()


HELLO = {
    "jsonrpc": "2.0", "id": 1, "method": "initialize",
    "params": {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "\x1b[31m", "version": "1"}},
}  # fmt: skip


def test_pipes_carry_one_object_in_a_line_and_garbage_ends_nothing(piped: PipedAgent) -> None:
    for garbage in (b"\n", b"{\n", b"\xff\xfe\n", b"[1, 2]\n", b'{"jsonrpc": "2.0"}\n', b"null\n"):
        piped.write(garbage)
    piped.write(json.dumps(HELLO).encode() + b"\n")
    answers = [piped.read()]
    while "result" not in answers[-1]:
        answers.append(piped.read())
    assert answers[-1]["id"] == 1
    assert answers[-1]["result"]["serverInfo"]["name"] == "ibrobot"


def test_line_that_is_too_long_ends_the_connection(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stdio, "LONGEST_LINE", 1000)
    agent = PipedAgent(rig)
    with contextlib.suppress(BrokenPipeError):
        agent.write(b'{"a": "' + b"x" * 5_000 + b'"}\n')
    assert agent._answers.readline() == b""
    agent.close()


def test_agent_that_closes_the_pipe_of_its_answers_is_disconnected(rig: Rig) -> None:
    agent = PipedAgent(rig)
    agent.write(json.dumps(HELLO).encode() + b"\n")
    agent.read()
    agent._answers.close()
    agent._thread.join(timeout=10)
    served = agent._thread.is_alive()
    agent.close()
    assert not served


def test_agent_that_reads_no_answers_is_disconnected_before_they_fill_the_memory(rig: Rig) -> None:
    agent = PipedAgent(rig)
    agent.write(json.dumps(HELLO).encode() + b"\n")
    agent.read()
    call = json.dumps({"jsonrpc": "2.0", "id": 2, "method": "tools/list"}).encode() + b"\n"
    with contextlib.suppress(BrokenPipeError):
        agent.write(call * 2_000)
    agent._thread.join(timeout=10)
    served = agent._thread.is_alive()
    agent.close()
    assert not served


def test_person_grants_by_the_command(door: AgentDoor, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(IbrobotError, match="no agent is connected: start its program"):
        ArmAgent(yes=True)()
    agent = authority_of(door.session).join("claude")
    ArmAgent(yes=True, seconds=9)()
    assert "1:claude may move the robot for 9 s at 25% of its speed" in capsys.readouterr().out
    command = ShowAgents()
    command.show(command())
    assert "1:claude: 9 s left at 25%, /planning/go_to" in capsys.readouterr().out
    DisarmAgent()()
    command.show(command())
    assert capsys.readouterr().out == "connected: 1:claude\nthe last authority ended: disarmed\n"
    authority_of(door.session).leave(agent)


def test_grant_is_for_the_agent_that_the_person_was_shown(
    door: AgentDoor, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another one takes its place while the person is asked."""
    authority = authority_of(door.session)
    first = authority.join("claude")

    def asked(question: str, *, flag: str) -> bool:
        assert "1:claude on tester: for 300 s" in capsys.readouterr().out
        authority.leave(first)
        authority.join("claude")
        return True

    monkeypatch.setattr("ibrobot_mcp.commands.confirm", asked)
    with pytest.raises(IbrobotError, match="name one agent by `agent`; connected: 2:claude"):
        ArmAgent()()
    assert authority.status().armed == ""


@pytest.mark.parametrize(("named", "armed"), [("claude", "1:claude"), ("1:claude", "1:claude"), ("codex", "2:codex")])
def test_person_names_an_agent_with_or_without_its_number(door: AgentDoor, named: str, armed: str) -> None:
    authority = authority_of(door.session)
    for name in ("claude", "codex", "twin", "twin"):
        authority.join(name)
    ArmAgent(yes=True, agent=named)()
    assert authority.status().armed == armed
    for unclear in ("", "twin", "nobody"):
        with pytest.raises(RequestError, match="name one agent by --agent; connected: 1:claude, 2:codex, 3:twin, 4"):
            ArmAgent(yes=True, agent=unclear)()


def test_user_without_a_name_may_grant(door: AgentDoor, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container that runs as a number."""

    def nameless() -> str:
        raise KeyError("uid not found")

    monkeypatch.setattr("getpass.getuser", nameless)
    authority_of(door.session).join("claude")
    ArmAgent(yes=True)()
    grant = authority_of(door.session).status().grant
    assert grant is not None
    assert grant.by == str(os.getuid())


@pytest.mark.parametrize(
    ("service", "why"),
    [
        ("/set_mdoe", "--allow /set_mdoe: nobody serves it in mode idle, did you mean '/set_mode'?"),
        ("/agent/arm", "--allow /agent/arm: it is for persons only, and cannot be granted"),
        ("/agent/status", "--allow /agent/status: it moves nothing, so that it needs no grant"),
        ("/agent/disarm", "--allow /agent/disarm: it moves nothing, so that it needs no grant"),
        ("", "--allow : nobody serves it"),
    ],
)
def test_services_that_cannot_be_granted_are_refused_with_the_reason(door: AgentDoor, service: str, why: str) -> None:
    authority_of(door.session).join("claude")
    with pytest.raises(IbrobotError, match=re.escape(why)):
        ask(next(running()), "/agent/arm", {"seconds": 60, "services": [service]})
    ask(next(running()), "/agent/arm", {"seconds": 60, "services": ["/set_mode", "/planning/go_to"]})


def test_several_persons_are_answered_at_once(door: AgentDoor) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(5):  # these say nothing
            idle = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            idle.connect(str(next(running())))
        assert ask(next(running()), "/agent/status")["agents"] == []


def test_an_agent_cannot_take_the_sessions_of_others(
    door: AgentDoor, token: str, caplog: pytest.LogCaptureFixture
) -> None:
    other = add_token("hostile")

    async def talk() -> list[int]:
        first = {
            "jsonrpc": "2.0", "id": 1, "method": "initialize",
            "params": {
                "protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "x", "version": "1"},
            },
        }  # fmt: skip
        accepts = {"Accept": "application/json, text/event-stream"}
        async with bearer(other) as bad, bearer(token) as http:
            taken = [(await bad.post(door.url, json=first, headers=accepts)).status_code for _ in range(10)]
            return [*taken, (await http.post(door.url, json=first, headers=accepts)).status_code]

    assert asyncio.run(talk()) == [200] * 8 + [503] * 2 + [200]
    assert "session" not in caplog.text, "a flood of them would hide the lines of the run"


def test_person_sees_what_the_agent_asks_for_before_granting_it(
    door: AgentDoor, capsys: pytest.CaptureFixture[str]
) -> None:
    """A person who grants by the command sees the request, and why there is no path."""
    bus, authority = door.session.bus, authority_of(door.session)
    bus.serve(stand_in("/planning/go_to"), lambda request: None)
    agent = authority.join("claude")
    with pytest.raises(HardwareError, match="may not move the robot"):
        authority.call(agent, "/planning/go_to", {"goal": "home"})
    ArmAgent(yes=True)()
    shown = capsys.readouterr().out
    assert 'it asks for: /planning/go_to {"goal": "home"}\n' in shown
    assert re.search(r"^path: none: .*/planning/plan", shown, re.MULTILINE)
    assert authority.status().armed == agent.name


def test_person_can_grant_what_takes_long_to_plan(
    door: AgentDoor, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow(path: Path, service: str, request: Any = None) -> Any:
        if service == persons.ASKED:
            raise IbrobotError(f"{path.name} does not answer: timed out")
        return ask(path, service, request)

    monkeypatch.setattr(commands, "ask", slow)
    authority = authority_of(door.session)
    agent = authority.join("claude")
    ArmAgent(yes=True)()
    assert re.search(r"^what it asks for is not known: .* does not answer: timed out$", capsys.readouterr().out, re.M)
    assert authority.status().armed == agent.name


def test_region_that_is_given_twice_is_refused(door: AgentDoor) -> None:
    with pytest.raises(RequestError, match=r"--region position\.elbow: it is given twice"):
        ArmAgent(yes=True, region=("position.elbow=0:1", "position.elbow=-9:9"))()


@pytest.mark.parametrize("region", ["tool.position", "tool.position=", "tool.position=1", "=1:2", "a=1:2:3", "a=x:y"])
def test_regions_that_make_no_sense_are_refused(door: AgentDoor, region: str) -> None:
    with pytest.raises(RequestError, match=r"write e\.g\. tool\.position=0\.1:0\.4"):
        ArmAgent(yes=True, region=(region,))()


def test_no_run_is_said(folders: Path) -> None:
    with pytest.raises(RequestError, match="no robot with a door for agents runs here"):
        DisarmAgent()()


def test_socket_serves_no_other_service(door: AgentDoor) -> None:
    (path,) = running()
    with pytest.raises(IbrobotError, match="this socket serves /agent/arm, /agent/disarm, /agent/status"):
        ask(path, "/reset")


def test_socket_of_a_killed_run_goes_and_garbage_ends_nothing(door: AgentDoor) -> None:
    left = sockets_folder() / "dead.1"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as old:
        old.bind(str(left))
    (sockets_folder() / "folder").mkdir()
    (path,) = running()
    assert not left.exists()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as garbage:
        garbage.connect(str(path))
        garbage.sendall(b"{")
        garbage.shutdown(socket.SHUT_WR)
        garbage.recv(10)
    assert ask(path, "/agent/status")["agents"] == []


def test_folder_that_others_may_enter_is_refused(folders: Path) -> None:
    (folders / "ibrobot").mkdir(mode=0o700)
    (folders / "ibrobot").chmod(0o755)
    with pytest.raises(IbrobotError, match="other users may enter it: chmod 700"):
        sockets_folder()


def test_folder_is_the_same_for_a_program_that_starts_with_few_variables(
    folders: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the SDK of the protocol starts `ibrobot mcp`; the person's terminal has those of the session."""
    monkeypatch.setattr("ibrobot_mcp.persons._RUNTIMES", folders / "run")
    monkeypatch.setattr("ibrobot_mcp.persons._WITHOUT", folders / "tmp")
    session = folders / "run" / str(os.getuid())
    session.mkdir(parents=True)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(session))
    monkeypatch.setenv("TMPDIR", str(folders / "elsewhere"))
    of_terminal = sockets_folder()
    for variable in ("XDG_RUNTIME_DIR", "TMPDIR"):
        monkeypatch.delenv(variable)
    assert sockets_folder() == of_terminal == session / "ibrobot"
    of_terminal.rmdir()
    session.rmdir()
    assert sockets_folder() == folders / "tmp" / f"ibrobot-{os.getuid()}"


def test_nothing_but_sockets_of_killed_runs_is_removed_from_the_folder(folders: Path) -> None:
    folder = sockets_folder()
    kept = [folder / "notes.txt", folder / "folder", folder / "link"]
    kept[0].write_text("mine")
    kept[1].mkdir()
    kept[2].symlink_to(kept[0])
    assert list(running()) == []
    assert all(each.exists() for each in kept)


def test_folder_that_another_place_stands_for_is_refused(folders: Path) -> None:
    (folders / "keys").mkdir(mode=0o700)
    (folders / "ibrobot").symlink_to(folders / "keys")
    with pytest.raises(IbrobotError, match="is a link"):
        sockets_folder()


def test_socket_of_a_run_that_is_busy_stays(folders: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as busy:
        busy.bind(str(sockets_folder() / "busy.1"))
        busy.listen(0)
        with contextlib.ExitStack() as stack:
            for _ in range(3):
                waiting = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
                waiting.setblocking(False)
                with contextlib.suppress(BlockingIOError):
                    waiting.connect(str(sockets_folder() / "busy.1"))
            assert [each.name for each in running(0.05)] == ["busy.1"]


@pytest.mark.parametrize(
    "request_",
    [
        "[" * 60_000,
        '{"service": ' * 5_000,
        "null",
        "[]",
        "NaN",
        '{"service": ["/agent/arm"]}',
        '{"service": "/agent/arm", "request": 3}',
        '{"service": "/agent/arm", "request": {"seconds": NaN, "services": ["/x"]}}',
        '{"service": "/agent/arm", "request": {"seconds": 1e999, "services": ["/x"]}}',
        '{"service": "/agent/arm", "request": {"seconds": "60", "services": "/x"}}',
        '{"service": "/agent/arm", "request": {"seconds": 60, "services": ["/x"], "region": {"a": [[NaN, 1]]}}}',
        '{"service": "/agent/arm", "request": {"seconds": 60, "services": [], "agent": "\\ud800"}}',
        "\x00\xff",
    ],
)
def test_persons_are_heard_after_any_request(door: AgentDoor, request_: str) -> None:
    (path,) = running()
    agent = authority_of(door.session).join("claude")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as garbage:
        garbage.connect(str(path))
        garbage.sendall(request_.encode("latin-1"))
        garbage.shutdown(socket.SHUT_WR)
        with contextlib.suppress(OSError):
            garbage.recv(1000)
    assert ask(path, "/agent/status")["armed"] == ""
    authority_of(door.session).leave(agent)


def test_log_is_a_line_for_each_event(door: AgentDoor, folders: Path) -> None:
    agent = authority_of(door.session).join('x"\n{"event": "forged"}')
    with pytest.raises(IbrobotError):
        authority_of(door.session).call(agent, "/nothing", {"a": "\n"})
    door.stop()
    (path,) = (folders / "states" / "ibrobot" / "agents").iterdir()
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [each["event"] for each in lines] == ["joined", "refused"]
    assert {each["agent"] for each in lines} == {"1:xeventforged"}
    assert {each["robot"] for each in lines} == {"tester"}


def log_file(folders: Path) -> Path:
    path = folders / "states" / "ibrobot" / "agents" / "tester.jsonl"
    path.parent.mkdir(parents=True)
    return path


def test_full_disk_ends_the_authority_and_loses_nothing_in_silence(
    folders: Path, token: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit, "_AGAIN_S", 0.001)
    path = log_file(folders)
    path.symlink_to("/dev/full")
    door = AgentDoor(McpOptions(), session_with_control())
    door.start()
    authority = authority_of(door.session)
    authority.join("claude")
    while not door._audit.trouble:
        threading.Event().wait(0.001)
    grant = {"seconds": 60, "services": ["/set_mode"]}
    with pytest.raises(HardwareError, match=r"cannot be written: .*No space left on device; nothing was granted"):
        door.session.bus.call("/agent/arm", grant)
    assert authority.status().armed == ""
    path.unlink()  # there is space again; the file is opened only once
    door.stop()
    assert "3 entries of the log of agents were not written" in caplog.text
    assert caplog.text.count("no agent has authority until it can") == 1


class SlowDisk:
    """A file that takes nothing before it is `drained`."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self._end = os.open(path, os.O_RDWR | os.O_NONBLOCK)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(self._end, b"." * 4096)

    def drained(self, events: int) -> list[str]:
        """The events that are written from now on, once there are so many."""
        os.set_blocking(self._end, True)
        text = b""
        while text.count(b"\n") < events:
            text += os.read(self._end, 65536)
        return [json.loads(line)["event"] for line in text.lstrip(b".").splitlines()]

    def close(self) -> None:
        os.close(self._end)


def test_slow_disk_delays_no_end_of_an_authority_and_loses_nothing(
    folders: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = SlowDisk(log_file(folders))
    door = AgentDoor(McpOptions(http=False), session_with_control())
    door.start()
    authority = authority_of(door.session)
    agent = authority.join("claude")
    door.session.bus.call("/agent/arm", {"seconds": 60, "services": ["/set_mode"]})
    door.step(0)
    assert authority.status().armed == "1:claude"
    monkeypatch.setattr(audit, "LATE_S", 0.0)
    door.step(0)
    assert "has not been written for 0 s" in authority.status().ended
    monkeypatch.setattr(audit, "LATE_S", 60.0)
    authority.leave(agent)
    assert disk.drained(4) == ["joined", "armed", "ended", "left"]
    door.stop()
    disk.close()


def test_log_that_is_removed_is_begun_again(door: AgentDoor, folders: Path) -> None:
    path = audit.audit_path(door.session)
    authority = authority_of(door.session)
    authority.join("claude")
    while not path.exists() or b"joined" not in path.read_bytes():
        threading.Event().wait(0.01)
    path.unlink()
    path.parent.rmdir()
    ask(next(running()), "/agent/arm", {"seconds": 60, "services": ["/set_mode"]})
    door.stop()
    assert [json.loads(line)["event"] for line in path.read_text().splitlines()] == ["armed", "ended"]


def test_line_that_a_full_disk_has_torn_stays_alone(door: AgentDoor, folders: Path) -> None:
    path = log_file(folders)
    path.write_text('{"event": "cal')
    authority_of(door.session).join("claude")
    door.stop()
    torn, whole = path.read_text().splitlines()
    assert torn == '{"event": "cal'
    assert json.loads(whole)["event"] == "joined"


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"host": "0.0.0.0"}, "can be reached from the network, which needs TLS"),
        ({"certificate": Path("x")}, "certificate and key belong together"),
        ({"port": 70_000}, "must be at most 65535"),
    ],
)
def test_unsafe_options_are_refused(options: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        McpOptions(**options)
