"""An arm with a tool."""

from __future__ import annotations

import attrs
import pytest
from ibrobot_testing import make_robot

from ibrobot_core.api import Description, Joint, Robot

AXES = {
    "shoulder_pan": "0 0 1",
    "shoulder_lift": "0 1 0",
    "elbow_flex": "0 1 0",
    "wrist_flex": "0 1 0",
    "wrist_roll": "1 0 0",
    "gripper": "0 0 1",
}
PLACES = ("0 0 0.05", "0 0 0.05", "0.15 0 0", "0.15 0 0", "0.05 0 0", "0.03 0.01 0")


@pytest.fixture(scope="session")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """An arm with the joints of `make_robot`; its tool points along the arm."""
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    bodies = ""
    for (name, axis), place in zip(AXES.items(), PLACES, strict=True):
        bodies += f'<body pos="{place}"><joint name="{name}" axis="{axis}"/><geom size="0.01"/>'
        if name == "wrist_roll":
            bodies += '<site name="tool" pos="0.08 0 0" xyaxes="0 0 -1 0 1 0"/>'
    path.write_text(f"<mujoco><worldbody>{bodies}{'</body>' * len(AXES)}</worldbody></mujoco>")
    joints = tuple(Joint(name, -1.6, 1.6, max_velocity=3.0, max_acceleration=20.0) for name in AXES)
    return attrs.evolve(make_robot(), joints=joints, description=Description(mjcf=path, tip="tool"))
