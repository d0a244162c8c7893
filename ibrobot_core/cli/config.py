"""`ibrobot config check` and `show`: check and show robot YAMLs."""

from __future__ import annotations

import json

import attrs

from ibrobot_core.cli.options import ConfigOptions
from ibrobot_core.config.missing import describe
from ibrobot_core.descriptors import UnitsDescriptor
from ibrobot_core.errors import ConfigError, PluginError, Unsuccessful
from ibrobot_core.options import option
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.safe_output import echo


@attrs.frozen(kw_only=True)
class ShowConfig(ConfigOptions):
    """Print CONFIG as a run would use it, as YAML.

    All defaults are filled in, and the YAML loads again.
    """

    mode: str | None = option(None, typed="--mode MODE", help="start in this control mode, not default_control_mode")

    def __call__(self) -> None:
        from ibrobot_core.config.show import to_yaml

        robot = self.load(self.mode)
        if robot.missing:
            raise PluginError(f"{robot.source}: not all defaults are known: {describe(robot.missing)}")
        echo(to_yaml(robot), nl=False)


@attrs.frozen(kw_only=True)
class CheckConfig(ShowConfig):
    """Report all faults of CONFIG; exit with 2 if there are any."""

    deep: bool = option(
        False, help="also compare the models of all modes, without their weights, and want calibrations"
    )

    as_json: bool = option(False, typed="--json", help="print a list of {file, line, path, message}")

    def __call__(self) -> None:
        from ibrobot_core.contract.specs import Contract
        from ibrobot_core.launch.absence import notes_of
        from ibrobot_core.launch.models import check_models

        registry = installed_plugins()
        try:
            robot = self.load(self.mode)
            modes = [name for name in robot.control_modes if name not in robot.unavailable]
            models = check_models(robot, registry, modes) if self.deep else []
            units = [each for each in registry.of_kind("units") if isinstance(each, UnitsDescriptor)]
            uncalibrated = [problem for each in units for problem in each.uncalibrated(robot)]
            if self.deep and uncalibrated:
                raise ConfigError(uncalibrated)
        except ConfigError as error:
            if not self.as_json:
                raise
            echo(json.dumps([{**attrs.asdict(p), "file": str(p.file)} for p in error.problems], indent=2))
            raise Unsuccessful(exit_code=error.exit_code) from None
        if self.as_json:
            echo("[]")
            return
        body, count = "simulation" if robot.simulated else "hardware", len(robot.robot.joints)
        echo(f"{robot.source}: ok ({robot.robot.name}, {count} joint{'' if count == 1 else 's'}, {body})")
        echo(f"joints brake from full speed within {robot.robot.braking_s.max() * 1e3:.0f} ms")
        echo(f"modes: {', '.join(robot.control_modes)}; starts in {robot.default_control_mode}")
        notes = [*notes_of(robot, registry), *(f"{problem.path}: {problem.message}" for problem in uncalibrated)]
        for spec, part in zip(robot.contract.observations, Contract.from_config(robot).observation_parts, strict=True):
            if part.align != spec.align:
                notes.append(f"{part.key}: a {part.type} has no header: {part.topic} goes by the time of receipt")
        for line in (*(f"note: {note}" for note in notes), *models):
            echo(line)
