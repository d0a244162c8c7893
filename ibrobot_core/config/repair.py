"""Sections without their faulty values, so that independent checks of a file do not wait until these are mended."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping
from typing import Any

from ibrobot_core.convert import Converter, Faults, Key

_ANY_JOINT = {"lower": -1e6, "upper": 1e6, "max_velocity": 1.0, "max_acceleration": 100.0, "beyond_model": True}
"""The values of a joint with faults: no check of another value depends on them."""
_ROUNDS = 3
"""Values may only be found faulty once others are left out."""


def structure_rest(section: str, value: Any, kind: Any, faulty: Collection[Key], converter: Converter) -> Any:
    """Structure a section without its faulty values; None if nothing sensible is left.

    Args:
        section: its name.
        value: its value in the file.
        kind: the annotation of its type.
        faulty: the keys of its faults, from the section on.
        converter: structures the values.
    """
    for _ in range(_ROUNDS):
        value = copy.deepcopy(value)
        if not all(_left_out(section, value, key) for key in faulty):
            return None
        try:
            return converter.structure(value, kind)
        except Faults as faults:
            faulty = [key for key, _ in faults.found]
        except (ValueError, TypeError):
            return None
    return None


def _left_out(section: str, value: Any, key: Key) -> bool:
    """Leave out the value at `key` of a mapping; return whether that is possible.

    Joints get harmless values. Groups cannot be left out, since executors depend on them, nor can items of a list,
    since the places of their successors are numbered.
    """
    match (section, *key):
        case ("robot", "joints", int(index), *_):
            joint = value["joints"][index]
            name = joint.get("name") if isinstance(joint, Mapping) else None
            value["joints"][index] = {"name": name if isinstance(name, str) else f"joint {index}", **_ANY_JOINT}
            return True
        case ("robot", "groups", *_):
            return False
    for part in key[:-1]:
        value = value.get(part) if isinstance(value, dict) else value[part] if isinstance(value, list) else None  # type: ignore[index]
    if not key or not isinstance(value, dict) or key[-1] not in value:
        return False
    del value[key[-1]]
    return True
