"""Recording: a queue from the bus to the recorder's own thread, which no publisher waits for."""

from __future__ import annotations

import queue
from typing import override

from ibrobot_core.bus import Subscription
from ibrobot_core.config.schema import Recording as RecordingConfig
from ibrobot_core.interfaces import EpisodeEnd, EpisodeStart, Recorder
from ibrobot_core.launch.component import Worker
from ibrobot_core.launch.session import Session
from ibrobot_core.recording.episode import episode_start

_DEPTH = 4096
"""Messages that may wait for the recorder."""


class Recording(Worker):
    """Writes what is on the bus while an episode is on."""

    def __init__(self, session: Session, config: RecordingConfig) -> None:
        super().__init__(
            "recording", f"{config.type} into {config.root}", on_failure=session.fail,
            lockstep=session.request.lockstep,
        )  # fmt: skip
        self._session = session
        self._config = config
        self._recorder: Recorder | None = None
        self._orders: queue.SimpleQueue[EpisodeStart | EpisodeEnd] = queue.SimpleQueue()
        self._incoming: Subscription | None = None
        self._recording = False

    @override
    def setup(self) -> None:
        session = self._session
        descriptor = session.registry.find("recorder", self._config.type)
        self._recorder = descriptor.make(self._config.options, session.context("recording"))
        self._incoming = session.bus.subscribe(None, _DEPTH)

    def begin(self, number: int) -> None:
        """From here on messages belong to a new episode."""
        session = self._session
        topics = {topic: type_ for topic, (type_, _) in session.bus.topics().items()}
        seed = session.request.seed + number - 1
        start = episode_start(
            session.config, self._config, topics, mode=session.mode, seed=seed, stamp_ns=session.clock.now_ns()
        )
        self._orders.put(start)

    def end(self, outcome: str) -> None:
        """Messages up to here belong to the episode."""
        dropped = {"*": self._incoming.dropped} if self._incoming and self._incoming.dropped else {}
        self._orders.put(EpisodeEnd(self._session.clock.now_ns(), outcome, dropped))

    @override
    def work(self, timeout_s: float) -> None:
        assert self._recorder is not None
        assert self._incoming is not None
        item = self._incoming.get(timeout_s)
        while not self._orders.empty():
            order = self._orders.get()
            if isinstance(order, EpisodeStart):
                self._recorder.begin(order)
                self._kept = set(order.topics)
                self._recording = True
            elif self._recording:
                self._drain(self._recorder, order.stamp_ns)
                self._recorder.end(order)
                self._recording = False
        if item is not None and self._recording and item.topic in self._kept:
            self._recorder.write(item.topic, item.message, item.received_ns)
        self._drain(self._recorder, None)

    def _drain(self, recorder: Recorder, until_ns: int | None) -> None:
        """Write what waits, up to `until_ns`; what came outside an episode is let go."""
        assert self._incoming is not None
        for item in self._incoming.drain():
            if self._recording and item.topic in self._kept and (until_ns is None or item.received_ns <= until_ns):
                recorder.write(item.topic, item.message, item.received_ns)

    @override
    def teardown(self) -> None:
        if self._incoming is not None:
            if self._recorder is not None:
                self.work(0.0)
                self._recorder.close()
            self._incoming.close()
