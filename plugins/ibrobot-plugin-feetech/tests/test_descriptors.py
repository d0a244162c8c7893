"""What the descriptors say."""

from __future__ import annotations

import attrs
import ibrobot_feetech
import pytest
from ibrobot_feetech.options import EmulatedSignalOptions, FollowerOptions, LeaderOptions
from ibrobot_testing import check_descriptor, make_robot


def test_the_followers_descriptor_says_calibration_and_anchored_joints() -> None:
    (descriptor,) = ibrobot_feetech.ibrobot_hardware()
    options = FollowerOptions(port="/dev/null", calibration="left", anchored=("gripper",))
    check_descriptor(descriptor, options)
    assert (options.calibration, options.anchored) == ("left", ("gripper",))


def test_the_emulators_signal_gives_no_pictures() -> None:
    (descriptor,) = ibrobot_feetech.ibrobot_sensors()
    options = EmulatedSignalOptions(socket="/tmp/arm", signal="/scene")
    check_descriptor(descriptor, options)
    assert options.picture is None


def test_the_leaders_descriptor() -> None:
    (descriptor,) = ibrobot_feetech.ibrobot_teleop()
    check_descriptor(descriptor, LeaderOptions(port="/dev/null", calibration="leader"))


def test_a_robot_without_a_gripper_gets_no_fault_about_an_option_that_nobody_wrote() -> None:
    robot = make_robot().part("arm")
    options = FollowerOptions(port="/dev/ttyACM0", calibration="arm")
    assert list(options.check(robot, robot.joint_names)) == []
    [fault] = attrs.evolve(options, gentle=("hand",)).check(robot, robot.joint_names)
    assert fault.option == ("gentle", 0)


def test_an_empty_port_is_refused() -> None:
    with pytest.raises(ValueError, match=r"is empty; give the serial port, e\.g\. /dev/ttyACM0"):
        FollowerOptions(port=" ", calibration="arm")
