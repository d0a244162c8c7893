"""Checks a recorded episode by reading all of it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from ibrobot_core.api import NS_PER_S, Contract, RecorderError
from ibrobot_mcap.metadata import METADATA
from ibrobot_mcap.reader import Rosbag2Reader

_FEW = 8
"""Minimum number of messages to compute the period of a topic."""


def problems_of(path: Path, longest_gap: float) -> list[str]:
    """List all problems of an episode.

    Args:
        path: the episode.
        longest_gap: longest acceptable pause in a topic, in multiples of its median period.
    """
    try:
        reader = Rosbag2Reader(path)
    except RecorderError as error:
        return [str(error)]
    problems = []
    stamps: dict[str, list[int]] = defaultdict(list)
    last_header: dict[str, int] = {}
    back: dict[str, int] = defaultdict(int)
    try:
        summary, repeated, short = reader.summary(), reader.repeated(), reader.short()
        if not summary.finished:
            problems.append("unfinished; `ibrobot episodes repair` makes it whole")
        for item in reader.messages():
            stamps[item.topic].append(item.received_ns)
            stamp_ns = getattr(getattr(item.message, "header", None), "stamp_ns", None)
            if stamp_ns is not None:
                back[item.topic] += stamp_ns < last_header.get(item.topic, stamp_ns)
                last_header[item.topic] = stamp_ns
    except RecorderError as error:
        problems.append(str(error))
    finally:
        reader.close()
    absent = [topic for topic in _required(summary.metadata) if not stamps[topic]]
    problems += [f"no message of {topic}, which is in its contract" for topic in absent]
    for topic, stated in reader.stated.items():
        known = summary.topics.get(topic)
        found = (known.count if known is not None else 0) + repeated.get(topic, 0)
        if stated != found:
            problems.append(f"{topic}: {found} messages, {METADATA} says {stated}")
    for topic, known in summary.topics.items():
        if known.missing and topic not in short:
            problems.append(f"{topic}: {known.missing} messages that the recorder wrote are missing since a repair")
        if known.dropped:
            problems.append(f"{topic}: {known.dropped} messages were lost while recording")
        if back[topic]:
            problems.append(f"{topic}: header stamps went back {back[topic]} times")
        problems += _pause(topic, stamps[topic], longest_gap, summary.start_ns)
    return problems


def _required(metadata: Mapping[str, str]) -> Collection[str]:
    """The topics of an episode's contract; empty if it has none."""
    contract = Contract.of_episode(metadata)
    return () if contract is None else contract.topics


def _pause(topic: str, stamps: list[int], longest_gap: float, start_ns: int) -> list[str]:
    """A problem if the longest pause of a topic is too long."""
    if len(stamps) < _FEW:
        return []
    pauses = np.diff(stamps) / 1e6
    period, longest = float(np.median(pauses)), float(pauses.max())
    if period <= 0 or longest <= longest_gap * period:
        return []
    at_s = (stamps[int(pauses.argmax())] - start_ns) / NS_PER_S
    return [f"{topic}: a pause of {longest:.0f} ms at {at_s:.2f} s, its period is {period:.1f} ms"]
