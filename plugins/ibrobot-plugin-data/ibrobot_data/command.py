"""`ibrobot convert`: recorded episodes -> a dataset that LeRobot trains on."""

from __future__ import annotations

import json
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import attrs
from ibrobot_provenance.datasets import DatasetDescriptor
from ibrobot_provenance.jobs import check_pool
from ibrobot_provenance.work_options import shard_of
from ibrobot_terminal.plural import counted, plural

from ibrobot_core.api import Contract, DatasetError, option
from ibrobot_core.app import (
    NORM_MODES,
    Emit,
    Event,
    Failed,
    Override,
    RequestError,
    Unsuccessful,
    default_of,
    echo,
    fields,
    flag_of,
    installed_plugins,
    wrong_input,
)
from ibrobot_data import conversion
from ibrobot_data.conversion import ConvertOptions
from ibrobot_data.prompt import check_prompt
from ibrobot_data.request import ConversionRequest, EpisodeReport, Report
from ibrobot_data.stated import listed_joints, names_of, names_option

if TYPE_CHECKING:
    from ibrobot_core.app import RobotConfig

_Progress = Callable[[int], AbstractContextManager[Any]]
"""Receives the number of episodes, and yields the function that shows the progress."""
_MIB = 1 << 20
_ONLY_TO_DATASET = (
    "append", "type_", "force_contract", "any_robot", "missing", "outcome", "success", "jobs", "on", "shard",
    "only", "context", "units",
)  # fmt: skip
_EVENT_S = 0.1
_MUCH = 0.1
"""The report lists episodes that lost more than this fraction of their ticks."""


def _writer_flags() -> dict[str, Any]:
    """Option of a dataset writer -> the option of this command."""
    flags = {}
    for writer in installed_plugins().of_kind("dataset"):
        for name in writer.flags if isinstance(writer, DatasetDescriptor) else ():
            known = attrs.fields_dict(writer.options)[name]
            text = f"{writer.type}: {known.metadata['help']}"
            off = known.default is True
            flags[name] = option(False if off else None, typed=f"--no-{name}" if off else "", label=None, help=text)
    return flags


_WRITER_FLAGS = _writer_flags()


def _with_writer_flags[C](kind: type[C]) -> type[C]:
    """Class decorator: add the options of the installed dataset writers."""
    for name, flag in _WRITER_FLAGS.items():
        setattr(kind, name, flag)
        kind.__annotations__[name] = "bool" if flag._default is False else "str | None"
    return kind


@attrs.frozen(kw_only=True)
@_with_writer_flags
class Convert(ConvertOptions):
    """Make a dataset for training from recorded episodes, or with --to bag episodes from a dataset.

    EPISODES are episodes, folders of them such as episodes/default, or DATASET:N; with --to bag it is one dataset.
    After an interruption, run the same command again to continue. An episode that cannot be converted is reported and
    left out; the command then exits with 1.
    """

    to: str = option("dataset", choices=("dataset", "bag"), label=None, help="what to make")
    numbers: str | None = option(
        None, typed="--episodes N,N-M", label=None, help="with --to bag: only these episodes, counted from 0"
    )
    names: tuple[str, ...] = names_option(
        "with --to bag: names of a feature's elements in their order, for a dataset that does not have them"
    )
    type_: str | None = option(
        None, typed="--type TYPE", label=None, help="dataset writer; by default that of an installed plugin"
    )
    sets: tuple[str, ...] = option(
        (), typed="--set OPTION=VALUE", label=None, help="any other option of the dataset writer"
    )
    as_json: bool = option(False, typed="--json", label=None, help="print the report as JSON")

    def __call__(self, emit: Emit) -> None:
        self._check_applies()
        try:
            with wrong_input():
                check_prompt(self.prompt)
                progress = partial(_progress, quiet=self.as_json) if emit is None else partial(_events, emit)
                report = (_to_bags if self.to == "bag" else _to_dataset)(self, progress)
        except KeyboardInterrupt:
            if emit is not None:
                emit(Failed("interrupted; finished episodes are kept: the same conversion continues with the others"))
            else:
                echo("interrupted; finished episodes are kept: run the same command again to continue", err=True)
            raise Unsuccessful(exit_code=130) from None
        if emit is not None:
            emit(conversion.Report(**report.summary()))  # each episode had its event
        elif self.as_json:
            echo(json.dumps({**report.summary(), "reports": [attrs.asdict(each) for each in report.episodes]}))
        else:
            _print_report(report)
        if report.failed or not (report.converted or all(each.passed_over for each in report.episodes)):
            raise Unsuccessful

    def _check_applies(self) -> None:
        """Refuse options that are of the other direction."""
        only_other = ("numbers", "names") if self.to == "dataset" else (*_ONLY_TO_DATASET, *_WRITER_FLAGS)
        for name, field in fields(type(self)).items():
            if name in only_other and getattr(self, name) != default_of(field):
                raise RequestError(f"{flag_of(name, field)} does not apply to --to {self.to}")

    def writer_overrides(self) -> tuple[str, ...]:
        """The options of the dataset writer, as overrides."""
        overrides: list[str] = []
        for name in _WRITER_FLAGS:
            if (value := getattr(self, name)) is True:
                overrides.append(Override.of(f"--no-{name}", f"{name}=false"))
            elif value:
                overrides.append(Override.of(f"--{name} {value}", f"{name}={value}"))
        return (*overrides, *self.sets)


def conversion_request(options: Convert) -> ConversionRequest:
    """The request for a dataset that the options make.

    Raises:
        IbrobotError: for options that do not fit, or what they need is not installed.
    """
    check_pool(options.on)
    if options.units is not None:
        installed_plugins().find("units", options.units)
    type_ = options.type_ or installed_plugins().default("dataset")
    writer_options = _options("dataset", type_, options.writer_overrides())
    robot, calibration = _stated(options)
    return ConversionRequest(
        options.out, writer_options, type_, append=options.append, outcomes=options.outcome,
        jobs=options.jobs, on=options.on, norm_mode=options.norm_mode or NORM_MODES[0],
        units=options.units, missing=options.missing,
        prompt=options.prompt, success=options.success, only=options.only, context=options.context,
        any_robot=options.any_robot,
        force_contract=options.force_contract, calibration=calibration,
        contract=Contract.from_config(robot) if robot is not None else None,
        document=json.loads(json.dumps(robot.document, default=str)) if robot is not None else None,
    )  # fmt: skip


def _to_dataset(options: Convert, progress: _Progress) -> Report:
    from ibrobot_data.run import convert as run
    from ibrobot_data.run import find_episodes

    request = conversion_request(options)
    episodes = find_episodes(options.episodes)
    episodes = [episodes[number] for number in shard_of(options.shard, len(episodes))]
    with progress(len(episodes)) as watch:
        return run(request, episodes, watch)


def _to_bags(options: Convert, progress: _Progress) -> Report:
    from ibrobot_core.api import EpisodeAddress
    from ibrobot_data.config_metadata import metadata_from_config
    from ibrobot_data.episode import make_writer
    from ibrobot_data.to_bags import BagRequest, convert_to_bags

    names = names_of(options.names)
    robot, calibration = _stated(options)
    stated = metadata_from_config(robot, options.norm_mode, calibration, names) if robot is not None else {}
    if len(options.episodes) != 1:
        raise RequestError("--to bag takes one dataset at a time")
    address = EpisodeAddress.of(options.episodes[0])
    dataset, recorder = installed_plugins().default("dataset"), installed_plugins().default("recorder")
    writer = make_writer(ConversionRequest(address.path, _options("dataset", dataset, ()), dataset))
    if (summary := writer.summary(address.path)) is None:
        raise DatasetError(f"{address.path}: not a dataset of type {dataset}")
    chosen = (address.number,) if address.number is not None else _numbers(options.numbers, summary.episodes)
    request = BagRequest(
        address.path, chosen, options.out, _options("recorder", recorder, options.sets), recorder,
        prompt=options.prompt,
        contract=Contract.from_config(robot) if robot is not None else None,
        given=stated,
    )  # fmt: skip
    with progress(len(chosen)) as watch:
        return convert_to_bags(request, watch)


def _numbers(text: str | None, total: int) -> tuple[int, ...]:
    """Parse e.g. `0,3-5`; returns the numbers in order.

    Raises:
        RequestError: for anything else, or a number beyond the dataset.
    """
    if text is None:
        return tuple(range(total))
    numbers: set[int] = set()
    for piece in text.split(","):
        ends = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", piece)
        if ends is None:
            raise RequestError(f"--episodes: {piece!r} is neither a number nor a range; write e.g. 0,3-5")
        numbers |= set(range(int(ends[1]), int(ends[2] or ends[1]) + 1))
    if not numbers or max(numbers) >= total:
        there = f"0 to {total - 1}" if total else "none"
        raise RequestError(f"--episodes: {text}: the dataset's episodes are {there}")
    return tuple(sorted(numbers))


def _options(kind: str, type_: str, overrides: Sequence[str]) -> Any:
    from ibrobot_core.app import single_options

    return single_options(installed_plugins().find(kind, type_).options, overrides, type_)


def _stated(options: ConvertOptions) -> tuple[RobotConfig | None, Mapping[str, Mapping[str, Any]] | None]:
    """The robot YAML and the calibration that the options name."""
    from ibrobot_calibration import load_calibration

    from ibrobot_core.app import find_config
    from ibrobot_data.config_metadata import load_contract, with_anchored

    if options.anchored is not None and (options.calibration is None or options.config is None):
        raise RequestError("--anchored needs --calibration and --config, which has the joints' limits")
    calibration = load_calibration(options.calibration).snapshot() if options.calibration is not None else None
    robot = load_contract(find_config(options.config, installed_plugins())) if options.config is not None else None
    if robot is not None and calibration is not None:
        calibration = with_anchored(calibration, robot, listed_joints(options.anchored))
    return robot, calibration


@contextmanager
def _events(emit: Callable[[Event], None], episodes: int) -> Iterator[Any]:
    """Yield a function that prints events: one for each episode, and at most ten a second in between."""
    begin = last = time.monotonic()
    done = 0

    def watch(frames: int, total: int, report: EpisodeReport | None) -> None:
        nonlocal done, last
        now = time.monotonic()
        if report is None and now - last < _EVENT_S:
            return
        last = now
        done += report is not None
        episode, error = ("", "") if report is None else (report.source, report.error)
        event = conversion.Progress(
            done=done, of=episodes, frames=frames, total_frames=max(total, frames), seconds=round(now - begin, 3),
            episode=episode, error=error,
        )  # fmt: skip
        emit(event)

    emit(conversion.Begin(episodes))
    yield watch


@contextmanager
def _progress(episodes: int, quiet: bool) -> Iterator[Any]:
    """Yield a function that shows the progress: a bar on a terminal, otherwise one line per episode."""
    begin, done = time.monotonic(), 0

    def rate(frames: int) -> str:
        return f"{frames / max(time.monotonic() - begin, 1e-9):.0f} frames/s"

    if not sys.stderr.isatty():

        def line(frames: int, total: int, report: EpisodeReport | None) -> None:
            nonlocal done
            if report is not None and not quiet:
                done += 1
                what = report.error.splitlines()[0] if report.error else counted(report.frames, "frame")
                echo(f"{report.source}: {what} ({done} of {episodes}, {rate(frames)})", err=True)

        yield line
        return
    from ibrobot_terminal.screen import Screen, styled
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    counts, speed = (TextColumn(each, markup=False) for each in ("{task.description}", "{task.fields[rate]}"))
    with Progress(counts, BarColumn(), speed, TimeRemainingColumn(), console=Screen(stderr=True)) as bar:
        task = bar.add_task(f"0 of {counted(episodes, 'episode')}", total=None, rate="")

        def move(frames: int, total: int, report: EpisodeReport | None) -> None:
            nonlocal done
            if report is not None:
                done += 1
                if report.error:
                    why = report.error.splitlines()[0]
                    bar.console.print(styled(report.source, "red") + styled(f": left out: {why}"))
            bar.update(
                task,
                description=f"{done} of {counted(episodes, 'episode')}",
                completed=frames,
                total=max(total, frames),
                rate=rate(frames),
            )

        yield move


def _print_report(report: Report) -> None:
    summary = report.summary()
    for error in dict.fromkeys(each.error for each in report.failed):  # several may have the same error
        sources = ", ".join(each.source for each in report.failed if each.error == error)
        echo(f"left out {sources}: {error}", err=True)
    for each in report.episodes:
        if each.passed_over:
            echo(f"passed over {each.source}: {each.passed_over}", err=True)
    done = report.converted
    for each in done:
        if not each.finished:
            echo(f"unfinished {each.source}: it has the {counted(each.frames, 'frame')} that could be read", err=True)
    if not done:
        echo(f"nothing was added to {report.out}")
        return
    resumed = f", {report.resumed} of them by an earlier run" if report.resumed else ""
    made = summary["episodes"]
    source = f" from {counted(len(done), 'recording')}" if made != len(done) else ""
    episodes, frames = plural(made, "episode"), plural(summary["frames"], "frame")
    echo(f"{made} {episodes}{source}, {summary['frames']} {frames}{resumed} -> {report.out}")
    echo(
        f"gaps {summary['gaps']} (ticks skipped {summary['skipped_ticks']}, held {summary['held_ticks']}), "
        f"messages lost in recording {summary['lost_messages']}"
    )
    for each in done:
        if each.skipped > _MUCH * (each.frames + each.skipped):
            echo(f"{each.source}: {each.skipped} of {each.frames + each.skipped} ticks are left out", err=True)
    if cuts := [ticks for each in done for _, ticks in each.cuts]:
        times, ticks = plural(len(cuts), "time"), plural(max(cuts), "tick")
        echo(f"incomplete ticks left out: {len(cuts)} {times}, at most {max(cuts)} {ticks} in a row")
    for what, of_each in (
        ("went missing", [each.gaps for each in done]),
        ("stamps that jumped", [each.resets for each in done]),
        ("lost in recording", [each.lost for each in done]),
        ("missing since", [each.missing for each in done]),
    ):
        if counts := sum(map(Counter, of_each), Counter[str]()):
            echo(f"{what}: {', '.join(f'{name} {count}' for name, count in counts.most_common())}")
    if summary["without_prompt"]:
        echo(f"episodes without a prompt, whose task is empty: {summary['without_prompt']}; --prompt TEXT sets it")
    echo(f"{summary['size_bytes'] / _MIB:.1f} MiB in {report.seconds:.1f} s")
