"""The floor of core's public interface for commands, sections, sources and sessions: what reaches into a run.

    from ibrobot_core.app import Command, Component, SectionDescriptor, Session

`ibrobot_core.api` is the floor for devices, models and formats. Both import their names on first use.
"""

from __future__ import annotations

from ibrobot_core.late_names import LateNames

_NAMES = LateNames(__name__, __file__)
__all__ = list(_NAMES.homes)
__getattr__, __dir__, home_of = _NAMES.load, _NAMES.listed, _NAMES.home_of
