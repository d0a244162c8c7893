"""The rule for names: what is a name shows as itself, and two names that are not the same do not look the same."""

from __future__ import annotations

import sys
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_kinematics.visible_names import name_fault

from ibrobot_core.app import echo


@pytest.mark.parametrize("name", ["cube", "red cube 2", "a" * 100, "\u30b3\u30c3\u30d7", "caf\u00e9", "ignore rules"])
def test_names_of_one_line_are_names(name: str) -> None:
    assert name_fault(name) == ""


@pytest.mark.parametrize(
    "text",
    ["", " ", " cube", "cube ", "cu\nbe", "cu\tbe", "\x1b[2J", "cu\u202ebe", "cube\u200b", "cube\u3164", "\u2800",
     "cu\ufe0fbe", "cu\xadbe", "cu\u2028be", "\ud800", "cube\U000e0041", "cube\U000e0100", "a" * 101],
)  # fmt: skip
def test_what_does_not_show_is_no_name_and_the_error_shows_it(text: str) -> None:
    fault = name_fault(text)
    assert fault.startswith("a name is one line of 1 to 100 visible characters, without spaces around it, got '")
    assert fault.isascii()
    assert fault.isprintable()
    assert len(fault) < 1200


@given(st.text(max_size=120))
def test_no_character_of_a_name_controls_anything(text: str) -> None:
    if not name_fault(text):
        assert text == text.strip()
        assert 0 < len(text) <= 100
        assert not {unicodedata.category(each) for each in text} & {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}


def test_all_characters_of_names_are_shown_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    taken = "".join(each for each in map(chr, range(sys.maxunicode + 1)) if not name_fault(f"a{each}a"))
    echo(taken)
    assert capsys.readouterr().out == f"{taken}\n"
