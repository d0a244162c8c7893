"""What a robot YAML says of its table, and of the world of a base, compared with the robot."""

from __future__ import annotations

from collections.abc import Iterator

from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.mjcf import read_mjcf

from ibrobot_core.api import OptionFault
from ibrobot_core.app import RobotConfig
from ibrobot_planning.guard.options import ClearanceGuardOptions
from ibrobot_planning.planners.options import GoalCheckOptions, RrtConnectOptions

type Key = tuple[str | int, ...]


def faults(config: RobotConfig) -> Iterator[OptionFault]:
    """A table above the arm's first joint, and clouds around a base that drives, each with its key in the YAML."""
    heights = dict(floors(config))
    highest = max(heights.values(), default=0.0)
    if highest > 0 and (first := _first_joint(config)) is not None:
        for key, height in heights.items():
            if height > first:
                yield OptionFault(
                    key,
                    f"a table at {height:g} m is above the arm's first joint, which is at {first:.3g} m: give the"
                    " height of its top in the base frame, e.g. 0.0 for an arm that stands on it",
                )
    guard, world = config.control.guard, config.plugin_sections.get("world")
    if guard is not None and isinstance(guard.options, ClearanceGuardOptions) and guard.options.base is not None:
        for name in world.options.clouds if world is not None else ():
            yield OptionFault(
                ("world", "clouds", name),
                "clouds are in the frame of the base, which drives: leave it out, and list the objects around it",
            )


def floors(config: RobotConfig) -> Iterator[tuple[Key, float]]:
    """Heights of the table that a YAML states, each with its key [m]."""
    heights: list[tuple[Key, float | None]] = [(("robot", "description", "floor"), config.robot.description.floor)]
    stated: list[tuple[Key, object]] = [
        (("goals",), goals.options if (goals := config.plugin_sections.get("goals")) is not None else None)
    ]
    for name, mode in config.control_modes.items():
        stated.append((("control_modes", name, "planner"), None if mode.planner is None else mode.planner.options))
    for key, options in stated:
        if isinstance(options, GoalCheckOptions | RrtConnectOptions):
            heights.append(((*key, "floor"), options.floor))
    guard = config.control.guard
    if guard is not None and isinstance(guard.options, ClearanceGuardOptions):
        known = [height for _, height in heights]
        # A guard that the YAML does not mention has that of another key.
        heights += [(("control", "guard", "floor"), guard.options.floor)] if guard.options.floor not in known else []
    yield from ((key, height) for key, height in heights if height is not None)


def _first_joint(config: RobotConfig) -> float | None:
    """Height of the lowest joint that no other one moves, in the base frame [m]; None without a model that can be read.

    Several arms stand on one table: the lowest counts.
    """
    description = config.robot.description
    if description.mjcf is None:
        return None
    arms = description.arms or {"": (0.0, 0.0, 0.0, 0.0)}
    heights = []
    for prefix, (_, _, z, _) in arms.items():
        names = [n.removeprefix(prefix) for n in config.robot.joint_names if description.arm_of(n) == prefix]
        try:
            mjcf = read_mjcf(description.mjcf)
            tree = mjcf.tree(mjcf.skeleton, names)
        except KinematicsError:
            return None  # its own check says so
        heights += [z + float(joint.placement[2, 3]) for joint in tree.joints if joint.parent < 0]
    return min(heights, default=None)
