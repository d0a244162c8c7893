"""The page's deadman and STOP in Chromium, over slow links, and when a part on their way stalls or is lost."""

from __future__ import annotations

import asyncio
import itertools
import os
import shutil
import signal
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from page_run import PageClient, client, page_run
from slow_link import SlowLink

from ibrobot_core.app import installed_plugins

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--no-sandbox", "--disable-3d-apis", "--disable-gpu"]
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
    pytest.mark.skipif(("hardware", "mujoco") not in installed_plugins().entries, reason="needs ibrobot-plugin-mujoco"),
]
WAIT_S = 30.0
MOVING_RAD = 2e-3
"""Change of a command between two states that counts as motion. After a reset or a mode switch, the robot holds where
it is measured, which changes the command by the sag of the arm.
"""
GAP_NS = 100_000_000
SPEED = 0.8
"""Speed of a jogged joint [rad/s]."""
PATIENT = ("--set", "control.peer_timeout=5")
"""The page's deadman ends each motion here; a busy machine may hold up the run for longer than the usual 0.3 s."""
UP = "shoulder_pan up, hold to move"


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with page_run("so101_blind", "--sim", "--mode", "web", *PATIENT) as found:
        yield found


@attrs.frozen
class Scene:
    """A run, a page in Chromium that operates it over a link, and a client that watches it."""

    page: Any
    browser: Any
    link: SlowLink
    watcher: PageClient

    async def until(self, expression: str) -> None:
        async with asyncio.timeout(WAIT_S):
            while not await self.page.evaluate(expression):
                await asyncio.sleep(0.03)

    async def ready(self) -> None:
        await self.until(
            "ibrobot.state && ibrobot.status && ibrobot.drive.open && ibrobot.line.socket.readyState === 1"
        )
        if not await self.page.evaluate("ibrobot.operating"):
            await self.page.evaluate("ibrobot.drive.call('operate', {take_over: true})")
        await self.page.evaluate(
            "ibrobot.state.estop || ibrobot.status.faults.length ? ibrobot.drive.command('reset') : 0"
        )
        await self.page.evaluate("ibrobot.drive.command('call', {service: '/set_mode', request: 'web'})")
        await self.until("ibrobot.jogs.length > 0")
        await self.page.get_by_role("button", name="home", exact=True).scroll_into_view_if_needed()

    async def hold(self) -> None:
        """Hold the button of a joint until it moves, away from the nearer limit."""
        at_rad = self.watcher.states[-1]["position"][0]
        button = self.page.get_by_label(UP if at_rad < 0 else UP.replace("up", "down"))
        await button.hover()
        for _ in range(10):  # on a busy machine, a stall ends a press before it moves anything
            begun_ns = time.time_ns()
            await self.page.mouse.down()
            with_motion = asyncio.get_running_loop().time() + 1.0
            while asyncio.get_running_loop().time() < with_motion:
                if moved_since(self.watcher, begun_ns):
                    return
                await asyncio.sleep(0.01)
            await self.page.mouse.up()
        raise AssertionError(f"it does not move: {await self.page.locator('.toasts').inner_text()}")


def motions(watcher: PageClient) -> list[int]:
    """Stamps of the states in which a command changed [ns].

    While states stay away, as from a server that stalls, the robot counts as moving at its speed.
    """
    found = []
    for before, after in itertools.pairwise(watcher.states):
        change = float(np.abs(np.subtract(after["command"], before["command"])).max())
        if change > MOVING_RAD:
            gap = after["stamp"] - before["stamp"] > GAP_NS
            found.append(before["stamp"] + int(change / SPEED * 1e9) if gap else after["stamp"])
    return found


def moved_since(watcher: PageClient, since_ns: int) -> bool:
    return any(stamp > since_ns for stamp in motions(watcher)[-1:])


def moved_for_s(watcher: PageClient, since_ns: int) -> float:
    """How long the robot moved after a time [s]."""
    last = [stamp for stamp in motions(watcher) if stamp > since_ns]
    return (last[-1] - since_ns) / 1e9 if last else 0.0


@attrs.frozen
class Stage:
    """What the tests share: a run, a browser, the link between them, and the event loop in which both live."""

    address: str
    link: SlowLink
    browser: Any
    runner: asyncio.Runner


@pytest.fixture(scope="module")
def stage(address: str) -> Iterator[Stage]:
    async_api = pytest.importorskip("playwright.async_api", reason="needs playwright: pip install playwright")
    port = int(address.split("/")[2].rpartition(":")[2])

    async def begin(opened: AsyncExitStack) -> tuple[SlowLink, Any]:
        link = await opened.enter_async_context(SlowLink(port))
        playwright = await opened.enter_async_context(async_api.async_playwright())
        rule = f"--host-resolver-rules=MAP localhost:{port} 127.0.0.1:{link.port}"
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=[*FLAGS, rule])
        opened.push_async_callback(browser.close)
        return link, browser

    with asyncio.Runner() as runner:
        opened = AsyncExitStack()
        try:
            link, browser = runner.run(begin(opened))
            yield Stage(address, link, browser, runner)
        finally:
            runner.run(opened.aclose())


@asynccontextmanager
async def scene(stage: Stage) -> AsyncIterator[Scene]:
    link = stage.link
    async with client(stage.address) as watcher:
        context = await stage.browser.new_context(viewport={"width": 1020, "height": 700}, device_scale_factor=0.25)
        try:
            page = await context.new_page()
            await page.goto(stage.address.replace("127.0.0.1", "localhost"))
            found = Scene(page, stage.browser, link, watcher)
            await found.ready()
            yield found
        finally:
            link.cut, link.up_per_s, link.latency_s = False, None, 0.0
            await context.close()
            await link.emptied()


def run(stage: Stage, test: Callable[[Scene], Awaitable[None]]) -> None:
    async def inside() -> None:
        async with scene(stage) as found:
            await test(found)

    stage.runner.run(asyncio.wait_for(inside(), 120))


async def renderers(found: Scene) -> list[int]:
    """Process ids of the browser's renderers; one is the page's."""
    session = await found.browser.new_browser_cdp_session()
    processes = (await session.send("SystemInfo.getProcessInfo"))["processInfo"]
    return [each["id"] for each in processes if each["type"] == "renderer"]


def server_of(address: str) -> int:
    """Process id of the page's server."""
    port = int(address.split("/")[2].rpartition(":")[2])
    inodes = {
        line.split()[9]
        for line in Path("/proc/net/tcp").read_text().splitlines()[1:]
        if line.split()[1] == f"0100007F:{port:04X}" and line.split()[3] == "0A"
    }
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                links = {os.readlink(each) for each in (folder / "fd").iterdir()}
            except OSError:
                continue
            if links & {f"socket:[{inode}]" for inode in inodes}:
                return int(folder.name)
    raise AssertionError("the page's server is not there")


async def renderer_stalls(found: Scene, address: str, seconds: float = 1.0) -> int:
    pids = await renderers(found)
    begun_ns = time.time_ns()
    for number in (signal.SIGSTOP, signal.SIGCONT):
        for pid in pids:
            with suppress(ProcessLookupError):  # that of a page before, which ends
                os.kill(pid, number)
        if number == signal.SIGSTOP:
            await asyncio.sleep(seconds)
    return begun_ns


async def renderer_stalls_for_5_s(found: Scene, address: str) -> int:
    return await renderer_stalls(found, address, 5.0)


async def page_hides(found: Scene, address: str) -> int:
    begun_ns = time.time_ns()
    for hidden in ("true", "false"):  # without a screen, Chromium hides no page by itself
        await found.page.evaluate(f"Object.defineProperty(document, 'hidden', {{value: {hidden}, configurable: true}})")
        await found.page.evaluate("document.dispatchEvent(new Event('visibilitychange')), 0")
        await asyncio.sleep(1.0)
    return begun_ns


async def network_is_cut(found: Scene, address: str) -> int:
    begun_ns = time.time_ns()
    found.link.cut = True
    await asyncio.sleep(2.0)
    found.link.cut = False
    return begun_ns


async def server_stalls(found: Scene, address: str) -> int:
    begun_ns = time.time_ns()
    pid = server_of(address)
    os.kill(pid, signal.SIGSTOP)
    await asyncio.sleep(2.0)
    os.kill(pid, signal.SIGCONT)
    return begun_ns


async def stops(found: Scene, address: str) -> int:
    begun_ns = time.time_ns()
    await found.watcher.estop()
    await found.watcher.until(lambda: found.watcher.states[-1]["estop"])
    await found.until("ibrobot.state.estop")
    await found.page.evaluate("ibrobot.drive.command('reset')")
    return begun_ns


async def mode_switches(found: Scene, address: str) -> int:
    await found.page.evaluate("ibrobot.drive.command('call', {service: '/set_mode', request: 'moveit_planning'})")
    begun_ns = time.time_ns()
    await found.page.evaluate("ibrobot.drive.command('call', {service: '/set_mode', request: 'web'})")
    return begun_ns


async def control_is_lost(found: Scene, address: str) -> int:
    begun_ns = time.time_ns()
    await found.watcher.call("operate", take_over=True)
    await asyncio.sleep(0.3)
    await found.watcher.call("resign")
    await found.page.evaluate("ibrobot.drive.call('operate', {})")
    return begun_ns


ROWS = (
    renderer_stalls,
    renderer_stalls_for_5_s,
    page_hides,
    network_is_cut,
    server_stalls,
    stops,
    mode_switches,
    control_is_lost,
)
LONG = (renderer_stalls_for_5_s, stops, mode_switches, control_is_lost)
"""In the short run, a shorter stall shows the first; tests of the teleop show what a reset or another operator ends."""
HOLD_S = 0.3
PATIENCE_S = 1.0
"""Slack for a machine that runs other tests, too; an idle one needs none."""


@pytest.mark.parametrize(
    "row",
    [pytest.param(each, marks=[pytest.mark.long] * (each in LONG)) for each in ROWS],
    ids=lambda row: str(row.__name__),
)
def test_a_press_that_outlives_an_event_moves_nothing(
    stage: Stage, row: Callable[[Scene, str], Awaitable[int]]
) -> None:
    async def test(found: Scene) -> None:
        await found.hold()
        begun_ns = await row(found, stage.address)
        over_ns = time.time_ns()
        await asyncio.sleep(1.0)
        print(f"{row.__name__}: moved for {moved_for_s(found.watcher, begun_ns):.3f} s")
        assert moved_for_s(found.watcher, begun_ns) < HOLD_S + PATIENCE_S
        assert not moved_since(found.watcher, over_ns), "the button is still held"
        await found.page.mouse.up()
        await found.ready()
        await found.hold()
        await found.page.mouse.up()

    run(stage, test)


@pytest.mark.parametrize("held_s", [0.1, pytest.param(3.0, marks=pytest.mark.long)])
@pytest.mark.parametrize("rate", [300, *(pytest.param(rate, marks=pytest.mark.long) for rate in (700, 2000))])
def test_on_a_narrow_link_motion_ends_soon_after_the_release_and_stop_is_not_late(
    stage: Stage, rate: int, held_s: float
) -> None:
    async def test(found: Scene) -> None:
        await found.hold()
        found.link.up_per_s = rate
        await asyncio.sleep(held_s)
        released_ns = time.time_ns()
        await found.page.mouse.up()
        await asyncio.sleep(2.0)
        print(
            f"{rate} bytes/s, held {held_s} s: moved {moved_for_s(found.watcher, released_ns):.3f} s after the release"
        )
        assert moved_for_s(found.watcher, released_ns) < HOLD_S + PATIENCE_S
        await found.page.mouse.down()
        await asyncio.sleep(0.5)
        await stop_latches(found, rate)

    run(stage, test)


def test_on_a_link_of_1_s_latency_motion_ends_soon_after_the_loss_and_stop_takes_the_latency(stage: Stage) -> None:
    async def test(found: Scene) -> None:
        await found.hold()
        begun_ns = time.time_ns()
        found.link.latency_s = 1.0
        await asyncio.sleep(1.5)
        print(f"1 s latency: moved for {moved_for_s(found.watcher, begun_ns):.3f} s after the loss")
        assert moved_for_s(found.watcher, begun_ns) < HOLD_S + PATIENCE_S
        await found.page.mouse.up()
        await asyncio.sleep(1.5)
        pressed_ns = time.time_ns()
        await found.page.mouse.down()
        await asyncio.sleep(2.0)
        assert not moved_since(found.watcher, pressed_ns), "no message can be young enough"
        assert "too slow" in await found.page.locator(".toasts").inner_text()
        await stop_latches(found, 0)

    run(stage, test)


async def stop_latches(found: Scene, rate: int) -> None:
    """Click STOP, which is confirmed or raises the alarm, and latches after the link's own delay."""
    stops = found.watcher.states[-1]["stops"]
    clicked_ns = time.time_ns()
    await found.page.locator("#stop").dispatch_event("pointerdown")
    await found.watcher.until(lambda: found.watcher.states[-1]["stops"] > stops)
    latched = next(state for state in found.watcher.states if state["stops"] > stops)
    took_s = (latched["stamp"] - clicked_ns) / 1e9
    print(f"{rate} bytes/s, {found.link.latency_s} s: STOP latched {took_s:.3f} s after the click")
    assert took_s < found.link.latency_s + 0.2 + PATIENCE_S
    found.link.up_per_s, found.link.latency_s = None, 0.0
    await found.until("document.getElementById('stop').textContent === 'STOP Esc'")
    await found.until("!document.querySelector('#faults .alarm')")


def test_a_stop_that_is_not_confirmed_raises_an_alarm_that_names_other_ways(stage: Stage) -> None:
    async def test(found: Scene) -> None:
        found.link.cut = True
        await found.page.keyboard.press("Escape")
        assert await found.page.locator("#stop").inner_text() == "stopping …"
        await found.page.locator("#faults .alarm").wait_for(timeout=WAIT_S * 1e3)
        alarm = await found.page.locator("#faults .alarm").inner_text()
        assert "Press Esc in the terminal of the run, or switch off the robot's power" in alarm
        found.link.cut = False
        await found.watcher.until(lambda: found.watcher.states[-1]["estop"])
        await found.until("!document.querySelector('#faults .alarm')")
        await found.until("document.getElementById('stop').textContent === 'STOP Esc'")

    run(stage, test)
