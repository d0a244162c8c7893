"""Episodes of a dataset -> recorded episodes, with one message of each topic at every tick."""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import attrs
from ibrobot_provenance.datasets import with_pinholes
from ibrobot_provenance.ownership import Ownership
from ibrobot_terminal.plural import counted

import ibrobot_core
from ibrobot_core.api import (
    Context,
    Contract,
    ContractError,
    EpisodeEnd,
    EpisodeReader,
    EpisodeStart,
    EpisodeSummary,
    IbrobotError,
    Recorder,
    RecorderError,
    Robot,
    SteppedClock,
)
from ibrobot_core.app import installed_plugins
from ibrobot_data.episode import stop_if_full
from ibrobot_data.episode_dataset import EpisodeDataset
from ibrobot_data.episode_start import episode_folder
from ibrobot_data.errors import DiskFull
from ibrobot_data.request import EpisodeReport, Report
from ibrobot_data.run import STAGING, Watch, clear_staging, own_staging, size_of

_DIGEST = "source_digest"
"""Key of the metadata: hash that identifies the dataset's episode."""
_PROGRESS_EVERY = 30
"""Messages of a topic between two progress reports."""


@attrs.frozen
class BagRequest:
    """One conversion of a dataset into recorded episodes."""

    dataset: Path
    numbers: tuple[int, ...]
    """The episodes, from 0."""
    out: Path
    """`OUT/episodes/episode_000001` becomes episode 0 of the dataset."""
    options: Any
    """Of the recorder."""
    type: str
    """Of the recorder."""
    contract: Contract | None = None
    """The contract that the dataset must have; None accepts any."""
    given: Mapping[str, str] = attrs.field(factory=dict)
    """Metadata for a dataset without its own; see `EpisodeAddress`."""
    prompt: str = ""
    """Task of episodes without one."""


def convert_to_bags(request: BagRequest, watch: Watch = lambda done, total, report: None) -> Report:
    """Write episodes of a dataset as recorded ones; each is written completely or not at all.

    Existing ones are passed over, so an interrupted conversion can continue.

    Raises:
        InUse: when another conversion into `request.out` is running.
        PluginError: when the recorder is not installed.
        RecorderError: when nothing can be written at `request.out`.
    """
    begin = time.monotonic()
    try:
        with own_staging(request.out):
            clear_staging(request.out / STAGING)
            reports = _convert_all(request, watch)
    except OSError as error:
        raise RecorderError(f"{request.out}: cannot be written: {error.strerror}") from error
    return Report(request.out, tuple(reports), size_of(request.out), time.monotonic() - begin, resumed=0)


def _convert_all(request: BagRequest, watch: Watch) -> list[EpisodeReport]:
    reports: list[EpisodeReport] = []
    done = 0
    for number in request.numbers:
        job = _Job(request, number)

        def progress(frames: int, before: int = done) -> None:
            watch(before + frames, before + frames, None)

        try:
            report = job.run(progress)
        except DiskFull as error:
            raise DiskFull(
                f"stopped at {error}; {len([each for each in reports if not each.error])} of "
                f"{counted(len(request.numbers), 'episode')} converted and kept in {request.out}: make room, and "
                "run the same command again"
            ) from None
        done += report.frames
        watch(done, done, report)
        reports.append(report)
    return reports


class _Job:
    """One episode."""

    def __init__(self, request: BagRequest, number: int) -> None:
        self._request = request
        self._path = request.dataset.with_name(f"{request.dataset.name}:{number}")
        self._target = episode_folder(request.out, number + 1)
        self._making = request.out / STAGING / self._target.name

    def run(self, progress: Callable[[int], None]) -> EpisodeReport:
        """Convert the episode. After a fault, the report has the error and no files remain."""
        report = EpisodeReport(self._path.name)
        try:
            with closing(installed_plugins().open_episode(self._path, self._request.given)) as reader:
                summary = reader.summary()
                prompt = summary.metadata.get("prompt") or self._request.prompt
                report = attrs.evolve(report, outcome=summary.outcome, prompt=prompt, start_ns=summary.start_ns)
                self._target.parent.mkdir(parents=True, exist_ok=True)
                with Ownership(self._target, "is being written"):
                    if self._target.exists():
                        return attrs.evolve(report, passed_over=self._known(summary, reader.digest()))
                    frames = self._write(reader, summary, self._check(summary), prompt, progress)
        except (IbrobotError, OSError) as error:
            stop_if_full(error, report.source)
            return attrs.evolve(report, error=str(error))
        finally:
            shutil.rmtree(self._making, ignore_errors=True)
            with suppress(OSError):  # not empty
                self._target.parent.rmdir()
        return attrs.evolve(report, frames=frames)

    def _known(self, summary: EpisodeSummary, digest: str) -> str:
        """The reason not to convert it: the target exists and is this episode."""
        with closing(installed_plugins().open_episode(self._target)) as reader:
            there = reader.summary()
        known = there.metadata.get("source", "a recording"), there.metadata.get(_DIGEST)
        if known != (self._source(summary), digest):
            raise RecorderError(f"{self._target}: is another episode ({known[0]}); convert into another folder")
        return "already converted"

    def _source(self, summary: EpisodeSummary) -> str:
        return summary.metadata.get("source", self._path.name)

    def _check(self, summary: EpisodeSummary) -> Contract:
        contract = Contract.from_canonical(json.loads(summary.metadata["contract"]))
        given = self._request.contract
        asked = with_pinholes(given.without_signals()) if given is not None else contract
        if asked.fingerprint() != contract.fingerprint():
            difference = asked.difference(contract, names=("--config", "dataset"))
            raise ContractError(f"{self._path}: was made with another contract than that of --config:\n{difference}")
        EpisodeDataset(self._request.out).check(contract)
        return contract

    def _write(
        self,
        reader: EpisodeReader,
        summary: EpisodeSummary,
        contract: Contract,
        prompt: str,
        progress: Callable[[int], None],
    ) -> int:
        metadata = {
            "ibrobot_version": ibrobot_core.__version__,
            **summary.metadata,
            "prompt": prompt,
            "source": self._source(summary),
            _DIGEST: reader.digest(),
        }
        self._making.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(self._making, ignore_errors=True)
        # With a stepped clock it writes immediately, and equal datasets give equal files.
        ctx = Context("convert", SteppedClock(0), logging.getLogger("ibrobot.convert"), Robot("convert", ()))
        recorder: Recorder = installed_plugins().create("recorder", self._request.type, self._request.options, ctx)
        counts = dict.fromkeys(contract.topics, 0)
        try:
            recorder.begin(EpisodeStart(self._making, summary.start_ns, contract.topics, metadata))
            for item in reader.messages(contract.topics):
                recorder.write(item.topic, item.message, item.received_ns)
                counts[item.topic] += 1
                if counts[item.topic] % _PROGRESS_EVERY == 0:
                    progress(max(counts.values()))
            recorder.end(EpisodeEnd(summary.end_ns, summary.outcome))
        except BaseException:
            with suppress(RecorderError):  # the first error matters
                recorder.close()
            raise
        EpisodeDataset(self._request.out).join(contract, metadata.get("robot", ""), metadata.get("robot_type", ""))
        self._making.rename(self._target)
        return max(counts.values(), default=0)
