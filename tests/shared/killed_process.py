"""Commands of `ibrobot` that die, as by kill -9, before their n-th change of files.

Imported, `killing()` gives the function that runs them. Run as a program, it forks a child for each, and imports what
one imported, so that the next ones need not.
"""

from __future__ import annotations

import importlib
import json
import mmap
import os
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

NAMES = ("rename", "replace", "mkdir", "unlink", "rmdir", "symlink", "fsync", "ftruncate", "remove")
KILLED = 9
_ROOM = 1 << 20
"""For the number of changes and the names of modules [bytes]."""


@contextmanager
def killing() -> Iterator[Callable[..., tuple[int, int]]]:
    """A function of a point, from 1, and a command line: returns the exit code, `KILLED` then, and the changes so far.

    Point 0 lets the command end by itself.
    """
    with subprocess.Popen(
        [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        stdin, stdout = process.stdin, process.stdout

        def run(point: int, *command: object) -> tuple[int, int]:
            stdin.write(json.dumps([point, *map(str, command)]) + "\n")
            stdin.flush()
            code, changes = map(int, stdout.readline().split())
            return code, changes

        yield run
        stdin.close()


def _die_at(point: int, changes: mmap.mmap) -> None:
    count = 0

    def dying(call: Callable[..., Any]) -> Callable[..., Any]:
        def called(*arguments: Any, **more: Any) -> Any:
            nonlocal count
            count += 1
            changes[:4] = struct.pack("i", count)
            if count == point:
                _end(KILLED, changes)
            return call(*arguments, **more)

        return called

    for name in NAMES:
        setattr(os, name, dying(getattr(os, name)))


def _end(code: int, changes: mmap.mmap) -> NoReturn:
    """End the child; its parent reads what it imported."""
    names = "\n".join(sys.modules).encode()
    changes[4 : 4 + len(names)] = names
    os._exit(code)


def _run(point: int, command: Sequence[str]) -> tuple[int, int]:
    """Run a command in a child process; returns its exit code and how often it changed files."""
    from ibrobot_core.cli.main import main

    changes = mmap.mmap(-1, _ROOM)
    child = os.fork()
    if child:
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        for name in changes[4:].rstrip(b"\0").decode().split("\n"):
            if name not in sys.modules:
                with suppress(ImportError):  # made by another one
                    importlib.import_module(name)
        return code, struct.unpack("i", changes[:4])[0]
    os.dup2(2, 1)
    sys.argv = ["ibrobot", *command]
    _die_at(point, changes)
    try:
        main()
    except SystemExit as end:
        _end(end.code if isinstance(end.code, int) else 0, changes)
    _end(0, changes)


if __name__ == "__main__":
    for line in sys.stdin:
        at, *words = json.loads(line)
        print(*_run(at, words), flush=True)
