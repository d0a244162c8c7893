"""Options shared by the commands that read a robot YAML or run a robot; a command's class derives from one of these."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

import attrs

from ibrobot_core.cli.declared import viewer_flags
from ibrobot_core.config import RobotConfig, find_config, load_config
from ibrobot_core.config.overrides import Override
from ibrobot_core.errors import RequestError
from ibrobot_core.options import option
from ibrobot_core.plugins import installed_plugins


@attrs.frozen(kw_only=True)
class ConfigOptions:
    """A robot YAML, with overrides."""

    config: str | None = option(None, typed="CONFIG", names="robot", label=None, help="robot YAML")
    sim: bool = option(False, label=None, help="use the simulation section instead of hardware")
    overrides: tuple[str, ...] = option((), typed="--set PATH=VALUE", label=None, help="e.g. control.rate_hz=50")

    def load(self, mode: str | None = None, overrides: Sequence[str] | None = None) -> RobotConfig:
        """Load the YAML, with other overrides than `changes`, and for a mode other than its default.

        Raises:
            ConfigError: if it is invalid.
        """
        path = find_config(self.config, installed_plugins())
        overrides = self.changes() if overrides is None else overrides
        return load_config(path, overrides=overrides, mode=mode, sim=self.sim)

    def changes(self) -> tuple[str, ...]:
        """The overrides of all options."""
        return self.overrides


@attrs.frozen(kw_only=True)
class RunOptions(ConfigOptions):
    """A run of a robot, and how it is shown."""

    lockstep: bool = option(False, label=None, help="run in simulated time, as fast as possible, reproducibly")
    viewer: str | None = option(None, typed="--viewer TYPE", names="viewer", label=None, help="show the robot in it")
    headless: bool = option(False, label=None, help="print plain lines, without window, viewer and panel")
    as_json: bool = option(False, typed="--json", label=None, help="print the summary, or the plan, as JSON only")

    @override
    def changes(self) -> tuple[str, ...]:
        """The overrides of all options.

        Raises:
            RequestError: for options that exclude each other.
        """
        typed = viewer_flags().get(self.viewer or "", f"--viewer {self.viewer}")
        if self.viewer and self.headless:
            raise RequestError(f"{typed.partition(' ')[0]} and --headless exclude each other")
        return (*((Override.of(typed, f"viewer.type={self.viewer}"),) if self.viewer else ()), *self.overrides)


@attrs.frozen(kw_only=True)
class ModeOptions(RunOptions):
    """A run of a robot in a mode."""

    seed: int = option(0, label=None, help="first episode's seed; later ones add 1")
    mode: str | None = option(None, typed="--mode MODE", label=None, help="in place of default_control_mode")
    duration: float | None = option(None, ge=0, unit="s", label=None, help="stop after this time")
    goals: tuple[str, ...] = option((), typed="--goal GOAL", label=None, help="a pose, joint=rad,… or xyz=X,Y,Z")
    dry_run: bool = option(False, label=None, help="print the plan, compare model and contract; start nothing")

    def check_end(self, config: RobotConfig, episodes: int | None) -> None:
        """Refuse a run in simulated time that would go on for ever without a goal."""
        mode = config.control_modes[config.default_control_mode]
        ends = self.goals or episodes is not None or self.duration is not None
        if self.lockstep and mode.planner is not None and not ends:
            advice = "add --goal, --duration or --episodes"
            raise RequestError(f"--lockstep: nothing sends mode {mode.name} a goal: {advice}")
