"""A plugin with units that need no calibration, which are a default beside those of ibrobot-calibration."""

from __future__ import annotations

from ibrobot_testing.fakes.formats import FakeUnits

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import UnitsDescriptor


@hookimpl
def ibrobot_units():
    yield UnitsDescriptor("other_units", make=FakeUnits, summary="plain degrees", default=True)
