"""Alignment against a brute-force oracle that looks at every sample again at every tick."""

from __future__ import annotations

import gc
import weakref

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ibrobot_core.contract.align import Stream
from ibrobot_core.schema import Align

MS = 1_000_000
S = 1000 * MS

HOLD_NS = 250 * MS
"""Greatest age of a sample that `hold` gives."""
ALIGNS = [
    Align("hold"),
    Align("hold", "receive"),
    Align("asof", "header", 100.0),
    Align("asof", "receive", 0.0),
    Align("asof", "header", 35.5),
    Align("drop"),
    Align("drop", "receive"),
]


def oracle(samples: list[tuple[int, int, int]], align: Align, step_ns: int, t_ns: int) -> tuple[int | None, int]:
    """Value and resets at `t_ns`, by the rules alone; samples are (header stamp, receipt, value)."""
    limit = max(S, 2 * step_ns)
    stamped = [(stamp if align.stamp == "header" else got, got, value) for stamp, got, value in samples if got <= t_ns]
    since_jump: list[tuple[int, int]] = []
    resets = 0
    for stamp, got, value in stamped:
        newest = max((s for s, _ in since_jump), default=stamp)
        if stamp > got + limit:
            since_jump, resets = [], resets + 1
        elif stamp > newest + limit or stamp < newest - limit:
            since_jump, resets = [(stamp, value)], resets + 1
        else:
            since_jump.append((stamp, value))
    due = [(stamp, order, value) for order, (stamp, value) in enumerate(since_jump) if stamp <= t_ns]
    if not due:
        return None, resets
    stamp, _, value = max(due)
    if align.strategy == "hold" and t_ns - stamp > HOLD_NS:
        return None, resets
    if align.strategy == "asof":
        assert align.tol_ms is not None
        if not t_ns - stamp <= align.tol_ms * MS:
            return None, resets
    if align.strategy == "drop" and not stamp > t_ns - step_ns:
        return None, resets
    return value, resets


deltas = st.one_of(st.integers(0, 60), st.sampled_from([0, 0, 999, 1000, 1001, 2500]))
OFTEN_AT_A_LIMIT = [0, 0, -999, -1000, -1001, 990, 1001, 1400, 1401, 100_000]
latencies = st.one_of(st.integers(-40, 120), st.sampled_from(OFTEN_AT_A_LIMIT))
clock_steps = st.sampled_from([0, 0, 0, 0, 0, 0, -1500, 1500, -900, 3000, -3000])
streams = st.lists(st.tuples(deltas, latencies, clock_steps), max_size=40)


@settings(deadline=None)
@given(
    sends=streams,
    ticks=st.lists(st.integers(0, 90), min_size=1, max_size=40),
    align=st.sampled_from(ALIGNS),
    step_ms=st.sampled_from([1, 33, 100, 700]),
    eager=st.booleans(),
)
def test_agrees_with_the_rules_at_every_tick(
    sends: list[tuple[int, int, int]], ticks: list[int], align: Align, step_ms: int, eager: bool
) -> None:
    """Eager streams are filled before the first tick, as when a live run is late; others as the messages come."""
    samples, got, behind = [], 10 * S, 0
    for value, (delta, latency, clock_step) in enumerate(sends):
        got += delta * MS
        behind += clock_step * MS
        samples.append((got - latency * MS - behind, got, value))
    stream: Stream[int] = Stream(align, step_ms * MS, HOLD_NS)
    waiting = list(samples)
    t_ns = 10 * S - 20 * MS
    for tick in ticks:
        t_ns += tick * MS
        while waiting and (eager or waiting[0][1] <= t_ns):
            stream.add(*waiting.pop(0))
        chosen = stream.at(t_ns)
        found = (None if chosen is None else chosen.value, stream.resets)
        assert found == oracle(samples, align, step_ms * MS, t_ns)


def filled(
    align: Align, *samples: tuple[int, int, str], step_ns: int = 33 * MS, hold_ns: int = 10_000 * S
) -> Stream[str]:
    stream: Stream[str] = Stream(align, step_ns, hold_ns)
    for sample in samples:
        stream.add(*sample)
    return stream


def value(stream: Stream[str], t_ns: int) -> str | None:
    sample = stream.at(t_ns)
    return None if sample is None else sample.value


def test_a_sample_counts_once_it_is_both_stamped_and_received() -> None:
    stream = filled(Align(), (5 * MS, 9 * MS, "late"))
    assert value(stream, 9 * MS - 1) is None
    assert value(stream, 9 * MS) == "late"
    stream = filled(Align(), (9 * MS, 5 * MS, "early"))
    assert value(stream, 9 * MS - 1) is None
    assert value(stream, 9 * MS) == "early"


def test_of_equal_stamps_the_one_received_last_counts() -> None:
    assert value(filled(Align(), (MS, MS, "first"), (MS, 2 * MS, "second")), 3 * MS) == "second"


def test_ages_at_their_very_limits() -> None:
    asof = filled(Align("asof", "header", 100.0), (S, S, "x"))
    assert value(asof, S + 100 * MS) == "x"
    assert value(asof, S + 100 * MS + 1) is None
    drop = filled(Align("drop"), (S, S, "x"))
    assert value(drop, S + 33 * MS - 1) == "x"
    assert value(drop, S + 33 * MS) is None
    hold = filled(Align("hold"), (S, S, "x"), hold_ns=HOLD_NS)
    assert value(hold, S + HOLD_NS) == "x"
    assert value(hold, S + HOLD_NS + 1) is None


@pytest.mark.parametrize("step_ns", [33 * MS, 700 * MS])
def test_a_jump_resets_and_is_counted(step_ns: int) -> None:
    limit = max(S, 2 * step_ns)
    ahead = filled(Align(), (S, 5 * S, "a"), (S + limit, 5 * S, "b"), step_ns=step_ns)
    assert value(ahead, 5 * S) == "b"
    assert ahead.resets == 0
    ahead.add(S + 2 * limit + 1, 6 * S, "c")
    assert value(ahead, 6 * S) == "c"
    assert ahead.resets == 1
    back = filled(Align(), (9 * S, 9 * S, "a"), (9 * S - limit, 10 * S, "b"), step_ns=step_ns)
    assert value(back, 10 * S) == "a"
    assert back.resets == 0
    back.add(9 * S - limit - 1, 11 * S, "c")
    assert value(back, 11 * S) == "c"
    assert back.resets == 1


def test_a_stamp_ahead_of_its_receipt_is_a_jump_and_is_not_kept() -> None:
    stream = filled(Align(), (S, S, "a"), (3 * S, 2 * S - 1, "future"))
    assert value(stream, 2 * S) is None
    assert stream.resets == 1
    assert value(stream, 4 * S) is None


def test_a_jump_counts_from_its_receipt_on_and_no_sooner() -> None:
    stream = filled(Align(), (5 * S, 5 * S, "before"), (1 * S, 6 * S, "after"))
    assert value(stream, 6 * S - 1) == "before"
    assert stream.resets == 0
    assert value(stream, 6 * S) == "after"
    assert stream.resets == 1


def test_a_sender_ahead_of_us_is_followed_sample_by_sample() -> None:
    stream: Stream[int] = Stream(Align(), 33 * MS, HOLD_NS)
    for k in range(300):
        stream.add(k * 10 * MS + 500 * MS, k * 10 * MS, k)
        chosen = stream.at(k * 10 * MS)
        assert (None if chosen is None else chosen.value) == (k - 50 if k >= 50 else None)


class Payload:
    """Something that can be watched."""


@pytest.mark.parametrize("ahead_ns", [0, 900 * MS, 3600 * S, -3600 * S])
def test_what_is_kept_is_bounded(ahead_ns: int) -> None:
    """Also for a sender whose clock is ahead of ours, a little or by an hour."""
    stream: Stream[Payload] = Stream(Align(), 33 * MS, HOLD_NS)
    alive: weakref.WeakSet[Payload] = weakref.WeakSet()
    for k in range(1000):
        payload = Payload()
        alive.add(payload)
        stream.add(k * 10 * MS + ahead_ns, k * 10 * MS, payload)
        del payload
        if k % 3 == 0:
            stream.at(k * 10 * MS)
    gc.collect()
    assert len(alive) <= 100


def test_misuse_is_refused() -> None:
    stream = filled(Align(), (S, S, "a"))
    with pytest.raises(ValueError, match=r"order of receipt, got 999999999 after 1000000000 ns"):
        stream.add(S, S - 1, "b")
    with pytest.raises(ValueError, match=r"align it by `stamp: receive`"):
        stream.add(None, S, "b")
    stream.at(S)
    with pytest.raises(ValueError, match="ticks must not go back, got 999999999 ns after 1000000000 ns"):
        stream.at(S - 1)


def test_without_header_the_receipt_counts() -> None:
    stream: Stream[str] = Stream(Align(stamp="receive"), 33 * MS, HOLD_NS)
    stream.add(None, S, "x")
    sample = stream.at(S)
    assert sample is not None
    assert (sample.stamp_ns, sample.received_ns, sample.value) == (S, S, "x")
