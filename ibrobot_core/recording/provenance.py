"""What a recording's metadata says of the robot: its contract, its YAML and its calibrations."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ibrobot_core.contract.joint_units import with_closed_ends
from ibrobot_core.contract.specs import Contract

if TYPE_CHECKING:
    from ibrobot_core.config import RobotConfig


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


def robot_metadata(contract: Contract, document: Mapping[str, Any], calibrations: Mapping[str, Any]) -> dict[str, str]:
    """Metadata of an episode, by the names that a recorder's metadata has.

    Args:
        contract: of the episode.
        document: the robot YAML as plain values; empty where it is not known.
        calibrations: hardware -> joint -> fields of `JointCalibration`; empty where they are not known.
    """
    robot = document.get("robot") or {}
    found = {"contract": json.dumps(contract.canonical()), "fingerprint": contract.fingerprint()}
    if document:
        found |= {"config": json.dumps(document)}
        found |= {"robot": str(robot.get("name", "")), "robot_type": str(robot.get("robot_type", ""))}
    return found | ({"calibration": json.dumps(calibrations)} if calibrations else {})
