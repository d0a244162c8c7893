"""What `ibrobot doctor` says of ROS, with a fake in its place."""

from __future__ import annotations

import os

import pytest
from ibrobot_ros import installation
from ibrobot_ros.doctor import checks

from . import fake_node


@pytest.fixture
def sourced(tmp_path, monkeypatch):
    """Makes a sourced ROS whose interpreter behaves in some way."""

    def make(behaviour=""):
        (tmp_path / "python3").symlink_to(fake_node.write(tmp_path, behaviour))
        monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
        monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))

    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    return make


def test_ros_and_what_it_lacks_are_named(sourced):
    sourced()
    found, *lacking = checks()
    assert found.ok
    assert found.found == (
        "ROS 2 jazzy with rmw_none, domain 0, discovery localhost, python, rclpy rclpy (the sourced ROS)"
    )
    assert [each.name for each in lacking] == ["ros control_msgs", "ros tf2_msgs", "ros ibrobot_msgs"]
    assert not any(each.ok or each.matters for each in lacking)
    assert lacking[0].remedy == "the actions of executors need it: apt install ros-jazzy-control-msgs"


@pytest.mark.parametrize(("behaviour", "said"), [("missing", "no rclpy"), ("dies", "a library is missing")])
def test_a_broken_ros_is_named(sourced, behaviour, said):
    sourced(behaviour)
    (found,) = checks()
    assert (found.ok, found.matters) == (False, False)
    assert said in found.found
    assert "setup.bash" in found.remedy


def test_no_ros_is_no_fault_of_the_machine(monkeypatch, tmp_path):
    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    monkeypatch.setattr(installation, "DISTROS", tmp_path)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    (found,) = checks()
    assert (found.ok, found.matters, found.found) == (False, False, "no ROS 2 was found")
