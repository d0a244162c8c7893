"""`ibrobot record`: run a robot and record its episodes, by keys or unattended."""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

import click

from ibrobot_core.app import (
    LaunchRequest,
    Override,
    RobotConfig,
    Runtime,
    check_end,
    declared,
    echo,
    emit,
    find_config,
    installed_plugins,
    load_config,
    run_options,
    run_overrides,
    run_robot,
)
from ibrobot_data import RECORD
from ibrobot_data.cues import Cues
from ibrobot_data.episode_dataset import EpisodeDataset, count_complete
from ibrobot_data.episode_service import EpisodeService
from ibrobot_data.operator import Operator
from ibrobot_data.plural import plural
from ibrobot_data.recording_session import RecordOptions


@click.command()
@run_options(
    "config",
    "sim",
    "lockstep",
    "seed",
    "mode",
    "overrides",
    "duration",
    "goals",
    "viewer",
    "headless",
    "dry_run",
    "as_json",
)
@declared(RECORD)
def record(options: RecordOptions, config: str | None, events: bool, **run: Any) -> None:
    """Run a robot and record its episodes as bags.

    CONFIG is a robot YAML as for `ibrobot launch`. If it has no `recording` section, episodes go to episodes/default.
    In simulation a policy's episodes begin and end by themselves, and the scene decides on success. In all other modes
    keys begin and end them, and so do the buttons of a teleoperation device. Without a terminal, use such a device,
    --auto, or --continuous for one episode without a break; recording.split_size and recording.split_duration divide
    it into files.

    Exits as `ibrobot launch` does.
    """
    if options.continuous and (options.auto or options.episodes is not None or options.reset_time):
        raise click.UsageError("--continuous records one episode: leave --auto, --episodes and --reset-time out")
    robot = _recorded(config, options.dataset, options.root, run)
    check_end(robot, {**run, "episodes": options.episodes})
    assert robot.recording is not None
    folder, prompt, earlier = robot.recording.folder, options.prompt, 0
    if options.resume:
        earlier = count_complete(folder)
        prompt = prompt or EpisodeDataset(folder).prompt or None
    if options.episodes is not None and earlier >= options.episodes:
        echo(f"{folder}: has {earlier} {plural(earlier, 'episode')} already")
        return
    live = sys.stdin.isatty() and sys.stdout.isatty() and not run["headless"]
    cues = Cues(options.cues, sys.stdout.fileno() if live else None)

    def operator(runtime: Runtime) -> Operator:
        service = runtime.session.episodes
        assert isinstance(service, EpisodeService)
        service.earlier = earlier
        return Operator(
            runtime.session, service, options.episodes, options.reset_time, prompt, auto=options.auto,
            continuous=options.continuous, keys=live, report=partial(emit, RECORD) if events else None,
            cues=cues,
        )  # fmt: skip

    request = LaunchRequest(
        run["lockstep"], run["seed"], run["duration"], options.episodes and options.episodes - earlier, run["goals"],
        prompt=prompt or "", by_operator=True,
    )  # fmt: skip
    shown = {name: run[name] for name in ("headless", "dry_run", "as_json")}
    run_robot(robot, request, **shown, make_hooks=operator)


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
