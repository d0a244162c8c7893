"""A plugin with units that need no calibration, which are a default beside those of ibrobot-calibration."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from ibrobot_testing.fakes.formats import FakeUnits

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import UnitsDescriptor


def of_recording(norm_mode: str, contract: Any, calibration: Any, document: Any) -> FakeUnits:
    model: Any = SimpleNamespace(norm_mode=norm_mode)
    return FakeUnits(document, model, contract)


@hookimpl
def ibrobot_units():
    summary = "plain degrees"
    yield UnitsDescriptor("other_units", make=FakeUnits, summary=summary, default=True, of_recording=of_recording)
    yield UnitsDescriptor("units_of_runs", make=FakeUnits, summary=summary)
