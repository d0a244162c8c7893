"""The component of the section: HTTP, pipes, the socket of this machine's user, and the log beside the recordings."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast, override

import httpx2
import pytest
from ibrobot_mcp import ibrobot_commands, ibrobot_sections, stdio
from ibrobot_mcp.audit import authority_of
from ibrobot_mcp.commands import ArmAgent, DisarmAgent, ShowAgents
from ibrobot_mcp.door import AgentDoor
from ibrobot_mcp.options import McpOptions
from ibrobot_mcp.persons import ask, running, sockets_folder
from ibrobot_mcp.stdio import Pipes, serve_pipes
from ibrobot_testing import SectionSuite, check_descriptor, make_session, stand_in
from mcp import Client
from mcp.client.streamable_http import streamable_http_client
from mcp_types import Implementation

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import SET_MODE, Component, RequestError, Session

from .conftest import Rig

TOKEN = "0123456789abcdef-test"


def session_with_control() -> Session:
    session = make_session()
    control = {
        "report": {"loop": {}, "counters": {}},
        "running": True,
        "call": lambda do: {},
        "write_plan": lambda plan: None,
    }
    session.control = cast("Any", SimpleNamespace(**control, stops=0))
    session.bus.serve(stand_in(SET_MODE.name), lambda request: None)
    return session


@pytest.fixture(autouse=True)
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "states"))
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
    assert {each.name for each in ibrobot_commands()} == {"mcp", "agent", "agent arm", "agent disarm", "agent status"}


@pytest.fixture
def door() -> Iterator[AgentDoor]:
    made = AgentDoor(McpOptions(token=TOKEN), session_with_control())
    made.start()
    yield made
    made.stop()


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 401),
        ({"Authorization": "Bearer another-token-of-this-length"}, 401),
        ({"Authorization": f"Bearer {TOKEN}", "Origin": "http://evil.example"}, 403),
        ({"Authorization": f"Bearer {TOKEN}", "Host": "evil.example"}, 403),
        ({"Authorization": f"Bearer {TOKEN}", "Sec-Fetch-Site": "cross-site"}, 403),
        ({"Authorization": f"Bearer {TOKEN}"}, 406),
    ],
)
@pytest.mark.parametrize("method", ["GET", "POST", "DELETE"])
def test_http_needs_the_token_and_its_own_origin(
    door: AgentDoor, method: str, headers: dict[str, str], status: int
) -> None:
    answer = httpx2.request(method, door.url, headers=headers, timeout=30)
    # A request that may enter is refused by the protocol for what it lacks.
    assert answer.status_code == status or (status == 406 and answer.status_code in (400, 404, 405, 406, 415))


@pytest.mark.parametrize("mode", ["auto", "legacy"])
def test_agent_over_http(door: AgentDoor, mode: str) -> None:
    async def talk() -> None:
        async with (
            httpx2.AsyncClient(headers={"Authorization": f"Bearer {TOKEN}"}) as http,
            Client(streamable_http_client(door.url, http_client=http), mode=mode) as client,
        ):
            assert "state" in {each.name for each in (await client.list_tools()).tools}
            state = await client.call_tool("state", {})
            assert state.structured_content["authority"]["agents"] == ["1:mcp"]

    asyncio.run(talk())


@pytest.mark.parametrize("mode", ["auto", "legacy"])
def test_agents_of_two_programs_over_http_are_two(door: AgentDoor, mode: str) -> None:
    async def talk(name: str) -> Any:
        async with (
            httpx2.AsyncClient(headers={"Authorization": f"Bearer {TOKEN}"}) as http,
            Client(
                streamable_http_client(door.url, http_client=http),
                mode=mode,
                client_info=Implementation(name=name, version="1"),
            ) as client,
        ):
            await client.list_tools()
            return (await client.call_tool("state", {})).structured_content["authority"]["agents"]

    async def both() -> Any:
        await talk("first")
        return await talk("second")

    assert "2:second" in asyncio.run(both())


def test_large_request_is_refused(door: AgentDoor) -> None:
    with contextlib.suppress(httpx2.TransportError):  # it may close the connection before all of it was sent
        answer = httpx2.post(
            door.url, content=b"[" * 2_000_000, headers={"Authorization": f"Bearer {TOKEN}"}, timeout=30
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
    with pytest.raises(IbrobotError, match="name one agent by `agent`; connected: none"):
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
    door.step(0)
    (path,) = (folders / "states" / "ibrobot" / "agents").iterdir()
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [each["event"] for each in lines] == ["joined", "refused"]
    assert {each["agent"] for each in lines} == {"1:xeventforged"}
    assert {each["robot"] for each in lines} == {"tester"}


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"host": "0.0.0.0"}, "can be reached from the network, which needs TLS"),
        ({"token": "short"}, "token must have at least 16 characters"),
        ({"certificate": Path("x")}, "certificate and key belong together"),
        ({"port": 70_000}, "must be at most 65535"),
    ],
)
def test_unsafe_options_are_refused(options: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        McpOptions(**options)
