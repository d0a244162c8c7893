"""Scheduling class of every thread of a run.

    python tests/shared/thread_classes.py record so101 --sim --headless --episodes 1

runs that `ibrobot` command, and afterwards prints, as JSON, each thread of its process and of the processes that it
started, with the class under which it ran: `OTHER`, `RR` or `FIFO`, and `RESET` where threads that it starts return to
`OTHER`. Threads that are not Python's count as `native`.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections import defaultdict
from pathlib import Path
from typing import override

_PERIOD_S = 0.2
_CLASSES = {os.SCHED_OTHER: "OTHER", os.SCHED_BATCH: "BATCH", os.SCHED_FIFO: "FIFO", os.SCHED_RR: "RR"}


def scheduling_class(thread: int) -> str:
    """The scheduling class of the thread with this native id; empty if it has ended."""
    try:
        policy = os.sched_getscheduler(thread)
    except ProcessLookupError:
        return ""
    text = _CLASSES.get(policy & ~os.SCHED_RESET_ON_FORK, str(policy))
    return f"{text} RESET" if policy & os.SCHED_RESET_ON_FORK else text


class Sampler(threading.Thread):
    """Notes the classes of all threads of this process and its children, several times a second."""

    def __init__(self) -> None:
        super().__init__(name="sampler", daemon=True)
        self.seen: defaultdict[str, set[str]] = defaultdict(set)
        """Name of a thread -> its classes."""
        self._end = threading.Event()

    @override
    def run(self) -> None:
        """Sample until the end."""
        while not self._end.wait(_PERIOD_S):
            self._sample()

    def end(self) -> None:
        """Stop."""
        self._end.set()
        self.join()

    def _sample(self) -> None:
        # Names after classes: a thread that starts meanwhile has its name before it changes its class.
        classes = {thread: found for thread in _threads(os.getpid()) if (found := scheduling_class(thread))}
        names = {thread.native_id: thread.name for thread in threading.enumerate()}
        for thread, found in classes.items():
            if thread != self.native_id:
                self.seen[names.get(thread, "native")].add(found)
        for task in _threads(os.getpid()):
            for child in _read(f"/proc/self/task/{task}/children").split():
                program = _read(f"/proc/{child}/comm").strip()
                self.seen[f"child process {program}"].update(map(scheduling_class, _threads(int(child))))


def _threads(process: int) -> list[int]:
    try:
        return [int(each.name) for each in Path(f"/proc/{process}/task").iterdir()]
    except FileNotFoundError:
        return []


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except (FileNotFoundError, ProcessLookupError):
        return ""


def main() -> None:
    """Run the command, then print."""
    from ibrobot_core.cli.main import main as ibrobot

    sampler = Sampler()
    sampler.start()
    try:
        ibrobot()
    finally:
        sampler.end()
        print(json.dumps({name: sorted(classes - {""}) for name, classes in sorted(sampler.seen.items())}, indent=1))


if __name__ == "__main__":
    sys.argv[0] = "ibrobot"
    main()
