"""The public interface: what the stub names exists, is imported late, and is documented."""

from __future__ import annotations

import inspect
import subprocess
import sys
from typing import get_origin

import pytest

from ibrobot_core import api


@pytest.mark.parametrize("name", api.__all__)
def test_every_name_is_there(name: str) -> None:
    assert getattr(api, name) is not None


def test_a_name_stands_for_one_thing() -> None:
    assert len(api.__all__) == len(set(api.__all__))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Hardwear'"):
        _ = api.Hardwear  # type: ignore[attr-defined]


def test_names_are_listed() -> None:
    assert set(api.__all__) <= set(dir(api))


def test_importing_it_imports_nothing_else_of_core() -> None:
    code = "import sys, ibrobot_core.api; print([m for m in sys.modules if m.startswith(('ibrobot_core.', 'numpy'))])"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert loaded.strip() == "['ibrobot_core.api']"


@pytest.mark.parametrize(
    "name", [name for name in api.__all__ if callable(found := getattr(api, name)) and get_origin(found) is None]
)
def test_every_class_and_function_is_documented(name: str) -> None:
    assert inspect.getdoc(getattr(api, name)), f"{name} has no docstring"
