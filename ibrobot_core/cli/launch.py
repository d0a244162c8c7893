"""`ibrobot launch`: run a robot, real or simulated, from its YAML."""

from __future__ import annotations

from typing import Any

import click

from ibrobot_core.cli.options import check_end, run_options, run_overrides
from ibrobot_core.cli.run import run_robot
from ibrobot_core.config import find_config, load_config
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.plugins import installed_plugins


@click.command()
@run_options()
def launch(config: str | None, **options: Any) -> None:
    """Run a robot.

    CONFIG is a robot YAML: a path, or the name of one shipped with ibrobot or a plugin; so101 by default.
    --episodes counts episodes of a policy in simulation.

    Exits with 0 if the run succeeded, 1 if a component failed or a fault was raised, 2 for a wrong command line
    or YAML, 3 if an episode or goal did not succeed, 130 on a second Ctrl-C.
    """
    path = find_config(config, installed_plugins())
    robot = load_config(path, overrides=run_overrides(options), mode=options["mode"], sim=options["sim"])
    check_end(robot, options)
    request = LaunchRequest(
        options["lockstep"], options["seed"], options["duration"], options["episodes"], options["goals"]
    )
    run_robot(robot, request, headless=options["headless"], dry_run=options["dry_run"], as_json=options["as_json"])
