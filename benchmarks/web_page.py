"""The page of `ibrobot launch --web`: lateness of control beside it, ages of what pages show, and kills in motion.

    python benchmarks/web_page.py lateness [--blocks 4] [--seconds 20] [--pages 3]
    python benchmarks/web_page.py ages [--seconds 20]
    python benchmarks/web_page.py browser [--seconds 20]      # needs Chromium and playwright
    python benchmarks/web_page.py kills [--kills 50]
    python benchmarks/web_page.py pages [--seconds 10]        # CPU of one page and of ten
    python benchmarks/web_page.py memory [--minutes 60]
    python benchmarks/web_page.py deadman [--minutes 10]      # needs Chromium and playwright

Each runs the simulated SO-101 with its cameras, prints a table, and exits with 1 if it misses its limit.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests/shared"))

from page_run import PageClient, client, page_run

SO101 = ("so101", "--sim", "--mode", "web")
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist")
"""Flags of Chromium for software rendering: twice as fast as its default."""
MOVING_RAD = 1e-4
_MORE_MB = 20.0
"""How much memory the page's server may gain after warm-up [MB]."""
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


def row(*cells: Any) -> None:
    """Print a row of a table."""
    print("  ".join(f"{cell:>12}" if i else f"{cell:<28}" for i, cell in enumerate(cells)), flush=True)


def lates(page: PageClient, since: int) -> np.ndarray:
    """Lateness of the control loop in the states since an index [us]."""
    return np.array([state["late_us"] for state in page.states[since:]])


async def lateness(blocks: int, seconds: float, pages: int) -> bool:
    """Lateness with pages and without, in turn; one quiet page measures in both."""
    row("block", "p50 us", "p99 us", "missed", "ticks")
    with page_run(*SO101) as address:
        async with client(address) as meter:
            await meter.stream.send_bytes(bytes((255, 0, 1, 255)))  # states and status alone
            await meter.until(lambda: len(meter.states) > 50)
            await asyncio.sleep(3)
            found: dict[bool, list[np.ndarray]] = {False: [], True: []}
            missed_with_pages = 0
            for i in range(2 * blocks):
                shown = bool(i % 2)
                async with contextlib.AsyncExitStack() as stack:
                    for _ in range(pages if shown else 0):
                        await stack.enter_async_context(client(address))
                    await asyncio.sleep(1)
                    since, missed = len(meter.states), meter.status["counts"]["loop"]["missed"]
                    await asyncio.sleep(seconds)
                    found[shown].append(lates(meter, since))
                    missed = meter.status["counts"]["loop"]["missed"] - missed
                    missed_with_pages += missed if shown else 0
                late = found[shown][-1]
                name = f"{pages} pages, cameras" if shown else "no page but the meter"
                row(name, f"{np.median(late):.0f}", f"{np.percentile(late, 99):.0f}", missed, len(late))
    p99 = {}
    for shown, blocks_of in found.items():
        late = np.concatenate(blocks_of)
        p99[shown] = np.percentile(late, 99)
        row("all with pages" if shown else "all without", f"{np.median(late):.0f}", f"{p99[shown]:.0f}")
    return bool(p99[True] <= max(1.1 * p99[False], p99[False] + 50)) and not missed_with_pages


async def ages(seconds: float) -> bool:
    """Age of states and pictures when they reach a Python client."""
    with page_run(*SO101) as address:
        async with client(address) as page:
            await page.until(lambda: len(page.states) > 50)
            page.states.clear()
            page.pictures.clear()
            await asyncio.sleep(seconds)
            row("to a Python client", "per second", "p50 ms", "p99 ms")
            found = {"states": [(state["stamp"], state["at_ns"]) for state in page.states]}
            for channel in sorted({channel for channel, *_ in page.pictures}):
                found[f"camera {channel - 15}"] = [(s, at) for each, s, at in page.pictures if each == channel]
            worst = 0.0
            for name, times in found.items():
                age = np.array([(at - stamp) / 1e6 for stamp, at in times])
                worst = max(worst, float(np.percentile(age, 99)))
                row(name, f"{len(age) / seconds:.1f}", f"{np.median(age):.1f}", f"{np.percentile(age, 99):.1f}")
            return worst <= 100


def browser(seconds: float) -> bool:
    """Frames per second and ages in headless Chromium with software rendering."""
    from playwright.sync_api import sync_playwright

    with page_run(*SO101) as address, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        tab = chromium.new_page(viewport={"width": 1440, "height": 900})
        tab.goto(address)
        while tab.evaluate("ibrobot.view.frames") < 3:
            tab.wait_for_timeout(100)
        tab.evaluate("ibrobot.view.ages = []; ibrobot.view.frames = 0; ibrobot.cameras.frames = {}")
        tab.wait_for_timeout(seconds * 1e3)
        view = tab.evaluate("({count: ibrobot.view.frames, ages: ibrobot.view.ages})")
        found = {"3D": view, **tab.evaluate("ibrobot.cameras.frames")}
        row("in Chromium", "per second", "p50 ms", "p99 ms")
        met = True
        for name, times in found.items():
            age = np.array(times["ages"])
            count = times["count"]
            row(name, f"{count / seconds:.1f}", f"{np.median(age):.0f}", f"{np.percentile(age, 99):.0f}")
            met &= bool(count / seconds >= 5 and np.percentile(age, 99) <= 500)
        chromium.close()
        return met


async def kills(count: int) -> bool:
    """Time until the arm holds, after the operator's page is closed, killed, or cut off in motion."""
    held: dict[str, list[float]] = {"closed": [], "killed": [], "cut off": []}
    with page_run(*SO101) as address:
        async with client(address) as watcher:
            await watcher.until(lambda: watcher.status.get("jogs"))
            for how in itertools.islice(itertools.cycle(held), count):
                async with client(address) as operator:
                    await operator.call("operate", take_over=True)
                    speed = -0.6 if watcher.states[-1]["position"][0] > 0 else 0.6
                    await operator.jog(0.5, joints={"shoulder_pan": speed, "wrist_roll": speed})
                    if how == "closed":
                        await operator.drive.close()
                    elif how == "killed":
                        operator.cut()
                    gone_ns = time.time_ns()
                    await asyncio.sleep(0.7)
                moving = [
                    after["stamp"]
                    for before, after in itertools.pairwise(watcher.states[-60:])
                    if np.abs(np.subtract(after["command"], before["command"])).max() > MOVING_RAD
                ]
                held[how].append((moving[-1] - gone_ns) / 1e9 if moving else float("nan"))
    row("operator's page", "times", "median s", "longest s")
    for how, times in held.items():
        row(how, len(times), f"{np.median(times):.3f}", f"{np.max(times):.3f}")
    return max(map(max, held.values())) <= 0.3


def server_of(run_name: str = "ibrobot_web.server.process") -> int:
    """Process id of the page's server."""
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if run_name in (folder / "cmdline").read_text().split("\0"):
                return int(folder.name)
    raise RuntimeError("the page's server is not running")


def cpu_s(pid: int) -> float:
    """CPU time of a process [s]."""
    fields = (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S


def memory_mb(pid: int) -> float:
    """Resident memory of a process [MB]."""
    return int((Path("/proc") / str(pid) / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


async def pages(seconds: float) -> bool:
    """CPU of the run and of the page's server without a page, with one and with ten, each twice in turn."""
    row("pages", "run %", "server %", "both %")
    used: dict[int, list[float]] = {0: [], 1: [], 10: []}
    with page_run(*SO101) as address:
        await asyncio.sleep(3)
        server = server_of()
        host = int((Path("/proc") / str(server) / "stat").read_text().rpartition(")")[2].split()[1])
        for count in (*used, *used):
            async with contextlib.AsyncExitStack() as stack:
                for _ in range(count):
                    await stack.enter_async_context(client(address))
                await asyncio.sleep(3)
                begun = cpu_s(host), cpu_s(server)
                await asyncio.sleep(seconds)
                shares = [
                    100 * (cpu_s(pid) - before) / seconds for pid, before in zip((host, server), begun, strict=True)
                ]
                used[count].append(sum(shares))
                row(count, *(f"{share:.1f}" for share in (*shares, sum(shares))))
    return sum(used[10]) <= 2 * sum(used[1])


async def memory(minutes: float) -> bool:
    """Memory of the page's server, with a page that comes and goes."""
    row("minute", "server MB")
    used = []
    with page_run(*SO101) as address:
        for minute in range(round(minutes) + 1):
            async with client(address):
                await asyncio.sleep(60)
            used.append(memory_mb(server_of()))
            if minute in (0, 1, 2, 5) or minute % 10 == 0:
                row(minute, f"{used[-1]:.1f}")
    return used[-1] - used[min(2, len(used) - 1)] <= _MORE_MB


HELD = """ibrobot.deadman.hold(() => (
  {joints: {shoulder_pan: Math.sin(performance.now() / 1000) > 0 ? 0.5 : -0.5}}))"""
"""Holds the page's own deadman, and turns the joint to and fro."""
_PAUSE_S = 0.12
"""A joint that stands still for longer than this was released: the deadman's messages come every 0.04 s. The page may
skip states, so that time counts between two states without motion."""


def deadman(minutes: float) -> bool:
    """False releases of a deadman that is held in Chromium while 3D and cameras run: pauses of the joint's motion.

    Shows the memory of the page's server too.
    """
    from playwright.sync_api import sync_playwright

    with page_run(*SO101) as address, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        tab = chromium.new_page(viewport={"width": 1440, "height": 900})
        tab.goto(address)
        while tab.evaluate("ibrobot.view.frames") < 3 or not tab.evaluate("Boolean(ibrobot.jogs)"):
            tab.wait_for_timeout(100)
        tab.evaluate(
            """() => {
              ibrobot.pauses = []; ibrobot.longest = 0; ibrobot.count = 0;
              let before = null, still = 0;
              ibrobot.stream.addEventListener("state", ({detail}) => {
                ibrobot.count += 1;
                const moves = before && Math.abs(detail.command[0] - before.command[0]) > 1e-4;
                still = before && !moves ? still + (detail.stamp - before.stamp) / 1e9 : 0;
                ibrobot.longest = Math.max(ibrobot.longest, still);
                if (still > PAUSE && !ibrobot.paused) ibrobot.pauses.push(still);
                ibrobot.paused = still > PAUSE;
                before = detail;
              });
            }""".replace("PAUSE", str(_PAUSE_S))
        )
        tab.evaluate(HELD)
        press = tab.evaluate("ibrobot.deadman.press")
        row("minute", "pauses", "longest s", "states/s", "3D/s", "server MB")
        used = []
        for minute in range(1, round(minutes) + 1):
            before = tab.evaluate("[ibrobot.count, ibrobot.view.frames]")
            tab.wait_for_timeout(60_000)
            after = tab.evaluate("[ibrobot.count, ibrobot.view.frames]")
            pauses, longest = tab.evaluate("[ibrobot.pauses, ibrobot.longest]")
            rates = [f"{(b - a) / 60:.1f}" for a, b in zip(before, after, strict=True)]
            used.append(memory_mb(server_of()))
            row(minute, len(pauses), f"{longest:.3f}", *rates, f"{used[-1]:.1f}")
        held = tab.evaluate("ibrobot.deadman.held") and tab.evaluate("ibrobot.deadman.press") == press
        row("held all the time" if held else "released by the page")
        chromium.close()
        return bool(held and not pauses) and used[-1] - used[0] <= _MORE_MB


def main() -> None:
    """Run one of the measurements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("lateness", "ages", "browser", "kills", "pages", "memory", "deadman"))
    parser.add_argument("--blocks", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--pages", type=int, default=3)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--minutes", type=float, help="60; of the deadman 10")
    given = parser.parse_args()
    match given.what:
        case "lateness":
            met = asyncio.run(lateness(given.blocks, given.seconds, given.pages))
        case "ages":
            met = asyncio.run(ages(given.seconds))
        case "browser":
            met = browser(given.seconds)
        case "kills":
            met = asyncio.run(kills(given.kills))
        case "pages":
            met = asyncio.run(pages(given.seconds))
        case "memory":
            met = asyncio.run(memory(given.minutes or 60))
        case _:
            met = deadman(given.minutes or 10)
    sys.exit(0 if met else 1)


if __name__ == "__main__":
    main()
