"""Runs commands `ibrobot episodes …` that die, as by kill -9, before their n-th change of files. Not a test."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

from ibrobot_mcap.commands import episodes

NAMES = ("rename", "replace", "mkdir", "unlink", "rmdir", "symlink", "fsync", "ftruncate", "remove")


def die_at(point: int) -> None:
    count = 0

    def dying(call: Callable[..., Any]) -> Callable[..., Any]:
        def called(*arguments: Any, **more: Any) -> Any:
            nonlocal count
            count += 1
            if count == point:
                os._exit(9)
            return call(*arguments, **more)

        return called

    for name in NAMES:
        setattr(os, name, dying(getattr(os, name)))


def run(point: int, command: Sequence[str]) -> int:
    """Run a command in a child process; returns its exit code."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    os.dup2(2, 1)
    die_at(point)
    episodes(list(command), standalone_mode=False)
    os._exit(0)


if __name__ == "__main__":
    for line in sys.stdin:
        point, *command = json.loads(line)
        print(run(point, command), flush=True)
