"""Recording of parts of a run: corrections, or highlights, each with the time before it from a ring buffer."""

from __future__ import annotations

import queue
from collections import deque
from functools import partial
from types import NoneType
from typing import override

from ibrobot_provenance.recorded_names import COMMANDER, POLICY

from ibrobot_core.api import EpisodeEnd, RecorderError, String, ns
from ibrobot_core.app import NoRequest, Received, RecordedRun, Service
from ibrobot_data.options import EpisodesOptions
from ibrobot_data.recording_worker import RecordingWorker

HIGHLIGHT = Service("/record_episode/highlight", NoRequest, NoneType, "Begin or end a highlight, as its key does.")


class PartialRecording(RecordingWorker):
    """Records parts of the run's episodes, each as an episode of the dataset.

    Until a part begins, the newest messages are kept in memory for `before` seconds. An episode's end also ends its
    part, which then has the episode's outcome; a part that ends before has the outcome `unknown`.

    Args:
        session: the run.
        options: which parts, and how much before and after them.
    """

    keeps_whole = False

    def __init__(self, session: RecordedRun, options: EpisodesOptions) -> None:
        super().__init__(session)
        self._options = options
        self._recent: deque[Received] = deque()
        """The ring buffer."""
        self._present: tuple[int, str] | None = None
        """Number and prompt of the run's present episode."""
        self._end_ns: int | None = None
        """When the present part ends [ns], once that is known."""
        self._keys: queue.SimpleQueue[str] | None = None
        self._pressed: queue.SimpleQueue[None] = queue.SimpleQueue()

    @override
    def setup(self) -> None:
        super().setup()
        bus, keys = self.session.bus, self.session.request.keys
        if self._options.keep == "highlights":
            self._keys = keys() if keys is not None else None
            bus.serve(HIGHLIGHT, lambda _: self._pressed.put(None))
            self.on_end.callback(bus.unserve, HIGHLIGHT)

    @override
    def begin(self, number: int, prompt: str, *, again: bool = False) -> None:
        self._later(partial(self._begin_run_episode, number, prompt))

    @override
    def end(self, outcome: str, faults: tuple[str, ...] = ()) -> None:
        with self._pending_lock:
            self._ending += 1
        self._later(partial(self._end_run_episode, outcome, faults))

    @override
    def work(self, timeout_s: float) -> None:
        super().work(timeout_s)
        if self._presses() % 2 and self._present is not None:
            now_ns = self.session.bus.snapshot_ns()
            if self._open:
                self._end_part(now_ns, "unknown")
            else:
                self._begin_part(now_ns)

    @override
    def _write(self, item: Received, received_ns: int) -> None:
        if self._open:
            super()._write(item, received_ns)
        elif self._keeps(item.topic):
            self._recent.append(item)
            while self._recent[0].received_ns < received_ns - ns(self._options.before):
                self._recent.popleft()
        if self._options.keep == "corrections" and item.topic == COMMANDER and self._present is not None:
            assert isinstance(item.message, String)
            self._correct(item.message.data != POLICY, received_ns)

    def _correct(self, taken: bool, now_ns: int) -> None:
        """Begin or end a correction."""
        if taken:
            self._end_ns = None
            if not self._open:
                self._begin_part(now_ns)
        elif self._open and self._end_ns is None:
            self._end_ns = now_ns + ns(self._options.after)
        elif self._open and self._end_ns is not None and now_ns >= self._end_ns:
            self._end_part(now_ns, "unknown")

    def _begin_run_episode(self, number: int, prompt: str) -> None:
        self._present = number, prompt
        self._watch_model()
        self._recent.clear()

    def _end_run_episode(self, outcome: str, faults: tuple[str, ...]) -> None:
        self._present = None
        if self._open:
            self._end_part(self.session.bus.snapshot_ns(), outcome, faults)
        with self._pending_lock:
            self._ending -= 1

    def _begin_part(self, now_ns: int) -> None:
        assert self._present is not None
        number, prompt = self._present
        recent, self._recent = self._recent, deque()
        since_ns = recent[0].received_ns if recent else now_ns
        self._end_ns = None
        try:
            start, owned = self._start_of(number, prompt, since_ns)
        except RecorderError as error:
            self._fail(error)
            return
        latched = [item for item in self.session.bus.latched().values() if item.received_ns < since_ns]
        self._open_episode(start, owned, latched, self._incoming.lost.copy())
        for item in recent:
            super()._write(item, item.received_ns)

    def _end_part(self, now_ns: int, outcome: str, faults: tuple[str, ...] = ()) -> None:
        with self._pending_lock:
            self._provisional += outcome != "discarded"
            self._ending += 1
        self._end_episode(EpisodeEnd(now_ns, outcome, faults=faults), outcome != "discarded")

    def _presses(self) -> int:
        """How often the key or the service was used since the last call."""
        presses = 0
        while not self._pressed.empty():
            self._pressed.get()
            presses += 1
        while self._keys is not None and not self._keys.empty():
            presses += self._keys.get() == self._options.highlight_key
        return presses
