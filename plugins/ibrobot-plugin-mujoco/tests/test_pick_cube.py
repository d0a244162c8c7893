"""Scene `pick_cube`: where the cube begins, and when it counts as put into the bin."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_mujoco.model import build_world
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.scenes import scene
from ibrobot_mujoco.scenes.options import PickCubeOptions
from ibrobot_mujoco.scenes.table import CLEARANCE
from ibrobot_mujoco.so101 import so101

from ibrobot_core.api import HardwareError, Vector

ROBOT = so101()
REST = ROBOT.pose("rest")


class Table:
    """The scene at rest, with the arm in its rest pose."""

    def __init__(self, **options: Any) -> None:
        self.world, self.task = build_world(MujocoOptions(scene=scene(**options)), ROBOT, visual=False)
        self.model, self.physics = self.world.model, self.world.data
        self.pose_arm(REST)

    def place(self, rng: np.random.Generator) -> None:
        self.task.begin(self.world, rng)

    def pose_arm(self, positions: Vector) -> None:
        self.physics.qpos[:6] = positions
        mujoco.mj_forward(self.model, self.physics)

    def put_cube(self, x: float, y: float, z: float, speed: float = 0.0) -> None:
        self.physics.joint("cube").qpos[:] = [x, y, z, 1, 0, 0, 0]
        self.physics.joint("cube").qvel[:] = [0, 0, speed, 0, 0, 0]
        mujoco.mj_forward(self.model, self.physics)

    def success(self) -> bool:
        return bool(self.task.success(self.world))


@pytest.fixture(scope="module")
def table() -> Table:
    return Table()


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_cube_begins_within_its_ranges_and_clear_of_everything(table: Table, seed: int) -> None:
    options = PickCubeOptions()
    table.place(np.random.default_rng(seed))
    x, y, z, w, *axis, last = table.physics.joint("cube").qpos
    assert options.cube_distance[0] <= math.hypot(x, y) <= options.cube_distance[1]
    assert options.cube_bearing[0] <= math.atan2(y, x) <= options.cube_bearing[1]
    assert z == 0.0125
    assert axis == [0, 0]
    assert w**2 + last**2 == pytest.approx(1)
    assert max(abs(x - 0.10), abs(y - 0.24)) > 0.055 + CLEARANCE, "the cube is in the bin"
    mujoco.mj_forward(table.model, table.physics)
    touching = {table.model.geom(int(g)).name for g in table.physics.contact.geom.ravel()}
    assert touching <= {"table", "cube"}


def test_poses_cover_their_ranges(table: Table) -> None:
    rng = np.random.default_rng(0)
    places = []
    for _ in range(200):
        table.place(rng)
        places.append(table.physics.joint("cube").qpos.copy())
    bearings = np.arctan2(*np.stack(places)[:, 1::-1].T)
    assert bearings.min() < -0.6
    assert bearings.max() > 0.4


def test_cube_is_never_put_into_the_bin_or_under_the_arm() -> None:
    everywhere = Table(cube_distance=(0.1, 0.35), cube_bearing=(-0.5, 1.5))
    rng = np.random.default_rng(0)
    for _ in range(100):
        everywhere.place(rng)
        x, y, _ = everywhere.physics.joint("cube").qpos[:3]
        assert max(abs(x - 0.10), abs(y - 0.24)) > 0.055 + CLEARANCE
        mujoco.mj_forward(everywhere.model, everywhere.physics)
        touching = {everywhere.model.geom(int(g)).name for g in everywhere.physics.contact.geom.ravel()}
        assert touching <= {"table", "cube"}


def test_no_place_for_the_cube_is_an_error() -> None:
    full = Table(cube_distance=(0.0, 0.01))
    with pytest.raises(HardwareError, match=r"no place for the cube 0.03 m clear .* cube_distance \[0.0, 0.01\]"):
        full.place(np.random.default_rng(0))


@pytest.mark.parametrize(
    ("position", "speed", "expected"),
    [
        ((0.10, 0.24, 0.017), 0.0, True),
        ((0.14, 0.20, 0.020), 0.0, True),
        ((0.10, 0.24, 0.017), 0.2, False),
        ((0.10, 0.24, 0.060), 0.0, False),
        ((0.10, 0.31, 0.017), 0.0, False),
        ((0.17, 0.24, 0.017), 0.0, False),
        ((0.25, 0.00, 0.0125), 0.0, False),
    ],
    ids=["middle", "corner", "moving", "above the rim", "beside in y", "beside in x", "on the table"],
)
def test_success_is_a_cube_lying_in_the_bin(
    table: Table, position: tuple[float, float, float], speed: float, expected: bool
) -> None:
    table.pose_arm(REST)
    table.put_cube(*table.physics.site("gripperframe").xpos)
    assert not table.success(), "the hand holds it"
    table.put_cube(*position, speed)
    assert table.success() is expected


def test_success_needs_the_gripper_to_let_go() -> None:
    # The bin stands under the resting arm, whose jaws reach into it.
    table = Table(bin_position=(0.212, 0.0))
    tip = table.physics.site("gripperframe").xpos.copy()
    table.put_cube(*tip)
    assert not table.success()
    table.pose_arm(ROBOT.pose("home"))
    assert table.success()
