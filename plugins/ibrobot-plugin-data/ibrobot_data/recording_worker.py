"""The recording worker: a queue from the bus to the recorder's thread, which never blocks publishers."""

from __future__ import annotations

import logging
import queue
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import override

import attrs
from ibrobot_provenance.ownership import Ownership

from ibrobot_core.api import (
    NS_PER_S,
    Contract,
    EpisodeEnd,
    EpisodeStart,
    IbrobotError,
    Message,
    Recorder,
    RecorderError,
    seconds,
)
from ibrobot_core.app import (
    Component,
    ComponentFailed,
    Episodes,
    Received,
    RecordedRun,
    SessionWorker,
    error_text,
)
from ibrobot_data.episode_start import episode_start, is_kept, model_topics, take_next_folder
from ibrobot_data.written import WrittenEpisode, lost_text, read_back

_DEPTH = 4096
"""Length of the queue to the recorder, in messages."""
_RATE_WINDOW = 31
"""Number of messages over which a rate is measured."""
_SILENT_NS = NS_PER_S
"""A topic without a message for this time is silent [ns]."""
_PATIENCE_S = 60.0
"""How long the end of a run waits for a disk that takes nothing [s]."""
_TELL_S = 5.0
"""Interval of the lines about a disk for which the end of a run waits [s]."""
_GLANCE_S = 0.05
"""Interval at which the end of a run looks whether everything is written [s]."""
GIVE_UP = "f12"
"""The key that ends the wait for a slow disk."""
_MIB = 1 << 20


class NoRecording(Component):
    """Placeholder in a run that records nothing."""

    @override
    def start(self) -> None:
        pass

    @override
    def stop(self) -> None:
        pass


class RecordingWorker(SessionWorker):
    """Writes the bus's messages to a recorder during an episode; its `episodes` begins and ends them.

    If the recorder fails, e.g. on a full disk, the recording of the episode ends with a fault. The robot continues, and
    the next episode is recorded again. A run of `ibrobot record` whose mode begins the episodes ends instead: nobody is
    there to make room.

    At the end of the run, it waits for a slow disk as long as that takes data, until an operator gives up.
    """

    session: RecordedRun
    episodes: Episodes
    """Begins and ends its episodes, as the next two set by `EpisodeService`."""
    serving: Callable[[], AbstractContextManager[None]]
    """Serves what operators and other programs call, while its context is open."""
    on_kept: Callable[[], None]
    """Called when an episode is written and kept."""
    urgent = True
    may_wait = True
    keeps_whole = True
    """Whether an episode of the run is one recording, so that it can be recorded again."""

    def __init__(self, session: RecordedRun) -> None:
        config = session.config.recording
        assert config is not None
        super().__init__(session, "recording", f"{config.type} into {config.root}")
        self._config = config
        self._contract = Contract.from_config(session.config)
        self._of_model: Mapping[str, str] = {}
        """Topics of the acting policy that an episode has beside those of the contract."""
        session.refuse_absent("the recording", self._keeps)
        self._pending: deque[tuple[int, Callable[[], None]]] = deque()
        """Pending begins and ends of episodes: stamp [ns] and action."""
        self._pending_lock = threading.Lock()
        """Held while an action is stamped and queued, and while actions and messages are taken, to keep their order."""
        self._open = self._reported_absent = False
        self._owned: Ownership | None = None
        """The folder of the open episode."""
        self._seen: dict[str, deque[int]] = {}
        """Topic -> times of the last messages [ns]."""
        self._newest: dict[str, Message] = {}
        """Topic -> its last message."""
        self._sizes: dict[str, int] = {}
        """Topic -> size of a message [bytes], measured once per episode, since images may have to be encoded."""
        self._lost: Mapping[str, int] = {}
        """Topic -> messages lost in the queue before the present episode."""
        self._lost_before: dict[str, int] = {}
        """Topic -> messages lost in the queue before the newest one that was written in the present episode."""
        self._lost_by_now = Counter[str]()
        """Topic -> messages lost in the queue when it was last emptied."""
        self._told_of_loss = False
        """Whether the log has a line about the losses of the present episode."""
        self._whole = 0
        """Complete episodes that were kept."""
        self._provisional = 0
        """Episodes that have ended but are not completely written yet."""
        self._ending = 0
        """Ends of episodes that were requested and are not carried out yet."""
        self._again = False
        """Whether the present episode replaces the one kept last."""
        self.kept: Path | None = None
        """The folder of the episode kept last."""
        self.replaced: Path | None = None
        """The folder of the kept episode that the present one replaces."""
        self.written: list[WrittenEpisode] = []
        """The episodes that have ended, as they are on the disk, without discarded and replaced ones."""
        self._handled = 0
        """Number of messages and actions handled so far."""
        self._closed = False
        """Whether the thread has ended, or the disk was given up."""
        self.failure: RecorderError | None = None
        """The error that cut short the recording of the present or last episode; None without an error."""

    @override
    def setup(self) -> None:
        session = self.session
        self._closed = False
        self.on_end.callback(self._close)
        self.recorder: Recorder = session.make("recorder", self._config, "recording")
        self._incoming = session.bus.subscribe(None, _DEPTH, wants=self._keeps)
        self.on_end.callback(self._incoming.close)
        self.on_end.enter_context(self.serving())
        self.on_end.callback(self._give_up)
        self.on_end.callback(self._did, self.recorder.close)
        self.on_end.callback(self.work, 0.0)

    @override
    def stop(self) -> None:
        given_up = not (self.session.request.lockstep or self._wait_until_written())
        try:
            super().stop()
        except ComponentFailed:
            if not given_up:
                raise
        if given_up and self.writing:
            self._abandon()

    def _wait_until_written(self) -> bool:
        """Wait until all episodes are written; False if the disk takes nothing any more, or an operator gives up."""
        keys: queue.SimpleQueue[str] | None = None
        begin = moved = told = time.monotonic()
        progress = self._progress()
        while self.writing and not self._closed:
            if keys is None and self.session.request.keys is not None:
                keys = self.session.request.keys()
            self.pause(_GLANCE_S)
            now, before, progress = time.monotonic(), progress, self._progress()
            moved = now if progress != before else moved
            if now - moved >= _PATIENCE_S or _was_pressed(keys):
                return False
            if now - told >= _TELL_S:
                told = now
                how = "Ctrl-C, pressed twice, gives up" if keys is None else f"{GIVE_UP.upper()} gives up"
                self.session.log.warning(
                    "still writing the recording, for %.0f s; %.1f MiB are left, nothing was written for %.0f s; %s",
                    now - begin, self.recorder.waiting() / _MIB, now - moved, how,
                )  # fmt: skip
        return True

    def _progress(self) -> object:
        return self.recorder.waiting(), self._handled, self._ending

    def _abandon(self) -> None:
        """Leave an episode that the disk does not take."""
        owned, left = self._owned, self.recorder.waiting()
        self._closed = True
        if owned is not None:
            self.written.append(WrittenEpisode(owned.path, "unknown", "unknown", whole=False))
            self._fail(RecorderError(f"{owned.path}: unfinished: the disk did not take the last {left / _MIB:.1f} MiB"))
        else:
            self._fail(RecorderError("the disk did not take the last episode"))

    def _close(self) -> None:
        self._closed = True

    def begin(self, number: int, prompt: str, *, again: bool = False) -> None:
        """Begin an episode; it gets all messages from now on.

        Args:
            number: its number in the run, from 1.
            prompt: description of the task.
            again: whether it replaces the episode kept last, if it is kept itself.

        Raises:
            RecorderError: if the episode cannot be recorded in its dataset.
        """
        session = self.session
        self.failure = None
        with self._pending_lock:
            start, owned = self._start_of(number, prompt, session.bus.snapshot_ns())
            latched = tuple(i for i in session.bus.latched().values() if i.received_ns <= start.stamp_ns)
            begin = partial(self._open_episode, start, owned, latched, self._incoming.lost.copy(), again=again)
            self._pending.append((start.stamp_ns, begin))
            self._again = again

    def _start_of(self, number: int, prompt: str, stamp_ns: int) -> tuple[EpisodeStart, Ownership]:
        """The start of the dataset's next episode, which is of episode `number` of the run, and its folder.

        Raises:
            RecorderError: if it cannot be recorded in its dataset.
        """
        self._sizes = {}
        self._watch_model()
        owned = take_next_folder(self._config.folder)
        try:
            start = episode_start(self.session, owned.path, number=number, stamp_ns=stamp_ns, prompt=prompt)
        except BaseException:
            owned.close()
            raise
        return start, owned

    def _later(self, act: Callable[[], None]) -> None:
        """Let the thread of the recorder do something between the messages received until now and the next ones."""
        with self._pending_lock:
            self._pending.append((self.session.bus.snapshot_ns(), act))

    def end(self, outcome: str, faults: tuple[str, ...] = ()) -> None:
        """End the episode, during which `faults` occurred; messages up to now belong to it."""
        with self._pending_lock:
            provisional, again = outcome != "discarded" and self.failure is None, self._again
            self._ending += 1
            self._provisional += provisional and not again
            end = EpisodeEnd(self.session.bus.snapshot_ns(), outcome, faults=faults)
            self._pending.append((end.stamp_ns, partial(self._end_episode, end, provisional, again)))

    @property
    def writing(self) -> bool:
        """Whether an episode that has ended is not completely written yet."""
        return self._ending > 0

    @property
    def present(self) -> Path | None:
        """The folder of the episode that is being recorded or written; None without one."""
        owned = self._owned
        return owned.path if owned is not None else None

    @property
    def saved(self) -> int:
        """Number of episodes kept, including those still being written; incomplete ones are subtracted later."""
        with self._pending_lock:
            return self._whole + (0 if self._closed else self._provisional)

    @override
    def work(self, timeout_s: float) -> None:
        lost = self._incoming.lost.copy()
        first = self._incoming.get(timeout_s)
        with self._pending_lock:
            pending, self._pending = self._pending, deque()
            # The queue drops its oldest message: what was lost until now came before those that are left.
            lost_until = self._incoming.lost.copy()
            items = [*([first] if first is not None else []), *self._incoming.drain()]
            self._lost_by_now = self._incoming.lost.copy()
        self._tell_losses()
        for item in items:
            self._note(item)
            while pending and pending[0][0] < item.received_ns:
                pending.popleft()[1]()
            self._lost_before[item.topic] = (lost if item is first else lost_until)[item.topic]
            self._write(item, item.received_ns)
            self._handled += 1
        for _, action in pending:
            action()
            self._handled += 1
        self._tell_losses()

    def rates(self) -> dict[str, float]:
        """Measured rate of each recorded topic [Hz]; 0 after a single message."""
        rates = {}
        for topic, stamps in self._seen.copy().items():
            span_ns = stamps[-1] - stamps[0]
            rates[topic] = (len(stamps) - 1) * NS_PER_S / span_ns if span_ns else 0.0
        return rates

    def flow(self) -> float:
        """Disk space that an episode takes per second, from present rates and message sizes [bytes/s]."""
        for topic, message in self._newest.copy().items():
            if topic not in self._sizes:
                self._sizes[topic] = self.recorder.size_of(message)
        sizes = self._sizes.copy()
        return sum(rate * sizes.get(topic, 0) for topic, rate in self.rates().items())

    def silent(self) -> dict[str, float | None]:
        """Silent topics of the contract: topic -> time since the last message [s], None if there was none."""
        now_ns = self.session.clock.now_ns()
        silent_s: dict[str, float | None] = {}
        for topic in self._contract.topics:
            stamps = self._seen.get(topic)
            if stamps is None:
                silent_s[topic] = None
            elif now_ns - stamps[-1] > _SILENT_NS:
                silent_s[topic] = seconds(now_ns - stamps[-1])
        return silent_s

    def lost(self) -> dict[str, int]:
        """Topic -> messages of the present episode that were not recorded, so far."""
        return dict(Counter(self._lost_in_queue(self._incoming.lost.copy())) + Counter(self.recorder.lost()))

    def _lost_in_queue(self, total: Mapping[str, int]) -> dict[str, int]:
        """Topic -> kept messages lost in the queue during the present episode, of those lost in the whole run."""
        return {t: n for t, count in total.items() if self._keeps(t) and (n := count - self._lost.get(t, 0))}

    def _lacks_end(self) -> bool:
        """Whether the newest message of a topic was lost in the queue."""
        return any(
            self._lost_by_now[topic] > self._lost_before.get(topic, self._lost.get(topic, 0))
            for topic in self._lost_in_queue(self._lost_by_now)
        )

    def _tell_losses(self) -> None:
        """Report once per episode, and at once, that messages are lost."""
        if self._open and not self._told_of_loss and (lost := self.lost()):
            self._told_of_loss = True
            self.session.log.warning(
                "the recording loses messages: %s so far; the disk or this computer is too slow", lost_text(lost)
            )

    def _note(self, item: Received) -> None:
        if self._keeps(item.topic):
            self._newest[item.topic] = item.message
            self._seen.setdefault(item.topic, deque(maxlen=_RATE_WINDOW)).append(item.received_ns)

    def _open_episode(
        self, start: EpisodeStart, owned: Ownership, latched: Iterable[Received], lost: Mapping[str, int], *,
        again: bool = False,
    ) -> None:  # fmt: skip
        """Open an episode; `latched` and `lost` are the latched messages and the lost ones counted when it began."""
        self.failure = None
        self.replaced = self.kept if again else None
        self._lost, self._lost_before, self._told_of_loss = lost, {}, False
        self._give_up()
        self._owned = owned
        self._open = self._did(partial(self.recorder.begin, start))
        if not self._open:
            self._give_up()
        for item in latched:
            self._write(item, start.stamp_ns)

    def _end_episode(self, end: EpisodeEnd, provisional: bool, again: bool = False) -> None:
        """End the open episode, which replaces the one before if `again`.

        `provisional`: whether it was complete at the request to end it, and is to be kept.
        """
        folder = self._owned.path if self._owned is not None else None
        episode = self._finish(end)
        kept = episode is not None and episode.whole and provisional
        replaced = episode is not None and kept and again and not episode.unknown and self._remove_kept()
        with self._pending_lock:
            self._provisional -= provisional and not again
            self._whole += kept and not replaced
        self.replaced = None
        if kept:
            self.kept = folder
            self.on_kept()
        with self._pending_lock:
            self._ending -= 1
        self._report_absent()

    def _remove_kept(self) -> bool:
        """Delete the episode kept last; return whether it is gone. One that another program uses stays."""
        if self.kept is None:
            return False
        try:
            with Ownership(self.kept, "is being deleted", wait_s=0.0):
                shutil.rmtree(self.kept)
        except (OSError, IbrobotError) as error:
            self.session.log.warning("the episode that was recorded again stays: %s", error_text(error, "; "))
            return False
        self.written = [each for each in self.written if each.path != self.kept]
        return True

    def _finish(self, end: EpisodeEnd) -> WrittenEpisode | None:
        """End the open episode, and return what is on the disk; None without an episode, and for a discarded one."""
        if not self._open:
            return None
        self._open = False
        assert self._owned is not None
        folder, lost = self._owned.path, self.lost()
        # Of what the queue held when the episode ended, nothing can be lost after it was taken.
        dropped = self._lost_in_queue(self._lost_by_now)
        lacks_end = end.outcome != "discarded" and self._lacks_end()
        told = attrs.evolve(end, outcome="unknown" if lacks_end else end.outcome, dropped=dropped)
        ended = self._did(partial(self.recorder.end, told))
        episode = None
        if end.outcome != "discarded":
            if ended:
                episode = read_back(self.session, folder, end.outcome, told.outcome, lost)
            else:
                episode = WrittenEpisode(folder, end.outcome, "unknown", whole=False, error=str(self.failure))
            if not self._closed:
                self.written.append(episode)
                self.session.log.log(logging.INFO if episode.whole else logging.ERROR, "%s", episode.line())
        self._give_up()
        return episode

    def _give_up(self) -> None:
        """Leave the folder of the last episode to others."""
        if self._owned is not None:
            self._owned.close()
            self._owned = None

    def _write(self, item: Received, received_ns: int) -> None:
        if not self._open or not self._keeps(item.topic):
            return
        if not self._did(partial(self.recorder.write, item.topic, item.message, received_ns)):
            self._finish(EpisodeEnd(received_ns, "unknown"))

    def _did(self, act: Callable[[], object]) -> bool:
        """Call the recorder; return False after a failure of any kind, which ends the recording of the episode."""
        try:
            act()
        except RecorderError as error:
            self._fail(error)
        except Exception as error:  # a plugin's bug must neither end the run nor go unreported
            self.session.log.debug("the recorder failed", exc_info=error)
            self._fail(RecorderError(f"the recorder {self._config.type!r} failed: {error_text(error, '; ')}"))
        else:
            return True
        return False

    def _fail(self, error: RecorderError) -> None:
        session = self.session
        if self.failure is not None:
            return  # report the first failure, not its consequences
        self.failure = error
        fault = f"recording ended: {error_text(error, '; ')}"
        session.add_fault(fault)
        ends = session.request.by_operator and session.simulates_episodes
        session.log.error("%s; %s", fault, "the run ends" if ends else "the robot goes on")
        session.emit("ibrobot_fault_raised", fault=fault)
        if ends:
            session.finish()

    def _report_absent(self) -> None:
        """Report once, after the first episode, the listed topics without messages: they may be misspelt."""
        listed = self._config.topics if isinstance(self._config.topics, tuple) else ()
        absent = [topic for topic in listed if topic not in self._seen]
        if absent and not self._reported_absent:
            self._reported_absent = True
            self.session.log.warning(
                "recording.topics: no message on %s so far, so none was recorded; available: %s",
                ", ".join(absent),
                ", ".join(self.session.bus.topics()),
            )

    def _watch_model(self) -> None:
        """Keep the topics of the policy that acts from now on."""
        if self._config.topics == "contract":
            self._of_model = model_topics(self.session.config, self.session.command_source.described())

    def _keeps(self, topic: str) -> bool:
        return topic in self._of_model or is_kept(topic, self._config.topics, self._contract)


def _was_pressed(keys: queue.SimpleQueue[str] | None) -> bool:
    """Whether an operator gave up since the last call."""
    pressed = False
    while keys is not None and not keys.empty():
        pressed = keys.get() == GIVE_UP or pressed
    return pressed
