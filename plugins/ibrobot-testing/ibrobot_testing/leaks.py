"""Resource leaks of tests: threads, child processes, open files and ports.

Every suite checks them. For other tests of a project, set `usefixtures = ["no_leaks"]` in its pytest configuration.
"""

from __future__ import annotations

import gc
import os
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from pathlib import Path
from sysconfig import get_path
from typing import Literal, Self, get_args

import attrs
import pytest

type Kind = Literal["thread", "process", "file", "port"]
"""Kinds of leaks; a port is an open TCP or UDP socket."""

_SHARED = ("/dev/dri", "/dev/nvidia", "/dev/urandom", "/dev/null", "anon_inode:[eventpoll]", get_path("platlib"))
"""Files that libraries open once and keep open, such as a GPU's device or Matplotlib's fonts."""


_POLL_S = 0.05

_KINDS: tuple[Kind, ...] = get_args(Kind.__value__)


def _check_reasons(_: object, __: object, allow: Mapping[Kind, str]) -> None:
    for kind, reason in allow.items():
        if kind not in _KINDS:
            raise ValueError(f"allow: {kind!r} is not a kind of leak; the kinds are {', '.join(_KINDS)}")
        if not reason.strip():
            raise ValueError(f"allow: say why a {kind} may be left behind, e.g. {{{kind!r}: 'libfoo keeps it'}}")


@attrs.frozen
class LeakCheck:
    """A check for leaks of a test, with exceptions that need a reason.

    Files, ports and child processes are detected on Linux only.

    Attributes:
        allow: kind of leak -> reason why it is allowed.
        grace_s: time for threads, processes and connections to end [s].
    """

    allow: Mapping[Kind, str] = attrs.field(factory=dict[Kind, str], validator=_check_reasons)
    grace_s: float = 5.0

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Fail the test if the block leaks a resource.

        Raises:
            pytest.fail.Exception: if there is a leak; names each thread, process, file and port.
        """
        if os.name == "posix":
            resource_tracker.ensure_running()  # it lives as long as the interpreter and is not a leak
        before = _Found.now()
        yield
        deadline = time.monotonic() + self.grace_s
        self._join_threads(before, deadline)
        left = self._left_since(before)
        if left:
            gc.collect()  # closes files without references, which are not leaks
            left = self._left_since(before)
        while left and time.monotonic() < deadline:  # e.g. a server's end of a connection, which its thread closes
            time.sleep(_POLL_S)
            left = self._left_since(before)
        if left:
            pytest.fail("the test left behind: " + "; ".join(left), pytrace=False)

    def _join_threads(self, before: _Found, deadline: float) -> None:
        """Wait for ending threads."""
        if "thread" not in self.allow:
            for thread in _threads() - before.threads:
                thread.join(max(0.0, deadline - time.monotonic()))

    def _left_since(self, before: _Found) -> list[str]:
        """Descriptions of the leaks since `before` that are not allowed."""
        now = _Found.now()
        left: list[tuple[Kind, str]] = [("thread", f"thread {t.name!r}") for t in now.threads - before.threads]
        left += [("process", f"process {i}: {text}") for i, text in now.children.items() if i not in before.children]
        left += [_describe(fd, target) for fd, target in now.files.items() if before.files.get(fd) != target]
        return [text for kind, text in left if kind not in self.allow]


@attrs.frozen
class _Found:
    """The resources of this process at one moment."""

    threads: set[threading.Thread]
    children: dict[int, str]
    files: dict[int, str]

    @classmethod
    def now(cls) -> Self:
        return cls(_threads(), _child_processes(), _open_files())


def _threads() -> set[threading.Thread]:
    """Those of Python; libraries' own, which are dummies, cannot be joined, and may seem alive long after their end."""
    return {thread for thread in threading.enumerate() if not isinstance(thread, threading._DummyThread)}


def _open_files() -> dict[int, str]:
    """Descriptor -> its target; empty if the system does not provide it."""
    files: dict[int, str] = {}
    directory = "/proc/self/fd"
    for name in os.listdir(directory) if os.path.exists(directory) else ():
        try:
            target = os.readlink(f"{directory}/{name}")
        except FileNotFoundError:  # the one that listed the directory
            continue
        if not target.startswith(_SHARED):
            files[int(name)] = target
    return files


def _child_processes() -> dict[int, str]:
    """Process id -> command line of every child, or else its name; including zombies."""
    processes: dict[int, str] = {}
    tasks = "/proc/self/task"
    for task in os.listdir(tasks) if os.path.exists(tasks) else ():
        pids: list[str] = []
        # Threads and processes end while this looks at them.
        with suppress(FileNotFoundError, ProcessLookupError), open(f"{tasks}/{task}/children") as children:
            pids = children.read().split()
        for pid in pids:
            with suppress(FileNotFoundError, ProcessLookupError):
                command = Path(f"/proc/{pid}/cmdline").read_text(errors="replace").replace("\0", " ")
                # A process that begins or has ended has none.
                processes[int(pid)] = command or Path(f"/proc/{pid}/comm").read_text(errors="replace").strip()
    return processes


def _describe(fd: int, target: str) -> tuple[Kind, str]:
    """Kind and description of an open descriptor: sockets by their port."""
    if target.startswith("socket:"):
        with suppress(OSError), socket.socket(fileno=os.dup(fd)) as opened:
            if opened.family in {socket.AF_INET, socket.AF_INET6} and opened.getsockname()[1]:
                host, port, *_ = opened.getsockname()
                return "port", f"port {port} on {host}"
    return "file", f"open file {fd}: {target}"


@pytest.fixture
def no_leaks() -> Iterator[None]:
    """Fail a test that leaks a resource."""
    with LeakCheck().watch():
        yield
