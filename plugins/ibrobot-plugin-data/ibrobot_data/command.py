"""`ibrobot convert`: recorded episodes -> a dataset that LeRobot trains on."""

from __future__ import annotations

import json
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs
import click
from click.core import ParameterSource

from ibrobot_core.api import Contract, DatasetDescriptor, DatasetError, Flag
from ibrobot_core.app import NORM_MODES, EpisodePath, echo, installed_plugins, with_closed_ends, wrong_input
from ibrobot_data.prompt import check_prompt
from ibrobot_data.request import MISSING, ONLY, OUTCOMES, ConversionRequest, EpisodeReport, Report
from ibrobot_data.words import plural

if TYPE_CHECKING:
    from ibrobot_core.app import RobotConfig

_Progress = Callable[[int], AbstractContextManager[Any]]
"""Receives the number of episodes, and gives the function that shows the progress."""
_MIB = 1 << 20
_ONLY_TO_BAG = ("numbers",)
_ONLY_TO_DATASET = (
    "append", "type_", "force_contract", "any_robot", "missing", "outcomes", "success", "jobs", "only", "context",
)  # fmt: skip
_EVENT_S = 0.1
_MUCH = 0.1
"""The report names episodes that lost a larger share of their ticks."""
_MISSING = attrs.fields(ConversionRequest).missing.default
_CONTEXT = attrs.fields(ConversionRequest).context.default


def _flags() -> dict[str, Flag]:
    """Name of a parameter -> the flag that a dataset writer adds to this command."""
    descriptors = (entry.descriptor for entry in installed_plugins().entries.values())
    flags = [flag for each in descriptors if isinstance(each, DatasetDescriptor) for flag in each.flags]
    return {flag.name.removeprefix("--").replace("-", "_"): flag for flag in flags}


def _flags_of_writers(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the flags of the installed dataset writers."""
    for name, flag in reversed(_flags().items()):
        command = click.option(flag.name, name, is_flag=flag.value is not None, help=flag.help)(command)
    return command


@click.command()
@click.argument("episodes", nargs=-1, required=True, type=EpisodePath())
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The dataset: a new folder.")
@click.option("--to", type=click.Choice(("dataset", "bag")), default="dataset", show_default=True, help="What to make.")
@click.option("--episodes", "numbers", metavar="N,N-M", help="With --to bag: only these episodes, counted from 0.")
@click.option("--append", is_flag=True, help="Add new episodes to an existing dataset.")
@click.option("--type", "type_", help="Dataset writer; by default that of an installed plugin.")
@_flags_of_writers
@click.option("--set", "sets", multiple=True, metavar="OPTION=VALUE", help="Any other option of the dataset writer.")
@click.option("--config", metavar="CONFIG", help="Robot YAML, or a YAML with only a contract, for foreign bags.")
@click.option("--force-contract", is_flag=True, help="Use --config's contract even if the recorded one differs.")
@click.option("--any-robot", is_flag=True, help="Merge episodes even if robot, robot type or calibration differ.")
@click.option("--norm-mode", type=click.Choice(NORM_MODES), help="Unit of the dataset's joints; by default radians.")
@click.option("--calibration", metavar="NAME", help="Calibration for --norm-mode, instead of the recorded one.")
@click.option(
    "--missing",
    type=click.Choice(MISSING),
    default=_MISSING,
    show_default=True,
    help="If an observation is missing: refuse the episode, skip the tick, or hold the last value.",
)
@click.option(
    "--outcome", "outcomes", multiple=True, type=click.Choice(OUTCOMES), help="Only this outcome; repeatable."
)
@click.option("--prompt", default="", metavar="TEXT", help="Task of episodes recorded without one.")
@click.option(
    "--only",
    type=click.Choice(ONLY),
    default="all",
    show_default=True,
    help="Keep only the rows that the operator or the policy commanded; each stretch becomes an episode.",
)
@click.option(
    "--context",
    type=click.FloatRange(min=0),
    default=_CONTEXT,
    show_default=True,
    metavar="S",
    help="Seconds to keep before and after an intervention, for --only interventions.",
)
@click.option("--success", is_flag=True, help="Add next.success: true in the last row of a success.")
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    metavar="N",
    help="Episodes in parallel; by default one for each CPU core.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
@click.option("--events", is_flag=True, help="Print the progress as JSON lines, and the report as the last one.")
@click.pass_context
def convert(context: click.Context, /, to: str, as_json: bool, events: bool, **asked: Any) -> None:
    """Make a dataset for training from recorded episodes, or with --to bag episodes from a dataset.

    EPISODES are episodes, folders of them such as episodes/default, or DATASET:N; with --to bag it is one dataset.
    After an interruption, run the same command again to continue. An episode that cannot be converted is reported and
    left out; the command then exits with 1.
    """
    given = [name for name in asked if context.get_parameter_source(name) is ParameterSource.COMMANDLINE]
    only_other = _ONLY_TO_BAG if to == "dataset" else (*_ONLY_TO_DATASET, *_flags())
    if wrong := [name for name in given if name in only_other]:
        option = next(each.opts[0] for each in context.command.params if each.name == wrong[0])
        raise click.UsageError(f"{option} has no meaning for --to {to}")
    try:
        with wrong_input():
            check_prompt(asked["prompt"])
            progress = _events if events else partial(_progress, quiet=as_json)
            report = (_to_bags if to == "bag" else _to_dataset)(progress=progress, **asked)
    except KeyboardInterrupt:
        echo("interrupted; finished episodes are kept: run the same command again to continue", err=True)
        sys.exit(130)
    if events:
        summary = report.summary()
        del summary["reports"]  # each episode had its event
        _emit("report", **summary)
    elif as_json:
        echo(json.dumps(report.summary()))
    else:
        _print_report(report)
    if report.failed or not (report.converted or all(each.passed_over for each in report.episodes)):
        sys.exit(1)


def _to_dataset(
    *, episodes: tuple[Path, ...], out: Path, type_: str | None, config: str | None, calibration: str | None,
    progress: _Progress, outcomes: tuple[str, ...], jobs: int | None, sets: tuple[str, ...], norm_mode: str | None,
    numbers: str | None, **asked: Any,
) -> Report:  # fmt: skip
    from ibrobot_data.run import convert as run
    from ibrobot_data.run import find_episodes

    overrides = [_override(flag, value) for name, flag in _flags().items() if (value := asked.pop(name))]
    type_ = type_ or installed_plugins().default("dataset")
    request = ConversionRequest(
        out, _options("dataset", type_, (*overrides, *sets)), type_,
        outcomes=outcomes or OUTCOMES, jobs=jobs or cores(), norm_mode=norm_mode or "radians",
        **_given(config, calibration), **asked,
    )  # fmt: skip
    found = find_episodes(episodes)
    with progress(len(found)) as watch:
        return run(request, found, watch)


def _to_bags(
    *, episodes: tuple[Path, ...], out: Path, config: str | None, calibration: str | None, progress: _Progress,
    sets: tuple[str, ...], norm_mode: str | None, numbers: str | None, prompt: str, **_: Any,
) -> Report:  # fmt: skip
    from ibrobot_core.api import EpisodeAddress
    from ibrobot_data.episode import make_writer
    from ibrobot_data.given import metadata_from_config
    from ibrobot_data.to_bags import BagRequest, convert_to_bags

    if len(episodes) != 1:
        raise click.UsageError("--to bag takes one dataset at a time")
    address = EpisodeAddress.of(episodes[0])
    dataset, recorder = installed_plugins().default("dataset"), installed_plugins().default("recorder")
    writer = make_writer(ConversionRequest(address.path, _options("dataset", dataset, ()), dataset))
    if (summary := writer.summary(address.path)) is None:
        raise DatasetError(f"{address.path}: not a dataset of type {dataset}")
    chosen = (address.number,) if address.number is not None else _numbers(numbers, summary.episodes)
    robot = _robot(config) if config is not None else None
    request = BagRequest(
        address.path, chosen, out, _options("recorder", recorder, sets), recorder, prompt=prompt,
        contract=Contract.from_config(robot) if robot is not None else None,
        given=metadata_from_config(robot, norm_mode, _calibration(calibration)) if robot is not None else {},
    )  # fmt: skip
    with progress(len(chosen)) as watch:
        return convert_to_bags(request, watch)


def _numbers(text: str | None, total: int) -> tuple[int, ...]:
    """The numbers that e.g. `0,3-5` means, in order.

    Raises:
        click.BadParameter: for other words, or a number that the dataset does not have.
    """
    if text is None:
        return tuple(range(total))
    found: set[int] = set()
    for piece in text.split(","):
        ends = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", piece)
        if ends is None:
            raise click.BadParameter(
                f"{piece!r} is not a number, nor two with a dash, e.g. 0,3-5", param_hint="--episodes"
            )
        found |= set(range(int(ends[1]), int(ends[2] or ends[1]) + 1))
    if not found or max(found) >= total:
        there = f"0 to {total - 1}" if total else "none"
        raise click.BadParameter(f"{text}: the dataset's episodes are {there}", param_hint="--episodes")
    return tuple(sorted(found))


def _override(flag: Flag, value: Any) -> str:
    from ibrobot_core.app import Override

    if flag.value is not None:
        return Override.of(flag.name, f"{flag.option}={flag.value}")
    return Override.of(f"{flag.name} {value}", f"{flag.option}={value}")


def cores() -> int:
    """Number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _options(kind: str, type_: str, overrides: Sequence[str]) -> Any:
    from ibrobot_core.app import single_options

    return single_options(installed_plugins().find(kind, type_).options, overrides, type_)


def _robot(config: str) -> RobotConfig:
    from ibrobot_core.app import find_config
    from ibrobot_data.given import load_contract

    return load_contract(find_config(config, installed_plugins()))


def _given(config: str | None, calibration: str | None) -> dict[str, Any]:
    """Fields of the request that come from a robot YAML and a calibration."""
    numbers = _calibration(calibration)
    if config is None:
        return {"calibration": numbers}
    robot = _robot(config)
    return {
        "calibration": numbers and with_closed_ends(numbers, robot),
        "contract": Contract.from_config(robot),
        "document": json.loads(json.dumps(robot.document, default=str)),
    }


def _calibration(name: str | None) -> Mapping[str, Mapping[str, Any]] | None:
    if name is None:
        return None
    from ibrobot_core.api import load_calibration

    return load_calibration(name).snapshot()


def _emit(event: str, **facts: Any) -> None:
    """Print an event for a program that reads the output."""
    echo(json.dumps({"event": event, **facts}))


@contextmanager
def _events(episodes: int) -> Iterator[Any]:
    """A function that prints the progress as events: one for each episode, and at most ten a second beside them."""
    begin = last = time.monotonic()
    done = 0

    def event(frames: int, total: int, report: EpisodeReport | None) -> None:
        nonlocal done, last
        now = time.monotonic()
        if report is None and now - last < _EVENT_S:
            return
        last = now
        done += report is not None
        facts: dict[str, Any] = {"done": done, "of": episodes, "frames": frames, "total_frames": max(total, frames)}
        if report is not None:
            facts |= {"episode": report.source, "error": report.error}
        _emit("progress", **facts, seconds=round(now - begin, 3))

    _emit("begin", of=episodes)
    yield event


@contextmanager
def _progress(episodes: int, quiet: bool) -> Iterator[Any]:
    """A function that shows the progress: a bar on a terminal, otherwise one line per episode."""
    begin, done = time.monotonic(), 0

    def rate(frames: int) -> str:
        return f"{frames / max(time.monotonic() - begin, 1e-9):.0f} frames/s"

    if not sys.stderr.isatty():

        def line(frames: int, total: int, report: EpisodeReport | None) -> None:
            nonlocal done
            if report is not None and not quiet:
                done += 1
                what = report.error.splitlines()[0] if report.error else f"{report.frames} frames"
                echo(f"{report.source}: {what} ({done} of {episodes}, {rate(frames)})", err=True)

        yield line
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from ibrobot_core.app import Screen, styled

    counts, speed = (TextColumn(each, markup=False) for each in ("{task.description}", "{task.fields[rate]}"))
    with Progress(counts, BarColumn(), speed, TimeRemainingColumn(), console=Screen(stderr=True)) as bar:
        task = bar.add_task(f"0 of {episodes} episodes", total=None, rate="")

        def move(frames: int, total: int, report: EpisodeReport | None) -> None:
            nonlocal done
            if report is not None:
                done += 1
                if report.error:
                    why = report.error.splitlines()[0]
                    bar.console.print(styled(report.source, "red") + styled(f": left out: {why}"))
            bar.update(
                task,
                description=f"{done} of {episodes} episodes",
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
            echo(f"unfinished {each.source}: it has the {each.frames} frames that could be read", err=True)
    if not done:
        echo(f"nothing was added to {report.out}")
        return
    resumed = f", {report.resumed} of them by an earlier run" if report.resumed else ""
    made = summary["episodes"]
    source = f" from {len(done)} {plural(len(done), 'recording')}" if made != len(done) else ""
    episodes, frames = plural(made, "episode"), plural(summary["frames"], "frame")
    echo(f"{made} {episodes}{source}, {summary['frames']} {frames}{resumed} -> {report.out}")
    echo(
        f"gaps {summary['gaps']} (ticks skipped {summary['skipped_ticks']}, held {summary['held_ticks']}), "
        f"messages lost in recording {summary['lost_messages']}"
    )
    for each in done:
        if each.skipped > _MUCH * (each.frames + each.skipped):
            echo(f"cut {each.source}: {each.skipped} of {each.frames + each.skipped} ticks are left out", err=True)
    if cuts := [ticks for each in done for _, ticks in each.cuts]:
        times, ticks = plural(len(cuts), "time"), plural(max(cuts), "tick")
        echo(f"left out where something was missing: {len(cuts)} {times}, at most {max(cuts)} {ticks} in a row")
    for what, of_each in (
        ("missing for a time", [each.gaps for each in done]),
        ("stamps that jumped", [each.resets for each in done]),
        ("lost in recording", [each.lost for each in done]),
        ("missing since", [each.missing for each in done]),
    ):
        if counts := sum(map(Counter, of_each), Counter[str]()):
            echo(f"{what}: {', '.join(f'{name} {count}' for name, count in counts.most_common())}")
    if summary["without_prompt"]:
        echo(f"without a prompt, so with an empty task: {summary['without_prompt']}; --prompt TEXT gives them one")
    echo(f"{summary['size_bytes'] / _MIB:.1f} MiB in {report.seconds:.1f} s")
