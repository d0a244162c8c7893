"""Convert one episode into a staged dataset of one episode, in any process."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from errno import EDQUOT, ENOSPC
from pathlib import Path
from typing import Any
from uuid import uuid4

import attrs
import numpy as np
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_calibration.joint_units import recorded_units
from ibrobot_provenance.datasets import DatasetWriter
from ibrobot_provenance.files import sync
from ibrobot_provenance.ownership import Ownership
from ibrobot_provenance.recorded_names import OPERATOR, POLICY
from numpy.typing import NDArray

from ibrobot_core.api import (
    Context,
    Contract,
    ContractError,
    DatasetError,
    EpisodeAddress,
    EpisodeReader,
    EpisodeSummary,
    Feature,
    IbrobotError,
    RealClock,
    RecorderError,
    Robot,
)
from ibrobot_core.app import installed_plugins
from ibrobot_data.commanders import Commanders, is_labelled, stretches
from ibrobot_data.errors import DiskFull
from ibrobot_data.growing import GrowingEpisode
from ibrobot_data.identity import identity
from ibrobot_data.request import ConversionRequest, EpisodeReport
from ibrobot_data.ticks import TASK_KEY, Ticks

SUCCESS = "next.success"
INTERVENTION, REWARD, DONE = "intervention", "next.reward", "next.done"
DATASET = "dataset"
"""The dataset within a unit."""
MAKING = ".making."
"""Part of the names of folders of incomplete units."""
_RECORD = "episode.json"
_VERSION = 6
"""Version of the unit format; units of an older one are converted again."""


@attrs.frozen(eq=False)
class _Row:
    """A row of the episode: key -> value, the task, and who commanded if the request needs it."""

    values: dict[str, NDArray[Any]]
    task: str
    commander: str


_KEEPS: Mapping[str, Callable[[_Row], bool]] = {
    "all": lambda row: True,
    "interventions": lambda row: row.commander == OPERATOR,
    "policy": lambda row: row.commander == POLICY,
}


@attrs.frozen
class Job:
    """One episode to convert, and the folder of its unit, which is created atomically."""

    request: ConversionRequest
    episode: Path
    source: str
    unit: Path


@attrs.frozen
class Unit:
    """A converted episode in the staging folder."""

    path: Path
    key: str
    """Hash of the request and the episode's files: a unit with an equal key need not be converted again."""
    report: EpisodeReport
    fps: float
    features: Mapping[str, Feature]
    contract: Mapping[str, Any]
    robot_type: str
    calibration: Mapping[str, Mapping[str, Any]]
    document: Mapping[str, Any]
    """The robot YAML as plain values; empty if unknown."""
    recorded: Mapping[str, str]
    """The episode's metadata."""

    @property
    def dataset(self) -> Path:
        """The dataset of this episode alone."""
        return self.path / DATASET


def make_writer(request: ConversionRequest) -> DatasetWriter:
    """The dataset writer that the request names.

    Raises:
        PluginError: when it is not installed.
    """
    ctx = Context("convert", RealClock(), logging.getLogger("ibrobot.convert"), Robot("convert", ()))
    writer: DatasetWriter = installed_plugins().create("dataset", request.type, request.options, ctx)
    return writer


def unit_key(job: Job) -> str:
    """Hash of a unit's input: the parts of the request that affect the data, and the episode's files."""
    request = job.request
    contract = request.contract.canonical() if request.contract is not None else None
    shaping = [
        _VERSION, request.type, attrs.asdict(request.options), contract, request.force_contract,
        request.document, request.calibration, request.norm_mode, request.missing, request.prompt, request.success,
        request.labels, request.only, request.context, request.units,
    ]  # fmt: skip
    address = EpisodeAddress.of(job.episode)
    root = address.path
    files = sorted(p for p in root.rglob("*") if p.is_file()) if root.is_dir() else [root]
    stats = [(str(path.relative_to(root)), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    made_of = [shaping, address.number, stats]
    return hashlib.sha256(json.dumps(made_of, sort_keys=True, default=str).encode()).hexdigest()


def read_unit(path: Path) -> Unit | None:
    """The unit at `path`; None if there is none."""
    try:
        record = json.loads((path / _RECORD).read_bytes())
    except FileNotFoundError:
        return None
    features = {
        key: Feature(each["dtype"], tuple(each["shape"]), tuple(each["names"]))
        for key, each in record.pop("features").items()
    }
    return Unit(path, report=EpisodeReport(**record.pop("report")), features=features, **record)


@attrs.frozen
class _Ended:
    """What is known of an episode once it has ended."""

    key: str
    """See `unit_key`."""
    summary: EpisodeSummary
    report: EpisodeReport


def convert_episode(job: Job, progress: Callable[[int], None], growing: GrowingEpisode | None = None) -> EpisodeReport:
    """Convert an episode into its unit. After a fault, the report has the error and no files remain.

    Args:
        job: the episode and its unit.
        progress: called with the number of frames done since the last call.
        growing: the episode, if it is still being recorded.

    Raises:
        DiskFull: if the disk of the unit is full.
    """
    # Another process may convert the episode at the same time.
    making = job.unit.with_name(f"{job.unit.name}{MAKING}{uuid4().hex}")
    report = EpisodeReport(job.source)
    try:
        with ExitStack() as stack:
            if growing is None:
                reader, ended = _open(job, stack)
                if unwanted := unwanted_outcome(ended.summary, job.request):  # it was marked meanwhile
                    return attrs.evolve(report, outcome=ended.summary.outcome, passed_over=unwanted)
                report = ended.report
                unit = _write(job, reader, ended.summary, lambda: ended, making, progress)
            else:
                begun = growing.summary()
                unit = _write(job, growing, begun, lambda: _end(job, stack, begun), making, progress)
            if unit is None:
                return attrs.evolve(report, passed_over=_NOTHING[job.request.only])
            _sync(making)
            _put(making, job.unit, unit.key)
    except Exception as error:  # noqa: BLE001 - a fault in a plugin must not cost the other episodes
        shutil.rmtree(making, ignore_errors=True)
        stop_if_full(error, job.source)
        return attrs.evolve(report, error=error_text(error))
    return unit.report


def _open(job: Job, stack: ExitStack) -> tuple[EpisodeReader, _Ended]:
    """Open an episode that has ended, and keep others from changing it, until `stack` is left."""
    if EpisodeAddress.of(job.episode).number is None:
        stack.enter_context(Ownership(job.episode, "is being converted", shared=True))
    key = unit_key(job)
    reader = stack.enter_context(closing(installed_plugins().open_episode(job.episode)))
    summary = reader.summary()
    report = attrs.evolve(
        _described(EpisodeReport(job.source), summary, job.request), identity=identity(reader, summary)
    )
    return reader, _Ended(key, summary, report)


def _end(job: Job, stack: ExitStack, begun: EpisodeSummary) -> _Ended:
    """What is known of an episode at its end, after checks that it began as its unit says.

    Raises:
        DatasetError: if not.
    """
    _, ended = _open(job, stack)
    summary = ended.summary
    known = {name: summary.metadata.get(name) for name in begun.metadata}
    if not summary.finished or summary.start_ns != begun.start_ns or known != dict(begun.metadata):
        raise DatasetError(f"{job.source}: is not the episode that was followed")
    if is_labelled(summary) != is_labelled(begun):
        raise DatasetError(f"{job.source}: who commands was recorded later than its first messages")
    return ended


def _put(making: Path, unit: Path, key: str) -> None:
    """Rename a folder to that of the unit, unless another process has converted the same episode."""
    try:
        making.rename(unit)
    except OSError:
        there = read_unit(unit)
        if there is None or there.key != key:
            raise
        shutil.rmtree(making)


_NOTHING = {"interventions": "no operator commands in it", "policy": "no policy commands in it"}
"""Rows to keep -> why an episode without any is passed over."""


def unwanted_outcome(summary: EpisodeSummary, request: ConversionRequest) -> str:
    """Why an episode is passed over for its outcome; empty if it is wanted."""
    return "" if summary.outcome in request.outcomes else f"its outcome is {summary.outcome}"


def stop_if_full(error: BaseException, source: str) -> None:
    """End the whole conversion if a full disk caused `error`, since the other episodes would fail, too.

    Raises:
        DiskFull: if a full disk caused the error.
    """
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, DiskFull) or (isinstance(cause, OSError) and cause.errno in (ENOSPC, EDQUOT)):
            # Without its path, which is one of the staging folder.
            reason = cause.strerror if isinstance(cause, OSError) else str(cause)
            raise DiskFull(f"{source}: {reason}") from error
        cause = cause.__cause__ or cause.__context__


def error_text(error: Exception) -> str:
    """Message for an error; one that no interface documents is shown with the line that raised it."""
    if isinstance(error, IbrobotError | OSError):
        return str(error)
    place = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{Path(place.filename).name}:{place.lineno}"
    return f"{type(error).__name__}: {error} (at {where}): a fault in ibrobot or a plugin; please report it"


def _prompt(summary: EpisodeSummary, request: ConversionRequest) -> str:
    return summary.metadata.get("prompt") or request.prompt


def _described(report: EpisodeReport, summary: EpisodeSummary, request: ConversionRequest) -> EpisodeReport:
    """A report with what the summary says.

    Raises:
        DatasetError: if the request needs an outcome that the episode does not have.
    """
    if request.success and summary.outcome == "unknown" and not unwanted_outcome(summary, request):
        raise DatasetError(f"{SUCCESS} cannot be determined: the episode's outcome is unknown")
    return attrs.evolve(
        report,
        finished=summary.finished,
        outcome=summary.outcome,
        prompt=_prompt(summary, request),
        start_ns=summary.start_ns,
        lost={topic: each.dropped for topic, each in summary.topics.items() if each.dropped},
        missing={topic: each.missing for topic, each in summary.topics.items() if each.missing},
    )


def _write(
    job: Job, reader: EpisodeReader, begun: EpisodeSummary, end: Callable[[], _Ended], folder: Path,
    progress: Callable[[int], None],
) -> Unit | None:  # fmt: skip
    """Write the dataset of one episode and the record of the unit; returns None if no row is wanted.

    Args:
        job: the episode and its unit.
        reader: the episode.
        begun: its summary, as far as it is known before its messages are read.
        end: what is known after that.
        folder: that of the unit, until it is complete.
        progress: see `convert_episode`.
    """
    request = job.request
    contract = _contract(request, begun)
    document = request.document or _recorded(begun, "config")
    recorded = _joined(_recorded(begun, "calibration"))
    calibration = recorded if request.calibration is None else _completed(request.calibration, recorded)
    units = recorded_units(request.units, request.norm_mode, contract, calibration, document)
    robot_type = (document.get("robot") or {}).get("robot_type") or begun.metadata.get("robot_type", "")
    prompt = _prompt(begun, request)
    ticks = Ticks(reader, contract, request.missing)
    commanders = Commanders(reader, begun) if request.labels or request.only != "all" else None
    writer = make_writer(request)
    features: dict[str, Feature] = {}
    waiting: _Row | None = None
    pieces: list[tuple[int, int]] = []
    tasks = dict[str, None]()

    def rows() -> Iterator[_Row]:
        for row in ticks:
            values, task = _labelled(units(row), contract, ticks.tasks, prompt)
            commander = commanders.at(ticks.stamp_ns) if commanders is not None else ""
            yield _Row(values, task, commander)
            progress(1)

    try:
        number = -1
        context = round(request.context * contract.rate_hz) if request.only == "interventions" else 0
        for row, number, begins in stretches(rows(), _KEEPS[request.only], context):
            if waiting is None:
                features = _features(contract, row.values, request)
                folder.mkdir(parents=True)
                writer.create(folder / DATASET, contract.rate_hz, features, {"robot_type": robot_type})
            else:
                _add(writer, waiting, request, features, last=begins)
            if begins:
                if pieces:
                    writer.save_episode()
                pieces.append((number, 0))
            pieces[-1] = (pieces[-1][0], pieces[-1][1] + 1)
            waiting = row
            tasks.setdefault(row.task)
        if waiting is None:
            return None
        ended = end()
        succeeds = ended.report.outcome == "success" and number == ticks.rows - 1
        _add(writer, waiting, request, features, last=True, succeeds=succeeds and _has_end(ticks, request))
        writer.save_episode()
    finally:
        writer.finalize()
    report = attrs.evolve(
        ended.report, frames=sum(count for _, count in pieces), stretches=pieces, skipped=ticks.skipped,
        cuts=tuple(ticks.cuts), held=ticks.held, gaps=dict(ticks.gaps), resets=ticks.resets, prompt="; ".join(tasks),
    )  # fmt: skip
    unit = Unit(
        job.unit, ended.key, report, contract.rate_hz, features, contract.canonical(), robot_type, calibration,
        document, ended.summary.metadata,
    )  # fmt: skip
    record = {name: value for name, value in attrs.asdict(unit).items() if name != "path"}
    (folder / _RECORD).write_text(json.dumps(record, indent=2), encoding="utf-8")
    return unit


def _has_end(ticks: Ticks, request: ConversionRequest) -> bool:
    """Whether the last row is the end of the episode.

    Raises:
        DatasetError: if not, and the request asks in which row it succeeded.
    """
    if ticks.lacks_end and request.success:
        raise DatasetError(
            f"{SUCCESS} cannot be determined: the last {ticks.cuts[-1][1]} ticks are left out, since something is "
            "missing; --missing hold repeats the last value"
        )
    return not ticks.lacks_end


def _labelled(
    values: dict[str, NDArray[Any]], contract: Contract, tasks: Sequence[str], prompt: str
) -> tuple[dict[str, NDArray[Any]], str]:
    """A row with its signals in the dataset's types, and its task: the prompt unless a topic provides it."""
    signals = {part.key: values[part.key].astype(part.feature.dtype) for part in contract.signal_parts}
    number = signals.pop(TASK_KEY, None)
    rest = {key: value for key, value in values.items() if key != TASK_KEY}
    return rest | signals, prompt if number is None else tasks[int(number[0])]


def _add(
    writer: DatasetWriter, row: _Row, request: ConversionRequest, features: Mapping[str, Feature], *,
    last: bool, succeeds: bool = False,
) -> None:  # fmt: skip
    """Write a row. `last`: it ends an episode of the dataset. `succeeds`: the recorded episode succeeds with it."""
    added: dict[str, NDArray[Any]] = {SUCCESS: np.array([succeeds])} if request.success else {}
    if request.labels:
        added[INTERVENTION] = np.array([row.commander == OPERATOR])
        added[REWARD], added[DONE] = np.array([succeeds], np.float32), np.array([last])
    writer.add_frame(added | {key: value for key, value in row.values.items() if key in features}, row.task)


def _features(contract: Contract, values: Mapping[str, NDArray[Any]], request: ConversionRequest) -> dict[str, Feature]:
    """Features of the contract, with sizes from the messages, of its signals, and those that the request adds."""
    features = {key: attrs.evolve(each, shape=values[key].shape) for key, each in contract.features().items()}
    if request.labels:
        flag = Feature("bool", (1,))
        features |= {INTERVENTION: flag, REWARD: Feature("float32", (1,)), DONE: flag}
    features |= {part.key: part.feature for part in contract.signal_parts if part.key != TASK_KEY}
    return features | ({SUCCESS: Feature("bool", (1,))} if request.success else {})


def _contract(request: ConversionRequest, summary: EpisodeSummary) -> Contract:
    recorded = recorded_contract(summary.metadata)
    if request.contract is None:
        if recorded is None:
            raise ContractError("the episode has no contract; name a robot YAML that has it with --config")
        return recorded
    if recorded is None:
        return request.contract
    if request.contract.fingerprint() != recorded.fingerprint() and not request.force_contract:
        difference = request.contract.difference(recorded, names=("--config", "recorded"))
        raise ContractError(f"recorded with another contract; --force-contract uses that of --config:\n{difference}")
    return request.contract


def recorded_contract(metadata: Mapping[str, str]) -> Contract | None:
    """The contract of a recorded episode; None if it has none.

    Raises:
        ContractError: when it cannot be read, or does not match its fingerprint.
    """
    if "contract" not in metadata:
        return None
    try:
        contract = Contract.from_canonical(json.loads(metadata["contract"]))
    except (ValueError, RecursionError) as error:
        raise ContractError(f"the recorded contract cannot be read: {error}") from None
    if metadata.get("fingerprint", contract.fingerprint()) != contract.fingerprint():
        raise ContractError("the recorded contract is damaged: it does not match the recorded fingerprint")
    return contract


def _recorded(summary: EpisodeSummary, name: str) -> Mapping[str, Any]:
    """A JSON object from the episode's metadata; empty if there is none."""
    try:
        document = json.loads(summary.metadata.get(name, "{}"))
    except ValueError as error:
        raise RecorderError(f"its metadata {name!r} cannot be read: {error}") from None
    return document if isinstance(document, dict) else {}


def _completed(
    calibration: Mapping[str, Mapping[str, Any]], recorded: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, Any]]:
    """A calibration, completed with the recorded `closed_at` of joints that lack it."""
    ends = {joint: {"closed_at": each["closed_at"]} for joint, each in recorded.items() if "closed_at" in each}
    return {joint: {**ends.get(joint, {}), **numbers} for joint, numbers in calibration.items()}


def _joined(calibrations: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The calibrations of all hardware as one."""
    joined = {joint: numbers for each in calibrations.values() for joint, numbers in each.items()}
    for joint, numbers in joined.items():
        try:
            Calibration({joint: JointCalibration(**numbers)})
        except (TypeError, ValueError) as error:
            raise RecorderError(f"the recorded calibration of {joint!r} is invalid: {error}") from None
    return joined


def _sync(folder: Path) -> None:
    """Flush every file to the disk."""
    for path in folder.rglob("*"):
        if path.is_file():
            sync(path)
