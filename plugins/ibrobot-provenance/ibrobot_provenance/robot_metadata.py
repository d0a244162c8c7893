"""Metadata of an episode that come from its contract and its robot, with the keys used in recordings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from ibrobot_core.api import Contract


def robot_metadata(contract: Contract, document: Mapping[str, Any], calibrations: Mapping[str, Any]) -> dict[str, str]:
    """The metadata as JSON texts.

    Args:
        contract: the contract of the episode.
        document: the robot YAML as plain values; empty if unknown.
        calibrations: hardware -> joint -> fields of `JointCalibration`; empty if unknown.
    """
    robot = document.get("robot") or {}
    metadata = {"contract": json.dumps(contract.canonical()), "fingerprint": contract.fingerprint()}
    if document:
        metadata |= {"config": json.dumps(document)}
        metadata |= {"robot": str(robot.get("name", "")), "robot_type": str(robot.get("robot_type", ""))}
    return metadata | ({"calibration": json.dumps(calibrations)} if calibrations else {})
