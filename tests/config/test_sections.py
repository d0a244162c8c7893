"""Sections that plugins add to the robot YAML."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import attrs
import pytest
import yaml

from ibrobot_core.api import Options
from ibrobot_core.config import RobotConfig
from ibrobot_core.config.show import to_yaml
from ibrobot_core.descriptors import SectionDescriptor
from ibrobot_core.errors import ConfigError
from ibrobot_core.options import OptionFault, option
from ibrobot_core.plugins import Entry, Failure, Registry
from ibrobot_core.robot import Robot

Load = Callable[..., RobotConfig]


@attrs.frozen
class Box:
    """A box of the world."""

    size: tuple[float, float, float] = option(unit="m", help="edges")


@attrs.frozen
class WorldOptions(Options):
    """What is around the robot."""

    table: bool = option(True, help="whether there is a table")
    padding: float = option(0.005, unit="m", ge=0, help="distance to keep")
    boxes: dict[str, Box] = option(factory=dict, help="boxes by name")
    tip: str = option("pan", help="the joint that carries the tool")
    code: str = option("", secret=True, help="opens the map server")

    def __attrs_post_init__(self) -> None:
        if self.table and self.padding > 1:
            raise ValueError("a table does not go with a padding above 1 m")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        if self.tip not in robot.joint_names:
            yield OptionFault(("tip",), f"no joint {self.tip!r}")


def _make(options: object, session: object) -> Any:
    raise AssertionError("checking a config makes nothing")


@pytest.fixture(autouse=True)
def world(registry: Registry) -> None:
    section = SectionDescriptor("around", "what is around the robot", WorldOptions, make=_make)
    registry.entries["section", "around"] = Entry("section", section, "fake", "ibrobot-plugin-fake", "1.0")


def faults(load_text: Load, text: str, **options: Any) -> str:
    with pytest.raises(ConfigError) as message:
        load_text(text, **options)
    return str(message.value)


def test_options_of_a_section_are_loaded(load_text: Load, base: str) -> None:
    config = load_text(base + "around: {padding: 0.01, boxes: {shelf: {size: [1, 2, 3]}}}\n")
    assert config.plugin_sections["around"].options == WorldOptions(padding=0.01, boxes={"shelf": Box((1.0, 2.0, 3.0))})


@pytest.mark.parametrize("text", ["", "around:\n", "around: null\n"])
def test_a_file_may_lack_the_section(load_text: Load, base: str, text: str) -> None:
    assert load_text(base + text).plugin_sections == {}


def test_an_override_reaches_into_the_section(load_text: Load, base: str) -> None:
    config = load_text(base, overrides=["around.padding=0.02"])
    assert config.plugin_sections["around"].options.padding == 0.02


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("{padding: -1}", ": around.padding: -1.0 is too small, must be at least 0 m"),
        ("{padding: wide}", ": around.padding: expected a number, got 'wide'"),
        ("{paddign: 1}", ": around.paddign: unknown key, did you mean 'padding'?"),
        ("{type: around}", ": around.type: unknown key; known keys: table, padding, boxes, tip, code"),
        ("{boxes: {shelf: {size: [1, 2]}}}", ": around.boxes.shelf.size: expected a list of 3 values, got 2"),
        ("{boxes: {shelf: {}}}", ": around.boxes.shelf.size: required key is missing"),
        ("{padding: 2}", ": around: a table does not go with a padding above 1 m"),
        ("{tip: tail}", ": around.tip: no joint 'tail'"),
        ("[1]", ": around: expected a mapping, got a list"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(load_text: Load, base: str, text: str, fault: str) -> None:
    line = base.count("\n") + 1
    assert faults(load_text, f"{base}around: {text}\n") == f"robot.yaml:{line}{fault}"


def test_a_section_that_no_plugin_has_is_an_unknown_key(load_text: Load, base: str) -> None:
    assert "arround: unknown key, did you mean 'around'?" in faults(load_text, base + "arround: {}\n")


def test_a_section_named_like_one_of_core_is_refused(load_text: Load, base: str, registry: Registry) -> None:
    registry.entries["section", "executors"] = registry.entries.pop(("section", "around"))
    assert faults(load_text, base) == (
        "robot.yaml:17: executors: ibrobot-plugin-fake adds a section of this name, which is one of ibrobot's own: "
        "rename it there, or uninstall that package"
    )


def test_broken_plugins_are_named_beside_an_unknown_section(load_text: Load, base: str, registry: Registry) -> None:
    registry.failures.append(Failure("fake_maps", "fake-maps", "import", "ImportError: no maps"))
    message = faults(load_text, base + "maps: {}\n")
    assert "maps: unknown key" in message
    assert "plugin 'fake_maps' (fake-maps) failed to import: ImportError: no maps" in message


def test_a_secret_of_a_section_is_not_shown(load_text: Load, base: str) -> None:
    config = load_text(base + "around: {code: abc123}\n")
    assert config.plugin_sections["around"].options.code == "abc123"
    assert config.document["around"]["code"] == "***"
    assert "abc123" not in to_yaml(config)


def test_config_show_has_the_section_with_its_defaults(load_text: Load, base: str) -> None:
    shown = to_yaml(load_text(base + "around: {padding: 0.01}\n"))
    assert yaml.safe_load(shown)["around"] == {"table": True, "padding": 0.01, "boxes": {}, "tip": "pan", "code": "***"}
