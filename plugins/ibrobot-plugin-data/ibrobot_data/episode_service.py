"""Starts and ends recorded episodes, for the command line and through services on the bus."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Mapping
from types import NoneType
from typing import TYPE_CHECKING, Any, override

import attrs

from ibrobot_core.api import Contract, NotSupported, RecorderError, documented, option, seconds
from ibrobot_core.app import DiskFull, Episodes, NoRequest, RunAccess, Service, wrong_input
from ibrobot_data.conversion import OUTCOMES
from ibrobot_data.episode_dataset import EpisodeDataset
from ibrobot_data.episode_start import is_kept
from ibrobot_data.prompt import check_prompt

if TYPE_CHECKING:
    from ibrobot_data.recording_worker import RecordingWorker


@documented
@attrs.frozen
class StartEpisode:
    """A request to `/record_episode/start`."""

    prompt: str | None = option(None, help="description of the task; without one, that of the last episode")


@documented
@attrs.frozen
class StopEpisode:
    """A request to `/record_episode/stop`."""

    outcome: str = option("unknown", choices=OUTCOMES, help="how the episode ended")


START = Service("/record_episode/start", StartEpisode, NoneType, "Begin an episode.", alone="prompt")
STOP = Service("/record_episode/stop", StopEpisode, NoneType, "End the episode.", alone="outcome")
DISCARD = Service("/record_episode/discard", NoRequest, NoneType, "End the episode, and delete it.")
STATUS: Service[NoRequest, Mapping[str, Any]] = Service(
    "/record_episode/status", NoRequest, Mapping, "The state of recording, for a user interface."
)
_MIB = 1 << 20


class EpisodeService(Episodes):
    """Recorded episodes, begun and ended by the mode or an operator. The operator's methods are thread-safe.

    Args:
        session: the run.
        recording: the worker that records them.

    Attributes:
        by_mode: whether the mode begins and ends episodes, so that an operator can only watch.
        wanted: number of episodes after which the run ends; None: it does not end by itself.

    Raises:
        RecorderError: if the dataset has another contract or cannot be written, or if `recording.topics` leaves out a
            topic of the contract in a run where an operator records.
    """

    def __init__(self, session: RunAccess, recording: RecordingWorker) -> None:
        super().__init__(session)
        self._recording = recording
        self.wanted: int | None = None
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
        left_out = [topic for topic in contract.topics if not is_kept(topic, config, contract)]
        if session.request.by_operator and left_out:
            raise RecorderError(
                f"recording.topics leaves out {', '.join(left_out)}, which the contract needs; no episode could be "
                "converted: add them, or write `topics: contract`"
            )

    @override
    def begin(self) -> None:
        self._recording.begin(self.number + 1, self.prompt)
        super().begin()

    @override
    def end(self, outcome: str) -> None:
        if self.running:
            self._recording.end(self.judged(outcome), self.faults)
        super().end(outcome)

    @property
    def saved(self) -> int:
        """Number of complete episodes that were kept."""
        return self._recording.saved

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

    def start(self, prompt: str | None = None) -> None:
        """Begin an episode.

        Args:
            prompt: description of the task; None repeats the last prompt.

        Raises:
            RecorderError: if an episode is being recorded, a fault or emergency stop is not reset, topics of the
                contract are silent (names them), or no file can hold the prompt.
            DiskFull: if the disk has no room for an episode of `contract.max_duration_s` at present rates.
            NotSupported: if the mode begins episodes itself.
        """
        with self._lock:
            self._check_by_operator()
            if self.running:
                raise RecorderError("an episode is being recorded; end it first")
            if fault := self._session.stopped_by:
                raise RecorderError(f"not recording: {fault}; reset it first")
            if silent := self._recording.silent():
                topics = ", ".join(
                    f"{topic} ({'nothing yet' if age is None else f'nothing for {age:.1f} s'})"
                    for topic, age in silent.items()
                )
                raise RecorderError(f"not recording: the contract's topics are silent: {topics}")
            self._check_space()
            self.prompt = self.last_prompt if prompt is None else check_prompt(prompt)
            self.begin()
            if self.prompt:
                self._dataset.prompt = self.prompt

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

    def elapsed_s(self) -> float:
        """Time since the episode began [s]; 0 without an episode."""
        if not self.running:
            return 0.0
        return seconds(self._session.clock.now_ns() - self.begun_ns)

    def free_bytes(self) -> int:
        """Free space on the dataset's disk [bytes]."""
        folder = self.folder
        while not folder.exists():
            folder = folder.parent
        return shutil.disk_usage(folder).free

    def status(self) -> Mapping[str, Any]:
        """The state of recording, for a user interface."""
        failure = self._recording.failure
        return {
            "recording": self.running, "by_mode": self.by_mode, "episode": self.number, "saved": self.saved,
            "wanted": self.wanted, "prompt": self.prompt, "elapsed_s": round(self.elapsed_s(), 2),
            "max_duration_s": self._session.config.contract.max_duration_s,
            "rates_hz": {topic: round(rate, 1) for topic, rate in self._recording.rates().items()},
            "silent": list(self._recording.silent()), "lost": self._recording.lost(),
            "free_bytes": self.free_bytes(), "bytes_per_s": round(self._recording.flow()),
            "waiting_bytes": self._recording.waiting(), "failure": str(failure) if failure is not None else "",
        }  # fmt: skip

    def serve(self) -> None:
        """Register the services on the bus."""
        bus = self._session.bus
        bus.serve(START, lambda request: self.start(request.prompt))
        bus.serve(STOP, lambda request: self.stop(request.outcome))
        bus.serve(DISCARD, lambda _: self.discard())
        bus.serve(STATUS, lambda _: self.status())

    def unserve(self) -> None:
        """Remove the services from the bus."""
        for service in (START, STOP, DISCARD, STATUS):
            self._session.bus.unserve(service)

    def _end(self, outcome: str) -> None:
        with self._lock:
            self._check_by_operator()
            if not self.running:
                raise RecorderError("no episode is being recorded")
            self.end(outcome)

    def _check_space(self) -> None:
        longest_s, flow = self._session.config.contract.max_duration_s, self._recording.flow()
        free, kept = self.free_bytes(), self._recording.min_free
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
