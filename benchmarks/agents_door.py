"""What a flood of an agent's calls costs control, and how late an agent's stop is.

    python benchmarks/agents_door.py [--pairs 2] [--seconds 20] [--stops 50]

The simulated SO-101 in real time, with posts around it and the planner around obstacles. An agent in a process of its
own, without any grant, calls over HTTP: it asks for plans and cancels them as fast as it can, with eight calls open. In
turn with the flood, the same run is left alone for as long: each pair gives the ticks that control missed, the lateness
of its ticks, and the share of a processor that the run's host uses, with and without. Then the agent stops the robot
during a motion, again and again: from the call to the first state with the stop, and to commands at rest.
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import os
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from typing import Any

import httpx2
import numpy as np
from apparatus import CONFIGS, report, running
from ibrobot_mcp.door import AgentDoor
from ibrobot_mcp.tokens import add_token
from mcp import Client, MCPError
from mcp.client.streamable_http import streamable_http_client

from ibrobot_core.app import Runtime, Session, installed_plugins, load_config

CONFIG = CONFIGS / "so101_blind.yaml"
OPEN = 8
STILL_RAD = 1e-6
LATEST_STOP_MS = 100.0
GOALS = ("shoulder_pan=1.2", "xyz=0.2,-0.15,0.08", "xyz=0.15,0.2,0.05", "home", "xyz=0.25,0.0,0.03")


def robot() -> Any:
    """The robot, beside a cage of posts."""
    posts = ", ".join(
        f"p{number}: {{shape: box, size: [0.02, 0.02, 0.3], position: [{x}, {y}, 0.15]}}"
        for number, (x, y) in enumerate([(0.3, 0.12), (0.3, -0.12), (0.2, 0.28), (0.2, -0.28), (0.36, 0.0)])
    )
    overrides = ("simulation.scene={type: empty}", f"world={{objects: {{{posts}}}}}", "mcp={}")
    return load_config(CONFIG, sim=True, mode="moveit_planning", overrides=overrides, registry=installed_plugins())


def flood(url: str, token: str, idle: Any, begin: Any, end: Any, calls: Any) -> None:
    """Call from a process of its own, between `begin` and `end`, again and again."""

    async def call(client: Client) -> None:
        while begin.is_set():
            with suppress(MCPError, httpx2.HTTPError):
                await client.call_tool("plan_to", {"goal": GOALS[calls.value % len(GOALS)]})
                calls.value += 1
                if calls.value % 3 == 0:
                    await client.call_tool("cancel_motion", {})

    async def talk() -> None:
        async with (
            httpx2.AsyncClient(headers={"Authorization": f"Bearer {token}"}, timeout=60) as http,
            Client(streamable_http_client(url, http_client=http), mode="legacy") as client,
        ):
            await client.list_tools()
            while not end.is_set():
                idle.set()
                if not await asyncio.to_thread(begin.wait, 0.1):
                    continue
                await asyncio.gather(*(call(client) for _ in range(OPEN)))

    asyncio.run(talk())


class Watch:
    """The ticks of control between `begin` and `end`."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._states: list[Any] = []
        session.on_state.append(self._states.append)

    def during(self, seconds: float) -> tuple[int, float, float]:
        """Missed ticks, the 99th percentile of the lateness [ms], and the host's share of a processor, in this time."""
        self._states.clear()
        missed = self._session.control.report["loop"]["missed"]
        used_s = time.process_time()
        time.sleep(seconds)
        share = (time.process_time() - used_s) / seconds
        late_ms = [each.late_ns / 1e6 for each in self._states.copy()]
        return self._session.control.report["loop"]["missed"] - missed, float(np.percentile(late_ms, 99)), share


async def stopped(session: Session, client: Client, number: int) -> tuple[float, float]:
    """How long after its call a stop was latched, and the commands were at rest [s]."""
    session.bus.call("/planning/go_to", f"shoulder_pan={1.0 if number % 2 else -1.0}")
    seen: list[tuple[float, Any]] = []
    moving, ended = threading.Event(), threading.Event()

    def note(state: Any) -> None:
        seen.append((time.monotonic(), state))
        if len(seen) > 1 and np.abs(state.command - seen[-2][1].command).max() > 0.005:
            moving.set()
        if state.estop and np.abs(state.command - seen[-2][1].command).max() < STILL_RAD:
            ended.set()

    session.on_state.append(note)
    try:
        await asyncio.to_thread(moving.wait)
        begun_s = time.monotonic()
        await client.call_tool("stop", {})
        await asyncio.to_thread(ended.wait)
    finally:
        session.on_state.remove(note)
    latched = next(at for at, state in seen if state.estop)
    after = [(at, state.command) for at, state in seen if at >= begun_s]
    rest = next(
        at for (_, before), (at, now) in pairwise(after) if at >= latched and np.abs(now - before).max() < STILL_RAD
    )
    return latched - begun_s, rest - begun_s


async def stops(session: Session, runtime: Runtime, url: str, token: str, count: int) -> list[tuple[float, float]]:
    """The latencies of stops."""
    found = []
    async with (
        httpx2.AsyncClient(headers={"Authorization": f"Bearer {token}"}, timeout=60) as http,
        Client(streamable_http_client(url, http_client=http)) as client,
    ):
        await client.list_tools()
        for number in range(count):
            found.append(await stopped(session, client, number))
            await asyncio.to_thread(runtime.reset)
    return found


def percentiles(name: str, seconds: Sequence[float]) -> str:
    """A line about latencies."""
    p50, p99 = np.percentile(np.array(seconds) * 1e3, [50, 99])
    return f"{name}: p50 {p50:.1f} ms, p99 {p99:.1f} ms, most {max(seconds) * 1e3:.1f} ms"


def measured(
    runtime: Runtime, count: int, seconds: float, number_of_stops: int
) -> tuple[list[tuple[Any, Any]], list[tuple[float, float]]]:
    """What was seen alone and in the flood, as pairs, and the latencies of stops."""
    session = runtime.session
    door = next(each for each in runtime.plan.components if isinstance(each, AgentDoor))
    token = add_token("flood")
    context = multiprocessing.get_context("spawn")
    idle, begin, end, calls = *(context.Event() for _ in range(3)), context.Value("i", 0, lock=False)
    agent = context.Process(target=flood, args=(door.url, token, idle, begin, end, calls))
    agent.start()
    pairs = []
    try:
        session.watch_states().get(30.0)
        idle.wait()
        watch = Watch(session)
        for number in range(count):
            calm = watch.during(seconds)
            before = calls.value
            begin.set()
            flooded = watch.during(seconds)
            made = calls.value - before
            begin.clear()
            idle.clear()
            idle.wait()
            pairs.append((calm, flooded))
            print(
                f"pair {number + 1}: missed {calm[0]} alone, {flooded[0]} in the flood of {made} calls;"
                f" lateness p99 {calm[1]:.2f} and {flooded[1]:.2f} ms;"
                f" the run uses {calm[2]:.0%} and {flooded[2]:.0%} of a processor",
                flush=True,
            )
        return pairs, asyncio.run(stops(session, runtime, door.url, token, number_of_stops))
    finally:
        end.set()
        begin.clear()
        agent.join()


def main() -> int:
    """Measure, and print what came of it; 1 if control missed more ticks in the flood, or a stop was late."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--pairs", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--stops", type=int, default=50)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ |= {"XDG_RUNTIME_DIR": folder, "XDG_STATE_HOME": folder, "XDG_CONFIG_HOME": folder}
        with running(robot()) as runtime:
            pairs, latencies = measured(runtime, args.pairs, args.seconds, args.stops)
    print(percentiles("stop latched", [each[0] for each in latencies]))
    print(percentiles("commands at rest", [each[1] for each in latencies]))
    figures = {
        "missed_alone": sum(each[0][0] for each in pairs),
        "missed_flooded": sum(each[1][0] for each in pairs),
        "flood_share": statistics.median(each[1][2] - each[0][2] for each in pairs),
        "lateness_ratio": statistics.median(each[1][1] / each[0][1] for each in pairs),
        "stop_p50_ms": float(np.percentile([each[0] for each in latencies], 50)) * 1e3,
        "stop_p99_ms": float(np.percentile([each[0] for each in latencies], 99)) * 1e3,
    }
    report(**figures)
    return int(figures["missed_flooded"] > figures["missed_alone"] or figures["stop_p99_ms"] > LATEST_STOP_MS)


if __name__ == "__main__":
    sys.exit(main())
