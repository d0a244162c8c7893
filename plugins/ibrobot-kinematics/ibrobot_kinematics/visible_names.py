"""The rule for names of objects, tasks and steps, which people and agents read in panels, pages and logs."""

from __future__ import annotations

from ibrobot_core.app import UNPRINTABLE

_LONGEST = 100
"""Longest name, in characters: panels and pages show it beside other things."""


def name_fault(name: str) -> str:
    """Why a text is no name; empty if it is one: one line of 1 to 100 visible characters, without spaces around."""
    if 0 < len(name) <= _LONGEST and name.isprintable() and name == name.strip() and not UNPRINTABLE.search(name):
        return ""
    got = ascii(name[:_LONGEST])
    return f"a name is one line of 1 to {_LONGEST} visible characters, without spaces around it, got {got}"
