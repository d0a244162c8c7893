"""Jobs for the suite of pools. They leave files in a folder, by which a check sees what they did, and when."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import attrs

from ibrobot_core.api import DatasetError

type Progress = Callable[[int], None]
_POLL_S = 0.02


@attrs.frozen
class Order:
    """The argument of these jobs."""

    number: int
    folder: str = ""
    """For what the job leaves behind, and waits for."""


def square(order: Order, progress: Progress) -> int:
    """The square of the number, which is the progress, too."""
    for _ in range(order.number):
        progress(1)
    return order.number**2


def process(order: Order, progress: Progress) -> tuple[int, str]:
    """The process of the job, and its folder."""
    return os.getpid(), os.getcwd()


def fail_if_odd(order: Order, progress: Progress) -> int:
    """The number if it is even; otherwise an error."""
    if order.number % 2:
        error = DatasetError(f"{order.number} is odd")
        error.exit_code = 7
        raise error
    return order.number


def divide(order: Order, progress: Progress) -> float:
    """A bug for the number 0."""
    return 1 / order.number


def die_once(order: Order, progress: Progress) -> int:
    """Kill the process, unless it was done before."""
    progress(1)
    mark = Path(order.folder) / f"died_{order.number}"
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return order.number


def die_if_odd(order: Order, progress: Progress) -> int:
    """Kill the process each time if the number is odd."""
    progress(1)
    if order.number % 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return order.number


def wait(order: Order, progress: Progress) -> int:
    """Leave the file `began_N` with the process, and wait for the file `go`."""
    progress(1)
    folder = Path(order.folder)
    staged = folder / f".began_{order.number}"
    staged.write_text(str(os.getpid()))
    staged.rename(folder / f"began_{order.number}")
    while not (folder / "go").exists():
        time.sleep(_POLL_S)
    return order.number


def count_begun(order: Order, progress: Progress) -> int:
    """The number of jobs that begin until this one ends, which takes longer than a process needs to begin."""
    folder = Path(order.folder)
    (folder / f"began_{order.number}").touch()
    for _ in range(2):
        subprocess.run([sys.executable, "-c", f"import {__name__}"], check=True)
    return len(list(folder.glob("began_*")))
