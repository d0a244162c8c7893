"""The floor of core's public interface for commands, sections, sources and sessions: what reaches into a run.

    from ibrobot_core.app import Command, Component, SectionDescriptor, Session

`ibrobot_core.api` is the floor for devices, models and formats. Both import their names on first use.
"""

from __future__ import annotations

from typing import Any

from ibrobot_core.late_names import LateNames

_NAMES = LateNames(__name__, __file__)

__all__ = list(_NAMES.homes)


def home_of(name: str) -> str:
    """The module that defines a name of this floor."""
    return _NAMES.homes[name]


def __getattr__(name: str) -> Any:
    value = globals()[name] = _NAMES.load(name)
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]
