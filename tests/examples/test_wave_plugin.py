"""The example of the tutorial: it is found, described and made as any plugin, and the pages show it as it is."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from ibrobot_testing import host_context

from ibrobot_core.plugins import discover

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

EXAMPLE = Path(__file__).parent / "ibrobot-plugin-wave"
ROOT = Path(__file__).parents[2]


def test_it_is_found_through_its_entry_point(site: Site) -> None:
    site.add("ibrobot-plugin-wave", EXAMPLE / "ibrobot_wave/__init__.py")
    registry = discover(site.entry_points())
    assert registry.failures == []
    descriptor = registry.find("teleop", "wave")
    assert descriptor.summary == "waves with one joint"
    teleop = descriptor.make(descriptor.options(joint="gripper"), host_context())
    teleop.connect()
    teleop.disconnect()


def test_options_are_checked() -> None:
    from ibrobot_wave import WaveOptions

    with pytest.raises(ValueError, match="3 is too large, must be at most 1 rad"):
        WaveOptions(amplitude=3)


def test_pyproject_names_the_module() -> None:
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["ibrobot"] == {"wave": "ibrobot_wave"}


def test_readme_shows_the_plugin_as_it_is() -> None:
    assert (EXAMPLE / "ibrobot_wave/__init__.py").read_text().strip() in (ROOT / "README.md").read_text()
