"""`ibrobot record`: run a robot and record its episodes, by keys or unattended."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import click

from ibrobot_core.app import (
    LaunchRequest,
    Override,
    RobotConfig,
    Runtime,
    check_end,
    find_config,
    installed_plugins,
    load_config,
    run_options,
    run_overrides,
    run_robot,
)
from ibrobot_data.episode_service import EpisodeService
from ibrobot_data.operator import Operator


@click.command()
@run_options()
@click.option("--dataset", metavar="NAME", help="Folder of the episodes, below the root.")
@click.option("--root", type=click.Path(path_type=Path), help="Folder of all datasets.")
@click.option("--prompt", metavar="TEXT", help="Description of the task; asked for if left out.")
@click.option("--auto", is_flag=True, help="Begin episodes automatically; end them after contract.max_duration_s.")
@click.option("--continuous", is_flag=True, help="One episode, from the start of the run to its end.")
@click.option(
    "--reset-time",
    type=click.FloatRange(min=0),
    default=0.0,
    show_default=True,
    metavar="S",
    help="Pause between episodes [s].",
)
def record(config: str | None, dataset: str | None, root: Path | None, **options: Any) -> None:
    """Run a robot and record its episodes as bags.

    CONFIG is a robot YAML as for `ibrobot launch`. If it has no `recording` section, episodes go to episodes/default.
    In simulation a policy's episodes begin and end by themselves, and the scene decides on success. In all other modes
    keys begin and end them, and so do the buttons of a teleoperation device. Without a terminal, use such a device,
    --auto, or --continuous for one episode without a break; recording.split_size and recording.split_duration divide
    it into files.

    Exits as `ibrobot launch` does.
    """
    prompt, auto, reset_time = options.pop("prompt"), options.pop("auto"), options.pop("reset_time")
    continuous = options.pop("continuous")
    if continuous and (auto or options["episodes"] is not None or reset_time):
        raise click.UsageError("--continuous records one episode: leave --auto, --episodes and --reset-time out")
    robot = _recorded(config, dataset, root, options)
    check_end(robot, options)
    live = sys.stdin.isatty() and sys.stdout.isatty() and not options["headless"]

    def operator(runtime: Runtime) -> Operator:
        service = runtime.session.episodes
        assert isinstance(service, EpisodeService)
        return Operator(
            runtime.session, service, options["episodes"], reset_time, prompt,
            auto=auto, continuous=continuous, keys=live,
        )  # fmt: skip

    request = LaunchRequest(
        options["lockstep"], options["seed"], options["duration"], options["episodes"], options["goals"],
        prompt=prompt or "", by_operator=True,
    )  # fmt: skip
    run_robot(
        robot,
        request,
        headless=options["headless"],
        dry_run=options["dry_run"],
        as_json=options["as_json"],
        make_hooks=operator,
    )


def _recorded(config: str | None, dataset: str | None, root: Path | None, options: dict[str, Any]) -> RobotConfig:
    """The robot of a YAML, with a section `recording` added if the YAML has none."""
    registry = installed_plugins()
    path = find_config(config, registry)
    changes = run_overrides(options)
    # An override within the section must not count as the section.
    known = [change for change in changes if not change.startswith("recording.")]
    robot = load_config(path, overrides=known, mode=options["mode"], sim=options["sim"], registry=registry)
    made = []
    if robot.recording is None:
        made = [f"recording={{type: {registry.default('recorder')}, root: episodes, topics: contract}}"]
    named = [
        Override.of(f"--{key} {value}", f"recording.{key}={json.dumps(str(value))}")
        for key, value in (("dataset", dataset), ("root", root))
        if value is not None
    ]
    return load_config(
        path, overrides=(*made, *changes, *named), mode=options["mode"], sim=options["sim"], registry=registry
    )
