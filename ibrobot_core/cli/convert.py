"""`ibrobot convert`: recorded episodes -> a dataset that LeRobot trains on."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from ibrobot_core.recording.convert.request import MISSING, OUTCOMES, EpisodeReport, Report, Request
from ibrobot_core.units import NORM_MODES

_MIB = 1 << 20


@click.command()
@click.argument("episodes", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The dataset: a new folder.")
@click.option("--append", is_flag=True, help="Add to the dataset that is there what is not in it yet.")
@click.option("--type", "type_", default="lerobot", show_default=True, help="Dataset writer.")
@click.option("--codec", metavar="NAME", help="Video encoder, e.g. h264; auto takes a GPU's where one opens.")
@click.option("--crf", type=int, metavar="N", help="Video quality; lower is better and larger.")
@click.option("--no-videos", is_flag=True, help="Keep pictures as they are, as PNG in the tables.")
@click.option("--set", "sets", multiple=True, metavar="OPTION=VALUE", help="Any other option of the dataset writer.")
@click.option("--config", metavar="CONFIG", help="Robot YAML with the contract; needed for bags of others.")
@click.option("--force-contract", is_flag=True, help="Take --config's contract where the recorded one differs.")
@click.option(
    "--norm-mode", type=click.Choice(NORM_MODES), default="radians", show_default=True, help="Unit of joints."
)
@click.option("--calibration", metavar="NAME", help="In place of the recorded one, for --norm-mode.")
@click.option(
    "--missing", type=click.Choice(MISSING), default="refuse", show_default=True,
    help="Where something is missing: refuse the episode, skip the tick, or hold the last value.",
)  # fmt: skip
@click.option("--outcome", "outcomes", multiple=True, type=click.Choice(OUTCOMES), help="Only these; repeatable.")
@click.option("--prompt", default="", metavar="TEXT", help="Task of episodes recorded without one.")
@click.option("--success", is_flag=True, help="Add next.success: true in the last row of a success.")
@click.option("--jobs", type=click.IntRange(min=1), metavar="N", help="Episodes side by side; one for two CPU cores.")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def convert(
    episodes: tuple[Path, ...], out: Path, type_: str, config: str | None, calibration: str | None, as_json: bool,
    outcomes: tuple[str, ...], jobs: int | None, codec: str | None, crf: int | None, no_videos: bool,
    sets: tuple[str, ...], **asked: Any,
) -> None:  # fmt: skip
    """Make a dataset for training from recorded episodes.

    EPISODES are episodes, or folders of them such as episodes/default. Interrupted, the same command goes on where it
    was. An episode that cannot be converted is told and left out; the command then exits with 1.
    """
    from ibrobot_core.recording.convert.run import convert as run
    from ibrobot_core.recording.convert.run import find_episodes

    shorthand = {"codec": codec, "crf": crf, "videos": "false" if no_videos else None}
    overrides = tuple(f"{name}={value}" for name, value in shorthand.items() if value is not None)
    request = Request(
        out, _options(type_, (*overrides, *sets)), type_,
        outcomes=outcomes or OUTCOMES, jobs=jobs or _jobs(), calibration=_calibration(calibration),
        **_contract(config), **asked,
    )  # fmt: skip
    found = find_episodes(episodes)
    with _progress(len(found), as_json) as watch:
        report = run(request, found, watch)
    if as_json:
        click.echo(json.dumps(report.summary()))
    else:
        _tell(report)
    if report.failed or not (report.converted or all(each.passed_over for each in report.episodes)):
        sys.exit(1)


def _jobs() -> int:
    """One for two CPU cores: a job decodes while its cameras are encoded beside it."""
    return max(1, (os.cpu_count() or 1) // 2)


def _options(type_: str, overrides: tuple[str, ...]) -> Any:
    from ibrobot_core.config.single import single_options
    from ibrobot_core.plugins import installed

    return single_options(installed().find("dataset", type_).options, overrides, type_)


def _contract(config: str | None) -> dict[str, Any]:
    if config is None:
        return {}
    from ibrobot_core.config import find_config, load
    from ibrobot_core.contract.specs import Contract
    from ibrobot_core.plugins import installed

    robot = load(find_config(config, installed()))
    return {"contract": Contract.from_config(robot), "document": json.loads(json.dumps(robot.document, default=str))}


def _calibration(name: str | None) -> Mapping[str, Mapping[str, int]] | None:
    if name is None:
        return None
    from ibrobot_core.calibration import load_calibration

    return load_calibration(name).numbers()


@contextmanager
def _progress(episodes: int, quiet: bool) -> Iterator[Any]:
    """What shows how far the conversion is: a bar on a terminal, else a line an episode."""
    begin, done = time.monotonic(), 0

    def rate(frames: int) -> str:
        return f"{frames / max(time.monotonic() - begin, 1e-9):.0f} frames/s"

    if not sys.stderr.isatty():

        def line(frames: int, total: int, report: EpisodeReport | None) -> None:
            nonlocal done
            if report is not None and not quiet:
                done += 1
                what = report.error.splitlines()[0] if report.error else f"{report.frames} frames"
                click.echo(f"{report.source}: {what} ({done} of {episodes}, {rate(frames)})", err=True)

        yield line
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[rate]}"), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(f"0 of {episodes} episodes", total=None, rate="")

        def move(frames: int, total: int, report: EpisodeReport | None) -> None:
            nonlocal done
            if report is not None:
                done += 1
                if report.error:
                    bar.console.print(f"[red]{report.source}[/]: left out: {report.error.splitlines()[0]}")
            text = f"{done} of {episodes} episodes"
            bar.update(task, description=text, completed=frames, total=max(total, frames), rate=rate(frames))

        yield move


def _tell(report: Report) -> None:
    summary = report.summary()
    for each in report.failed:
        click.echo(f"left out {each.source}: {each.error}", err=True)
    for each in report.episodes:
        if each.passed_over:
            click.echo(f"passed over {each.source}: {each.passed_over}", err=True)
    done = report.converted
    if not done:
        click.echo(f"nothing was added to {report.out}")
        return
    resumed = f", {report.resumed} of them by an earlier run" if report.resumed else ""
    click.echo(f"{len(done)} episodes, {summary['frames']} frames{resumed} -> {report.out}")
    click.echo(
        f"gaps {summary['gaps']} (ticks skipped {summary['skipped_ticks']}, held {summary['held_ticks']}), "
        f"messages lost in recording {summary['lost_messages']}"
    )
    click.echo(f"{summary['size_bytes'] / _MIB:.1f} MiB in {report.seconds:.1f} s")
