"""`ibrobot launch`: run a robot, real or simulated, from its YAML."""

from __future__ import annotations

from typing import Any

import click

from ibrobot_core.cli.options import run_options, run_overrides
from ibrobot_core.cli.run import MakeHooks, no_hooks, run_robot
from ibrobot_core.config import find_config, load_config
from ibrobot_core.launch.session import LaunchRequest
from ibrobot_core.plugins import installed_plugins


@click.command()
@run_options()
def launch(config: str | None, **options: Any) -> None:
    """Run a robot.

    CONFIG is a robot YAML: a path, or the name of one that comes with ibrobot or a plugin; so101 when left out.
    --episodes counts those of a policy in simulation.

    Exits with 0 when the run ended well, 1 when a component failed or a fault was raised, 2 for a wrong command line
    or YAML, 3 when not every episode or goal succeeded, 130 on a second Ctrl-C.
    """
    run_config(config, options)


def run_config(
    config: str | None, options: dict[str, Any], *, make_hooks: MakeHooks = no_hooks,
    recording: tuple[str, ...] | None = None, prompt: str = "",
) -> None:  # fmt: skip
    """Run a robot as a command line says, to the end of the process.

    Args:
        config: the robot YAML, as `launch` takes it.
        options: those of `run_options`.
        make_hooks: as `run_robot` takes it.
        recording: overrides of the `recording` section, which is made where the YAML has none; None: the run does what
            the mode does.
        prompt: what recorded episodes are recorded under.

    Raises:
        IbrobotError: e.g. for a YAML with mistakes, or when a component fails.
    """
    registry = installed_plugins()
    path = find_config(config, registry)
    changes, chosen = run_overrides(options), {"mode": options["mode"], "sim": options["sim"], "registry": registry}
    # An override within the section must not count as the section.
    known = [change for change in changes if recording is None or not change.startswith("recording.")]
    robot = load_config(path, overrides=known, **chosen)
    if recording is not None:
        made = []
        if robot.recording is None:
            made = [f"recording={{type: {registry.default('recorder')}, root: episodes, topics: contract}}"]
        robot = load_config(path, overrides=(*made, *changes, *recording), **chosen)
    request = LaunchRequest(
        options["lockstep"], options["seed"], options["duration"], options["episodes"], options["goals"],
        prompt=prompt, by_operator=recording is not None,
    )  # fmt: skip
    run_robot(
        robot, request, headless=options["headless"], dry_run=options["dry_run"], as_json=options["as_json"],
        make_hooks=make_hooks,
    )  # fmt: skip
