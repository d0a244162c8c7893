"""Joint logs on disk: a CSV with the header `time_s,JOINT,…` and a row of positions [rad] for each time.

Recorded logs have a last column `crc32`: the checksum of all lines up to this one, without this column in the rows.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from zlib import crc32

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import RecorderError

TIME, SUM = "time_s", "crc32"
TOPIC = "/joint_states"
"""The recorded topic."""
LOG, METADATA = "joints.csv", "metadata.json"
"""Files of a recorded episode."""


@attrs.frozen(eq=False)
class JointLog:
    """Samples of joint positions."""

    joints: tuple[str, ...]
    times: NDArray[np.float64]
    """[s], increasing, shape (N,), N >= 1."""
    positions: NDArray[np.float64]
    """[rad], shape (N, J)."""


def header(joints: Sequence[str]) -> tuple[str, int]:
    """The first line of a log, and its checksum."""
    line = ",".join((TIME, *joints, SUM))
    return f"{line}\n", crc32(line.encode())


def row(time_ns: int, positions: Iterable[float], checksum: int) -> tuple[str, int]:
    """A line of a log, from which the same floats and the exact time in nanoseconds can be read, and its checksum.

    Args:
        time_ns: the time [ns].
        positions: [rad].
        checksum: of the line before.
    """
    sign, time_ns = ("-", -time_ns) if time_ns < 0 else ("", time_ns)
    time = f"{sign}{time_ns // 1_000_000_000}.{time_ns % 1_000_000_000:09d}"
    line = ",".join((time, *(repr(float(p)) for p in positions)))
    checksum = crc32(line.encode(), checksum)
    return f"{line},{checksum:08x}\n", checksum


def read_log(path: Path) -> JointLog:
    """Read a log.

    Raises:
        RecorderError: if it cannot be read, or the header or a row is invalid; with file:line.
    """
    try:
        # Accept the byte order mark that spreadsheets write.
        *lines, rest = path.read_text(encoding="utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise RecorderError(f"{path}: cannot be read: {error}") from None
    if rest:
        raise RecorderError(f"{path}:{len(lines) + 1}: the line does not end, so the log was cut off within it")
    first, *rows = lines or [""]
    rows = _checked(path, first, rows)
    names = [name.strip() for name in first.removesuffix(f",{SUM}").split(",")]
    _check_header(path, names)
    times: list[float] = []
    samples: list[list[float]] = []
    for number, line in enumerate(rows, start=2):
        where, cells = f"{path}:{number}", line.split(",")
        values = _numbers(where, names, cells)
        if times and values[0] <= times[-1]:
            raise RecorderError(f"{where}: time_s is {values[0]}, must be greater than {times[-1]}")
        times.append(values[0])
        samples.append(values[1:])
    if not times:
        raise RecorderError(f"{path}:1: has no row after the header")
    return JointLog(tuple(names[1:]), np.array(times), np.array(samples))


def _checked(path: Path, first: str, rows: Sequence[str]) -> list[str]:
    """The rows without their checksums, which a log that was written by hand does not have."""
    if not first.endswith(f",{SUM}"):
        return list(rows)
    checksum, checked = crc32(first.encode()), []
    for number, line in enumerate(rows, start=2):
        content, _, stated = line.rpartition(",")
        checksum = crc32(content.encode(), checksum)
        if stated != f"{checksum:08x}":
            raise RecorderError(
                f"{path}:{number}: the line or one before it was changed: {SUM} is {stated!r}, must be "
                f"{checksum:08x}; after a change on purpose, remove the column {SUM}"
            )
        checked.append(content)
    return checked


def _check_header(path: Path, names: Sequence[str]) -> None:
    where = f"{path}:1"
    if names[0] != TIME or not all(names) or len(names) == 1:
        raise RecorderError(f"{where}: the header begins with {names[0]!r}, must be {TIME},JOINT,…")
    for name in names[1:]:
        if names.count(name) > 1:
            raise RecorderError(f"{where}: joint {name!r} has {names.count(name)} columns, must have one")


def _numbers(where: str, names: Sequence[str], cells: Sequence[str]) -> list[float]:
    if len(cells) != len(names):
        raise RecorderError(f"{where}: {len(cells)} values, must be {len(names)} as in the header")
    values: list[float] = []
    for name, cell in zip(names, cells, strict=True):
        try:
            value = float(cell)
        except ValueError:
            raise RecorderError(f"{where}: {name} is {cell!r}, must be a number") from None
        if not math.isfinite(value):
            raise RecorderError(f"{where}: {name} is {value}, must be finite")
        values.append(value)
    return values
