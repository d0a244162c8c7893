"""`ibrobot config check|show|schema`: check and show robot YAMLs, and print their JSON Schema."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from typing import override

import attrs
import click

from ibrobot_core.calibration import load_calibration
from ibrobot_core.cli.options import run_options
from ibrobot_core.config import RobotConfig, find_config, load_config
from ibrobot_core.config.missing import absent_models, describe, unavailable_modes
from ibrobot_core.errors import CalibrationError, ConfigError, PluginError, Problem
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.safe_output import echo
from ibrobot_core.schema import HardwareConfig, TeleopConfig

_CONFIG = "config "
config_options = run_options("config", "sim", "overrides", "mode")


class ConfigGroup(click.Group):
    """Also has the commands of plugins whose names begin with `config`."""

    @override
    def list_commands(self, ctx: click.Context) -> list[str]:
        plugins = (name.removeprefix(_CONFIG) for name in installed_plugins().commands if name.startswith(_CONFIG))
        return sorted([*super().list_commands(ctx), *plugins])

    @override
    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        declared = installed_plugins().commands.get(f"{_CONFIG}{cmd_name}")
        return declared.load() if declared is not None else super().get_command(ctx, cmd_name)


@click.group(cls=ConfigGroup)
def config() -> None:
    """Check and show robot YAMLs; copies and others come with plugins.

    CONFIG is a file, or the name of a config shipped with ibrobot or a plugin; so101 by default.
    """


@config.command()
@config_options
@click.option("--json", "as_json", is_flag=True, help="Print a list of {file, line, path, message}.")
@click.option(
    "--deep", is_flag=True, help="Also compare the models of all modes, without their weights, and want calibrations."
)
def check(
    config: str | None, sim: bool, overrides: tuple[str, ...], mode: str | None, as_json: bool, deep: bool
) -> None:
    """Report all faults of CONFIG; exit with 2 if there are any."""
    from ibrobot_core.launch.absence import absent_sensors, describe_absent
    from ibrobot_core.launch.models import check_models

    try:
        path = find_config(config, installed_plugins())
        robot_config = load_config(path, overrides=overrides, mode=mode, sim=sim)
        modes = [name for name in robot_config.control_modes if name not in robot_config.unavailable]
        models = check_models(robot_config, installed_plugins(), modes) if deep else []
        uncalibrated = list(_uncalibrated(robot_config))
        if deep and uncalibrated:
            raise ConfigError(uncalibrated)
    except ConfigError as error:
        if not as_json:
            raise
        echo(json.dumps([{**attrs.asdict(p), "file": str(p.file)} for p in error.problems], indent=2))
        sys.exit(error.exit_code)
    if as_json:
        echo("[]")
        return
    body = "simulation" if robot_config.simulated else "hardware"
    echo(f"{path}: ok ({robot_config.robot.name}, {len(robot_config.robot.joints)} joints, {body})")
    echo(f"joints brake from full speed within {robot_config.robot.braking_s.max() * 1e3:.0f} ms")
    echo(f"modes: {', '.join(robot_config.control_modes)}; starts in {robot_config.default_control_mode}")
    for line in (*unavailable_modes(robot_config.unavailable), *absent_models(robot_config.absent_models)):
        echo(f"note: {line}")
    if absent := describe_absent(absent_sensors(robot_config, installed_plugins())):
        echo(f"note: runs start without {absent}")
    for problem in uncalibrated:
        echo(f"note: {problem.path}: {problem.message}")
    for line in models:
        echo(line)


def _uncalibrated(config: RobotConfig) -> Iterator[Problem]:
    """What is wrong with the calibrations that a run needs at its start; this machine may not be the robot's."""
    limits = {joint.name: (joint.lower, joint.upper) for joint in config.robot.joints}
    mode = config.control_modes[config.default_control_mode]
    used = {*mode.devices.values(), *(mode.inference.devices.values() if mode.inference is not None else ())}
    parts: list[tuple[str, HardwareConfig | TeleopConfig]] = [
        ("hardware" if name == "hardware" else f"hardware.{name}", each) for name, each in config.hardware.items()
    ]
    parts += [(f"teleoperation.{name}", each) for name, each in config.teleoperation.items() if name in used]
    for path, part in parts:
        try:
            if part.calibration is not None:
                joints = part.joints if isinstance(part, HardwareConfig) else None
                load_calibration(part.calibration, joints).check_ranges(limits, config.closed_ends)
        except CalibrationError as error:
            yield Problem(config.source, 0, path, str(error))


@config.command()
@config_options
def show(config: str | None, sim: bool, overrides: tuple[str, ...], mode: str | None) -> None:
    """Print CONFIG as a run would use it, as YAML.

    All defaults are filled in, and the YAML loads again.
    """
    from ibrobot_core.config.show import to_yaml

    robot_config = load_config(find_config(config, installed_plugins()), overrides=overrides, mode=mode, sim=sim)
    if robot_config.missing:
        raise PluginError(f"{robot_config.source}: not all defaults are known: {describe(robot_config.missing)}")
    echo(to_yaml(robot_config), nl=False)
