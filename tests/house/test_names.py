"""Core names no plugin: what it says of them comes from descriptors, or from `official_plugins.json`, which is data."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import pytest

from ibrobot_core.errors import EXTRAS
from ibrobot_core.plugins import KINDS, OFFICIAL, RECORDS, example_type, official_plugins

CORE = OFFICIAL.parent
ORDINARY = {"calibrated", "gripper", "imu", "joint", "keyboard", "panel", "process", "processes", "trajectory", "twist"}
ORDINARY |= {"drawer", "empty", "handover", "push", "sort", "stack"}
"""Types that are words of the language too: they count where a YAML would name them, as in `type: WORD`."""
TYPED = {*KINDS, "planner", "pool", "scene"} - {"section", "source"}


def patterns() -> Iterator[str]:
    """Regular expressions of what core must not say."""
    for package, offers in official_plugins().items():
        name = package.removeprefix("ibrobot-plugin-")
        yield rf"\b(ibrobot-plugin-{name}|ibrobot_{name})\b"
        yield from (rf"\bibrobot {command}\b" for command in offers.get("command", ()))
        yield from (rf"\b{section}: \{{|plugin_sections\[.{section}.\]" for section in offers.get("section", ()))
        for type_ in (type_ for kind in offers if kind in TYPED for type_ in offers[kind]):
            yield rf"\b(type|execution_mode): {type_}\b" if type_ in ORDINARY else rf"\b{type_}\b"


def named(text: str, file: str = "") -> list[str]:
    """Line number and line of everything in a source text that names a plugin."""
    forbidden = re.compile("|".join(patterns()))
    lines = enumerate(text.splitlines(), start=1)
    return [f"{file}:{n}: {line.strip()}" for n, line in lines if forbidden.search(line)]


def test_core_names_no_plugin() -> None:
    files = sorted(CORE.rglob("*.py"))
    assert len(files) > 100
    found = [line for path in files for line in named(path.read_text(encoding="utf-8"), str(path.relative_to(CORE)))]
    assert found == []


@pytest.mark.parametrize(
    "line",
    [
        'DEFAULT = "recording={type: mcap}"',
        "# as scripted_pick does",
        "pip install ibrobot-plugin-zenoh",
        "import ibrobot_feetech",
        "teleoperation: {jog: {type: keyboard}}",
        "see `ibrobot episodes verify`",
        'config.plugin_sections["metrics"]',
    ],
)
def test_a_plugin_named_in_core_is_found(line: str) -> None:
    assert named(f"first = 1\n{line}") == [f":2: {line}"]


def test_examples_in_messages_are_default_types() -> None:
    kinds = [kind for offers in official_plugins().values() for kind in offers.get("default", ())]
    assert sorted(kinds) == ["dataset", "hardware", "pool", "recorder", "terminal", "transport", "units", "viewer"]
    for kind in kinds:
        assert any(example_type(kind) in offers.get(kind, ()) for offers in official_plugins().values())


@pytest.mark.integration
def test_official_plugins_are_listed_as_they_are() -> None:
    from official_plugins import extras, missing, offers

    if lacking := missing(offers()):
        pytest.fail(f"not installed: {', '.join(lacking)}; run uv sync --group cluster")
    assert offers() == official_plugins(), "run python tests/house/official_plugins.py"
    assert extras() == json.loads(EXTRAS.read_bytes()), "run python tests/house/official_plugins.py"


def test_no_two_packages_of_this_project_offer_the_same() -> None:
    owners: dict[tuple[str, str], list[str]] = {}
    for package, offers in official_plugins().items():
        for kind in offers.keys() - {"default", RECORDS, "job"}:
            for type_ in offers[kind]:
                owners.setdefault((kind, type_), []).append(package)
    assert {each: packages for each, packages in owners.items() if len(packages) > 1} == {}, "messages name only one"


def test_plugins_that_are_not_installed_are_named() -> None:
    from official_plugins import missing

    assert missing(set(official_plugins()) - {"ibrobot-plugin-ray"}) == ["ibrobot-plugin-ray"]
    assert missing(official_plugins()) == [], "run python tests/house/official_plugins.py"
