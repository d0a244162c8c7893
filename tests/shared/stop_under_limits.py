"""Emergency stops while the system runs out of memory, threads, files or disk: they are answered, or the run has ended.

    python tests/shared/stop_under_limits.py [--runs 200] [--seed 0] [--kind memory] [--floor 10] [--json FILE]

Each run is `ibrobot launch` of an arm that waves by itself, with its page, its keys in a pseudo-terminal, and its
services shared over Zenoh, all connected before. At a random moment, one limit is lowered to what is in use: of the
address space (`RLIMIT_AS`), of threads (a control group `pids`, since `RLIMIT_NPROC` does not bind root; `RLIMIT_NPROC`
for other users), of open files (`RLIMIT_NOFILE`), or the disk (a tmpfs of 4 MiB, as root) on which the run writes is
filled; for the host process alone or for all processes of the run. Then come calls and connections that need what is
missing, and, up to a second later, a stop by the page, by Esc or by `/estop`. It must be confirmed, or the run must
have ended, and the arm must be at rest, all within 0.5 s. The made-up arm notes in a shared file when it was last
moved, so that the figure does not depend on the processes that are short of something.

The first `--floor` runs lower nothing: they say how late a stop is on this machine. Prints a line per run and a table,
and exits with 1 if a stop was lost: no answer within 5 s in a run that goes on, or motion 2 s after it. Stops that were
only late are counted apart, since a busy machine is late without any limit.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import fcntl
import json
import mmap
import os
import pty
import random
import re
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import aiohttp
import attrs
import pytest
from ibrobot_ros2.services import Call, decode_answer, encode_call, endpoint
from ibrobot_testing import host_context
from ibrobot_testing.ports import free_port
from ibrobot_testing.site import made_up_site
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.transport import ZenohTransport

from ibrobot_core.errors import IbrobotError

KINDS = ("memory", "threads", "files", "disk")
WAYS = ("page", "key", "service")
ALLOWED_S = 0.5
LOST_S, REST_LOST_S = 5.0, 2.0
"""Times after which an answer that has not come, and an arm that still moves, count as lost [s]."""
START_S = 90.0
DISK = "4m"
PIDS = Path("/sys/fs/cgroup/pids")
MOVED = struct.Struct("<qq")
"""In the shared file: when the arm was last moved, and when it was last commanded, by the monotonic clock [ns]."""
PLUGINS = Path(__file__).parent / "plugins"
ROBOT = """
robot:
  name: mini
  joints:
    - {{name: pan, lower: -3.0, upper: 3.0, max_velocity: 3.0, max_acceleration: 40.0}}
    - {{name: lift, lower: -3.0, upper: 3.0, max_velocity: 3.0, max_acceleration: 40.0}}
  groups: {{arm: [pan, lift]}}
hardware: {{type: witness, file: {witness}}}
executors:
  arm_position: {{type: position, group: arm}}
control_modes:
  teleop: {{executors: [arm_position], teleop: wave}}
teleoperation:
  wave: {{type: waving}}
default_control_mode: teleop
control: {{rate_hz: 100, stop: hold}}
viewer: {{type: web, port: 0, browser: false}}
transport:
  type: zenoh
  mode: router
  listen: [{listen}]
  shared_memory: false
  share: {{services: [/estop], publish: [/joint_states]}}
"""


START = """
import fcntl, os, termios
with open({group!r}, "w") as group:
    group.write(str(os.getpid()))
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
from ibrobot_core.cli.main import main
main()
"""
"""The process of a run: in its control group, with the pseudo-terminal as its terminal."""


@attrs.frozen
class Result:
    """How a stop went."""

    number: int
    kind: str
    """Which limit was lowered; `none` for none."""
    way: str
    of_all: bool
    """Whether the limit of all processes was lowered, not of the host alone."""
    answered_s: float | None
    """Time from the stop to its answer, or to the end of the run; None if neither came."""
    ended: bool
    """Whether the run ended, before its answer or instead of it."""
    rest_s: float
    """Time from the stop to the last motion of the arm [s]."""
    was_moving: bool
    """Whether the arm moved when the stop was sent."""
    said: str

    @property
    def lost(self) -> bool:
        """Whether there was no answer, or the arm went on moving."""
        return self.answered_s is None or self.rest_s > REST_LOST_S

    @property
    def late(self) -> bool:
        """Whether the answer or the rest took longer than allowed."""
        return not self.lost and max(self.answered_s or 0.0, self.rest_s) > ALLOWED_S


class Witnessed:
    """The shared file in which the arm notes its motion."""

    def __init__(self, path: Path) -> None:
        path.write_bytes(bytes(4096))
        with path.open("r+b") as file:
            self._shared = mmap.mmap(file.fileno(), 4096)

    def moved_ns(self) -> int:
        """When the arm was last moved, by the monotonic clock [ns]."""
        moved: int = MOVED.unpack_from(self._shared)[0]
        return moved

    def is_moving(self) -> bool:
        """Whether the arm was moved within the last 0.1 s."""
        return time.monotonic_ns() - self.moved_ns() < 100_000_000


class Run:
    """A launched robot in a pseudo-terminal, with clients of its page and of its services."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(exist_ok=True)
        witness = folder.parent / f"witness-{folder.name}"
        self.witness = Witnessed(witness)
        port = free_port()
        (folder / "mini.yaml").write_text(ROBOT.format(witness=witness, listen=f"tcp/127.0.0.1:{port}"))
        self._group = PIDS / f"ibrobot-stop-{os.getpid()}-{folder.name}"
        self.has_group = False
        with contextlib.suppress(OSError):
            self._group.mkdir()
            self.has_group = True
        self._master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 160, 0, 0))
        begin = START.format(group=str(self._group / "cgroup.procs") if self.has_group else "/dev/null")
        command = [sys.executable, "-c", begin, "launch", "mini.yaml"]
        self.host = subprocess.Popen(
            command, cwd=folder, stdin=slave, stdout=slave, stderr=slave, start_new_session=True,
            env={**os.environ, "TERM": "xterm", "CI": "1", "TMPDIR": str(folder)},
        )  # fmt: skip
        os.close(slave)
        self.screen = b""
        self.output = (folder / "output.txt").open("ab", buffering=0)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        address = self._await(lambda: (m := re.search(rb"viewer: (http\S+)", self._text())) and m[1].decode(), "page")
        self._zenoh = ZenohTransport(
            ZenohOptions(connect=(f"tcp/127.0.0.1:{port}",), shared_memory=False), host_context()
        )
        self._loop = asyncio.new_event_loop()
        self._looping = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._looping.start()
        self._in_loop(self._open_page(address), START_S)
        self._await(self._is_served, "services")
        self._await(self.witness.is_moving, "motion")

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while piece := os.read(self._master, 65536):
                self.screen = (self.screen + piece)[-400_000:]

    def _text(self) -> bytes:
        return re.sub(rb"\x1b\[[0-9;?]*[a-zA-Z]", b"", self.screen)

    def _await(self, condition: Callable[[], Any], what: str) -> Any:
        deadline_s = time.monotonic() + START_S
        while not (found := condition()):
            if self.host.poll() is not None or time.monotonic() > deadline_s:
                raise RuntimeError(f"{what}: not within {START_S:g} s: {self._text()[-3000:].decode(errors='replace')}")
            time.sleep(0.05)
        return found

    def _in_loop(self, work: Any, timeout_s: float) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(timeout_s)

    async def _open_page(self, address: str) -> None:
        self._browser = aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True))
        async with self._browser.get(address) as answer:
            assert answer.status == 200, answer.status
            self.base = str(answer.url).rstrip("/")
        self._line = await self._browser.ws_connect(f"{self.base}/stop", origin=self.base)

    def _is_served(self) -> bool:
        with contextlib.suppress(IbrobotError):
            return self.ask("/estop/check", 5.0)
        return False

    def ask(self, service: str, timeout_s: float) -> bool:
        """Call a service; return whether it succeeded."""
        answer = decode_answer(self._zenoh.request(endpoint(), encode_call(Call(service)), timeout_s))
        return answer.result

    def processes(self) -> list[int]:
        """The host and its children."""
        found = [self.host.pid]
        for task in Path(f"/proc/{self.host.pid}/task").glob("*/children"):
            with contextlib.suppress(OSError):
                found += [int(pid) for pid in task.read_text().split()]
        return found

    def limit(self, kind: str, rng: random.Random, *, of_all: bool) -> None:
        """Lower a limit to what is in use."""
        pids = self.processes() if of_all else [self.host.pid]
        if kind == "memory":
            spare = rng.choice((0, 0, 1 << 16, 1 << 20, 8 << 20))
            for pid in pids:
                pages = int(Path(f"/proc/{pid}/statm").read_text().split()[0])
                _lower(pid, resource.RLIMIT_AS, pages * resource.getpagesize() + spare)
        elif kind == "threads":
            if self.has_group:
                (self._group / "pids.max").write_text((self._group / "pids.current").read_text())
            else:
                for pid in pids:
                    _lower(pid, resource.RLIMIT_NPROC, 1)
        elif kind == "files":
            for pid in pids:
                used = {int(entry) for entry in os.listdir(f"/proc/{pid}/fd")}
                _lower(pid, resource.RLIMIT_NOFILE, next(n for n in range(1 << 16) if n not in used))
        elif kind == "disk":
            with contextlib.suppress(OSError), (self._folder / "full").open("wb", buffering=0) as full:
                while True:
                    full.write(bytes(4096))

    def press(self) -> list[threading.Thread]:
        """Ask for what needs threads, memory and files, and do not wait for it."""

        def ask() -> None:
            with contextlib.suppress(Exception):
                self.ask("/rosapi/services", 3.0)

        def open_page() -> None:
            with contextlib.suppress(Exception):
                self._in_loop(self._fetch(), 3.0)

        threads = [threading.Thread(target=work, daemon=True) for work in [ask] * 5 + [open_page] * 3]
        for thread in threads:
            thread.start()
        return threads

    async def _fetch(self) -> None:
        async with aiohttp.ClientSession() as session, session.get(self.base, timeout=aiohttp.ClientTimeout(2.0)):
            pass

    def stop(self, way: str) -> tuple[float | None, bool, float, bool, str]:
        """Stop the robot; see `Result`."""
        begun_ns = time.monotonic_ns()
        was_moving = begun_ns - self.witness.moved_ns() < 100_000_000
        said, answered_s = "", None
        asked = threading.Thread(target=self._send, args=(way, begun_ns), daemon=True)
        self._answer: tuple[float, str] | None = None
        asked.start()
        ended = False
        while (passed_s := (time.monotonic_ns() - begun_ns) * 1e-9) < LOST_S:
            if self.host.poll() is not None:
                ended, answered_s = True, passed_s
                break
            if self._answer is not None and answered_s is None:
                answered_s, said = self._answer
                if answered_s is not None:
                    break
            if way == "key" and not self.witness.is_moving() and passed_s > 0.15:
                answered_s = max(0.0, (self.witness.moved_ns() - begun_ns) * 1e-9)  # nothing is sent back to a terminal
                break
            time.sleep(0.002)
        rest = begun_ns + int(REST_LOST_S * 1.5e9)
        while time.monotonic_ns() < rest and (self.host.poll() is None or self.witness.is_moving()):
            time.sleep(0.02)
        return answered_s, ended, max(0.0, (self.witness.moved_ns() - begun_ns) * 1e-9), was_moving, said

    def _send(self, way: str, begun_ns: int) -> None:
        answered = False
        try:
            if way == "key":
                os.write(self._master, b"\x1b")
                return
            if way == "page":
                answered, said = self._in_loop(self._stop_by_page(), LOST_S)
            else:
                answer = decode_answer(self._zenoh.request(endpoint(), encode_call(Call("/estop")), LOST_S))
                answered, said = answer.result, str(answer.values)
        except Exception as error:  # noqa: BLE001 - the figure says that there was no answer
            said = f"{type(error).__name__}: {error}"
        if answered:
            self._answer = ((time.monotonic_ns() - begun_ns) * 1e-9, said)
        else:
            self.refused = said

    refused = ""

    async def _stop_by_page(self) -> tuple[bool, str]:
        await self._line.send_str("1")
        message = await self._line.receive(LOST_S)
        return message.type is aiohttp.WSMsgType.TEXT and "ok" in json.loads(message.data), str(message.data)

    def tail(self) -> str:
        """The last that the run printed."""
        return self._text()[-2500:].decode(errors="replace")

    def close(self) -> None:
        """End everything."""
        pids = self.processes()
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.host.wait()
        with contextlib.suppress(Exception):
            self._in_loop(self._browser.close(), 2.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._looping.join(2.0)
        self._zenoh.close()
        self.output.close()
        os.close(self._master)
        if self.has_group:
            for _ in range(100):
                with contextlib.suppress(OSError):
                    self._group.rmdir()
                    break
                time.sleep(0.05)


def _lower(pid: int, limit: int, most: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        resource.prlimit(pid, limit, (most, resource.prlimit(pid, limit)[1]))


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[bool]:
    """A tmpfs at a folder; yields whether this user may mount one."""
    folder.mkdir()
    mounted = (
        os.geteuid() == 0
        and not subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "none", str(folder)], capture_output=True, check=False
        ).returncode
    )
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(folder)], check=False)
        shutil.rmtree(folder, ignore_errors=True)


def one(number: int, kind: str, way: str, rng: random.Random, base: Path) -> tuple[Result, str]:
    """One run."""
    of_all = kind == "threads" or rng.random() < 0.5
    with small_disk(base / f"run{number}") as mounted:
        if kind == "disk" and not mounted:
            raise PermissionError("a full disk needs a tmpfs, which only root may mount")
        run = Run(base / f"run{number}")
        try:
            time.sleep(rng.uniform(0.0, 1.0))
            if kind != "none":
                run.limit(kind, rng, of_all=of_all)
                run.press()
            time.sleep(rng.uniform(0.0, 1.0))
            answered_s, ended, rest_s, was_moving, said = run.stop(way)
            result = Result(number, kind, way, of_all, answered_s, ended, rest_s, was_moving, said or run.refused)
            return result, run.tail()
        finally:
            run.close()


def main() -> None:
    """Print how each stop went; 1 if one was lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200, help="runs with a limit, divided among the kinds")
    parser.add_argument("--floor", type=int, default=9, help="runs without a limit")
    parser.add_argument("--kind", choices=KINDS, action="append", help="only these limits")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="file for all results")
    options = parser.parse_args()
    kinds = options.kind or KINDS
    plan = ["none"] * options.floor + [kinds[i % len(kinds)] for i in range(options.runs)]
    results: list[Result] = []
    with (
        tempfile.TemporaryDirectory() as made,
        pytest.MonkeyPatch.context() as patches,
        made_up_site(Path(made) / "site", PLUGINS, patches) as site,
    ):
        for name in ("witness", "waving"):
            site.add(name, f"{name}.py")
        for number, kind in enumerate(plan):
            rng = random.Random(options.seed * 100_003 + number)
            way = WAYS[(number // len(kinds)) % len(WAYS)] if kind != "none" else WAYS[number % len(WAYS)]
            try:
                result, tail = one(number, kind, way, rng, Path(made))
            except RuntimeError as error:  # the machine was too busy to start it
                print(f"{number:4} {kind:8} {way:8} did not start: {error}", flush=True)
                continue
            results.append(result)
            _print(result, tail)
            if options.json:
                options.json.write_text(json.dumps([attrs.asdict(each) for each in results], indent=1))
    for kind in ("none", *kinds):
        _summarize(kind, [each for each in results if each.kind == kind])
    sys.exit(any(each.lost for each in results))


def _print(result: Result, tail: str) -> None:
    answered = "no answer" if result.answered_s is None else f"{result.answered_s * 1e3:6.0f} ms"
    verdict = "LOST" if result.lost else "late" if result.late else "ok"
    print(
        f"{result.number:4} {result.kind:8} {result.way:8} {'all ' if result.of_all else 'host'} {answered:>9}"
        f"{' (ended)' if result.ended else '        '} rest {result.rest_s * 1e3:6.0f} ms"
        f"{'' if result.was_moving else ' (at rest before)'} {verdict} {result.said[:100]}",
        flush=True,
    )
    if result.lost:
        print(tail, flush=True)


def _summarize(kind: str, results: list[Result]) -> None:
    if not results:
        return
    answered = _median_and_worst([each.answered_s for each in results if each.answered_s is not None])
    rest = _median_and_worst([each.rest_s for each in results])
    late, lost, ended = (sum(getattr(each, name) for each in results) for name in ("late", "lost", "ended"))
    print(
        f"{kind:8} {len(results):3} runs: answered or ended after {answered}, at rest after {rest}; "
        f"{ended} ended, {late} late, {lost} lost"
    )


def _median_and_worst(times_s: list[float]) -> str:
    ordered = sorted(times_s)
    return f"{ordered[len(ordered) // 2] * 1e3:.0f} ms (worst {ordered[-1] * 1e3:.0f})" if ordered else "-"


if __name__ == "__main__":
    main()
