"""Names that plugins import late exist: type checkers do not look into `Late("MODULE:NAME")`."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from ibrobot_core.descriptors import Late

ROOT = Path(__file__).parents[2]
FOLDERS = (ROOT, *sorted(ROOT.glob("plugins/*/")))
PACKAGES = [package for folder in FOLDERS for package in sorted(folder.glob("*ibrobot*/")) if package.name != "plugins"]


def places(text: str) -> Iterator[str]:
    """What each `Late` of a source text imports."""
    if f"{Late.__name__}(" not in text:  # parsing all files takes seconds
        return
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.Call(func=ast.Name(id=Late.__name__), args=[ast.Constant(value=str(place))]):
                yield place


def defines(place: str) -> bool:
    """Whether a package of this repository defines what a place names."""
    module, _, name = place.partition(":")
    package, *rest = module.split(".")
    for root in (each for each in PACKAGES if each.name == package):
        for path in (root.joinpath(*rest, "__init__.py"), root.joinpath(*rest).with_suffix(".py")):
            if path.is_file():
                body = ast.parse(path.read_text(encoding="utf-8")).body
                for part in name.split("."):
                    found = [node for node in body if getattr(node, "name", None) == part]
                    if not found:
                        return False
                    body = getattr(found[0], "body", [])
                return True
    return False


LATE = sorted(
    {
        place
        for package in PACKAGES
        for path in package.rglob("*.py")
        for place in places(path.read_text(encoding="utf-8"))
    }
)


@pytest.mark.parametrize("place", LATE)
def test_what_is_imported_late_exists(place: str) -> None:
    assert defines(place)


def test_most_descriptors_import_late() -> None:
    assert len(LATE) > 50


@pytest.mark.parametrize("place", ["ibrobot_core.descriptors:Gone", "ibrobot_core.gone:Late", "gone.descriptors:Late"])
def test_a_wrong_name_is_found(place: str) -> None:
    assert not defines(place)


def test_late_imports_when_it_is_called() -> None:
    assert Late("math:hypot")(3, 4) == 5
    assert Late("ibrobot_core.descriptors:Late").load() is Late
    with pytest.raises(ModuleNotFoundError):
        Late("ibrobot_core.gone:Late")()
