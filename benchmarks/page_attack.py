"""STOP under attack: generated messages to the page's server of a run that moves, and how soon STOP latches.

    python benchmarks/page_attack.py [--messages 10000] [--seed 0]

A page that drives sends the messages: JSON of every shape, with the keys and the words of the page's protocol and of
the one between the page's server and the run; whole commands of which one part is replaced; and garbage. They go to the
connections for commands, for stops and for pictures. After each hundred, the operator's page jogs the robot, and STOP
is pressed: it must be confirmed within 0.1 s.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import random
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests/shared"))

from ibrobot_web.messages import clock_ms
from page_run import SO101, PageClient, client, page_run

LIMIT_S = 0.1
EVERY = 100
WORDS = (
    "do", "id", "stops", "event", "log", "failed", "failure", "error", "exit_code", "holding", "logger", "level",
    "message", "pages", "wanted", "count", "command", "stop", "number", "facts", "reply", "ok", "alive", "at", "press",
    "joints", "targets", "linear", "turn", "pose", "mode", "goal", "take", "take_over", "enabled", "outcome", "prompt",
    "estop", "jog", "release", "preview", "smoothing", "intervene", "url", "shoulder_pan", "home", "${HOME}", "~",
)  # fmt: skip
COMMANDS: tuple[dict[str, Any], ...] = (
    {"do": "jog", "at": 1, "press": 1, "joints": {"shoulder_pan": 0.1}}, {"do": "release", "at": 1}, {"do": "reset"},
    {"do": "mode", "mode": "web"}, {"do": "preview", "goal": {"pose": "home"}}, {"do": "goal", "goal": "home"},
    {"do": "episode_start", "prompt": "x"}, {"do": "episode_stop", "outcome": "success"}, {"do": "cancel"},
    {"do": "smoothing", "enabled": True}, {"do": "intervene", "take": True}, {"do": "time"},
    {"do": "release", "event": "log"}, {"do": "estop", "event": "pages"}, {"do": "release", "event": "failed"},
)  # fmt: skip


def value(rng: random.Random, depth: int = 3) -> Any:
    """Any JSON."""
    kind = rng.randrange(10 if depth else 7)
    if kind == 0:
        return rng.choice((None, True, False))
    if kind in (1, 2):
        return rng.choice((0, -1, 1, 2**31, 2**53, 2**64, 10**400, 1e308, -1e308, 0.5, clock_ms()))
    if kind < 6:
        return rng.choice(WORDS)
    if kind == 6:
        return "".join(chr(rng.randrange(0xD7FF)) for _ in range(rng.randrange(20)))
    if kind == 7:
        return [value(rng, depth - 1) for _ in range(rng.randrange(4))]
    return {rng.choice(WORDS): value(rng, depth - 1) for _ in range(rng.randrange(5))}


def message(rng: random.Random) -> str:
    """A message, seldom a right one."""
    kind = rng.randrange(10)
    if kind == 0:
        return rng.choice(("", "{", "[" * 5000, "null", "\x00", "NaN", '{"do": NaN}', "1" * 5000, '{"a":' * 2000))
    if kind < 4:
        return json.dumps(value(rng))
    changed: dict[str, Any] = {**rng.choice(COMMANDS)}
    if rng.random() < 0.5:
        changed |= {"id": rng.randrange(1000), "stops": rng.choice((0, None, 5, -1))}
    for _ in range(rng.randrange(3)):
        changed[rng.choice((*changed, *WORDS))] = value(rng, 2)
    if changed.get("do") in ("finish", "operate", "resign"):  # which would only end the attack
        changed["do"] = "estop"
    return json.dumps(changed)


class Attack:
    """Sends messages by connections of its own, which it opens again after the server has closed them."""

    def __init__(self, page: PageClient, rng: random.Random) -> None:
        self._page = page
        self._rng = rng
        self._open: dict[str, Any] = {}
        self.connections = 0

    async def send(self) -> None:
        """Send a message by one of the connections."""
        path = self._rng.choice(("/drive", "/drive", "/drive", "/drive", "/stop", "/stream"))
        text = message(self._rng)
        while path == "/stop" and text.isascii() and text.isdecimal():
            text = message(self._rng)  # a number is a stop
        if path not in self._open or self._open[path].closed:
            self._open[path] = await self._page.connect(path)
            self.connections += 1
        socket = self._open[path]
        with contextlib.suppress(ConnectionError, RuntimeError):
            await (socket.send_bytes(text.encode()) if self._rng.random() < 0.1 else socket.send_str(text))
        with contextlib.suppress(TimeoutError, RuntimeError):
            await socket.receive(timeout=0.0005)

    async def close(self) -> None:
        """Close the connections."""
        for socket in self._open.values():
            await socket.close()


async def moves(operator: PageClient) -> None:
    """Jog until the robot has moved."""
    before = np.array(operator.states[-1]["command"])
    for _ in range(40):
        speed = 0.3 if operator.states[-1]["position"][0] < 0 else -0.3
        await operator.jog(0.1, joints={"shoulder_pan": speed})
        if np.abs(np.array(operator.states[-1]["command"]) - before).max() > 1e-3:
            return
    operator.press()
    said = await operator.call("jog", at=clock_ms(), press=operator.press_ms, joints={"shoulder_pan": 0.1})
    raise AssertionError(f"the operator's jog moves nothing: {said}; status: {operator.status}")


async def check(operator: PageClient) -> float:
    """Jog, stop in motion, and reset; return how long STOP took [s]."""
    if operator.states[-1]["estop"] or operator.status["faults"]:
        await operator.call("reset")
        await operator.until(lambda: not operator.states[-1]["estop"])
    if operator.status["mode"] != "web":
        await operator.call("mode", mode="web")
    await operator.call("operate", take_over=True)
    await moves(operator)
    stops = operator.states[-1]["stops"]
    took_s = await operator.estop()
    await operator.until(lambda: operator.states[-1]["estop"] and operator.states[-1]["stops"] == stops + 1)
    await operator.call("reset")
    await operator.until(lambda: not operator.states[-1]["estop"])
    return took_s


async def attack(address: str, count: int, seed: int) -> list[float]:
    """The times of STOP [s]."""
    times = []
    rng = random.Random(seed)
    async with client(address) as operator, client(address) as attacker:
        await operator.until(lambda: operator.states and operator.status.get("jogs"))
        attacks = Attack(attacker, rng)
        begun_s = time.monotonic()
        for number in range(1, count + 1):
            await attacks.send()
            if number % EVERY == 0:
                # The one who drives is the attacker, then the operator: both may send anything.
                times.append(await check(operator))
                print(f"{number} of {count} messages", file=sys.stderr, flush=True)
                if number % (2 * EVERY) == 0:
                    await attacker.call("operate", take_over=True)
        await attacks.close()
    print(f"{count} messages by {attacks.connections} connections in {time.monotonic() - begun_s:.0f} s")
    return times


def main() -> None:
    """Run the attack."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with page_run(*SO101) as address:
        times = asyncio.run(attack(address, given.messages, given.seed))
    late = [each for each in times if each > LIMIT_S]
    print(f"STOP {len(times)} times: median {np.median(times) * 1e3:.1f} ms, worst {max(times) * 1e3:.1f} ms")
    sys.exit(f"{len(late)} later than {LIMIT_S} s" if late else 0)


if __name__ == "__main__":
    main()
