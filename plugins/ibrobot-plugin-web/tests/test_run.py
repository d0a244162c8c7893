"""A run with its page, and pages without a browser: drive, watch, take over, and break off in motion."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from typing import Any

import aiohttp
import numpy as np
import pytest
from ibrobot_web.messages import clock_ms
from page_run import SO101, PageClient, client, page_run

from ibrobot_core.app import installed_plugins

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(("hardware", "mujoco") not in installed_plugins().entries, reason="needs ibrobot-plugin-mujoco"),
]
HOLD_NS = 500_000_000
"""An arm whose commands stay the same for so long holds [ns]."""
FAR_RAD = 1.5
"""What an arm that went on would reach, on its way to a limit [rad]."""
MOVING_RAD = 1e-4
"""Change of a command between two states that counts as motion."""
MALFORMED = 200


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with page_run(*SO101) as found:
        yield found


def run(test: Callable[[], Awaitable[None]]) -> None:
    asyncio.run(asyncio.wait_for(test(), 60))


def moved_until_ns(page: PageClient) -> int:
    """Stamp of the last state in which a command changed."""
    last = 0
    for before, after in itertools.pairwise(page.states):
        if np.abs(np.subtract(after["command"], before["command"])).max() > MOVING_RAD:
            last = after["stamp"]
    return last


async def ready(page: PageClient) -> None:
    await page.until(lambda: page.states and page.status.get("jogs"))
    if page.status["faults"]:
        await page.call("reset")


@pytest.mark.parametrize("end", ["release", "close", "cut", "silence"])
def test_the_arm_holds_soon_after_the_operator_is_gone(address: str, end: str) -> None:
    async def test() -> None:
        async with client(address) as watcher:
            async with client(address) as operator:
                await operator.call("operate", take_over=True)
                await ready(operator)
                middle = operator.states[-1]["position"][0] < 0
                speed = 0.6 if middle else -0.6
                motion = {"shoulder_pan": speed, "wrist_roll": speed}
                await operator.jog(0.5, joints=motion)
                while not moved_until_ns(watcher):  # on a busy machine, a press can end before it moves anything
                    await operator.jog(0.5, joints=motion)
                if end == "release":
                    await operator.call("release")
                elif end == "close":
                    await operator.drive.close()
                elif end == "cut":
                    operator.cut()
                await watcher.until(lambda: watcher.states[-1]["stamp"] > moved_until_ns(watcher) + HOLD_NS)
            assert abs(watcher.states[-1]["command"][0]) < FAR_RAD

    run(test)


def test_one_operates_and_the_other_watches(address: str) -> None:
    async def test() -> None:
        async with client(address) as one, client(address) as two:
            await one.call("operate", take_over=True)
            await ready(one)
            with pytest.raises(RuntimeError, match="this page only watches"):
                await two.service("/set_mode", "moveit_planning")
            await two.estop()
            await one.until(lambda: one.states[-1]["estop"])
            await one.until(lambda: one.status["faults"])
            assert "emergency stop" in one.status["faults"][0]["text"]
            assert "starts over" in await one.call("reset")
            await two.until(lambda: not two.states[-1]["estop"])
            await two.call("operate", take_over=True)
            with pytest.raises(RuntimeError, match="this page only watches"):
                await one.call("jog", at=clock_ms(), press=1)

    run(test)


def test_uploads_and_malformed_messages_harm_no_run(address: str) -> None:
    async def upload(page: PageClient) -> None:
        async def body() -> AsyncIterator[bytes]:
            for _ in range(100):
                yield bytes(1 << 20)

        with contextlib.suppress(aiohttp.ClientConnectionError):
            async with page.post("/", body()) as answer:
                assert answer.status in (405, 413)

    async def attack(page: PageClient) -> None:
        for _ in range(MALFORMED // 20):
            async with page.connect("/drive") as socket:
                for text in ('{"do":', "[[[", "null", '{"do": 1}') * 5:
                    with contextlib.suppress(ConnectionError):
                        await socket.send_str(text)
                while (await socket.receive(timeout=20)).type is aiohttp.WSMsgType.TEXT:
                    pass

    async def test() -> None:
        async with client(address) as operator, client(address) as attacker:
            await operator.call("operate", take_over=True)
            await ready(operator)
            before = operator.states[-1]["tick"]
            attacks = asyncio.gather(upload(attacker), attack(attacker))
            while not (attacks.done() and moved_until_ns(operator)):  # on a busy machine, silence ends a press early
                speed = 0.3 if operator.states[-1]["position"][0] < 0 else -0.3
                await operator.jog(0.4, joints={"shoulder_pan": speed})
            await attacks
            await operator.until(lambda: operator.states[-1]["tick"] > before + 100)
            assert operator.status["faults"] == []
            await operator.service("/set_mode", "web")

    run(test)


def test_modes_goals_and_errors_of_commands(address: str) -> None:
    async def test() -> None:
        async with client(address) as page:
            await page.call("operate", take_over=True)
            await ready(page)
            for wrong, why in (
                ({"do": "call", "service": "/set_mode", "request": "moveit"}, "no mode 'moveit'; the modes are"),
                ({"do": "call", "service": "/set_mode", "request": {}}, "mode: required key is missing"),
                ({"do": "fly"}, "unknown command 'fly'"),
                ({"do": "call", "service": "/planning/go_to", "request": "home"}, "nobody serves /planning/go_to"),
                ({"do": "jog", "at": clock_ms(), "press": 1, "joints": {"elbow": 1}}, "no joint 'elbow'"),
                ({"do": "jog", "at": clock_ms(), "press": 1, "joints": {"gripper": 7}}, "between -1 and 1"),
                ({"do": "jog", "at": 1, "press": 1}, "the connection is too slow to jog"),
                ({"do": "estop", "event": "pages"}, "unknown command 'estop'"),
            ):
                with pytest.raises(RuntimeError, match=why):
                    await page.call(**wrong)
            await page.service("/set_mode", "moveit_planning")
            await page.until(lambda: "/planning/go_to" in page.status["services"])
            await page.service("/planning/go_to", "home")
            await page.until(lambda: np.abs(page.states[-1]["position"]).max() < 0.05)
            await page.service("/set_mode", "web")

    run(test)


def test_states_and_pictures_are_fresh(address: str) -> None:
    async def test() -> None:
        async with client(address) as page:
            await page.until(lambda: len(page.states) > 30)
            if page.pictures:
                assert {channel for channel, *_ in page.pictures} <= {16, 17}
            stamps: Any = [state["stamp"] for state in page.states]
            assert stamps == sorted(stamps)

    run(test)
