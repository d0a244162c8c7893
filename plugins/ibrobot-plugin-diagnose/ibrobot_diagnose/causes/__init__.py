"""The causes of this package, a family in a file."""

from __future__ import annotations

from ibrobot_diagnose.cause import Cause
from ibrobot_diagnose.causes import data, episodes, joints, limits, model, motion, others, pictures, rig, timing

_FAMILIES = (timing, limits, motion, pictures, joints, data, episodes, model, rig, others)


def all_causes() -> tuple[Cause, ...]:
    """A cause of each class."""
    return tuple(each() for family in _FAMILIES for each in family.CAUSES)
