"""Progress of benchmarks that take minutes: a line on standard error after each round."""

from __future__ import annotations

import sys
from collections.abc import Iterator


def in_rounds(count: int, what: str = "round") -> Iterator[int]:
    """The numbers of the rounds, from 0."""
    for number in range(count):
        yield number
        print(f"{what} {number + 1} of {count}", file=sys.stderr, flush=True)
