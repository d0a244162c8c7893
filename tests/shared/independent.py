"""Recordings read without ibrobot, by mcap and rosbags, and the rules of alignment applied to them by brute force."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import attrs
import pyarrow.parquet as pq
from command_line import run_here
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore

from ibrobot_core.contract.specs import Contract

STORE = get_typestore(Stores.ROS2_JAZZY)


@attrs.frozen
class Sample:
    """A message: stamp of its header, or receipt without one, and receipt [ns]."""

    stamp_ns: int
    received_ns: int


Samples = dict[str, list[Sample]]
"""Topic -> its messages, in the order of receipt."""


def keys(contract: Contract) -> dict[str, tuple[str, int]]:
    """Topic -> key of the dataset, and greatest age of a sample [ns]."""
    ages = {"hold": contract.max_age * 1e9, "drop": contract.step_ns}
    found = {
        part.topic: (part.key, round(ages.get(part.align.strategy, (part.align.tol_ms or 0) * 1e6)))
        for part in contract.observation_parts
    }
    return found | {part.topic: ("action", round(contract.max_age * 1e9)) for part in contract.action_parts}


def samples(folder: Path, contract: Contract) -> Samples:
    """The messages of the contract's topics."""
    found: Samples = {topic: [] for topic in keys(contract)}
    with (folder / f"{folder.name}_0.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(topics=list(found)):
            assert schema is not None
            decoded: Any = STORE.deserialize_cdr(message.data, schema.name)
            stamp_ns = message.log_time
            if hasattr(decoded, "header"):
                stamp_ns = decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec
            found[channel.topic].append(Sample(stamp_ns, message.log_time))
    return found


def age(of_topic: list[Sample], t_ns: int) -> int | None:
    """Age at a tick [ns] of the sample that counts; None without one."""
    newest: int | None = None
    since_jump: list[int] = []
    for each in of_topic:
        if each.received_ns <= t_ns:
            if newest is not None and abs(each.stamp_ns - newest) > 10**9:
                newest, since_jump = None, []
            newest = each.stamp_ns if newest is None else max(newest, each.stamp_ns)
            since_jump.append(each.stamp_ns)
    due = [stamp_ns for stamp_ns in since_jump if stamp_ns <= t_ns]
    return t_ns - max(due) if due else None


def missing(read: Samples, contract: Contract) -> list[frozenset[str]]:
    """The keys that are missing at each tick."""
    times = [each.received_ns for of_topic in read.values() for each in of_topic]
    found, limits = [], keys(contract)
    for t_ns in range(min(times), max(times) + 1, contract.step_ns):
        old = {topic: age(of_topic, t_ns) for topic, of_topic in read.items()}
        found.append(frozenset(limits[topic][0] for topic, ns in old.items() if ns is None or ns > limits[topic][1]))
    return found


def gaps(ticks: list[frozenset[str]], contract: Contract) -> dict[str, int]:
    """Key -> how often it goes missing; before the first complete tick only what is longer than natural counts."""
    begin = ticks.index(frozenset())
    late = begin * contract.step_ns > contract.max_age * 1e9
    after = ticks[round(contract.max_age * contract.rate_hz) + 1 : begin] if late else ()
    found = dict.fromkeys(frozenset[str]().union(*after), 1)
    for before, now in zip(ticks[begin:], ticks[begin + 1 :], strict=False):
        for key in now - before:
            found[key] = found.get(key, 0) + 1
    return found


def check(folder: Path, out: Path, contract: Contract) -> tuple[dict[str, int], str]:
    """Compare `convert` of an episode, and its dataset, with the independent reading.

    Returns:
        Key -> gaps, and what `verify` says.
    """
    ticks = missing(samples(folder, contract), contract)
    whole = ticks.count(frozenset())
    done = run_here("convert", folder, "--out", out, "--no-videos", "--json")
    assert done.returncode == 0, done.stderr + done.stdout
    (report,) = json.loads(done.stdout)["reports"]
    table = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert table.num_rows == report["frames"] == whole
    assert report["gaps"] == gaps(ticks, contract)
    assert report["skipped"] in (len(ticks) - whole, len(ticks) - whole - ticks.index(frozenset()))
    metadata = json.loads((out / "meta/ibrobot.json").read_text())
    (kept,) = metadata["episodes"]
    assert kept["skipped"] == report["skipped"] == sum(count for _, count in kept["cuts"])
    return report["gaps"], run_here("episodes", "verify", folder).stdout
