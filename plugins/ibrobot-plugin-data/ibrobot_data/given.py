"""What a robot YAML says of a dataset that keeps nothing itself."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from ibrobot_core.api import Contract, RobotConfig, robot_metadata, with_closed_ends


def metadata_from_config(
    config: RobotConfig, norm_mode: str | None = None, calibration: Mapping[str, Mapping[str, Any]] | None = None
) -> dict[str, str]:
    """What a robot YAML tells of a dataset that keeps nothing itself; see `EpisodeAddress.given`.

    Args:
        config: the robot YAML.
        norm_mode: the unit of the dataset's joint positions.
        calibration: joint -> fields of `JointCalibration`, for a unit that needs them.
    """
    document = json.loads(json.dumps(config.document, default=str))
    calibrations = {"given": with_closed_ends(calibration, config)} if calibration else {}
    given = robot_metadata(Contract.from_config(config).without_signals(), document, calibrations)
    return given | ({"norm_mode": norm_mode} if norm_mode else {})
