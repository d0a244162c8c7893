"""Checks a recorded episode by reading all of it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import attrs
import numpy as np
from ibrobot_terminal.plural import counted

from ibrobot_core.api import NS_PER_S, Contract, Recorded, RecorderError, ns
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
    times: dict[str, _Times] = defaultdict(_Times)
    with closing(reader):
        summary, repeated, short = reader.summary(), reader.source.repeated, reader.short()
        if not summary.finished:
            problems.append("unfinished; `ibrobot episodes repair` makes it whole")
        try:
            for item in reader.messages():
                times[item.topic].take(item)
        except RecorderError as error:
            problems += str(error).splitlines()
    contract = Contract.of_episode(summary.metadata)
    absent = [topic for topic in (contract.topics if contract is not None else ()) if topic not in times]
    problems += [f"no message of {topic}, which is in its contract" for topic in absent]
    for topic, stated in reader.stated.items():
        known = summary.topics.get(topic)
        total = (known.count if known is not None else 0) + repeated.get(topic, 0)
        if stated != total:
            problems.append(f"{topic}: {counted(total, 'message')}, {METADATA} says {stated}")
    needed = _needed(contract) if contract is not None else {}
    span_ns = summary.start_ns, summary.end_ns
    for topic, known in summary.topics.items():
        if known.missing and topic not in short:
            problems.append(f"{topic}: lacks {counted(known.missing, 'message')} of the recorder, since a repair")
        if topic in times:
            problems += times[topic].problems(topic, longest_gap, needed.get(topic), span_ns)
    lost = Counter({topic: each.dropped for topic, each in summary.topics.items() if each.dropped})
    if lost:  # first, since it may explain the others
        of_each = ", ".join(f"{topic} {count}" for topic, count in lost.most_common())
        problems.insert(0, f"{counted(lost.total(), 'message')} lost while recording: {of_each}")
    return problems


@attrs.define
class _Times:
    """The times of a topic's messages [ns]."""

    received: list[int] = attrs.field(factory=list)
    fresh: list[int] = attrs.field(factory=list)
    """Receipt of those whose header stamp differs from the previous one."""
    back: int = 0
    """How often the header stamps decreased."""
    _stamp_ns: int | None = None

    def take(self, item: Recorded) -> None:
        """Add a message."""
        stamp_ns = getattr(getattr(item.message, "header", None), "stamp_ns", None)
        self.received.append(item.received_ns)
        if stamp_ns is None or stamp_ns != self._stamp_ns:
            self.fresh.append(item.received_ns)
        if stamp_ns is not None:
            self.back += self._stamp_ns is not None and stamp_ns < self._stamp_ns
            self._stamp_ns = stamp_ns

    def problems(
        self, topic: str, longest_gap: float, needed: tuple[int, bool] | None, span_ns: tuple[int, int]
    ) -> Iterator[str]:
        """Stamps that decrease, and the longest silence or pause, if it is too long; `needed` as from `_needed`."""
        if self.back:
            yield f"{topic}: header stamps went back {self.back} times"
        silence = ""
        if needed is not None:
            limit_ns, by_header = needed
            silence = _silence(self.fresh if by_header else self.received, limit_ns, span_ns)
        if text := silence or _pause(self.received, longest_gap, span_ns[0]):
            yield f"{topic}: {text}"


def _needed(contract: Contract) -> dict[str, tuple[int, bool]]:
    """Topic of an observation or action -> longest time without a sample [ns], and whether header stamps count."""
    needed = {}
    for part in contract.observation_parts:
        hold_ns, tolerance_ns = ns(contract.max_age), round((part.align.tol_ms or 0) * 1e6)
        longest = {"hold": hold_ns, "asof": tolerance_ns, "drop": contract.step_ns}[part.align.strategy]
        needed[part.topic] = longest, part.align.stamp == "header"
    for action in contract.action_parts:
        needed[action.topic] = ns(contract.max_age if action.max_age is None else action.max_age), False
    return needed


def _pause(stamps: list[int], longest_gap: float, start_ns: int) -> str:
    """The longest pause of a topic, if it is too long; else empty."""
    if len(stamps) < _FEW:
        return ""
    pauses = np.diff(stamps) / 1e6
    period, longest = float(np.median(pauses)), float(pauses.max())
    if period <= 0 or longest <= longest_gap * period:
        return ""
    at_s = (stamps[int(pauses.argmax())] - start_ns) / NS_PER_S
    return f"a pause of {longest:.0f} ms at {at_s:.2f} s, its period is {period:.1f} ms"


def _silence(stamps: list[int], limit_ns: int, span_ns: tuple[int, int]) -> str:
    """The longest silence of a topic of the contract, if it exceeds `limit_ns`; else empty.

    Args:
        stamps: receipt of each new sample [ns]; at least one.
        limit_ns: longest time without one [ns].
        span_ns: beginning and end of the episode [ns].
    """
    begin_ns, end_ns = span_ns
    start_ns, stop_ns = max(pairwise((begin_ns, *stamps, end_ns)), key=lambda each: each[1] - each[0])
    if stop_ns - start_ns <= limit_ns:
        return ""
    for_s = (stop_ns - start_ns) / NS_PER_S
    if stop_ns == stamps[0]:
        text = f"begins {for_s:.2f} s after the episode"
    elif start_ns == stamps[-1]:
        text = f"ends {for_s:.2f} s before the episode"
    else:
        text = f"nothing new for {for_s:.2f} s, from {(start_ns - begin_ns) / NS_PER_S:.2f} s on"
    return f"{text}; the contract allows {limit_ns / NS_PER_S:.3g} s"
