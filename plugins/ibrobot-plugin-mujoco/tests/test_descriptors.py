"""What the descriptors say."""

from __future__ import annotations

import ibrobot_mujoco
from ibrobot_mujoco.options import CameraOptions, MujocoOptions
from ibrobot_testing import check_descriptor


def test_the_simulation_needs_no_calibration() -> None:
    (descriptor,) = ibrobot_mujoco.ibrobot_hardware()
    check_descriptor(descriptor, MujocoOptions())
    assert MujocoOptions().calibration is None


def test_the_size_of_pictures_is_height_and_width() -> None:
    (descriptor,) = ibrobot_mujoco.ibrobot_sensors()
    options = CameraOptions(width=64, height=48)
    check_descriptor(descriptor, options)
    assert options.picture == (48, 64)
