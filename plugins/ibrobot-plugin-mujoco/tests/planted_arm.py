"""A simulated arm with planted parameters, and recordings of it."""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.identification.recordings import Recording
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.parameters import ArmParameters, as_yaml, read_parameters
from ibrobot_mujoco.scenes import scene
from ibrobot_mujoco.so101 import so101
from ibrobot_testing import control_context

from ibrobot_core.api import EpisodeSetup, Vector, resolve_path

ROBOT = so101()
TICK_NS = 10_000_000
STEP_S = 0.005
"""Of the physics, so that tests are short."""
PUBLISHED = read_parameters(resolve_path("package://ibrobot_mujoco/servos/so101_sts3215.yaml", Path()), ROBOT)
MIDDLE = (0.0, -0.6, 0.2, 0.0, 0.0, 0.6)
"""About where the arm moves [rad], clear of the table."""
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


def moves(seconds: float, seed: int = 0, reach: float = 0.45) -> Vector:
    """Commands above the table that show everything: fast and slow, wide and small, with pauses, shape (N, 6)."""
    rng = np.random.default_rng(seed)
    count = round(seconds * 1e9 / TICK_NS)
    columns = []
    for joint in range(6):
        middle = MIDDLE[joint]
        here, row = 0.0, list[float]()
        while len(row) < count:
            is_small = rng.random() < 0.35
            there = here + rng.choice((-1, 1)) * 0.05 if is_small else middle + rng.uniform(-reach, reach)
            steps = max(8, round(abs(there - here) / rng.choice((0.15, 0.6, 2.5)) * 100))
            share = np.linspace(0, 1, steps)
            row += list(here + (there - here) * share * share * (3 - 2 * share))
            row += [there] * int(rng.integers(5, 60))
            here = there
        columns.append(row[:count])
    return np.array(columns).T


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
