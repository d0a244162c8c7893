"""The rule for names of objects, tasks and steps, which people and agents read in panels, pages and logs."""

from __future__ import annotations

import re

_LONGEST = 100
"""Longest name, in characters: panels and pages show it beside other things."""
_UNSEEN = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2800\u3164\ufe00-\ufe0f\uffa0\U000e0100-\U000e01ef]"
)
"""Characters that count as printable and show nothing, so that two names would look the same."""


def name_fault(name: str) -> str:
    """Why a text is no name; empty if it is one: one line of 1 to 100 visible characters, without spaces around."""
    if 0 < len(name) <= _LONGEST and name.isprintable() and name == name.strip() and not _UNSEEN.search(name):
        return ""
    got = ascii(name[:_LONGEST])
    return f"a name is one line of 1 to {_LONGEST} visible characters, without spaces around it, got {got}"
