"""The floor of core's public interface for devices, models and formats, in one flat module.

    from ibrobot_core.api import Context, Teleop, TeleopCommand, TeleopDescriptor, hookimpl, option

`ibrobot_core.app` is the floor for what reaches into a run: commands, sections, sources. Each name is imported from its
module on first use, so that a plugin's descriptors import nothing heavy. Names on both floors are stable, as the page
"Public API" of the documentation defines. Everything else in `ibrobot_core` may change at any time.
"""

from __future__ import annotations

from ibrobot_core.late_names import LateNames

_NAMES = LateNames(__name__, __file__)
__all__ = list(_NAMES.homes)
__getattr__, __dir__, home_of = _NAMES.load, _NAMES.listed, _NAMES.home_of
