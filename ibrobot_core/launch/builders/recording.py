"""Recording: a queue from the bus to the recorder's own thread, which no publisher waits for."""

from __future__ import annotations

import threading
from collections import deque
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
        self._orders: deque[EpisodeStart | EpisodeEnd] = deque()
        self._order = threading.Lock()
        """Held while an order is stamped and queued, and while orders and messages are taken: neither overtakes."""
        self._incoming: Subscription | None = None
        self._kept: frozenset[str] | None = None
        """Topics of the open episode; None outside of one."""
        self._dropped = 0

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
        with self._order:
            start = episode_start(
                session.config, self._config, topics, mode=session.mode, seed=seed, stamp_ns=session.bus.snapshot_ns()
            )
            self._orders.append(start)

    def end(self, outcome: str) -> None:
        """Messages up to here belong to the episode."""
        assert self._incoming is not None
        with self._order:
            dropped, self._dropped = self._incoming.dropped - self._dropped, self._incoming.dropped
            lost = {"*": dropped} if dropped else {}
            self._orders.append(EpisodeEnd(self._session.bus.snapshot_ns(), outcome, lost))

    @override
    def work(self, timeout_s: float) -> None:
        assert self._recorder is not None
        assert self._incoming is not None
        first = self._incoming.get(timeout_s)
        with self._order:
            orders, self._orders = self._orders, deque()
            items = [*([first] if first is not None else []), *self._incoming.drain()]
        for item in items:
            while orders and orders[0].stamp_ns < item.received_ns:
                self._obey(self._recorder, orders.popleft())
            if self._kept is not None and item.topic in self._kept:
                self._recorder.write(item.topic, item.message, item.received_ns)
        for order in orders:
            self._obey(self._recorder, order)

    def _obey(self, recorder: Recorder, order: EpisodeStart | EpisodeEnd) -> None:
        if isinstance(order, EpisodeStart):
            recorder.begin(order)
            self._kept = frozenset(order.topics)
        elif self._kept is not None:
            self._kept = None
            recorder.end(order)

    @override
    def teardown(self) -> None:
        try:
            if self._incoming is not None:
                self.work(0.0)
        finally:
            if self._recorder is not None:
                self._recorder.close()
            if self._incoming is not None:
                self._incoming.close()
