"""Alignment: selects the sample of a stream that is its value at a tick, both live and offline."""

from __future__ import annotations

from collections import deque

import attrs

from ibrobot_core.schema import Align
from ibrobot_core.units import NS_PER_S


@attrs.frozen(eq=False)
class Sample[T]:
    """A value with the stamp used for alignment and the time of receipt [ns]."""

    stamp_ns: int
    received_ns: int
    value: T


class Stream[T]:
    """The samples of one topic, and the choice of the sample valid at a tick.

    At tick `t`, only samples with a stamp `<= t` that were received by `t` are considered, so that a conversion sees
    no more than a live run. The sample with the newest stamp is chosen; of equal stamps, the one received last. `hold`
    accepts it if `t - stamp <= max_age`, `asof` if `t - stamp <= tol_ms`, `drop` if `stamp > t - step`.

    A jump of the stamps resets the stream: it drops all earlier samples and increments `resets`. With a limit of
    `max(1 s, 2 steps)`, a jump is

    - a stamp further than the limit ahead of the newest so far, or behind it. A smaller step back is an
      out-of-order message, sorted by its stamp. (A sender whose clock is set back by less than the limit therefore
      goes unnoticed until it has caught up; until then the greatest age of a value bounds the error.)
    - a stamp further than the limit ahead of its own receipt. The sender's clock differs from ours, and the tick at
      which the sample is due is unknown. The sample is dropped.

    Memory is therefore bounded: the stream keeps the chosen sample, samples stamped ahead of the tick by at most the
    limit, and samples received after the tick.

    Args:
        align: strategy, stamp, and for `asof` the maximum age.
        step_ns: time between ticks [ns].
        max_age_ns: greatest age of a sample that `hold` gives [ns].
    """

    def __init__(self, align: Align, step_ns: int, max_age_ns: int) -> None:
        self.resets = 0
        self._by_header = align.stamp == "header"
        self._limit_ns = max(NS_PER_S, 2 * step_ns)
        # Maximum age of a sample [ns]; in integers, `stamp > t - step` is an age of at most step - 1.
        tolerance_ns = round((align.tol_ms or 0.0) * 1e6)
        self._max_age_ns = {"hold": max_age_ns, "asof": tolerance_ns, "drop": step_ns - 1}[align.strategy]
        self._unseen: deque[Sample[T]] = deque()
        self._ahead: list[Sample[T]] = []
        self._chosen: Sample[T] | None = None
        self._newest_ns: int | None = None
        self._received_ns: int | None = None
        self._tick_ns: int | None = None

    def add(self, stamp_header_ns: int | None, received_ns: int, value: T) -> None:
        """Add a sample, in the order of receipt.

        Args:
            stamp_header_ns: the header's stamp [ns]; None for a message without a header.
            received_ns: time of receipt [ns].
            value: the value that `at` returns, unchanged.

        Raises:
            ValueError: if it was received before its predecessor, or lacks a required header stamp.
        """
        if self._received_ns is not None and received_ns < self._received_ns:
            raise ValueError(f"samples must be in the order of receipt, got {received_ns} after {self._received_ns} ns")
        stamp_ns = stamp_header_ns if self._by_header else received_ns
        if stamp_ns is None:
            raise ValueError("a stream aligned by header stamps got a sample without one; align it by `stamp: receive`")
        self._received_ns = received_ns
        self._unseen.append(Sample(stamp_ns, received_ns, value))

    def at(self, t_ns: int) -> Sample[T] | None:
        """The sample valid at tick `t_ns` [ns], or None if it is missing.

        Raises:
            ValueError: for a tick before the last requested one.
        """
        if self._tick_ns is not None and t_ns < self._tick_ns:
            raise ValueError(f"ticks must not go back, got {t_ns} ns after {self._tick_ns} ns")
        self._tick_ns = t_ns
        while self._unseen and self._unseen[0].received_ns <= t_ns:
            self._take(self._unseen.popleft())
        if self._ahead:
            self._choose(t_ns)
        if self._chosen is None or t_ns - self._chosen.stamp_ns > self._max_age_ns:
            return None
        return self._chosen

    def _take(self, sample: Sample[T]) -> None:
        """Process a received sample: detect a jump, and keep the sample until it is due."""
        from_future = sample.stamp_ns - sample.received_ns > self._limit_ns
        newest_ns = sample.stamp_ns if self._newest_ns is None else self._newest_ns
        if from_future or abs(sample.stamp_ns - newest_ns) > self._limit_ns:
            self.resets += 1
            self._ahead.clear()
            self._chosen = self._newest_ns = None
            if from_future:
                return
            newest_ns = sample.stamp_ns
        self._newest_ns = max(newest_ns, sample.stamp_ns)
        self._ahead.append(sample)

    def _choose(self, t_ns: int) -> None:
        """Choose the newest sample that is due; `_ahead` is in the order of receipt."""
        ahead = []
        for sample in self._ahead:
            if sample.stamp_ns > t_ns:
                ahead.append(sample)
            elif self._chosen is None or sample.stamp_ns >= self._chosen.stamp_ns:
                self._chosen = sample
        self._ahead = ahead
