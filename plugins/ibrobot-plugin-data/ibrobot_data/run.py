"""A conversion: find episodes, convert them in parallel into staged units, and merge these in order."""

from __future__ import annotations

import hashlib
import itertools
import os
import re
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import attrs
from ibrobot_provenance.datasets import DatasetSummary
from ibrobot_provenance.jobs import Job as PoolJob
from ibrobot_provenance.jobs import Pool, open_pool
from ibrobot_provenance.ownership import Ownership
from ibrobot_terminal.plural import counted

from ibrobot_core.api import Contract, DatasetError, EpisodeAddress, IbrobotError, RecorderError, seconds
from ibrobot_core.app import installed_plugins, set_malloc
from ibrobot_data.commanders import is_labelled
from ibrobot_data.episode import (
    INTERVENTION,
    MAKING,
    Job,
    Unit,
    convert_episode,
    error_text,
    make_writer,
    read_unit,
    recorded_contract,
    unit_key,
    unwanted_outcome,
)
from ibrobot_data.errors import DiskFull
from ibrobot_data.growing import GrowingEpisode
from ibrobot_data.identity import KnownEpisodes, identity, identity_by_uuid
from ibrobot_data.provenance import conversion, provenance
from ibrobot_data.request import ConversionRequest, EpisodeReport, Report
from ibrobot_data.same_robot import Identity

STAGING = ".staging"
"""Folder within the dataset for converted episodes until the merge."""
_LOCK = "lock"
_THERE = "{}: already has a dataset; --append adds to it"
_MAP_FROM, _KEEP = 512 << 10, 8 << 20
"""Thresholds of malloc [bytes], so that freed images return to the system instead of fragmenting the heap."""

Watch = Callable[[int, int, EpisodeReport | None], None]
"""Receives the number of finished frames, the estimated total, and the report of an episode if one has finished."""


def find_episodes(paths: Sequence[Path]) -> list[Path]:
    """Find the episodes in `paths`: episodes, `DATASET:N`, or folders of them. Each appears once, in numeric order.

    Raises:
        RecorderError: for a path that neither is nor contains an episode.
    """
    readers = [reader for reader in installed_plugins().readers if not reader.numbered]

    def below(path: Path) -> Iterator[Path]:
        if any(reader.reads(path) for reader in readers):
            yield path
        elif path.is_dir():
            for child in sorted(path.iterdir(), key=_natural):
                if child.is_dir() and not child.name.startswith("."):  # e.g. the trash of `ibrobot episodes delete`
                    yield from below(child)

    by_real_path: dict[Path, Path] = {}
    for path in paths:
        address = EpisodeAddress.of(path)
        here = [path] if address.number is not None else list(below(path))
        if not here:
            installed_plugins().open_episode(path).close()  # raises the error that explains what an episode is
        by_real_path |= {each.resolve(): each for each in here}
    return list(by_real_path.values())


def convert(
    request: ConversionRequest, episodes: Sequence[Path], watch: Watch = lambda done, total, report: None
) -> Report:
    """Convert episodes into the dataset at `request.out`, in the order given.

    The report names episodes that cannot be converted; they are left out. Converted episodes are kept until all are
    done, so after an interruption the same call continues.

    Raises:
        DatasetError: when `out` has a dataset and `append` is false, when these episodes do not fit the dataset, or
            when it cannot be written.
        DiskFull: when the disk fills up; what is converted is kept.
        PluginError: when the dataset writer is not installed.
    """
    begin = time.monotonic()
    with _staging(request) as (whole, staging, old):
        plan = _Plan(whole, staging, old, episodes)
        request = plan.request
        # Without --append nothing may be added, unless the same command was killed after the merge.
        if old is not None and not request.append and plan.adds(old):
            raise DatasetError(_THERE.format(request.out))
        reports = plan.run(watch)
        units = [unit for unit in plan.units() if not reports[unit.report.source].error]
        reports |= _refuse_misfits(request, units, old)
        units = [unit for unit in units if reports[unit.report.source].kept]
        if units and old is not None and not request.append:
            raise DatasetError(_THERE.format(request.out))
        if units:
            _merge(request, old, units, [source for source in plan.sources if reports[source].error])
        clear_staging(staging)
    ordered = tuple(reports[source] for source in plan.sources)
    return Report(request.out, ordered, size_of(request.out), time.monotonic() - begin, plan.resumed)


def stage(request: ConversionRequest, episode: Path, progress: Callable[[int], None]) -> EpisodeReport | None:
    """Convert an episode in this process, and keep it for the call of `convert` that adds it to the dataset.

    Returns None if the dataset has the episode, or a finished unit of it is kept already.

    Args:
        request: the request of that call.
        episode: the episode's folder.
        progress: called with the number of frames done since the last call.

    Raises:
        DatasetError: as `convert`.
        DiskFull: as `convert`.
        InUse: if another conversion into the dataset is running.
    """
    set_malloc(_MAP_FROM, _KEEP)
    with _staging(request) as (whole, staging, old):
        plan = _Plan(whole, staging, old, [episode])
        return next((convert_episode(job, progress) for job in plan.unfinished(plan.todo)), None)


def follow(
    request: ConversionRequest, episode: Path, progress: Callable[[int], None], has_ended: Callable[[float], bool]
) -> EpisodeReport | None:
    """Convert an episode while it is being recorded, and keep it as `stage` does; the result is the same.

    An episode that cannot be followed, e.g. because it records who commands, is converted once it has ended.

    Args:
        request: as of `stage`.
        episode: the episode's folder.
        progress: called with the number of frames done since the last call.
        has_ended: see `GrowingEpisode`.

    Raises:
        DatasetError: as `convert`.
        DiskFull: as `convert`.
        InUse: if another conversion into the dataset is running.
    """
    set_malloc(_MAP_FROM, _KEEP)
    growing = GrowingEpisode(episode, has_ended)
    with _staging(request) as (whole, staging, old):
        if whole.only == "all" and not whole.labels and _has_begun(growing, whole):
            job = Job(whole, episode, _source(episode, ()), staging / _unit_of(episode))
            shutil.rmtree(job.unit, ignore_errors=True)
            if not (report := convert_episode(job, progress, growing)).error:
                return report
        while not growing.ended:
            growing.wait()
        plan = _Plan(whole, staging, old, [episode])
        return next((convert_episode(job, progress) for job in plan.unfinished(plan.todo)), None)


def _has_begun(growing: GrowingEpisode, request: ConversionRequest) -> bool:
    """Wait for a message of every topic that is needed; false if there is none, or the episode cannot be followed."""
    while not growing.ended:
        begin_s = time.monotonic()
        with suppress(RecorderError):  # nothing is on the disk yet
            summary = growing.summary()
            contract = request.contract or recorded_contract(summary.metadata)
            present = {topic for topic, each in summary.topics.items() if each.count}
            if contract is not None and present.issuperset(contract.topics):
                return not is_labelled(summary)
        growing.wait(time.monotonic() - begin_s)
    return False


def _unit_of(episode: Path) -> str:
    """Name of an episode's unit."""
    return hashlib.sha256(os.fsencode(episode.resolve())).hexdigest()[:32]


def check_out(request: ConversionRequest) -> None:
    """Check that episodes can be added to the dataset at `request.out`, or that it does not exist yet.

    Raises:
        DatasetError: as `convert`.
        InUse: if another conversion into the dataset is running.
    """
    with _staging(request):
        pass


def _merge(
    request: ConversionRequest, old: DatasetSummary | None, units: Sequence[Unit], failed: Sequence[str]
) -> None:
    """Add the units to the dataset."""
    writer = make_writer(request)
    if writer.summary(request.out) != old:
        raise DatasetError(f"{request.out}: another program has changed it; run the same command again")
    writer.merge(request.out, [unit.dataset for unit in units], provenance(request, old, units, failed))


def size_of(folder: Path) -> int:
    """Total size of the files in a folder [bytes]; 0 if there is none."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if folder.exists() else 0


def clear_staging(staging: Path) -> None:
    """Remove all but the lock from a staging folder."""
    for path in list(staging.iterdir()):
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != _LOCK:
            path.unlink()


def _remove_unfinished(staging: Path) -> None:
    """Remove incomplete units of processes that died."""
    for folder in staging.glob(f"*{MAKING}*"):
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _staging(request: ConversionRequest) -> Iterator[tuple[ConversionRequest, Path, DatasetSummary | None]]:
    """The staging folder, owned by this conversion, and the existing dataset, with labels requested if it has them."""
    out, staging = request.out, request.out / STAGING
    try:
        with own_staging(out):
            old = make_writer(request).summary(out)
            others = [path for path in out.iterdir() if path != staging]
            if old is None and others and all(path.name == _LOCK for path in staging.iterdir()):
                raise DatasetError(f"{out} is not empty and has no dataset of writer {request.type!r}")
            if old is not None:
                request = attrs.evolve(request, labels=INTERVENTION in old.features)
                _check_old(request, old)
            _remove_unfinished(staging)
            yield request, staging, old
    except OSError as error:
        raise DatasetError(f"{out}: cannot be written: {error.strerror}") from error


@contextmanager
def own_staging(out: Path) -> Iterator[None]:
    """Lock `out` against other conversions; afterwards, remove folders that are still empty.

    Raises:
        InUse: if another conversion into it is running.
        OSError: if it cannot be written.
    """
    staging = out / STAGING
    owned = None
    while owned is None:
        staging.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # another conversion ended, and removed the folder
            owned = Ownership(out, "is being written", file=staging / _LOCK)
    try:
        yield
    finally:
        owned.close()
        with suppress(OSError):  # not empty
            staging.rmdir()
            out.rmdir()


def _check_old(request: ConversionRequest, old: DatasetSummary) -> None:
    """Check that the dataset was made with the same settings."""
    known = old.metadata.get("conversion")
    if not request.append and known != conversion(request):
        raise DatasetError(_THERE.format(request.out))
    if known is None:
        raise DatasetError(f"{request.out}: not made by a conversion of ibrobot; convert into another folder")
    asked = conversion(request)
    known = {"missing": asked["missing"]} | known  # older datasets do not have it
    names = [name for name in asked | known if known.get(name) != asked.get(name)]
    wrong = [f"{name} {known.get(name)}, now {asked.get(name)}" for name in names]
    if wrong:
        raise DatasetError(f"{request.out}: was made with other settings: {'; '.join(wrong)}")


class _Plan:
    """The episodes, and the work left for each."""

    def __init__(
        self, request: ConversionRequest, staging: Path, old: DatasetSummary | None, episodes: Sequence[Path]
    ) -> None:
        self.request = request
        """The request, with labels if the dataset has them, or if it is new and an episode records who commanded."""
        self._staging = staging
        self._reports: dict[str, EpisodeReport] = {}
        self._jobs: dict[str, Job] = {}
        self._expected: dict[str, int] = {}
        """Source -> number of frames, estimated from its length."""
        self._copies: dict[str, str] = {}
        """Copy -> its original; a copy is converted only if the original fails."""
        self._alike: dict[Any, list[tuple[Job, str]]] = {}
        """Properties in which the summaries of copies agree -> new episodes, with identity if a summary tells it."""
        self.resumed = 0
        self.sources: dict[str, None] = {}
        self._labelled = False
        known = KnownEpisodes(old.metadata["episodes"] if old is not None else ())
        for path in episodes:
            source = _source(path, self.sources)
            self.sources[source] = None
            self._add(Job(request, path, source, staging / _unit_of(path)), known)
        if old is None and self._labelled:
            self.request = attrs.evolve(request, labels=True)
            self._jobs = {source: attrs.evolve(job, request=self.request) for source, job in self._jobs.items()}
        self._find_copies()

    def _add(self, job: Job, known: KnownEpisodes) -> None:
        source, report = job.source, EpisodeReport(job.source)
        try:
            with closing(installed_plugins().open_episode(job.episode)) as reader:
                summary = reader.summary()
                self._labelled = self._labelled or is_labelled(summary)
                there = known.find(source, reader, summary)
        except Exception as error:  # noqa: BLE001 - a fault in a plugin must not cost the other episodes
            self._reports[source] = attrs.evolve(report, error=error_text(error))
            return
        report = attrs.evolve(report, outcome=summary.outcome, start_ns=summary.start_ns)
        if there:
            self._reports[source] = attrs.evolve(report, passed_over=there)
            return
        counts = tuple((topic, each.count) for topic, each in sorted(summary.topics.items()))
        alike = self._alike.setdefault((summary.start_ns, summary.end_ns, counts), [])
        alike.append((job, identity_by_uuid(summary)))
        if unwanted := unwanted_outcome(summary, self.request):
            self._reports[source] = attrs.evolve(report, passed_over=unwanted)
        else:
            self._jobs[source] = job
            self._reports[source] = report
            text = summary.metadata.get("contract", "")
            rate = re.search(r'"rate_hz": ([0-9.]+)', text)
            rate_hz = self.request.contract.rate_hz if self.request.contract else float(rate[1]) if rate else 30.0
            self._expected[source] = round(seconds(summary.end_ns - summary.start_ns) * rate_hz) + 1

    @property
    def todo(self) -> tuple[str, ...]:
        """The sources of the episodes to convert."""
        return tuple(source for source in self._jobs if source not in self._copies)

    def adds(self, old: DatasetSummary) -> bool:
        """Whether there are episodes to convert besides those in which an earlier run failed."""
        failed = {source for run in old.metadata.get("runs", ()) for source in run["failed"]}
        return not failed.issuperset(self._jobs)

    def _find_copies(self) -> None:
        """Find copies before they are converted; only episodes that look alike are compared by their content."""
        for alike in self._alike.values():
            equal: dict[str, list[str]] = {}
            for job, known in alike if len(alike) > 1 else ():
                with suppress(IbrobotError, OSError):  # its conversion will report it
                    equal.setdefault(known or _identity(job.episode), []).append(job.source)
            for sources in equal.values():
                self._note_copies(sources)

    def _note_copies(self, sources: Sequence[str]) -> None:
        """Keep the first of equal episodes; none of them if their outcomes contradict each other."""
        outcomes = {source: self._reports[source].outcome for source in sources}
        if len(set(outcomes.values())) > 1:
            each = ", ".join(f"{source} is {outcome}" for source, outcome in outcomes.items())
            for source in sources:
                self._jobs.pop(source, None)
                error = f"copies of one episode have different outcomes: {each}; `ibrobot episodes mark` sets them"
                self._reports[source] = attrs.evolve(self._reports[source], passed_over="", error=error)
        elif sources[0] in self._jobs:
            self._copies |= dict.fromkeys(sources[1:], sources[0])

    def units(self) -> list[Unit]:
        """The staged units, in the order of the episodes."""
        units = [read_unit(self._jobs[source].unit) for source in self.sources if source in self._jobs]
        return [unit for unit in units if unit is not None]

    def run(self, watch: Watch) -> dict[str, EpisodeReport]:
        """Convert the episodes that are not staged yet; returns source -> report."""
        self._convert(self.todo, watch)
        for source, original in self._copies.items():
            if self._reports[original].error:  # of the copies, the first one that can be converted is kept
                self._convert([source], watch)
                self._copies |= {each: source for each, of in self._copies.items() if of == original and each != source}
            else:
                del self._jobs[source]
                self._reports[source] = attrs.evolve(self._reports[source], passed_over=f"is a copy of {original}")
        return self._reports

    def unfinished(self, sources: Sequence[str]) -> list[Job]:
        """The jobs of these episodes that no earlier run has finished."""
        todo = []
        for job in (self._jobs[source] for source in sources):
            unit = read_unit(job.unit)
            if unit is not None and unit.key == unit_key(job):
                self._reports[job.source] = unit.report
                self.resumed += 1
            else:
                shutil.rmtree(job.unit, ignore_errors=True)
                todo.append(job)
        return todo

    def _convert(self, sources: Sequence[str], watch: Watch) -> None:
        if not (todo := self.unfinished(sources)):
            return
        total = sum(self._expected[job.source] for job in todo)
        try:
            with closing(open_pool(self.request.on, self.request.jobs)) as pool:
                for report in _run_in_pool(todo, pool, lambda done, report: watch(done, total, report)):
                    self._reports[report.source] = report
        except DiskFull as error:
            _remove_unfinished(self._staging)
            kept = len(self.units())
            raise DiskFull(
                f"stopped at {error}; {kept} of {counted(len(self._jobs), 'episode')} converted and kept in "
                f"{self.request.out / STAGING}: make room, and run the same command again"
            ) from None


def _identity(episode: Path) -> str:
    with closing(installed_plugins().open_episode(episode)) as reader:
        return identity(reader, reader.summary())


def _convert_in_pool(job: Job, progress: Callable[[int], None]) -> EpisodeReport:
    set_malloc(_MAP_FROM, _KEEP)
    return convert_episode(job, progress)


def _run_in_pool(
    jobs: Sequence[Job], pool: Pool, watch: Callable[[int, EpisodeReport | None], None]
) -> Iterator[EpisodeReport]:
    """Convert each episode in its own process, which frees the memory that encoders leak."""
    frames = 0

    def count(done: int) -> None:
        nonlocal frames
        frames = done
        watch(done, None)

    work = (PoolJob(_convert_in_pool, job, own_process=True) for job in jobs)
    with closing(pool.run(work, count)) as finished:
        for done in finished:
            if done.error is not None and not isinstance(done.error, DiskFull):
                raise DatasetError(
                    f"{done.job.argument.source}: {done.error}, e.g. because memory ran out; finished episodes are "
                    "kept: run the same command again, with fewer --jobs if needed"
                )
            report, job = done.result(), done.job.argument
            if report.kept and not job.unit.exists():
                raise DatasetError(
                    f"{job.unit}: not found after a machine of the pool wrote it: episodes and dataset must be in a "
                    "folder that all machines of the pool share"
                )
            watch(frames, report)
            yield report


def _refuse_misfits(
    request: ConversionRequest, units: Sequence[Unit], old: DatasetSummary | None
) -> dict[str, EpisodeReport]:
    """Refuse units that do not fit the dataset, or the first unit if the dataset is new."""
    if not units:
        return {}
    fps, features, contract = units[0].fps, units[0].features, units[0].contract
    first = units[0].report.source
    robot = Identity.of_dataset(old.metadata if old is not None else {}, units)
    if old is not None:
        fps, features, contract, first = old.fps, old.features, old.metadata["contract"], "the dataset"
    refused = {}
    for unit in units:
        wrong = ""
        if Contract.from_canonical(unit.contract).fingerprint() != Contract.from_canonical(contract).fingerprint():
            difference = Contract.from_canonical(unit.contract).difference(contract, names=("this episode", first))
            wrong = f"its contract differs from that of {first}:\n{difference}"
        elif unit.fps != fps or dict(unit.features) != dict(features):
            keys = [key for key in {**features, **unit.features} if features.get(key) != unit.features.get(key)]
            each = ", ".join(f"{key} is {unit.features.get(key)}, not {features.get(key)}" for key in keys)
            wrong = f"its features differ from those of {first}: {each}"
        elif not request.any_robot and (difference := robot.difference(Identity.of_unit(unit), first)):
            wrong = f"{difference}; --any-robot merges them regardless"
        if wrong:
            refused[unit.report.source] = attrs.evolve(unit.report, error=wrong)
    return refused


def _source(path: Path, taken: Collection[str]) -> str:
    """A short name of an episode: `DATASET/EPISODE` for ibrobot's own, else its folder or file."""
    path = path.resolve()
    name = f"{path.parent.parent.name}/{path.name}" if path.parent.name == "episodes" else path.name
    name = os.fsencode(name).decode("utf-8", "backslashreplace")  # a name in another encoding
    if name not in taken:
        return name
    return next(each for number in itertools.count(2) if (each := f"{name} ({number})") not in taken)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key that orders names by the numbers in them."""
    return [(int(piece), "") if piece.isdigit() else (-1, piece) for piece in re.split(r"(\d+)", path.name)]
