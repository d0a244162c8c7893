"""Agents at a simulated arm: hostile ones, those that are killed, frozen or out of reach, and one that works."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hostile_agents
import pytest
import silenced_agents
from ibrobot_mcp.door import AgentDoor
from ibrobot_mcp.resources import Resources
from ibrobot_mcp.stdio import Pipes
from ibrobot_mcp.tokens import add_token
from ibrobot_terminal.authority import Grant, authority_of
from mcp import Client, StdioServerParameters

from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config

CONFIGS = Path(__file__).parents[2] / "configs"
AGENT = Path(__file__).parents[1] / "shared" / "piped_agent.py"
PATIENCE_S = 60.0


def test_hostile_agents_move_nothing_beyond_their_grants_and_memory_stays_flat() -> None:
    memory: list[float] = []
    run = hostile_agents.attacked(2_000, seed=0, on_part=memory.append)
    calls = sum(count for outcome, count in run.calls.items() if not outcome.startswith("person"))
    assert calls == 2_000
    assert +run.broken == {}
    assert max(run.stop_ticks) <= 10, "a stop by an agent is one within 100 ms"
    assert run.orders_obeyed > 50
    assert {"look", "find", "explain", "check_dataset", "evaluate", "record_episode", "run_policy"} <= set(run.tools)
    assert run.calls["moves"] > 20
    assert run.moved > 1.0, "they are granted motion, too"
    assert run.calls["refused"] > 500
    # Pytest keeps the log. The script shows that it is flat from 2,000 calls on.
    assert memory[-1] - memory[2] < 60.0, f"memory grows: {memory} MB"


class Watched:
    """A run in real time whose agent is at pipes, in a process of its own."""

    def __init__(self, lease: float) -> None:
        overrides = ("simulation.scene={type: empty}", "mcp={http: false}")
        config = load_config(
            CONFIGS / "so101_blind.yaml", sim=True, mode="moveit_planning", overrides=overrides,
            registry=installed_plugins(),
        )  # fmt: skip
        self.runtime = Runtime(Session(config, installed_plugins(), LaunchRequest()))
        self.session = self.runtime.session
        self.door = next(each for each in self.runtime.plan.components if isinstance(each, AgentDoor))
        source, self.to_door = os.pipe()
        self.from_door, sink = os.pipe()
        self.door.pipes = Pipes(source, sink)
        self.runtime.start()
        goal = "shoulder_pan=1.9"
        self.agent = subprocess.Popen(
            [sys.executable, str(AGENT), str(self.from_door), str(self.to_door), goal],
            pass_fds=(self.from_door, self.to_door), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        os.close(self.from_door)
        os.close(self.to_door)
        assert self.agent.stdout is not None
        assert self.agent.stdin is not None
        assert self.agent.stdout.readline() == b"ready\n"
        self.session.bus.call("/agent/arm", Grant(600.0, ("/planning/go_to",), speed=0.05, lease=lease))
        self.agent.stdin.write(b"go\n")
        self.agent.stdin.flush()
        self.until(lambda: self.pan > 0.02)

    @property
    def pan(self) -> float:
        """The commanded position of `shoulder_pan` [rad]."""
        assert self.session.state is not None
        return float(self.session.state.command[0])

    def until(self, condition: Callable[[], bool]) -> None:
        """Let time pass until a condition holds."""
        states, waited = self.session.watch_states(), 0
        while not condition():
            states.get(1.0)
            waited += 1
            assert waited < 100 * PATIENCE_S, "it does not come about"

    def holds(self) -> None:
        """Check that the arm holds, far from its goal, and nobody has authority."""
        self.until(lambda: not authority_of(self.session).status().armed)
        states = self.session.watch_states()
        for _ in range(20):
            states.get(1.0)
        rest = self.pan
        for _ in range(50):
            states.get(1.0)
        assert self.pan == rest
        assert rest < 1.0
        assert self.session.held

    def close(self) -> None:
        self.agent.kill()
        self.agent.wait()
        for pipe in (self.agent.stdin, self.agent.stdout):
            assert pipe is not None
            pipe.close()
        self.runtime.stop()


@pytest.fixture
def watched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Watched]]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    made: list[Watched] = []

    def make(lease: float) -> Watched:
        made.append(Watched(lease))
        return made[-1]

    yield make
    for each in made:
        each.close()


def test_arm_goes_on_while_its_agent_answers_pings(watched: Callable[..., Watched]) -> None:
    run = watched(3.0)
    run.until(lambda: run.pan > 0.6)  # at 0.15 rad/s, that takes longer than the lease
    assert authority_of(run.session).status().armed == "1:piped"


def test_arm_holds_when_its_agent_is_killed(watched: Callable[..., Watched]) -> None:
    run = watched(100.0)
    run.agent.kill()
    run.holds()
    assert run.session.finished.wait(PATIENCE_S), "the run of an agent at pipes ends with it"


def test_arm_holds_when_its_agent_is_frozen_and_stays_so_when_it_thaws(watched: Callable[..., Watched]) -> None:
    run = watched(3.0)
    run.agent.send_signal(signal.SIGSTOP)
    run.holds()
    assert "has been silent for" in authority_of(run.session).status().ended
    at = run.pan
    run.agent.send_signal(signal.SIGCONT)
    states = run.session.watch_states()
    for _ in range(50):
        states.get(1.0)
    assert run.pan == at


@pytest.mark.parametrize("mode", ["auto", "legacy"])
def test_arm_holds_when_its_agent_is_out_of_reach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str) -> None:
    import httpx2
    from mcp.client.streamable_http import streamable_http_client

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    overrides = ("simulation.scene={type: empty}", "mcp={}")
    config = load_config(
        CONFIGS / "so101_blind.yaml",
        sim=True,
        mode="moveit_planning",
        overrides=overrides,
        registry=installed_plugins(),
    )
    runtime = Runtime(Session(config, installed_plugins(), LaunchRequest()))
    session = runtime.session
    door = next(each for each in runtime.plan.components if isinstance(each, AgentDoor))
    runtime.start()
    token = add_token("claude")
    relay = silenced_agents.Relay(int(door.url.split(":")[2].split("/")[0]))

    async def talk() -> None:
        url = f"http://127.0.0.1:{relay.port}/mcp"
        headers = {"Authorization": f"Bearer {token}", "Host": door.url.split("/")[2]}
        async with (
            httpx2.AsyncClient(headers=headers, timeout=httpx2.Timeout(PATIENCE_S)) as http,
            Client(streamable_http_client(url, http_client=http), mode=mode) as client,
        ):
            await client.list_tools()
            session.bus.call("/agent/arm", Grant(600.0, ("/planning/go_to",), speed=0.05, lease=3.0))
            asking = asyncio.create_task(client.call_tool("go_to", {"goal": "shoulder_pan=1.9"}))
            while session.state is None or session.state.command[0] < 0.02:
                await asyncio.sleep(0)
            relay.cut.set()
            while authority_of(session).status().armed:
                await asyncio.sleep(0)
            asking.cancel()
            relay.cut.clear()
            await asyncio.gather(asking, return_exceptions=True)

    try:
        asyncio.run(talk())
        states = session.watch_states()
        for _ in range(20):
            states.get(1.0)
        assert session.state is not None
        rest = session.state.command.copy()
        for _ in range(50):
            states.get(1.0)
        assert (session.state.command == rest).all()
        assert rest[0] < 1.0
        assert session.held
        assert "silent for" in authority_of(session).status().ended
    finally:
        relay.close()
        runtime.stop()


@pytest.mark.parametrize(
    ("moment", "way"), [("policy", "freeze"), ("gripper", "kill"), ("recording", "partition"), ("task", "freeze")]
)
def test_arm_holds_whatever_its_agent_was_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str, way: str
) -> None:
    """`python tests/shared/silenced_agents.py 3` has all moments and ways."""
    for variable in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(variable, str(tmp_path))
    with silenced_agents.SilencedRun(tmp_path / "episodes") as run:
        assert run.silence(moment, way) == "holds"


UPRIGHT = [3.14159, 0.0, 0.0]


class Worker:
    """A scripted agent, by the client of the SDK or another one."""

    def __init__(self, client: Any) -> None:
        self.client = client

    async def call(self, name: str, /, **arguments: Any) -> Any:
        result = await self.client.call_tool(name, arguments)
        assert not result.is_error, result.content
        return result.structured_content

    async def step(self, tool: str, **arguments: Any) -> bool:
        """Perform a step; returns whether it succeeded."""
        answer = await self.call(tool, **arguments)
        while answer["result"] is None:
            answer = await self.call("wait", tool="task_step", number=answer["number"])
        return bool(answer["result"]["outcome"] == "SUCCEEDED")

    async def above(self, name: str, height: float, turn: float = 0.0, tolerance: float = 0.2) -> bool:
        goal = {"object": name, "xyz": [0, 0, height], "rpy": [*UPRIGHT[:2], turn], "angle_tolerance": tolerance}
        return await self.step("move", **goal)

    async def grasp(self, name: str) -> bool:
        """Go to an object, and close the gripper on it."""
        down = {"line": [{"object": name, "axis": "down", "angle_tolerance": 0.2}], "touch": [name, "table"]}
        for turn in (0.0, 1.5708, -1.5708, 3.14159):
            if await self.above(name, 0.07, turn) and await self.step("move", **down):
                return await self.step("gripper", position=-0.1, grasp=name)
        return False


@pytest.mark.long
@pytest.mark.parametrize("kind", ["auto", "legacy", "fastmcp"])
def test_scripted_agent_does_ten_tasks_of_increasing_length(tmp_path: Path, kind: str) -> None:
    """Each task goes on from the one before; the scene's ground truth counts."""
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "XDG_STATE_HOME": str(tmp_path)}
    arguments = ["-m", "ibrobot_core.cli.command", "mcp", "so101_pick_cube", "--sim"]
    command = [sys.executable, "-c", "from ibrobot_core.cli.command import main; main()", *arguments[2:]]
    client: Any
    if kind == "fastmcp":
        fastmcp = pytest.importorskip("fastmcp", reason="needs fastmcp: pip install fastmcp")
        stdio = fastmcp.client.transports.StdioTransport(command[0], command[1:], environment, keep_alive=False)
        client = fastmcp.Client(stdio)
    else:
        client = Client(StdioServerParameters(command=command[0], args=command[1:], env=environment), mode=kind)
    succeeded: list[bool] = []

    async def work() -> None:
        async with client:
            agent = Worker(client)
            assert (await agent.call("state"))["mode"] == "planned"
            grant = [*command[:3], "agent", "arm", "--yes", "--speed", "0.6", "--seconds", "600"]
            granted = await asyncio.to_thread(subprocess.run, grant, env=environment, capture_output=True, text=True)
            assert granted.returncode == 0, granted.stderr
            joints = {"shoulder_pan": 0.3}

            async def position(joint: str) -> float:
                return float((await agent.call("state"))["joints"][joint]["position_rad"])

            succeeded.append((await agent.call("plan_to", goal="home"))["answer"]["code"] == "SUCCESS")
            succeeded.append(await agent.step("gripper", position=0.6) and await position("gripper") > 0.55)
            await agent.step("move", joints=joints)
            succeeded.append(abs(await position("shoulder_pan") - 0.3) < 0.02)
            await agent.step("move", joints={"shoulder_pan": -0.3})
            await agent.step("move", joints=joints)
            succeeded.append(abs(await position("shoulder_pan") - 0.3) < 0.02)
            succeeded.append(await agent.above("cube", 0.12, tolerance=0.4))
            succeeded.append(await agent.grasp("cube"))
            await agent.step("move", line=[{"xyz": [0, 0, 0.07], "relative": True}], touch=["table"])
            succeeded.append(await position("gripper") > 0.02)  # it closes to -0.1 without something between its jaws
            over = {"object": "bin_floor", "xyz": [0, 0, 0.09], "axis": "down", "angle_tolerance": 0.3}
            await agent.step("move", **over)
            succeeded.append(await position("gripper") > 0.02)
            await agent.step("gripper", position=0.6, release="cube")
            for _ in range(100):
                if (await agent.call("state"))["scene_succeeded"]:
                    break
            succeeded.append(bool((await agent.call("state"))["scene_succeeded"]))
            await agent.step("move", pose="rest")
            succeeded.append(abs(await position("shoulder_pan")) < 0.05)

    asyncio.run(work())
    assert succeeded == [True] * 10
    (log,) = (tmp_path / "ibrobot" / "agents").iterdir()
    events = [json.loads(line)["event"] for line in log.read_text().splitlines()]
    assert re.fullmatch(r"joined armed( called)+ left ended", " ".join(events))


@pytest.mark.long
def test_agent_of_the_how_to_picks_up_the_cube(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/how-to/let-an-agent-use-the-robot.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "pick.py").write_text(code, encoding="utf-8")
    program = tmp_path / "bin" / "ibrobot"  # the client passes few variables on
    program.parent.mkdir()
    call = f"exec {sys.executable} -c 'from ibrobot_core.cli.command import main; main()' \"$@\""
    program.write_text(
        f"#!/bin/sh\nexport XDG_RUNTIME_DIR={tmp_path} XDG_STATE_HOME={tmp_path}\n{call}\n", encoding="utf-8"
    )
    program.chmod(0o755)
    environment = {**os.environ, "PATH": f"{program.parent}:{os.environ['PATH']}", "PYTHONUNBUFFERED": "1"}
    agent = subprocess.Popen(
        [sys.executable, tmp_path / "pick.py"],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert agent.stdout is not None
    with agent:
        assert "ask a person" in agent.stdout.readline()
        grant = [str(program), "agent", "arm", "--seconds", "120", "--speed", "0.5"]
        granted = subprocess.run(grant, input="y\n", capture_output=True, text=True, check=True)
        assert "it asks for: /task/run" in granted.stdout
        said = [line for line in agent.stdout.read().splitlines() if not line.startswith("refused:")]
    assert [each.strip() for each in said] == ["SUCCEEDED", "the cube is in the bin: True"]


def test_agents_read_the_robot_without_its_secrets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AGENT_TOKEN", "hunter2-hunter2-hunter2")
    config = load_config(
        CONFIGS / "so101_blind.yaml",
        sim=True,
        overrides=("viewer={type: web, password: '${AGENT_TOKEN}'}",),
        registry=installed_plugins(),
    )
    assert config.viewer is not None
    assert config.viewer.options.password == "hunter2-hunter2-hunter2"
    text = Resources(Session(config, installed_plugins(), LaunchRequest(lockstep=True))).read("ibrobot://robot")[1]
    assert "hunter2" not in text
    assert "shoulder_pan" in text
