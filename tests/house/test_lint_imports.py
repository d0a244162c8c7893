"""The contracts on imports cover every package under plugins/, whatever is added."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from lint_imports import ROOT, contracts

ONE_ANOTHER = "Plugins do not import one another"
LIBRARIES = "The libraries that plugins share do not import one another"
PACKAGES = (
    ("ibrobot-plugin-lamp", "ibrobot_lamp"),
    ("lerobot-lamp-ibrobot", "lerobot_lamp_ibrobot"),
    ("ibrobot-light", "ibrobot_light"),
)
THROUGH = "Plugins and libraries import core through ibrobot_core.api and ibrobot_core.app alone"


def read(plugins: Path) -> tuple[set[str], dict[str, dict[str, Any]]]:
    """Root packages, and contracts by name."""
    linter = tomllib.loads(contracts(plugins))["tool"]["importlinter"]
    return set(linter["root_packages"]), {each["name"]: each for each in linter["contracts"]}


def test_every_package_here_is_covered() -> None:
    roots, by_name = read(ROOT / "plugins")
    distributions = {path.parent for path in (ROOT / "plugins").glob("*/pyproject.toml")} - {ROOT / "plugins/ibrobot"}
    second = {"ibrobot_kit", "ibrobot_sensor_messages"}
    assert len(roots - second) == len(distributions) + 1, "core too"
    assert set(by_name[THROUGH]["source_modules"]) == roots - {"ibrobot_core"}
    assert {"ibrobot_kinematics", "ibrobot_ros2"} <= set(by_name[LIBRARIES]["modules"])
    assert "ibrobot_testing" not in by_name[LIBRARIES]["modules"]


def test_new_plugin_and_new_library_are_covered_without_an_edit(tmp_path: Path) -> None:
    for distribution, package in PACKAGES:
        (tmp_path / distribution / package).mkdir(parents=True)
        (tmp_path / distribution / package / "__init__.py").touch()
    roots, by_name = read(tmp_path)
    assert {package for _, package in PACKAGES} <= roots
    assert by_name[ONE_ANOTHER]["modules"] == ["ibrobot_lamp", "lerobot_lamp_ibrobot"]
    assert by_name[LIBRARIES]["modules"] == ["ibrobot_light"]
    assert by_name[THROUGH]["source_modules"] == [
        "ibrobot_lamp",
        "lerobot_lamp_ibrobot",
        "ibrobot_light",
        "ibrobot_testing",
    ]
