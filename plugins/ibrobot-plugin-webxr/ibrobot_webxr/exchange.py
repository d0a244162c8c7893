"""Exchange between the server's thread and the devices: poses and buttons one way, reports the other."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence

import attrs

from ibrobot_core.api import Clock, OperatorEvent, ns, seconds
from ibrobot_webxr.messages import HandPose, Hands

_WINDOW_S = 10.0
"""The least delay of a page is taken from the last one or two windows [s], since clocks drift."""
_MOST = 64
"""Most samples queued for a device; the oldest are dropped."""
_REPORTED_S = 0.5
"""Older reports [s] are dropped: their device no longer reads the page."""


class Delays:
    """Lateness of a page's messages relative to the fastest one.

    A stalled network delivers old poses in a burst: they arrive now, but they are late.
    """

    def __init__(self) -> None:
        self._least: list[float] = []
        self._until_s = 0.0

    def late_s(self, sent_s: float, arrived_s: float) -> float:
        """The delay of a message beyond the least delay [s], from its times by the two clocks [s]."""
        delay = arrived_s - sent_s
        if not self._least or arrived_s >= self._until_s:
            self._least = [delay, *self._least[:1]]
            self._until_s = arrived_s + _WINDOW_S
        self._least[0] = min(self._least[0], delay)
        return delay - min(self._least)


@attrs.frozen
class Sample:
    """A hand at an instant."""

    pose: HandPose | None
    """None while the hand is not tracked."""
    heading: float
    """Direction in which the operator looks [rad]."""
    time_s: float
    """The page's time [s]."""
    made_ns: int
    """When the pose was made, by our clock, if the fastest message took no time [ns]."""

    def age_s(self, now_ns: int) -> float:
        """The age at a time [s]."""
        return seconds(now_ns - self.made_ns)


@attrs.frozen
class Report:
    """What a device does with a hand, for the page."""

    device: str
    engaged: bool
    """Whether the hand moves the robot."""
    text: str
    """Why it does not, e.g. that the clutch must be released first; may be empty."""
    stamp_s: float
    """When, by the monotonic clock [s]."""


class Inbox:
    """The samples of some hands that a device has not read yet."""

    def __init__(self, lock: threading.Lock, hands: Sequence[str]) -> None:
        self._lock = lock
        self._samples: dict[str, deque[Sample]] = {hand: deque(maxlen=_MOST) for hand in hands}

    def put(self, hand: str, sample: Sample) -> None:
        """Add a sample of a hand, if the device uses it; called with the lock held."""
        if hand in self._samples:
            self._samples[hand].append(sample)

    def drain(self) -> list[tuple[str, Sample]]:
        """All samples that have come since the last call, by hand, oldest first."""
        with self._lock:
            taken = [(hand, sample) for hand, samples in self._samples.items() for sample in samples]
            for samples in self._samples.values():
                samples.clear()
            return taken


class Exchange:
    """The poses, buttons and reports of one page. All methods may be called from any thread."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._inboxes: list[Inbox] = []
        self._events: list[OperatorEvent] = []
        self._stop = False
        self._reports: dict[str, Report] = {}

    def join(self, hands: Sequence[str]) -> Inbox:
        """An inbox for a device that uses some hands."""
        inbox = Inbox(self._lock, hands)
        with self._lock:
            self._inboxes.append(inbox)
        return inbox

    def leave(self, inbox: Inbox) -> None:
        """Put no more samples into an inbox."""
        with self._lock:
            self._inboxes.remove(inbox)

    def put(self, hands: Hands, late_s: float) -> None:
        """Pass on the poses of a message that arrived `late_s` [s] later than the fastest would have."""
        with self._lock:
            made_ns = self._clock.now_ns() - ns(late_s)
            for inbox in self._inboxes:
                for hand in ("left", "right"):
                    inbox.put(hand, Sample(hands.hands.get(hand), hands.heading, hands.time_s, made_ns))

    def press(self, event: OperatorEvent) -> None:
        """Pass on a button."""
        with self._lock:
            self._events.append(event)

    def stop(self) -> None:
        """Pass on the emergency stop."""
        with self._lock:
            self._stop = True

    def take_events(self) -> tuple[tuple[OperatorEvent, ...], bool]:
        """The buttons pressed since the last call, and whether the emergency stop was."""
        with self._lock:
            taken = tuple(self._events), self._stop
            self._events, self._stop = [], False
            return taken

    def report(self, hands: Sequence[str], device: str, engaged: str | None, text: str) -> None:
        """Report what a device does with its hands; `engaged` is the one that moves the robot."""
        now_s = time.monotonic()
        with self._lock:
            for hand in hands:
                self._reports[hand] = Report(device, hand == engaged, text, now_s)

    def reports(self) -> Mapping[str, Report]:
        """Hand -> the report of the device that reads it now."""
        oldest_s = time.monotonic() - _REPORTED_S
        with self._lock:
            return {hand: report for hand, report in self._reports.items() if report.stamp_s > oldest_s}
