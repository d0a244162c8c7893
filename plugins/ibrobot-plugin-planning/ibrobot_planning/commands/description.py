"""`ibrobot description …`."""

from __future__ import annotations

from pathlib import Path

import click

from ibrobot_core.app import echo


@click.group()
def description() -> None:
    """Make files that describe a robot."""


@description.command()
@click.argument("config", metavar="CONFIG")
@click.option("--samples", type=click.IntRange(min=1), default=10_000, show_default=True, help="Random configurations.")
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the random configurations.")
@click.option(
    "--output", type=click.Path(dir_okay=False, path_type=Path), help="The file; without it, standard output."
)
def srdf(config: str, samples: int, seed: int, output: Path | None) -> None:
    """Write an SRDF of the robot in CONFIG.

    It has groups, poses, and links whose collisions need no check.

    Two links need no check if one joint connects them, or if they touch in nearly all or in none of the random
    configurations, as in MoveIt's setup assistant. Links have the names of the URDF or, without a URDF, of the MJCF.
    """
    from ibrobot_kinematics.urdf import read_urdf

    from ibrobot_core.app import find_config, installed_plugins, load_config
    from ibrobot_planning.world.arm import robot_arm
    from ibrobot_planning.world.collision import unchecked_pairs
    from ibrobot_planning.world.semantics import srdf as written
    from ibrobot_planning.world.semantics import urdf_names

    registry = installed_plugins()
    robot = load_config(find_config(config, registry), sim=True, registry=registry).robot
    arm = robot_arm(robot)
    pairs = unchecked_pairs(arm, samples=samples, seed=seed, never=True)
    urdf = robot.description.urdf
    names = {link: link for link in arm.frames} if urdf is None else urdf_names(arm, read_urdf(urdf))
    text = written(robot, pairs, names)
    if output is None:
        echo(text.removesuffix("\n"))
    else:
        output.write_text(text, encoding="utf-8")
