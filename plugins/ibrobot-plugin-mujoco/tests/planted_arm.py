"""A simulated arm with planted parameters, and recordings of it."""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np
from arm_moves import TICK_NS
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.identification.recordings import Recording
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.parameters import ArmParameters, as_yaml, read_parameters
from ibrobot_mujoco.scenes import scene
from ibrobot_mujoco.so101 import so101
from ibrobot_testing import control_context

from ibrobot_core.api import EpisodeSetup, Vector, resolve_path

ROBOT = so101()
STEP_S = 0.005
"""Of the physics, so that tests are short."""
PUBLISHED = read_parameters(resolve_path("package://ibrobot_mujoco/servos/so101_sts3215.yaml", Path()), ROBOT)
TICK_RAD = 2 * np.pi / 4096
"""Resolution of an STS3215's encoder [rad]."""


def planted(
    delay: float = 0.0, /, *, every: dict[str, float] | None = None, **joints: dict[str, float]
) -> ArmParameters:
    """The published servo with changes of all joints, and of some."""
    changed = {
        name: attrs.evolve(each, **{**(every or {}), **joints.get(name, {})}) for name, each in PUBLISHED.joints.items()
    }
    return attrs.evolve(PUBLISHED, delay=delay, joints=changed)


def simulated(parameters: ArmParameters, folder: Path, **more: object) -> MujocoHardware:
    """The arm as the simulation makes it from a file."""
    file = folder / "planted.yaml"
    file.write_text(as_yaml(parameters), encoding="utf-8")
    options = MujocoOptions(parameters=file, scene=scene("empty"), start_pose="home", timestep=STEP_S, **more)  # type: ignore[arg-type]
    hardware = MujocoHardware(options, control_context("sim", robot=ROBOT, period_ns=TICK_NS))
    hardware.connect()
    hardware.reset(EpisodeSetup(0))
    return hardware


def recorded(hardware: MujocoHardware, commands: Vector, name: str = "planted", encoder: float = TICK_RAD) -> Recording:
    """What a recording of these commands says; positions have the resolution of the encoder [rad]."""
    measured = []
    for command in commands:
        measured.append(hardware.read().position)
        hardware.write(command)
        hardware.advance(TICK_NS)
    times = np.arange(len(commands)) * TICK_NS / 1e9
    positions = np.stack(measured)
    if encoder:
        positions = np.round(positions / encoder) * encoder
    return Recording(name, times, commands, times, positions)
