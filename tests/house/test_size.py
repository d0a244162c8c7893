"""The size of core; `python tests/house/source_lines.py` shows that of each plugin, too."""

import importlib

import pytest
from source_lines import ROOT, count

LIMIT = 11_475
NAMES = {"ibrobot_core.api": 140, "ibrobot_core.app": 100}
"""Floor of core's interface -> most names on it."""


def test_core_stays_small():
    lines = count(ROOT / "ibrobot_core")
    table = "\n".join(f"{number:6} {folder}" for folder, number in lines.most_common())
    assert lines.total() <= LIMIT, (
        f"{lines.total()} source lines, at most {LIMIT}; move or simplify something:\n{table}"
    )


@pytest.mark.parametrize("floor", NAMES)
def test_the_interface_stays_small(floor: str):
    names = len(importlib.import_module(floor).__all__)
    advice = "what serves one package goes home to it, or is reached by an object that the package has anyway"
    assert names <= NAMES[floor], f"{names} names on {floor}, at most {NAMES[floor]}: {advice}"
