"""Checks of the simulation's options, before a run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ibrobot_core.api import HardwareError, MissingDependency, OptionFault, did_you_mean
from ibrobot_core.app import ConfigError
from ibrobot_mujoco.gl import check_asked
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.parameters import read_parameters

if TYPE_CHECKING:
    from ibrobot_core.api import Robot


def _unusable(options: MujocoOptions, robot: Robot) -> Iterator[OptionFault]:
    """Faults found by MuJoCo: an invalid MJCF, missing joints and actuators, wrong cameras in the options."""
    try:
        check_asked()
    except MissingDependency:
        return  # MuJoCo cannot be imported; a run reports the reason
    # It imports MuJoCo, so do it only if a run would simulate.
    from ibrobot_mujoco.model import build_spec

    try:
        build_spec(options, robot)
    except HardwareError as error:
        yield OptionFault((), " ".join(str(error).split()))


def _wrong_parameters(path: Path, robot: Robot) -> Iterator[OptionFault]:
    """Faults of a file of parameters."""
    try:
        read_parameters(path, robot)
    except ConfigError as error:
        for problem in error.problems:
            yield OptionFault(("parameters",), str(problem))


def check_world(options: MujocoOptions, robot: Robot) -> Iterator[OptionFault]:
    """Check that the robot has an MJCF, and that the parameters, the pose and joints in the options exist."""
    poses = list(robot.description.poses)
    wrong = [] if options.parameters is None else list(_wrong_parameters(options.parameters, robot))
    yield from wrong
    if robot.description.mjcf is None:
        yield OptionFault((), f"robot {robot.name!r} has no MJCF to simulate: set robot.description.mjcf", "mjcf")
    elif wrong:
        pass
    elif robot.description.mjcf.is_file():  # core has reported a missing one
        yield from _unusable(options, robot)
    if options.start_pose not in poses:
        message = f"unknown pose {options.start_pose!r}{did_you_mean(options.start_pose, poses, 'known')}"
        yield OptionFault(("start_pose",), message)
    for i, fault in enumerate(options.faults):
        if fault.joint is not None and fault.joint not in robot.joint_names:
            message = f"unknown joint {fault.joint!r}{did_you_mean(fault.joint, robot.joint_names, 'known')}"
            yield OptionFault(("faults", i, "joint"), message)
