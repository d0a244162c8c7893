"""The hook: units of policies."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Late, hookimpl
from ibrobot_core.app import UnitsDescriptor


@hookimpl
def ibrobot_units() -> Iterable[UnitsDescriptor]:
    """LeRobot's units, by the calibration."""
    yield UnitsDescriptor(
        type="calibrated",
        make=Late("ibrobot_calibration.model_units:model_units"),
        uncalibrated=Late("ibrobot_calibration.model_units:uncalibrated"),
        of_recording=Late("ibrobot_calibration.joint_units:calibrated_units"),
        summary="degrees and ranges of joints, as in LeRobot, by the calibration",
        default=True,
    )
