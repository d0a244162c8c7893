"""What `ibrobot doctor` says of a real ROS 2."""

from __future__ import annotations

import os
from pathlib import Path

from ibrobot_ros.doctor import checks

from .conftest import PYTHON


def test_a_sourced_ros_is_found(monkeypatch):
    root = Path(PYTHON).absolute().parent.parent
    monkeypatch.setenv("PATH", f"{root / 'bin'}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(root))
    monkeypatch.setenv("LD_LIBRARY_PATH", str(root / "lib"))
    monkeypatch.setenv("ROS_DOMAIN_ID", "3")
    (found,) = checks()
    assert found.ok
    assert "with rmw_fastrtps_cpp, domain 3, discovery localhost" in found.found
    assert "(the sourced ROS)" in found.found
