"""Where episodes come from: the contract in a recording's metadata, and what a dataset keeps of its recordings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.contract.joint_units import with_closed_ends
from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import CalibrationError, ContractError, RecorderError

if TYPE_CHECKING:
    from ibrobot_core.config import RobotConfig


def recorded_contract(metadata: Mapping[str, str]) -> Contract | None:
    """The contract that an episode was recorded by; None for one without.

    Raises:
        ContractError: when it cannot be read, or is not the one that its fingerprint is of.
    """
    if "contract" not in metadata:
        return None
    try:
        contract = Contract.from_canonical(json.loads(metadata["contract"]))
    except (ValueError, RecursionError) as error:
        raise ContractError(f"the recorded contract cannot be read: {error}") from None
    if metadata.get("fingerprint", contract.fingerprint()) != contract.fingerprint():
        raise ContractError("the recorded contract is damaged: it is not the one that the recorded fingerprint is of")
    return contract


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
    given = _described(Contract.from_config(config).without_signals(), document, calibrations)
    return given | ({"norm_mode": norm_mode} if norm_mode else {})


@attrs.frozen
class Origin:
    """Where an episode of a dataset comes from."""

    metadata: Mapping[str, str]
    """As the recorder was given: contract, fingerprint, config, calibration, prompt, seed, …"""
    contract: Contract
    document: Mapping[str, Any]
    """The robot YAML as plain values; empty where it is not known."""
    calibration: Mapping[str, Mapping[str, Any]]
    """Joint -> fields of `JointCalibration`; empty where it is not known."""
    norm_mode: str
    """The unit of the dataset's joint positions."""
    outcome: str = "unknown"
    start_ns: int | None = None
    """Receipt of the first message of the recording [ns]."""


def episode_origin(root: Path, metadata: Mapping[str, Any], number: int, given: Mapping[str, str]) -> Origin:
    """Where episode `number` of a dataset comes from.

    Args:
        root: the dataset, for errors.
        metadata: what the dataset keeps; empty for one that `convert` did not make, which goes by `given`.
        number: from 0.
        given: as in `EpisodeAddress`.

    Raises:
        ContractError: when neither says what the vectors are.
        RecorderError: for metadata that cannot be read.
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
        told_apart = {"prompt": episode["prompt"], "source": f"{root.resolve().name}:{number}"}
        outcome, start_ns = episode["outcome"], episode["start_ns"]
    except (KeyError, IndexError, TypeError) as error:
        raise RecorderError(f"{root}: what it keeps of episode {number} cannot be read: {error!r}") from None
    recorded |= told_apart | _described(contract, document, {"converted": calibration} if calibration else {})
    return Origin(recorded, contract, document, calibration, norm_mode, outcome, start_ns)


def _origin_as_given(root: Path, given: Mapping[str, str]) -> Origin:
    if "contract" not in given:
        raise ContractError(
            f"{root}: was not made by ibrobot, so it does not say which robot its vectors are of; "
            "name a robot YAML whose contract fits it"
        )
    if "norm_mode" not in given:
        raise CalibrationError(
            f"{root}: was not made by ibrobot, so it does not say the unit of its joints; "
            "--norm-mode does: radians, degrees or range_m100_100"
        )
    contract = Contract.from_canonical(json.loads(given["contract"]))
    calibrations = json.loads(given.get("calibration", "{}"))
    document = json.loads(given.get("config", "{}"))
    joined = {joint: numbers for each in calibrations.values() for joint, numbers in each.items()}
    return Origin(
        _described(contract, document, calibrations), contract, document, joined, given["norm_mode"]
    )  # fmt: skip


def _described(
    contract: Contract, document: Mapping[str, Any], calibrations: Mapping[str, Any]
) -> dict[str, str]:  # fmt: skip
    """By the names that a recorder's metadata has."""
    robot = document.get("robot") or {}
    found = {"contract": json.dumps(contract.canonical()), "fingerprint": contract.fingerprint()}
    if document:
        found |= {"config": json.dumps(document)}
        found |= {"robot": str(robot.get("name", "")), "robot_type": str(robot.get("robot_type", ""))}
    return found | ({"calibration": json.dumps(calibrations)} if calibrations else {})
