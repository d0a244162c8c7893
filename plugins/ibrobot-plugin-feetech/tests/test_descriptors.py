"""What the descriptors say."""

from __future__ import annotations

import ibrobot_feetech
from ibrobot_feetech.options import EmulatedSignalOptions, FollowerOptions, LeaderOptions
from ibrobot_testing import check_descriptor


def test_the_followers_descriptor_says_calibration_and_anchored_joints() -> None:
    (descriptor,) = ibrobot_feetech.ibrobot_hardware()
    options = FollowerOptions(port="/dev/null", calibration="left", anchored=("gripper",))
    check_descriptor(descriptor, options)
    assert (descriptor.calibration(options), descriptor.anchored(options)) == ("left", ("gripper",))


def test_the_emulators_signal_gives_no_pictures() -> None:
    (descriptor,) = ibrobot_feetech.ibrobot_sensors()
    options = EmulatedSignalOptions(socket="/tmp/arm", signal="/scene")
    check_descriptor(descriptor, options)
    assert descriptor.picture(options) is None


def test_the_leaders_descriptor() -> None:
    (descriptor,) = ibrobot_feetech.ibrobot_teleop()
    check_descriptor(descriptor, LeaderOptions(port="/dev/null", calibration="leader"))
