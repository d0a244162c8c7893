"""A small fake of LeRobot on the path of this process and of device processes."""

from __future__ import annotations

import json
import os
import shutil
from importlib import invalidate_caches
from pathlib import Path
from typing import Any

import attrs
import pytest
from ibrobot_lerobot_devices import camera, hardware, teleop

FAKE = Path(__file__).parent / "fake"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
PATIENCE_S = 20.0
"""A busy machine may keep the device process from answering."""


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with LeRobot."""
    folder = tmp_path_factory.mktemp("lerobot") / "site"
    shutil.copytree(FAKE, folder)
    install(folder, "lerobot", "0.6.1")
    return folder


@pytest.fixture(autouse=True)
def lerobot(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for packages that add to LeRobot, on the path after it."""
    added = tmp_path / "added"
    added.mkdir()
    for folder in (added, site):
        monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), str(added), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("XDG_CACHE_HOME", str(site.parent))
    return added


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tick waits for its reading, however busy the machine is."""
    monkeypatch.setattr(hardware, "_WAIT", PATIENCE_S * 100)
    monkeypatch.setattr(hardware, "_RELAX_S", PATIENCE_S)
    monkeypatch.setattr(hardware, "_RECONNECT_S", PATIENCE_S)


def install(folder: Path, name: str, version: str = "1.0") -> None:
    """Metadata of a distribution, whose modules are in `folder`."""
    metadata = folder / f"{name}-{version}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    invalidate_caches()


def install_package(folder: Path, name: str) -> None:
    """A package of others, from the folder `packages` here, that adds to LeRobot."""
    shutil.copy(FAKE.parent / "packages" / f"{name}.py", folder)
    install(folder, name)


@pytest.fixture
def ageless(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stepped clock, the real age of an answer would be one of another clock."""
    for module in (camera, teleop):
        monkeypatch.setattr(module, "age_ns", lambda answer: 0)
    monkeypatch.setattr(teleop, "_WAIT_S", PATIENCE_S)


@attrs.frozen
class Motors:
    """The motors of a fake arm, at a port of theirs."""

    port: Path

    @classmethod
    def at(cls, port: Path) -> Motors:
        """New motors, with the torque off."""
        port.write_text(json.dumps({"torque": False, "positions": dict.fromkeys(JOINTS, 5.0) | {"gripper": 40.0}}))
        return cls(port)

    @property
    def content(self) -> dict[str, Any]:
        """Torque and positions."""
        found: dict[str, Any] = json.loads(self.port.read_text())
        return found

    def move(self, **positions: float) -> None:
        """Move joints by hand, in LeRobot's units."""
        partial = self.port.with_suffix(".moved")
        partial.write_text(json.dumps({"torque": False, "positions": self.content["positions"] | positions}))
        partial.rename(self.port)

    def suffer(self, what: str) -> None:
        """Have a fault, or none."""
        partial = self.port.with_suffix(".new")
        partial.write_text(what)
        partial.rename(self.port.with_suffix(".fault"))


@pytest.fixture
def motors(tmp_path: Path) -> Motors:
    return Motors.at(tmp_path / "port")
