"""Recording: a queue from the bus to the recorder's own thread, which no publisher waits for."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, override

import attrs

from ibrobot_core.bus import Received
from ibrobot_core.component import Worker, error_line
from ibrobot_core.config.schema import RecordingConfig
from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import RecorderError
from ibrobot_core.interfaces import EpisodeEnd, EpisodeStart, Recorder
from ibrobot_core.messages import Message
from ibrobot_core.recording.episode import episode_start, is_kept
from ibrobot_core.units import NS_PER_S, seconds

if TYPE_CHECKING:
    from ibrobot_core.launch.session import Session

_DEPTH = 4096
"""Messages that may wait for the recorder."""
_RATE_WINDOW = 31
"""Messages that a measured rate looks back on."""
_SILENT_NS = NS_PER_S
"""A topic without a message for so long is silent [ns]."""


class RecordingWorker(Worker):
    """Writes what is on the bus while an episode is on.

    A recorder that fails, e.g. on a full disk, ends its episode's recording with a fault; the robot goes on,
    and the next episode is recorded again.
    """

    def __init__(self, session: Session, config: RecordingConfig) -> None:
        super().__init__(
            "recording", f"{config.type} into {config.root}", on_failure=session.fail, lockstep=session.request.lockstep
        )
        self._session = session
        self._config = config
        self._contract = Contract.from_config(session.config)
        self._orders: deque[tuple[int, Callable[[], None]]] = deque()
        """Beginnings and ends of episodes that are still to be carried out: stamp [ns] and what to do."""
        self._order = threading.Lock()
        """Held while an order is stamped and queued, and while orders and messages are taken: neither overtakes."""
        self._open = False
        self._seen: dict[str, deque[int]] = {}
        """Topic -> times of the last messages [ns]."""
        self._newest: dict[str, Message] = {}
        """Topic -> its last message."""
        self._sizes: dict[str, int] = {}
        """Topic -> size of a message of it [bytes], measured once an episode, since pictures may have to be encoded."""
        self._lost: Mapping[str, int] = {}
        """Topic -> messages lost on the way here, before the present episode."""
        self._reported_absent = False
        self._whole = 0
        self._provisional = 0
        """Episodes kept whole, and those that have ended and are not written to their ends yet."""
        self.failure: RecorderError | None = None
        """Why the recording of the present or last episode ended before it; None where it did not."""

    @override
    def setup(self) -> None:
        session = self._session
        descriptor = session.registry.find("recorder", self._config.type)
        self._recorder: Recorder = descriptor.make(self._config.options, session.context("recording"))
        self._incoming = session.bus.subscribe(None, _DEPTH)
        self.on_end.callback(self._incoming.close)
        self.on_end.callback(self._did, self._recorder.close)
        self.on_end.callback(self.work, 0.0)

    def begin(self, number: int, prompt: str) -> None:
        """From here on messages belong to a new episode.

        Raises:
            RecorderError: when it cannot be recorded where it should.
        """
        session = self._session
        self.failure = None
        self._sizes = {}
        topics = {topic: type_ for topic, (type_, _) in session.bus.topics().items()}
        seed = session.request.seed + number - 1
        with self._order:
            start = episode_start(
                session.config, self._config, topics, mode=session.mode, seed=seed, stamp_ns=session.bus.snapshot_ns(),
                lockstep=session.request.lockstep, prompt=prompt, plugins=session.registry.versions(),
                policy=session.acting.described() if session.acting is not None else None,
            )  # fmt: skip
            latched = tuple(i for i in session.bus.latched().values() if i.received_ns <= start.stamp_ns)
            begin = partial(self._open_episode, start, latched, self._incoming.lost.copy())
            self._orders.append((start.stamp_ns, begin))

    def end(self, outcome: str) -> None:
        """Messages up to here belong to the episode."""
        with self._order:
            provisional = outcome != "discarded" and self.failure is None
            self._provisional += provisional
            end = EpisodeEnd(self._session.bus.snapshot_ns(), outcome)
            self._orders.append((end.stamp_ns, partial(self._end_episode, end, provisional)))

    @property
    def saved(self) -> int:
        """Episodes that have ended and are kept; one that turns out not to be written to its end is taken back."""
        with self._order:
            return self._whole + self._provisional

    @override
    def work(self, timeout_s: float) -> None:
        first = self._incoming.get(timeout_s)
        with self._order:
            orders, self._orders = self._orders, deque()
            items = [*([first] if first is not None else []), *self._incoming.drain()]
        for item in items:
            self._note(item)
            while orders and orders[0][0] < item.received_ns:
                orders.popleft()[1]()
            self._write(item, item.received_ns)
        for _, carry_out in orders:
            carry_out()

    def rates(self) -> dict[str, float]:
        """Measured rate of each topic that is recorded [Hz]; 0 for one that came once."""
        rates = {}
        for topic, stamps in self._seen.copy().items():
            span_ns = stamps[-1] - stamps[0]
            rates[topic] = (len(stamps) - 1) * NS_PER_S / span_ns if span_ns else 0.0
        return rates

    def flow(self) -> float:
        """What an episode takes on the disk, by the rates and the messages of now [bytes/s]."""
        for topic, message in self._newest.copy().items():
            if topic not in self._sizes:
                self._sizes[topic] = self._recorder.size_of(message)
        sizes = self._sizes.copy()
        return sum(rate * sizes.get(topic, 0) for topic, rate in self.rates().items())

    @property
    def min_free(self) -> int:
        """Space on the disk that the recorder leaves free [bytes]."""
        return self._recorder.min_free

    def waiting(self) -> int:
        """What the recorder has taken and not written yet [bytes]."""
        return self._recorder.waiting()

    def silent(self) -> dict[str, float | None]:
        """The contract's topics without a message for a second: topic -> for how long [s], None: none ever came."""
        now_ns = self._session.clock.now_ns()
        found: dict[str, float | None] = {}
        for topic in self._contract.topics:
            stamps = self._seen.get(topic)
            if stamps is None:
                found[topic] = None
            elif now_ns - stamps[-1] > _SILENT_NS:
                found[topic] = seconds(now_ns - stamps[-1])
        return found

    def lost(self) -> dict[str, int]:
        """Messages that were lost on the way here during the present episode, per topic."""
        return {
            topic: n for topic, total in self._incoming.lost.copy().items() if (n := total - self._lost.get(topic, 0))
        }

    def _note(self, item: Received) -> None:
        if self._keeps(item.topic):
            self._newest[item.topic] = item.message
            self._seen.setdefault(item.topic, deque(maxlen=_RATE_WINDOW)).append(item.received_ns)

    def _open_episode(self, start: EpisodeStart, latched: Iterable[Received], lost: Mapping[str, int]) -> None:
        """Open an episode, with what was latched and what had been lost on the way here when it began."""
        self.failure = None
        self._lost = lost
        self._open = self._did(partial(self._recorder.begin, start))
        for item in latched:
            self._write(item, start.stamp_ns)

    def _end_episode(self, end: EpisodeEnd, provisional: bool) -> None:
        """End the open episode; `provisional`: when the end was asked for it was whole, and it is to be kept."""
        whole = self._finish(end)
        with self._order:
            self._provisional -= provisional
            self._whole += provisional and whole
        self._report_absent()

    def _finish(self, end: EpisodeEnd) -> bool:
        """End the open episode, if any; whether it is whole."""
        if not self._open:
            return False
        self._open = False
        # Counted now: what waited when the episode ended may have been lost since.
        dropped = {topic: n for topic, n in self.lost().items() if self._keeps(topic)}
        return self._did(partial(self._recorder.end, attrs.evolve(end, dropped=dropped)))

    def _write(self, item: Received, received_ns: int) -> None:
        if not self._open or not self._keeps(item.topic):
            return
        if not self._did(partial(self._recorder.write, item.topic, item.message, received_ns)):
            self._finish(EpisodeEnd(received_ns, "unknown"))

    def _did(self, act: Callable[[], object]) -> bool:
        """Let the recorder do something; a failure of any kind is a fault of the episode, and no other's."""
        try:
            act()
        except RecorderError as error:
            self._fail(error)
        except Exception as error:  # a plugin's bug must neither end the run nor go unreported
            self._session.log.debug("the recorder failed", exc_info=error)
            self._fail(RecorderError(f"the recorder {self._config.type!r} failed: {error_line(error)}"))
        else:
            return True
        return False

    def _fail(self, error: RecorderError) -> None:
        session = self._session
        if self.failure is not None:
            return  # what follows from the first is no news
        self.failure = error
        fault = f"recording ended: {error_line(error)}"
        session.add_fault(fault)
        session.log.error("%s; the robot goes on", fault)
        session.emit("ibrobot_fault_raised", fault=fault)

    def _report_absent(self) -> None:
        """Say once, after the first episode, which listed topics never came: a misspelt one never will."""
        listed = self._config.topics if isinstance(self._config.topics, tuple) else ()
        absent = [topic for topic in listed if topic not in self._seen]
        if absent and not self._reported_absent:
            self._reported_absent = True
            there = ", ".join(self._session.bus.topics())
            self._session.log.warning(
                "recording.topics: nothing of %s has come so far, nor was recorded; available: %s",
                ", ".join(absent),
                there,
            )

    def _keeps(self, topic: str) -> bool:
        return is_kept(topic, self._config, self._contract)
