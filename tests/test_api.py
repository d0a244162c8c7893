"""The public interface: what the stubs name exists, is imported late, and is documented."""

from __future__ import annotations

import inspect
import subprocess
import sys
from typing import get_origin

import pytest

from ibrobot_core import api, app

NAMES = [(floor, name) for floor in (api, app) for name in floor.__all__]


@pytest.mark.parametrize(("floor", "name"), NAMES)
def test_every_name_is_there(floor, name: str) -> None:
    assert getattr(floor, name) is not None


def test_a_name_stands_for_one_thing_on_one_floor() -> None:
    names = [name for _, name in NAMES]
    assert len(names) == len(set(names))


def test_the_floor_for_devices_reaches_into_no_run() -> None:
    homes = {api.home_of(name) for name in api.__all__}
    inside = ("cli", "control", "dispatch", "inference", "launch", "plugins", "run_hooks", "services", "component")
    assert [home for home in homes if home.split(".")[1] in inside] == []


@pytest.mark.parametrize("floor", [api, app])
def test_an_unknown_name_is_an_attribute_error(floor) -> None:
    with pytest.raises(AttributeError, match=f"module '{floor.__name__}' has no attribute 'Hardwear'"):
        _ = floor.Hardwear


@pytest.mark.parametrize("floor", [api, app])
def test_names_are_listed(floor) -> None:
    assert set(floor.__all__) <= set(dir(floor))


@pytest.mark.parametrize("floor", [api, app])
def test_importing_it_imports_nothing_else_of_core(floor) -> None:
    code = f"import sys, {floor.__name__}; print([m for m in sys.modules if m.startswith(('ibrobot_core.', 'numpy'))])"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert loaded.strip() == f"['ibrobot_core.late_names', '{floor.__name__}']"


@pytest.mark.parametrize(
    ("floor", "name"),
    [(floor, name) for floor, name in NAMES if callable(found := getattr(floor, name)) and get_origin(found) is None],
)
def test_every_class_and_function_is_documented(floor, name: str) -> None:
    assert inspect.getdoc(getattr(floor, name)), f"{name} has no docstring"


def test_a_mistyped_keyword_of_an_option_is_an_error() -> None:
    with pytest.raises(TypeError, match="has no keyword lable"):
        api.option(lable="Task")  # type: ignore[call-arg]
