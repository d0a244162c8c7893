"""Options shared by the commands that read a robot YAML or run a robot."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, override

import click
from click import argument, option

from ibrobot_core.descriptors import ViewerDescriptor
from ibrobot_core.plugins import installed_plugins

if TYPE_CHECKING:
    from ibrobot_core.config import RobotConfig


def _viewer_flags() -> dict[str, str]:
    """Type of an installed viewer -> its flag."""
    viewers = (installed_plugins().find("viewer", name) for name in installed_plugins().types("viewer"))
    return {each.type: each.flag for each in viewers if isinstance(each, ViewerDescriptor) and each.flag}


class EpisodePath(click.Path):
    """A recorded episode or a folder of them: a path, or a short name such as `pick:1`; see `find_episode`."""

    @override
    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        from ibrobot_core.interfaces.reader import find_episode

        return find_episode(Path(os.fsdecode(super().convert(value, param, ctx))))


_OPTIONS: dict[str, Callable[..., Any]] = {
    "config": argument("config", required=False),
    "sim": option("--sim", is_flag=True, help="Use the simulation section instead of hardware."),
    "lockstep": option("--lockstep", is_flag=True, help="Run in simulated time, as fast as possible, reproducibly."),
    "seed": option("--seed", type=int, default=0, show_default=True, help="First episode's seed; later ones add 1."),
    "mode": option("--mode", metavar="MODE", help="Start in this control mode, instead of default_control_mode."),
    "overrides": option(
        "--set", "overrides", multiple=True, metavar="PATH=VALUE", help="Override a key, e.g. control.rate_hz=50."
    ),
    "duration": option("--duration", type=click.FloatRange(min=0), metavar="S", help="Stop after S seconds."),
    "episodes": option("--episodes", type=click.IntRange(min=1), metavar="N", help="Stop after N episodes."),
    "goals": option(
        "--goal", "goals", multiple=True, metavar="GOAL", help="Planning modes: a pose, joint=rad,… or xyz=X,Y,Z."
    ),
    "viewer": option("--viewer", metavar="TYPE", help="Show the robot in this viewer."),
    "headless": option("--headless", is_flag=True, help="Print plain lines, without window, viewer and panel."),
    "dry_run": option("--dry-run", is_flag=True, help="Print the plan, compare model and contract; start nothing."),
    "as_json": option("--json", "as_json", is_flag=True, help="Print the summary, or the plan, as JSON only."),
}


def run_options[C: Callable[..., Any]](*names: str) -> Callable[[C], C]:
    """The argument `config` and the options of commands that run a robot.

    Args:
        names: any of `config`, `sim`, `lockstep`, `seed`, `mode`, `overrides`, `duration`, `episodes`, `goals`,
            `viewer`, `headless`, `dry_run`, `as_json`. All by default.

    Returns:
        A decorator for the function of a click command.
    """

    def add(command: C) -> C:
        for name in reversed(names or tuple(_OPTIONS)):
            for type_, flag in _viewer_flags().items() if name == "viewer" else ():
                command = option(flag, "viewer", flag_value=type_, help=f"As --viewer {type_}.")(command)
            command = _OPTIONS[name](command)
        return command

    return add


def run_overrides(options: Mapping[str, Any]) -> tuple[str, ...]:
    """The overrides of a robot YAML given by command-line options.

    Args:
        options: `overrides`, `viewer` and `headless` of `run_options`.

    Raises:
        click.UsageError: for options that exclude each other.
    """
    viewer = options["viewer"]
    if viewer and options["headless"]:
        flag = _viewer_flags().get(viewer, "--viewer")
        raise click.UsageError(f"{flag} and --headless exclude each other")
    if not viewer:
        return tuple(options["overrides"])
    from ibrobot_core.config.overrides import Override

    typed = _viewer_flags().get(viewer, f"--viewer {viewer}")
    return (Override.of(typed, f"viewer.type={viewer}"), *options["overrides"])


def check_end(config: RobotConfig, options: Mapping[str, Any]) -> None:
    """Refuse a run in simulated time that would go on for ever without a goal."""
    mode = config.control_modes[config.default_control_mode]
    ends = options["goals"] or options["episodes"] is not None or options["duration"] is not None
    if options["lockstep"] and mode.planner is not None and not ends:
        raise click.UsageError(
            f"--lockstep: nothing sends mode {mode.name} a goal: add --goal, --duration or --episodes"
        )
