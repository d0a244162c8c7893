"""Every key of the robot YAML and every option of the installed plugins is documented, and `help()` explains it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attrs
import pytest

from ibrobot_core.config import RobotConfig
from ibrobot_core.options import fields
from ibrobot_core.plugins import Entry, installed_plugins

pytestmark = pytest.mark.integration

json_schema = pytest.importorskip("ibrobot_import.schema").json_schema
ENTRIES = list(installed_plugins().entries.values())
DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def page(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """The text of a generated page."""
    monkeypatch.syspath_prepend(DOCS)
    import option_pages

    def text(name: str) -> str:
        kinds = option_pages.options_of_kinds()
        lines = kinds[name] if name in kinds else getattr(option_pages, f"{name}_page")()
        return "\n".join(lines)

    return text


def _keys(schema: Any) -> Iterator[str]:
    """Every key that a JSON Schema knows, at any depth."""
    if isinstance(schema, dict):
        yield from schema.get("properties", {})
        for inner in schema.values():
            yield from _keys(inner)
    elif isinstance(schema, list):
        for inner in schema:
            yield from _keys(inner)


def test_every_key_of_the_schema_is_on_a_page(page: Callable[[str], str]) -> None:
    kinds = {entry.kind for entry in ENTRIES}
    rows = page("config") + "".join(map(page, kinds))

    missing = {key for key in _keys(json_schema(installed_plugins())) if f"`{key}`" not in rows}

    assert missing == set()


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: f"{entry.kind}-{entry.descriptor.type}")
def test_every_option_stands_below_its_plugin(entry: Entry, page: Callable[[str], str]) -> None:
    _, _, rest = page(entry.kind).partition(f"## {entry.kind}: `{entry.descriptor.type}`\n")
    section, _, _ = rest.partition("\n## ")

    missing = [name for name in fields(entry.descriptor.options) if f"| `{name}` |" not in section]

    assert section
    assert missing == []


def _sections(kind: Any) -> Iterator[type[Any]]:
    """The classes of sections in a type, at any depth."""
    if isinstance(kind, type) and attrs.has(kind):
        yield kind
        for field in fields(kind).values():
            yield from _sections(field.type)
    for member in getattr(kind, "__args__", ()):
        yield from _sections(member)


@pytest.mark.parametrize(
    "kind",
    dict.fromkeys([*_sections(RobotConfig), *(found for e in ENTRIES for found in _sections(e.descriptor.options))]),
    ids=lambda kind: kind.__name__,
)
def test_help_explains_every_key(kind: type[Any]) -> None:
    text = inspect.getdoc(kind) or ""

    missing = [name for name, field in fields(kind).items() if f"\n    {name}: {field.metadata['help']}" not in text]

    assert missing == []
