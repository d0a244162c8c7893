"""Origin of a dataset's episodes, as stored by `ibrobot convert` or stated by the caller."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import CalibrationError, Contract, ContractError, RecorderError
from ibrobot_core.app import robot_metadata


@attrs.frozen
class Origin:
    """Origin of an episode in a dataset."""

    metadata: Mapping[str, str]
    """The recording's metadata: contract, fingerprint, config, calibration, prompt, seed, …"""
    contract: Contract
    document: Mapping[str, Any]
    """The robot YAML as plain values; empty if unknown."""
    calibration: Mapping[str, Mapping[str, Any]]
    """Joint -> fields of `JointCalibration`; empty if unknown."""
    norm_mode: str
    """The unit of the dataset's joint positions."""
    outcome: str = "unknown"
    start_ns: int | None = None
    """Time of receipt of the recording's first message [ns]."""


def episode_origin(root: Path, metadata: Mapping[str, Any], number: int, given: Mapping[str, str]) -> Origin:
    """The origin of episode `number` of a dataset.

    Args:
        root: the dataset, for errors.
        metadata: the dataset's metadata; if empty, because `convert` did not make the dataset, `given` is used.
        number: episode number, from 0.
        given: values given by the caller, as in `EpisodeAddress`.

    Raises:
        ContractError: if neither describes the vectors.
        RecorderError: if the metadata cannot be read.
    """
    if "conversion" not in metadata:
        return _origin_as_given(root, given)
    try:
        episode = metadata["episodes"][number]
        calibration = metadata["calibrations"][episode["calibration"]] if episode["calibration"] else {}
        document = metadata["configs"][episode["config"]] if episode.get("config") else {}
        contract = Contract.from_canonical(metadata["contract"]).without_signals()
        recorded = dict(episode.get("recorded", {}))
        norm_mode = metadata["conversion"]["norm_mode"]
        own = {"prompt": episode["prompt"], "source": f"{root.resolve().name}:{number}"}
        outcome, start_ns = episode["outcome"], episode["start_ns"]
    except (KeyError, IndexError, TypeError) as error:
        raise RecorderError(f"{root}: the metadata of episode {number} cannot be read: {error!r}") from None
    recorded |= own | robot_metadata(contract, document, {"converted": calibration} if calibration else {})
    return Origin(recorded, contract, document, calibration, norm_mode, outcome, start_ns)


def _origin_as_given(root: Path, given: Mapping[str, str]) -> Origin:
    if "contract" not in given:
        raise ContractError(
            f"{root}: was not made by ibrobot, so it does not name its robot; "
            "give a robot YAML with a matching contract"
        )
    if "norm_mode" not in given:
        raise CalibrationError(
            f"{root}: was not made by ibrobot, so it does not state the unit of its joints; "
            "give it: radians, degrees or range_m100_100"
        )
    contract = Contract.from_canonical(json.loads(given["contract"]))
    calibrations = json.loads(given.get("calibration", "{}"))
    document = json.loads(given.get("config", "{}"))
    joined = {joint: numbers for each in calibrations.values() for joint, numbers in each.items()}
    described = robot_metadata(contract, document, calibrations)
    return Origin(described, contract, document, joined, given["norm_mode"])
