"""The section's options: which ones are refused, and with what words."""

from __future__ import annotations

import pytest
from ibrobot_ros.options import RosOptions


def test_by_default_only_this_machine_is_reached():
    options = RosOptions()
    assert options.discovery == "localhost"
    assert (options.publish, options.services, options.actions) == ("all", "all", True)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"namespace": "a-b"}, "not a ROS 2 name"),
        ({"publish": "some"}, "must be all, or a list"),
        ({"publish": ("joint_states",)}, "not a full ROS 2 name"),
        ({"services": ("/a b",)}, "not a full ROS 2 name"),
        ({"subscribe": {"/lamp": "std_msgs/msg/Boole"}}, "did you mean 'std_msgs/msg/Bool'"),
        ({"subscribe": {"lamp": "std_msgs/msg/Bool"}}, "not a full ROS 2 name"),
        ({"qos": {"/lamp": "sensors"}}, "unknown profile 'sensors'"),
        ({"discovery": "everywhere"}, "is not one of: localhost, subnet"),
        ({"domain": 500}, "at most 232"),
    ],
)
def test_wrong_options_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        RosOptions(**given)
