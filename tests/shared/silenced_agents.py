"""Agents that fall silent: killed, frozen or cut off at each moment of their work, while the robot moves for them.

    python tests/shared/silenced_agents.py 3

In real time, in simulation, with each agent in a process of its own, behind a relay that can be cut. Counted are the
times that the authority ended, and that the arm held from then on, also when the agent came back.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from ibrobot_mcp.door import AgentDoor
from ibrobot_mcp.tokens import add_token
from ibrobot_terminal.authority import MOVING, Grant, authority_of

from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config
from ibrobot_core.errors import IbrobotError

CONFIG = Path(__file__).parents[2] / "configs" / "so101_pick_cube.yaml"
AGENT = Path(__file__).with_name("http_agent.py")
PATIENCE_S = 60.0
LEASE_S, SPEED = 2.0, 0.05
"""The motions last several times as long as the lease."""
_STILL_RAD = 1e-3
_BRAKE_TICKS, _WATCHED_TICKS = 30, 50
GRANTED = (*MOVING, "/set_mode", "/record_episode/start", "/record_episode/stop")
WAYS = ("kill", "freeze", "partition")
type Calls = Sequence[tuple[str, Mapping[str, Any]]]


class Relay:
    """Passes bytes between an agent and a server, until it is cut."""

    def __init__(self, port: int) -> None:
        self._port = port
        self.cut = threading.Event()
        self._started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))
        self._thread.start()
        self._started.wait(PATIENCE_S)

    async def _serve(self) -> None:
        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        server = await asyncio.start_server(self._relay, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        self._tasks: set[asyncio.Task[None]] = set()
        self._writers: list[asyncio.StreamWriter] = []
        self._started.set()
        await self._end.wait()
        tasks = tuple(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for writer in self._writers:
            writer.close()
        await asyncio.gather(*(writer.wait_closed() for writer in self._writers), return_exceptions=True)
        server.close()

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._port)
        self._writers += [writer, far_writer]
        for source, sink in ((reader, far_writer), (far_reader, writer)):
            task = asyncio.create_task(self._pass(source, sink))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _pass(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        while data := await source.read(4096):
            if not self.cut.is_set():  # what is cut neither arrives nor ends
                sink.write(data)
        sink.close()

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()


@attrs.frozen
class Moment:
    """What an agent is at when it falls silent."""

    calls: Calls
    """What it calls."""
    joint: str = ""
    """The joint whose motion shows that it is there; none for before a motion."""
    mode: str = "planned"


_PAN: Calls = [("move", {"joints": {"shoulder_pan": 1.5}})]
_TASK = "steps:\n- gripper: {position: 0.05}\n- move: {joints: {shoulder_pan: 1.5}}\n- move: {pose: home}"
MOMENTS: Mapping[str, Moment] = {
    "nothing asked yet": Moment([]),
    "a call on its way": Moment([("go_to", {"goal": "xyz=0.2,-0.1,0.1"})]),
    "approach": Moment([("go_to", {"goal": "shoulder_pan=1.5"})], "shoulder_pan"),
    "step `move`": Moment(_PAN, "shoulder_pan"),
    "straight line": Moment([("move", {"line": [{"xyz": [0.0, 0.0, 0.06], "relative": True}]})], "elbow_flex"),
    "gripper": Moment([("gripper", {"position": 1.6})], "gripper"),
    "task": Moment([("run_task", {"task": _TASK})], "shoulder_pan"),
    "policy": Moment([("run_policy", {"mode": "scripted", "seconds": 60})], "shoulder_lift", "scripted"),
    "mode of a policy": Moment([("enter_mode", {"mode": "scripted"})], "shoulder_lift", "scripted"),
    "recording": Moment([("record_episode", {"prompt": "turn"}), *_PAN], "shoulder_pan"),
}


class SilencedRun:
    """A run in real time, for one agent after another.

    Attributes:
        counts: moment, way and outcome -> how often.
        latest_s: longest time from silence to the end of the authority, by the clock of control [s].
    """

    def __init__(self, folder: Path, seed: int = 0) -> None:
        overrides = ("mcp={}", "tasks={}", f"recording={{type: mcap, root: {folder}, dataset: silenced}}")
        config = load_config(CONFIG, sim=True, mode="planned", overrides=overrides, registry=installed_plugins())
        self.runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(by_operator=True)))
        self.session = self.runtime.session
        self.random = random.Random(seed)
        self.door = next(each for each in self.runtime.plan.components if isinstance(each, AgentDoor))
        self.counts = Counter[tuple[str, str, str]]()
        self.latest_s = 0.0
        self._number = 0

    def __enter__(self) -> SilencedRun:
        self.runtime.start()
        self.host = self.door.url.split("/")[2]
        return self

    def __exit__(self, *raised: object) -> None:
        self.runtime.stop()

    @property
    def command(self) -> np.ndarray:
        """The commanded positions [rad]."""
        assert self.session.state is not None
        return self.session.state.command.copy()

    def until(self, condition: Callable[[], bool], what: str) -> None:
        """Let time pass until a condition holds."""
        states = self.session.watch_states()
        for _ in range(int(100 * PATIENCE_S)):
            if condition():
                return
            states.get(1.0)
        raise AssertionError(
            f"{what} does not come about; mode {self.session.mode}, {authority_of(self.session).status()}"
        )

    def ticks(self, count: int) -> None:
        """Let time pass."""
        states = self.session.watch_states()
        for _ in range(count):
            states.get(1.0)

    def begin(self) -> None:
        """Have the robot at home, in its mode, as a person does."""
        bus = self.session.bus
        bus.call("/set_mode", "planned")
        for service in ("/record_episode/stop", "/task/cancel"):
            with suppress(IbrobotError):  # there is none
                bus.call(service, None)
        for goal in ("gripper=0", "home"):
            number = bus.call("/planning/go_to", goal)
            self.until(partial(self._ended, number), goal)

    def _ended(self, number: int) -> bool:
        return self.session.bus.call("/planning/result", number) is not None

    def silence(self, moment: str, way: str) -> str:
        """Have an agent fall silent, and return the outcome: `holds`, or what went wrong."""
        self.begin()
        session, what = self.session, MOMENTS[moment]
        self._number += 1
        token = add_token(f"agent{self._number}")
        relay = Relay(int(self.host.rpartition(":")[2]))
        url = f"http://127.0.0.1:{relay.port}/mcp"
        agent = subprocess.Popen(
            [sys.executable, str(AGENT), url, token, self.host],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert agent.stdin is not None
        assert agent.stdout is not None
        try:
            assert agent.stdout.readline() == "ready\n"
            (name,) = (each for each in authority_of(session).status().agents if each.endswith(f":agent{self._number}"))
            session.bus.call("/agent/arm", Grant(600.0, GRANTED, speed=SPEED, lease=LEASE_S, agent=name))
            begin = self.command
            agent.stdin.write(json.dumps(what.calls) + "\n")
            agent.stdin.flush()
            if what.joint:
                i = session.config.robot.joint_names.index(what.joint)
                far = self.random.uniform(0.01, 0.1)
                self.until(lambda: session.mode == what.mode and abs(self.command[i] - begin[i]) > far, moment)
            else:
                self.ticks(self.random.randrange(30))
            if authority_of(session).status().armed != name:
                return "its authority has ended before"
            return self._silenced(agent, relay, way)
        finally:
            relay.cut.clear()
            agent.kill()
            agent.wait()
            agent.stdin.close()
            agent.stdout.close()
            relay.close()

    def _silenced(self, agent: subprocess.Popen[str], relay: Relay, way: str) -> str:
        session = self.session
        begun_ns = session.clock.now_ns()
        if way == "kill":
            agent.kill()
        elif way == "freeze":
            agent.send_signal(signal.SIGSTOP)
        else:
            relay.cut.set()
        self.until(lambda: not authority_of(session).status().armed, "the end of the authority")
        self.latest_s = max(self.latest_s, (session.clock.now_ns() - begun_ns) * 1e-9)
        self.ticks(_BRAKE_TICKS)
        rest = self.command
        self.ticks(_WATCHED_TICKS)
        if np.abs(self.command - rest).max() > _STILL_RAD:
            return "the arm moves on"
        if way == "freeze":
            agent.send_signal(signal.SIGCONT)
        relay.cut.clear()
        self.ticks(2 * _WATCHED_TICKS)
        if authority_of(session).status().armed or np.abs(self.command - rest).max() > _STILL_RAD:
            return "the arm moves when the agent is back"
        return "holds" if session.held else "the robot does not hold"


def main() -> int:
    """Silence agents, and print what came of it; 1 if an arm did not hold."""
    repeats = int(sys.argv[1])
    with tempfile.TemporaryDirectory() as folder:
        os.environ |= {"XDG_RUNTIME_DIR": folder, "XDG_STATE_HOME": folder, "XDG_CONFIG_HOME": folder}
        with SilencedRun(Path(folder) / "episodes") as run:
            for moment in MOMENTS:
                for way in WAYS:
                    for _ in range(repeats):
                        run.counts[moment, way, run.silence(moment, way)] += 1
                print(
                    f"{moment:20}",
                    {key[1:]: count for key, count in run.counts.items() if key[0] == moment},
                    flush=True,
                )
    held = sum(count for (_, _, outcome), count in run.counts.items() if outcome == "holds")
    print(f"{held} of {run.counts.total()} arms hold; authority ended at most {run.latest_s:.2f} s after the silence, "
          f"with a lease of {LEASE_S:g} s")  # fmt: skip
    return int(held < run.counts.total())


if __name__ == "__main__":
    sys.exit(main())
