"""A fixture that fails any test that leaves a thread, a child process or an open file behind.

In a plugin's `conftest.py`:

    from ibrobot_testing.leaks import no_leaks  # noqa: F401
"""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing import resource_tracker
from pathlib import Path

import pytest

GRACE_S = 30.0
"""How long a thread that was told to end may take to do so [s]."""

_SHARED = ("/dev/dri", "/dev/nvidia", "/dev/urandom", "/dev/null", "anon_inode:[eventpoll]")
"""Files that libraries open once and keep, such as a GPU's device."""


def open_files() -> dict[int, str]:
    """Descriptor -> what it is open on; empty where the system does not tell."""
    found: dict[int, str] = {}
    directory = Path("/proc/self/fd")
    for name in os.listdir(directory) if directory.exists() else ():
        try:
            target = os.readlink(directory / name)
        except FileNotFoundError:  # the one that listed the directory
            continue
        if not target.startswith(_SHARED):
            found[int(name)] = target
    return found


def child_processes() -> dict[int, str]:
    """Process id -> command line of every child, ended ones that nobody waited for included."""
    found: dict[int, str] = {}
    for children in Path("/proc/self/task").glob("*/children"):
        pids: list[str] = []
        with suppress(FileNotFoundError, ProcessLookupError):  # threads and processes end while this looks at them
            pids = children.read_text().split()
        for pid in pids:
            with suppress(FileNotFoundError, ProcessLookupError):
                found[int(pid)] = Path(f"/proc/{pid}/cmdline").read_text(errors="replace").replace("\0", " ")
    return found


def leaks(threads: set[threading.Thread], children: set[int], files: dict[int, str]) -> list[str]:
    """What there is now beyond `threads`, `children` and `files`, in words."""
    left: list[str] = []
    for thread in set(threading.enumerate()) - threads:
        if isinstance(thread, threading._DummyThread):
            continue  # a library's own, which Python cannot join, and may take for alive long after its end
        thread.join(GRACE_S)
        if thread.is_alive():
            left.append(f"thread {thread.name!r}")
    left += [f"child process {pid}: {name}" for pid, name in child_processes().items() if pid not in children]
    left += [f"open file {fd}: {name}" for fd, name in open_files().items() if files.get(fd) != name]
    return left


@pytest.fixture(autouse=True)
def no_leaks() -> Iterator[None]:
    """Fail a test that leaves something behind."""
    if os.name == "posix":
        resource_tracker.ensure_running()  # it lives as long as the interpreter, so it counts as there before
    threads, children, files = set(threading.enumerate()), set(child_processes()), open_files()
    yield
    left = leaks(threads, children, files)
    if left:
        gc.collect()  # a file without references is closed only now: untidy, but no leak
        left = leaks(threads, children, files)
    if left:
        pytest.fail("the test left behind: " + "; ".join(left), pytrace=False)
