"""A folder for the page's certificate that is not the user's, and an arm with a model."""

from __future__ import annotations

from pathlib import Path

import pytest

AXES = {
    "shoulder_pan": "0 0 1",
    "shoulder_lift": "0 1 0",
    "elbow_flex": "0 1 0",
    "wrist_flex": "0 1 0",
    "wrist_roll": "1 0 0",
    "gripper": "0 0 1",
}
_PLACES = ("0 0 0.05", "0 0 0.05", "0.15 0 0", "0.15 0 0", "0.05 0 0", "0.03 0.01 0")


@pytest.fixture(autouse=True)
def own_folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path_factory.getbasetemp() / "config"
    monkeypatch.setenv("XDG_CONFIG_HOME", str(folder))  # one certificate for all tests


@pytest.fixture(scope="session")
def mjcf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An arm with the joints of `make_robot`; its tool points along the arm."""
    path: Path = tmp_path_factory.mktemp("arm") / "arm.xml"
    bodies = ""
    for (name, axis), place in zip(AXES.items(), _PLACES, strict=True):
        bodies += f'<body pos="{place}"><joint name="{name}" axis="{axis}"/><geom size="0.01"/>'
        if name == "wrist_roll":
            bodies += '<site name="tool" pos="0.08 0 0" xyaxes="0 0 -1 0 1 0"/>'
    path.write_text(f"<mujoco><worldbody>{bodies}{'</body>' * len(AXES)}</worldbody></mujoco>")
    return path
