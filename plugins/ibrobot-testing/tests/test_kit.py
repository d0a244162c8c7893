"""`ibrobot plugins new` writes packages that work: each is tested, checked and run as its author would do."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest
from ibrobot_kit.new import FAKES, NewPlugin, render
from ibrobot_testing import ibrobot_command

from ibrobot_core.api import Descriptor
from ibrobot_core.app import RequestError, installed_plugins, load_config


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a package of each kind, as installed by `pip install -e`."""
    folder = tmp_path_factory.mktemp("packages")
    for kind in FAKES:
        made = Path(NewPlugin(kind, f"my_{kind}", folder)()["folder"])
        metadata = made / f"ibrobot_my_{kind}-0.1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {made.name}\nVersion: 0.1.0\n")
        (metadata / "entry_points.txt").write_text(f"[ibrobot]\nmy_{kind} = ibrobot_my_{kind}\n")
    return folder


def places(packages: Path) -> list[str]:
    return [str(path) for path in sorted(packages.iterdir())]


def environment(packages: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join(places(packages))}


def test_tests_of_new_packages_pass(packages: Path) -> None:
    tests = [str(path) for path in sorted(packages.glob("*/tests"))]
    assert len(tests) == len(FAKES)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--import-mode=importlib", *tests]
    done = subprocess.run(command, cwd=packages, env=environment(packages), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_new_packages_are_discovered_without_mistakes_and_their_robots_are_right(
    packages: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for place in places(packages):
        monkeypatch.syspath_prepend(place)
    installed_plugins.cache_clear()
    registry = installed_plugins()
    installed_plugins.cache_clear()
    assert registry.failures == []
    for kind in FAKES:
        descriptor = registry.find("sensor" if kind == "camera" else kind, f"my_{kind}")
        assert isinstance(descriptor, Descriptor)
        assert descriptor.summary
        (robot,) = packages.glob(f"*/my_{kind}.yaml")
        for sim in (False, True):
            assert load_config(robot, sim=sim, registry=registry).robot.name == "tryout"


@pytest.mark.parametrize(
    "kind",
    [kind if kind == "engine" else pytest.param(kind, marks=pytest.mark.long) for kind in FAKES],
)
def test_robot_of_a_new_package_runs(packages: Path, kind: str) -> None:
    (robot,) = packages.glob(f"*/my_{kind}.yaml")
    command = [*ibrobot_command(), "launch", str(robot), "--sim", "--lockstep", "--headless", "--duration", "1"]
    done = subprocess.run(command, env=environment(packages), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "faults     none" in done.stdout


@pytest.mark.parametrize("kind", FAKES)
def test_every_name_in_a_new_package_is_defined_or_imported(kind: str) -> None:
    """A class that is cut out of its module brings what it needs, and nothing of the fakes is left."""
    for path, text in render(kind, "odd_one").items():
        assert "Fake" not in text.replace("FakeArm", ""), path
        if path.endswith(".py"):
            tree = ast.parse(text)
            statements = (node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom | ast.Import))
            imported = {alias.asname or alias.name for node in statements for alias in node.names}
            used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
            assert imported - {"annotations"} <= used, path


@pytest.mark.parametrize("name", ["", "My_arm", "my-arm", "1st", "my arm", "../up", "ärm"])
def test_name_that_no_module_can_have_is_an_error(tmp_path: Path, name: str) -> None:
    with pytest.raises(RequestError, match=r"NAME is .*: use lower-case letters, digits and _, e.g. my_arm"):
        NewPlugin("teleop", name, tmp_path)()
    assert list(tmp_path.iterdir()) == []


def test_folder_that_exists_is_left_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "ibrobot-plugin-wave").mkdir()
    (tmp_path / "ibrobot-plugin-wave/mine.py").write_text("mine")
    with pytest.raises(RequestError, match="ibrobot-plugin-wave exists; choose another name, or move it away"):
        NewPlugin("teleop", "wave", tmp_path)()
    assert [path.name for path in (tmp_path / "ibrobot-plugin-wave").iterdir()] == ["mine.py"]
