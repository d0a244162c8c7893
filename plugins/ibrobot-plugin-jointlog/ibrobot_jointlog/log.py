"""Joint logs on disk: a CSV with the header `time_s,JOINT,…` and a row of positions [rad] for each time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.errors import TeleopError

TIME = "time_s"


@attrs.frozen(eq=False)
class JointLog:
    """Samples of joint positions."""

    times: NDArray[np.float64]
    """[s], increasing, shape (N,), N >= 1."""
    positions: NDArray[np.float64]
    """[rad], shape (N, J)."""


def header(joints: Sequence[str]) -> str:
    """The first line of a log."""
    return ",".join((TIME, *joints)) + "\n"


def row(time_ns: int, positions: Iterable[float]) -> str:
    """A line of a log; reading it gives back the same floats, and the time to the nanosecond."""
    sign, time_ns = ("-", -time_ns) if time_ns < 0 else ("", time_ns)
    time = f"{sign}{time_ns // 1_000_000_000}.{time_ns % 1_000_000_000:09d}"
    return ",".join((time, *(repr(float(p)) for p in positions))) + "\n"


def read_log(path: Path, joints: Sequence[str]) -> JointLog:
    """Read a log of exactly `joints`, in whatever order the file has them.

    Args:
        path: the file.
        joints: the joints to find, and their order in the result.

    Raises:
        TeleopError: with file:line, when it cannot be read, lacks a joint or has others, or a row does not fit.
    """
    try:
        # With or without the byte order mark that spreadsheets write.
        first, *rows = path.read_text(encoding="utf-8-sig").removesuffix("\n").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise TeleopError(f"{path}: cannot be read: {error}") from None
    names = [name.strip() for name in first.split(",")]
    order = _columns(path, names, joints)
    times: list[float] = []
    samples: list[list[float]] = []
    for number, line in enumerate(rows, start=2):
        where, cells = f"{path}:{number}", line.split(",")
        values = _numbers(where, names, cells)
        if times and values[0] <= times[-1]:
            raise TeleopError(f"{where}: time_s is {values[0]}, must be above {times[-1]} of the row before")
        times.append(values[0])
        samples.append([values[i] for i in order])
    if not times:
        raise TeleopError(f"{path}:1: no row follows the header, there must be at least one")
    return JointLog(np.array(times), np.array(samples))


def _columns(path: Path, names: Sequence[str], joints: Sequence[str]) -> list[int]:
    """Column of each joint."""
    where = f"{path}:1"
    if names[0] != TIME:
        raise TeleopError(f"{where}: the header begins with {names[0]!r}, must be {TIME},JOINT,…")
    for name in names[1:]:
        if name not in joints:
            raise TeleopError(f"{where}: no joint {name!r}; the joints are: {', '.join(joints)}")
        if names.count(name) > 1:
            raise TeleopError(f"{where}: joint {name!r} has {names.count(name)} columns, must have one")
    for joint in joints:
        if joint not in names:
            raise TeleopError(f"{where}: joint {joint!r} is missing")
    return [names.index(joint) for joint in joints]


def _numbers(where: str, names: Sequence[str], cells: Sequence[str]) -> list[float]:
    if len(cells) != len(names):
        raise TeleopError(f"{where}: {len(cells)} values, must be {len(names)} as in the header")
    values: list[float] = []
    for name, cell in zip(names, cells, strict=True):
        try:
            value = float(cell)
        except ValueError:
            raise TeleopError(f"{where}: {name} is {cell!r}, must be a number") from None
        if not math.isfinite(value):
            raise TeleopError(f"{where}: {name} is {value}, must be finite")
        values.append(value)
    return values
