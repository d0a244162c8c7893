"""Options of commands whose work is done elsewhere, or in parts by several machines that are merged afterwards."""

from __future__ import annotations

import re
from typing import Any

from ibrobot_core.api import option


def on_option() -> Any:
    """The option `on` of a command that runs jobs; see `open_pool`."""
    return option(
        "", label=None, unit="type[://address]",
        help="where the work is done: a type of pool, with an address if it needs one; by default on this machine",
    )  # fmt: skip


def shard_option() -> Any:
    """The option `shard` of a command that can do a part of its work; see `shard_of`."""
    return option(
        "", validator=_check_shard, label=None, unit="i/n",
        help="only the I-th of N parts of the work, each with an --out of its own, to be merged afterwards",
    )  # fmt: skip


def _check_shard(instance: object, attribute: object, shard: str) -> None:
    match = re.fullmatch(r"([1-9]\d{0,5})/([1-9]\d{0,5})", shard)
    if shard and (match is None or int(match[1]) > int(match[2])):
        raise ValueError(f"{shard!r} is no part; give I/N with I from 1 to N, e.g. 2/8")


def shard_of(shard: str, count: int) -> range:
    """The numbers, from 0, of the work in a shard such as `2/8`; all of it if the shard is empty."""
    number, of = map(int, (shard or "1/1").split("/"))
    return range(count * (number - 1) // of, count * number // of)
