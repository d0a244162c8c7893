"""A whole conversion: finds episodes, converts them in parallel into staged units, and merges these in order."""

from __future__ import annotations

import hashlib
import itertools
import multiprocessing
import os
import re
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import forkserver
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import Contract, DatasetError, DatasetSummary, EpisodeAddress, IbrobotError, seconds
from ibrobot_core.app import DiskFull, Ownership, end_signals, installed_plugins, set_malloc
from ibrobot_data.commanders import is_labelled
from ibrobot_data.episode import (
    INTERVENTION,
    Job,
    Unit,
    convert_episode,
    make_writer,
    read_unit,
    unexpected,
    unit_key,
    unwanted_outcome,
)
from ibrobot_data.identity import KnownEpisodes, identity
from ibrobot_data.provenance import conversion, provenance
from ibrobot_data.request import ConversionRequest, EpisodeReport, Report
from ibrobot_data.same_robot import Identity

STAGING = ".staging"
"""Folder within the dataset for converted episodes until the merge."""
_LOCK = "lock"
_THERE = "{}: already has a dataset; --append adds to it"
_POLL_S = 0.2
_END_S = 5.0
"""A converting process that takes longer to end after Ctrl-C is killed."""
_MAP_FROM, _KEEP = 512 << 10, 8 << 20
"""Thresholds of malloc [bytes]: freed images go back to the system, since they would fragment the heap."""

Watch = Callable[[int, int, EpisodeReport | None], None]
"""Receives the frames done, the estimated total, and the report of the episode just done, if any."""


def find_episodes(paths: Sequence[Path]) -> list[Path]:
    """The episodes that `paths` name: episodes, `DATASET:N`, or folders of them. Each appears once, in numeric order.

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

    found: dict[Path, Path] = {}
    for path in paths:
        address = EpisodeAddress.of(path)
        here = [path] if address.number is not None else list(below(path))
        if not here:
            installed_plugins().open_episode(path).close()  # raises the error that explains what an episode is
        found |= {each.resolve(): each for each in here}
    return list(found.values())


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
    with _staging(request) as (staging, old):
        request = _with_labels(request, episodes, old)
        if old is not None:
            _check_old(request, old)
        plan = _Plan(request, staging, old, episodes)
        # Without --append nothing may be added, but the same command may have been killed when it had merged.
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
    size = sum(path.stat().st_size for path in request.out.rglob("*") if path.is_file()) if request.out.exists() else 0
    ordered = tuple(reports[source] for source in plan.sources)
    return Report(request.out, ordered, size, time.monotonic() - begin, plan.resumed)


def _merge(
    request: ConversionRequest, old: DatasetSummary | None, units: Sequence[Unit], failed: Sequence[str]
) -> None:
    """Add the units to the dataset."""
    writer = make_writer(request)
    if writer.summary(request.out) != old:
        raise DatasetError(f"{request.out}: was changed by another program meanwhile; run the same command again")
    writer.merge(request.out, [unit.dataset for unit in units], provenance(request, old, units, failed))


def clear_staging(staging: Path) -> None:
    """Remove all but the lock from a staging folder."""
    for path in list(staging.iterdir()):
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != _LOCK:
            path.unlink()


@contextmanager
def _staging(request: ConversionRequest) -> Iterator[tuple[Path, DatasetSummary | None]]:
    """The staging folder, owned by this conversion, and the existing dataset."""
    out, staging = request.out, request.out / STAGING
    try:
        with own_staging(out):
            old = make_writer(request).summary(out)
            others = [path for path in out.iterdir() if path != staging]
            if old is None and others and all(path.name == _LOCK for path in staging.iterdir()):
                raise DatasetError(f"{out} is not empty and has no dataset of writer {request.type!r}")
            yield staging, old
    except OSError as error:
        raise DatasetError(f"{out}: cannot be written: {error.strerror}") from error


@contextmanager
def own_staging(out: Path) -> Iterator[None]:
    """A context in which nobody else converts into `out`; afterwards, folders that stayed empty are removed.

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


def _with_labels(request: ConversionRequest, episodes: Sequence[Path], old: DatasetSummary | None) -> ConversionRequest:
    """The request, which adds labels if the dataset has them, or if there is none and an episode says who commanded."""
    if old is not None:
        return attrs.evolve(request, labels=INTERVENTION in old.features)
    return attrs.evolve(request, labels=request.labels or any(map(_says_who_commanded, episodes)))


def _says_who_commanded(episode: Path) -> bool:
    try:
        reader = installed_plugins().open_episode(episode)
        try:
            return is_labelled(reader.summary())
        finally:
            reader.close()
    except Exception:  # noqa: BLE001 - the conversion reports it
        return False


def _check_old(request: ConversionRequest, old: DatasetSummary) -> None:
    """Check that the dataset was made with the same settings."""
    known = old.metadata.get("conversion")
    if not request.append and known != conversion(request):
        raise DatasetError(_THERE.format(request.out))
    if known is None:
        raise DatasetError(f"{request.out}: not made by a conversion of ibrobot; convert into another folder")
    asked = conversion(request)
    known = {"missing": asked["missing"]} | known  # older datasets do not have it
    wrong = [f"{name} {known.get(name)}, now {asked[name]}" for name in asked if known.get(name) != asked[name]]
    if wrong:
        raise DatasetError(f"{request.out}: was made with other settings: {'; '.join(wrong)}")


class _Plan:
    """The episodes, and the work left for each."""

    def __init__(
        self, request: ConversionRequest, staging: Path, old: DatasetSummary | None, episodes: Sequence[Path]
    ) -> None:
        self._request = request
        self._reports: dict[str, EpisodeReport] = {}
        self._jobs: dict[str, Job] = {}
        self._expected: dict[str, int] = {}
        """Source -> number of frames, estimated from its length."""
        self._copies: dict[str, str] = {}
        """Source -> the source of which it is a copy; not converted unless that one fails."""
        self._alike: dict[Any, list[Job]] = {}
        """What copies have in common, as far as summaries tell -> episodes that the dataset does not have."""
        self.resumed = 0
        self.sources: list[str] = []
        known = KnownEpisodes(old.metadata["episodes"] if old is not None else ())
        for path in episodes:
            source = _source(path, self.sources)
            self.sources.append(source)
            unit = hashlib.sha256(os.fsencode(path.resolve())).hexdigest()[:32]
            self._add(Job(request, path, source, staging / unit), known)
        self._find_copies()

    def _add(self, job: Job, known: KnownEpisodes) -> None:
        source, report = job.source, EpisodeReport(job.source)
        try:
            reader = installed_plugins().open_episode(job.episode)
            try:
                summary = reader.summary()
                there = known.find(source, reader, summary)
            finally:
                reader.close()
        except (IbrobotError, OSError) as error:
            self._reports[source] = attrs.evolve(report, error=str(error))
            return
        except Exception as error:  # noqa: BLE001 - a fault in a plugin must not cost the other episodes
            self._reports[source] = attrs.evolve(report, error=unexpected(error))
            return
        report = attrs.evolve(report, outcome=summary.outcome, start_ns=summary.start_ns)
        if there:
            self._reports[source] = attrs.evolve(report, passed_over=there)
            return
        counts = tuple((topic, each.count) for topic, each in sorted(summary.topics.items()))
        self._alike.setdefault((summary.start_ns, summary.end_ns, counts), []).append(job)
        if unwanted := unwanted_outcome(summary, self._request):
            self._reports[source] = attrs.evolve(report, passed_over=unwanted)
        else:
            self._jobs[source] = job
            self._reports[source] = report
            text = summary.metadata.get("contract", "")
            rate = re.search(r'"rate_hz": ([0-9.]+)', text)
            rate_hz = self._request.contract.rate_hz if self._request.contract else float(rate[1]) if rate else 30.0
            self._expected[source] = round(seconds(summary.end_ns - summary.start_ns) * rate_hz) + 1

    def adds(self, old: DatasetSummary) -> bool:
        """Whether there are episodes to convert that an earlier run did not have to leave out."""
        failed = {source for run in old.metadata.get("runs", ()) for source in run["failed"]}
        return not failed.issuperset(self._jobs)

    def _find_copies(self) -> None:
        """Find copies before they are converted; only episodes that look alike are compared by their content."""
        for alike in self._alike.values():
            equal: dict[str, list[Job]] = {}
            for job in alike if len(alike) > 1 else ():
                with suppress(IbrobotError, OSError):  # its conversion will report it
                    equal.setdefault(_identity(job.episode), []).append(job)
            for jobs in equal.values():
                self._note_copies([job.source for job in jobs])

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
        found = [read_unit(self._jobs[source].unit) for source in self.sources if source in self._jobs]
        return [unit for unit in found if unit is not None]

    def run(self, watch: Watch) -> dict[str, EpisodeReport]:
        """Convert the episodes that are not staged yet; returns source -> report."""
        self._convert([source for source in self._jobs if source not in self._copies], watch)
        for source, original in self._copies.items():
            if self._reports[original].error:  # of the copies, the first one that can be converted is kept
                self._convert([source], watch)
                self._copies |= {each: source for each, of in self._copies.items() if of == original and each != source}
            else:
                del self._jobs[source]
                self._reports[source] = attrs.evolve(self._reports[source], passed_over=f"is a copy of {original}")
        return self._reports

    def _convert(self, sources: Sequence[str], watch: Watch) -> None:
        todo = []
        for job in (self._jobs[source] for source in sources):
            unit = read_unit(job.unit)
            if unit is not None and unit.key == unit_key(job):
                self._reports[job.source] = unit.report
                self.resumed += 1
            else:
                shutil.rmtree(job.unit, ignore_errors=True)
                todo.append(job)
        total = sum(self._expected[job.source] for job in todo)
        try:
            for report in _run_in_processes(todo, self._request.jobs, lambda done, report: watch(done, total, report)):
                self._reports[report.source] = report
        except DiskFull as error:
            for job in todo:
                shutil.rmtree(job.making, ignore_errors=True)
            kept = len(self.units())
            raise DiskFull(
                f"stopped at {error}; {kept} of {len(self._jobs)} episodes are converted and kept in "
                f"{self._request.out / STAGING}: make room, and run the same command again"
            ) from None


def _identity(episode: Path) -> str:
    reader = installed_plugins().open_episode(episode)
    try:
        return identity(reader, reader.summary())
    finally:
        reader.close()


_done: Any = None
"""Frames done by all processes together; set in each of them."""


def _begin_process(done: Any) -> None:
    global _done  # noqa: PLW0603 - the initializer of a pool can only pass shared memory by a global
    _done = done
    set_malloc(_MAP_FROM, _KEEP)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Exit when the parent is killed, so as not to write at the same time as the next run."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _count(frames: int) -> None:
    with _done.get_lock():
        _done.value += frames


def _convert_in_process(job: Job) -> EpisodeReport:
    return convert_episode(job, _count)


def _run_in_processes(
    jobs: Sequence[Job], limit: int, watch: Callable[[int, EpisodeReport | None], None]
) -> Iterator[EpisodeReport]:
    """Convert each episode in its own process, which frees the memory that encoders leak."""
    if not jobs:
        return
    context = multiprocessing.get_context("forkserver")
    # Reader and writer are imported by now. A server that has them too forks processes that start at once.
    context.set_forkserver_preload([name for name in sys.modules if name.startswith("ibrobot_")])
    done = context.Value("q", 0)
    pool = ProcessPoolExecutor(min(limit, len(jobs)), context, _begin_process, (done,), max_tasks_per_child=1)
    try:
        with _deferred_signals():
            forkserver.ensure_running()
            waiting: set[Future[EpisodeReport]] = {pool.submit(_convert_in_process, job) for job in jobs}
        while waiting:
            finished, waiting = wait(waiting, _POLL_S, FIRST_COMPLETED)
            watch(done.value, None)
            for future in finished:
                report = future.result()
                watch(done.value, report)
                yield report
    except BrokenProcessPool:
        raise DatasetError(
            "a converting process was killed, e.g. because memory ran out; finished episodes are kept: "
            "run the same command again, with fewer --jobs if needed"
        ) from None
    except (KeyboardInterrupt, DiskFull):
        _end_pool(pool)
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _end_pool(pool: ProcessPoolExecutor) -> None:
    """End a pool, and its processes at once.

    The pool may start another process while one ends, and a terminated one may keep a lock that others wait for. So
    processes are terminated until the pool has ended.
    """
    ending = threading.Thread(target=pool.shutdown, kwargs={"cancel_futures": True}, daemon=True)
    ending.start()
    while ending.is_alive():
        end_processes(multiprocessing.active_children())
        ending.join(_POLL_S)


def end_processes(processes: Sequence[BaseProcess]) -> None:
    """Terminate processes, and kill those that take longer than `_END_S`."""
    for process in processes:
        process.terminate()
    deadline_s = time.monotonic() + _END_S
    for process in processes:
        process.join(max(0.0, deadline_s - time.monotonic()))
        if process.is_alive():
            process.kill()


@contextmanager
def _deferred_signals() -> Iterator[None]:
    """Defer Ctrl-C, SIGTERM and SIGHUP; block Ctrl-C in the processes started here, which would print tracebacks."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python delivers signals to the main thread alone
        return
    came: list[int] = []
    # Any thread may receive them.
    handlers = {number: signal.signal(number, lambda number, _: came.append(number)) for number in end_signals()}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # child processes inherit it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if came:
        signal.raise_signal(came[0])


def _refuse_misfits(
    request: ConversionRequest, units: Sequence[Unit], old: DatasetSummary | None
) -> dict[str, EpisodeReport]:
    """Reports of the units that do not fit the dataset, or the first unit if there is no dataset yet."""
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
        elif not request.any_robot and (
            difference := robot.difference(Identity.of_unit(unit.recorded, unit.robot_type, unit.calibration), first)
        ):
            wrong = f"{difference}; --any-robot merges them all the same"
        if wrong:
            refused[unit.report.source] = attrs.evolve(unit.report, error=wrong)
    return refused


def _source(path: Path, taken: Sequence[str]) -> str:
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
