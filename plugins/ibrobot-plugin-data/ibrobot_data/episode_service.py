"""Starts and ends recorded episodes, for the command line and through services on the bus."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from types import NoneType
from typing import TYPE_CHECKING, Any, Literal, get_args, override

import attrs
from ibrobot_terminal.plural import counted

from ibrobot_core.api import NS_PER_S, Contract, NotSupported, RecorderError, documented, option, seconds
from ibrobot_core.app import Episodes, NoRequest, RecordedRun, Service, wrong_input
from ibrobot_data.conversion import OUTCOMES
from ibrobot_data.cues import Cue
from ibrobot_data.episode_dataset import EpisodeDataset, count_complete
from ibrobot_data.episode_start import is_kept
from ibrobot_data.errors import DiskFull
from ibrobot_data.prompt import check_prompt

if TYPE_CHECKING:
    from pathlib import Path

    from ibrobot_data.recording_worker import RecordingWorker
    from ibrobot_data.written import WrittenEpisode

_COUNTED = ("episodes", "successes", "unjudged")
"""Numbers of episodes in the outcome of a run."""


@documented
@attrs.frozen
class StartEpisode:
    """A request to `/record_episode/start`."""

    prompt: str | None = option(None, help="description of the task; without one, that of the last episode")
    wait: bool = option(
        False, help="begin once the robot follows the operator's device; at once in a mode without teleoperation"
    )


@documented
@attrs.frozen
class StopEpisode:
    """A request to `/record_episode/stop`."""

    outcome: str = option("unknown", choices=OUTCOMES, help="how the episode ended")


@documented
@attrs.frozen
class EpisodeStatus:
    """The state of recording."""

    recording: bool = option(help="whether an episode is being recorded")
    by_mode: bool = option(help="whether the mode begins and ends episodes itself")
    episode: int = option(help="number of the present or last episode, from 1; 0 before the first")
    saved: int = option(help="number of complete episodes that were kept")
    wanted: int | None = option(help="number of episodes after which the run ends; null: it does not end by itself")
    prompt: str = option(help="the task")
    waiting: bool = option(help="whether an episode begins as soon as the robot follows the operator's device")
    can_redo: bool = option(help="whether there is an episode to record again")
    cues: int = option(help="number of cues so far")
    cue: str = option(choices=("", *get_args(Cue)), help="the newest cue; empty before the first")
    elapsed_s: float = option(unit="s", help="time since the episode began; 0 without an episode")
    max_duration_s: float = option(unit="s", help="`contract.max_duration_s`")
    rates_hz: Mapping[str, float] = option(unit="Hz", help="topic -> messages per second")
    silent: Sequence[str] = option(help="topics of the contract that have had no message for too long")
    lost: Mapping[str, int] = option(help="topic -> number of messages that were not recorded")
    free_bytes: int = option(unit="bytes", help="free space on the disk of the dataset")
    bytes_per_s: int = option(unit="bytes/s", help="what an episode takes at present rates")
    waiting_bytes: int = option(unit="bytes", help="what waits to be written")
    failure: str = option(help="the error that cut short the present or last episode; empty without one")


@documented
@attrs.frozen
class RecordEpisode:
    """A request to `/record_episode`."""

    prompt: str = option("", help="description of the task; empty: that of the last episode")


@documented
@attrs.frozen
class RecordedEpisode:
    """State of an episode."""

    success: bool = option(help="whether it is complete and kept")
    message: str = option(help="where it is, or why it is not kept")


@documented
@attrs.frozen
class RecordProgress:
    """How the present episode goes on."""

    seconds_remaining: int = option(unit="s", help="time until it ends by itself")
    feedback_message: str = option(help="its number, and what was lost")


@documented
@attrs.frozen
class DatasetInfo:
    """Where episodes go."""

    path: str = option(help="folder of the dataset")
    episodes: int = option(help="number of complete episodes in it")


CANCEL = Service(
    "/record_episode/cancel", NoRequest, NoneType, "End the episode early, and keep it, as IB-Robot's recorder does."
)
START = Service("/record_episode/start", StartEpisode, NoneType, "Begin an episode.", alone="prompt", cancel=CANCEL)
STOP = Service("/record_episode/stop", StopEpisode, NoneType, "End the episode.", alone="outcome")
REDO = Service(
    "/record_episode/redo", NoRequest, NoneType,
    "Record the present or last episode again, which replaces it; begins as with `wait`.",
)  # fmt: skip
DISCARD = Service("/record_episode/discard", NoRequest, NoneType, "End the episode, and delete it.")
STATUS = Service(
    "/record_episode/status", NoRequest, EpisodeStatus, "The state of recording, for a user interface.", reads=True
)
INFO = Service(
    "/record_episode/get_info", NoRequest, DatasetInfo, "Where episodes go, as IB-Robot's recorder says.", reads=True
)
PROGRESS = Service(
    "/record_episode/progress", NoRequest, RecordProgress, "How the present episode goes on.", reads=True
)
RECORD = Service(
    "/record_episode", RecordEpisode, RecordedEpisode, "Record an episode, and answer when it has ended.",
    alone="prompt", ros_type="ibrobot_msgs/action/RecordEpisode", progress=PROGRESS, cancel=CANCEL,
)  # fmt: skip
_GLANCE_S = 0.05
"""Interval at which the end of an episode is looked for [s]."""
_LAST_GLANCES = 60
"""How often it is still looked for once the run ends."""
_MIB = 1 << 20
_PAUSED_NS = NS_PER_S // 10
"""A robot that has not followed for this time is paused [ns]."""


class EpisodeService(Episodes):
    """Recorded episodes, begun and ended by the mode or an operator. The operator's methods are thread-safe.

    Args:
        session: the run.
        recording: the worker that records them; its run serves these episodes.

    Attributes:
        by_mode: whether the mode begins and ends episodes, so that an operator can only watch.
        wanted: number of episodes after which the run ends; None: it does not end by itself.
        earlier: number of episodes of earlier runs that count as saved.
        waiting: whether an episode begins as soon as the robot follows the operator's device.
        cues: number of cues so far; a page that sees it change plays `cue`.
        cue: the newest cue; empty before the first.

    Raises:
        RecorderError: if the dataset has another contract or cannot be written, or if `recording.topics` leaves out a
            topic of the contract in a run where an operator records.
    """

    def __init__(self, session: RecordedRun, recording: RecordingWorker) -> None:
        super().__init__(session)
        self._agent = session.authority.acting
        self._by_agent = False
        """Whether an agent has asked for the present or last episode."""
        self._recording = recording
        recording.episodes, recording.serving = self, self._served
        recording.on_kept = partial(self.play, "saved")
        self.wanted: int | None = None
        self.earlier = 0
        self.waiting = False
        self._waiting_ns = 0
        """Since when [ns]."""
        self.cues = 0
        self.cue: Cue | Literal[""] = ""
        self.on_cue: list[Callable[[Cue], None]] = []
        self._again = False
        """Whether the present episode replaces the last one."""
        self._last_counted: dict[str, int] = {}
        """What the last kept episode added to each of `_COUNTED`."""
        self.by_mode = session.simulates_episodes or not session.request.by_operator
        self._lock = threading.Lock()
        config = session.config.recording
        assert config is not None
        self.folder = config.folder
        self._dataset = EpisodeDataset(self.folder)
        contract = Contract.from_config(session.config)
        with wrong_input():  # the cause is `recording.root` or `recording.dataset`
            check_prompt(self.prompt)
            self._dataset.check_writable()
            self._dataset.check(contract)
        left_out = [topic for topic in contract.topics if not is_kept(topic, config.topics, contract)]
        if session.request.by_operator and left_out:
            raise RecorderError(
                f"recording.topics leaves out {', '.join(left_out)}, which the contract needs; no episode could be "
                "converted: add them, or write `topics: contract`"
            )

    @override
    def begin(self) -> None:
        self._recording.begin(self.number + 1, self.prompt, again=self._again)
        super().begin()
        self.play("start")

    @override
    def end(self, outcome: str) -> None:
        if not self.running:
            return
        self._recording.end(self.judged(outcome), self.faults)
        counts, kept = self._session.outcome, outcome != "discarded"
        if kept and self._again:  # what is recorded again counts once
            for name, number in self._last_counted.items():
                setattr(counts, name, getattr(counts, name) - number)
        before = {name: getattr(counts, name) for name in _COUNTED}
        super().end(outcome)
        if kept:
            self._last_counted = {name: getattr(counts, name) - number for name, number in before.items()}

    @property
    def saved(self) -> int:
        """Number of complete episodes that were kept."""
        return self.earlier + self._recording.saved

    @property
    def writing(self) -> bool:
        """Whether an episode that has ended is not completely written yet."""
        return self._recording.writing

    @property
    def written(self) -> Sequence[WrittenEpisode]:
        """The episodes that have ended, as they are on the disk, without discarded and replaced ones."""
        return self._recording.written

    @property
    def present(self) -> Path | None:
        """The folder of the episode that is being recorded or written; None without one."""
        return self._recording.present

    @property
    def replaced(self) -> Path | None:
        """The folder of the episode that is being recorded again; None without one."""
        return self._recording.replaced

    def play(self, cue: Cue) -> None:
        """Let the operator hear a cue, unless the mode begins and ends the episodes."""
        if not self.by_mode:
            self.cues, self.cue = self.cues + 1, cue
            for call in self.on_cue:
                call(cue)

    @property
    def failure(self) -> RecorderError | None:
        """The error that cut short the recording of the present or last episode; None without an error."""
        return self._recording.failure

    @property
    def last_prompt(self) -> str:
        """The prompt of the last episode, possibly of an earlier run.

        Raises:
            RecorderError: if the dataset's file cannot be read.
        """
        return self.prompt or self._dataset.prompt

    def start(self, prompt: str | None = None, *, wait: bool = False) -> None:
        """Begin an episode.

        Args:
            prompt: description of the task; None repeats the last prompt.
            wait: whether to begin once the robot follows the operator's device; see `follow`.

        Raises:
            RecorderError: if an episode is being recorded, a fault or emergency stop is not reset, topics of the
                contract are silent (names them), or no file can hold the prompt.
            DiskFull: if the disk has no room for an episode of `contract.max_duration_s` at present rates.
            NotSupported: if the mode begins episodes itself.
        """
        with self._lock:
            self._start(prompt, wait=wait)

    def record(self, prompt: str = "") -> RecordedEpisode:
        """Record an episode, and wait until it has ended, however it ends, and is written.

        Args:
            prompt: description of the task; empty repeats the last prompt.

        Raises:
            RecorderError: as `start`.
            DiskFull: as `start`.
            NotSupported: if the mode begins episodes itself, or in the thread of a lockstep run.
        """
        if self._session.request.lockstep:
            raise NotSupported(f"this service waits for the episode: in lockstep call {START.name} and {STOP.name}")
        before = self._recording.kept
        with self._lock:
            self._start(prompt or None, wait=False)
            number = self.number
        pause, left = threading.Event(), _LAST_GLANCES
        while left and ((self.running and self.number == number) or self.writing):
            left -= self._session.finished.is_set()  # the end of the run ends the episode
            pause.wait(_GLANCE_S)
        if self.failure is not None:
            return RecordedEpisode(False, str(self.failure))
        kept = self._recording.kept
        if self.writing:
            return RecordedEpisode(False, f"episode {number} is not written to its end yet: the disk is slow")
        if kept == before:
            return RecordedEpisode(False, f"episode {number} was discarded")
        remark = next((f"; {each.line()}" for each in self.written if each.path == kept and each.lost), "")
        return RecordedEpisode(True, f"episode {number} is {kept}{remark}")

    def progress(self) -> RecordProgress:
        """How the present episode goes on."""
        left_s = self._session.config.contract.max_duration_s - self.elapsed_s() if self.running else 0.0
        lost = sum(self._recording.lost().values())
        return RecordProgress(max(0, int(left_s)), f"episode {self.number}, {counted(lost, 'message')} lost")

    def redo(self) -> None:
        """Record the present episode again, or else the last one of this run, which is deleted once that is saved.

        Raises:
            RecorderError: as `start`, or without such an episode.
            NotSupported: if the mode begins episodes itself.
        """
        with self._lock:
            self._check_by_operator()
            if not self.can_redo:
                raise RecorderError("no episode of this run is saved, so there is none to record again")
            again = self._again or not self.running
            if self.running:
                self.end("discarded")
            self._check_ready()
            self._by_agent = self._agent.get() is not None
            self._begin(wait=True, again=again)

    @property
    def can_redo(self) -> bool:
        """Whether `redo` has an episode to record again."""
        return self._recording.keeps_whole and not self.waiting and (self.running or self._recording.saved > 0)

    def follow(self) -> None:
        """Begin the episode that waits, if the robot follows by now; called a few times a second.

        Raises:
            RecorderError: as `start`; the episode no longer waits.
        """
        with self._lock:
            if not self.waiting or (self._is_paused(self._waiting_ns) and not self._session.stopped_by):
                return
            self.waiting = False
            self._check_ready()
            self._begin(wait=False, again=self._again)

    def stop(self, outcome: str = "unknown") -> None:
        """End the present episode.

        Raises:
            RecorderError: if no episode is being recorded, or for an unknown outcome.
            NotSupported: if the mode ends episodes itself.
        """
        if outcome not in OUTCOMES:
            raise RecorderError(f"outcome must be one of {', '.join(OUTCOMES)}, not {outcome!r}")
        self._end(outcome)

    def discard(self) -> None:
        """End the present episode and delete it.

        Raises:
            RecorderError: if no episode is being recorded.
            NotSupported: if the mode ends episodes itself.
        """
        self._end("discarded")

    def _is_paused(self, since_ns: int) -> bool:
        """Whether an operator moves the robot in this mode, and it has not followed since a time [ns]."""
        by_hand = self._session.config.control_modes[self._session.mode].teleop is not None
        followed_ns = self._session.followed_ns
        return by_hand and (not followed_ns or followed_ns < since_ns)

    def _start(self, prompt: str | None, *, wait: bool) -> None:
        self._check_by_operator()
        if self.running:
            raise RecorderError("an episode is being recorded; end it first")
        self._check_ready()
        self.prompt = self.last_prompt if prompt is None else check_prompt(prompt)
        self._by_agent = self._agent.get() is not None
        self._begin(wait=wait, again=False)

    def _check_ready(self) -> None:
        """Check that an episode can begin.

        Raises:
            RecorderError: as `start`.
        """
        if fault := self._session.stopped_by:
            raise RecorderError(f"not recording: {fault}; reset it first")
        if silent := self._recording.silent():
            topics = ", ".join(
                f"{topic} ({'nothing yet' if age is None else f'nothing for {age:.1f} s'})"
                for topic, age in silent.items()
            )
            raise RecorderError(f"not recording: the contract's topics are silent: {topics}")
        self._check_space()

    def _begin(self, *, wait: bool, again: bool) -> None:
        self._again = again
        self._waiting_ns = self._session.clock.now_ns()
        self.waiting = wait and self._is_paused(self._waiting_ns - _PAUSED_NS)
        if self.waiting:
            return
        self.begin()
        if self.prompt:
            self._dataset.prompt = self.prompt

    def elapsed_s(self) -> float:
        """Time since the episode began [s]; 0 without an episode."""
        return seconds(self._session.clock.now_ns() - self.begun_ns) if self.running else 0.0

    def free_bytes(self) -> int:
        """Free space on the dataset's disk [bytes]."""
        folder = self.folder
        while not folder.exists():
            folder = folder.parent
        return shutil.disk_usage(folder).free

    def status(self) -> EpisodeStatus:
        """The state of recording, for a user interface."""
        recording, failure = self._recording, self._recording.failure
        return EpisodeStatus(
            recording=self.running, by_mode=self.by_mode, episode=self.number, saved=self.saved, wanted=self.wanted,
            prompt=self.prompt, waiting=self.waiting, can_redo=self.can_redo, cues=self.cues, cue=self.cue,
            elapsed_s=round(self.elapsed_s(), 2), max_duration_s=self._session.config.contract.max_duration_s,
            rates_hz={topic: round(rate, 1) for topic, rate in recording.rates().items()},
            silent=tuple(recording.silent()), lost=recording.lost(), free_bytes=self.free_bytes(),
            bytes_per_s=round(recording.flow()), waiting_bytes=recording.recorder.waiting(),
            failure=str(failure) if failure is not None else "",
        )  # fmt: skip

    @contextmanager
    def _served(self) -> Iterator[None]:
        """Serve the services on the bus while the context is open."""
        handlers: Mapping[Service[Any, Any], Callable[[Any], Any]] = {
            START: lambda request: self.start(request.prompt, wait=request.wait),
            REDO: lambda _: self.redo(),
            STOP: lambda request: self.stop(request.outcome),
            DISCARD: lambda _: self.discard(),
            STATUS: lambda _: self.status(),
            RECORD: lambda request: self.record(request.prompt),
            PROGRESS: lambda _: self.progress(),
            CANCEL: lambda _: self._cancel(),
            INFO: lambda _: DatasetInfo(str(self.folder), count_complete(self.folder)),
        }
        bus = self._session.bus
        for service, handler in handlers.items():
            bus.serve(service, handler)
        try:
            yield
        finally:
            for service in handlers:
                bus.unserve(service)

    def _cancel(self) -> None:
        """End the present episode. An agent, or the end of its authority, ends only episodes that an agent began.

        Raises:
            RecorderError: as `stop`, or if it is the episode of a person.
        """
        self._end("unknown", spares_persons=self._agent.get() is not None)

    def _end(self, outcome: str, *, spares_persons: bool = False) -> None:
        with self._lock:  # also for the check: a person may just begin the next one
            self._check_by_operator()
            if not (self.running or self.waiting):
                raise RecorderError("no episode is being recorded")
            if spares_persons and not self._by_agent:
                raise RecorderError(f"a person began this episode; {STOP.name} ends it")
            self.waiting = False
            self.end(outcome)

    def _check_space(self) -> None:
        longest_s, flow = self._session.config.contract.max_duration_s, self._recording.flow()
        free, kept = self.free_bytes(), self._recording.recorder.min_free
        takes = longest_s * flow
        if free < takes + kept:
            raise DiskFull(
                f"not recording: the disk of {self.folder} has {free / _MIB:.0f} MiB left; an episode of "
                f"{longest_s:g} s (contract.max_duration_s) takes {takes / _MIB:.0f} MiB at {flow / _MIB:.1f} MiB/s, "
                f"and {kept / _MIB:.0f} MiB stay free; make room, record elsewhere (recording.root), or shorten it"
            )

    def _check_by_operator(self) -> None:
        if self.by_mode:
            raise NotSupported(f"mode {self._session.mode} begins and ends its episodes itself")
