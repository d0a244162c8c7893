"""What a dataset keeps of where it comes from, so that its episodes can be read back as they were recorded."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import CalibrationError, ContractError, RecorderError
from ibrobot_core.interfaces import DatasetSummary

if TYPE_CHECKING:
    from ibrobot_core.config import RobotConfig
    from ibrobot_core.recording.convert.episode import Unit
    from ibrobot_core.recording.convert.request import Request

_KEPT_ONCE = ("contract", "fingerprint", "config", "calibration", "prompt")
"""What an episode's metadata says that lies elsewhere in the dataset's."""


def conversion(request: Request) -> dict[str, Any]:
    """What all episodes of a dataset must have been asked for alike."""
    options = attrs.asdict(request.options)
    return {"writer": request.type, "options": options, "norm_mode": request.norm_mode, "success": request.success}


def provenance(request: Request, old: DatasetSummary | None, units: Sequence[Unit]) -> dict[str, Any]:
    """What the dataset keeps of its making: contract, robots, calibrations, and where each episode comes from."""
    before: Mapping[str, Any] = old.metadata if old is not None else {}
    calibrations, configs = dict(before.get("calibrations", {})), dict(before.get("configs", {}))
    episodes = list(before.get("episodes", ()))
    for unit in units:
        report = attrs.asdict(unit.report)
        kept = {name: value for name, value in report.items() if name not in ("error", "passed_over")}
        kept["recorded"] = {name: value for name, value in unit.recorded.items() if name not in _KEPT_ONCE}
        kept["calibration"] = _file(calibrations, unit.calibration)
        kept["config"] = _file(configs, unit.document)
        episodes.append(kept)
    contract = before.get("contract", units[0].contract)
    return {
        "robot_type": before.get("robot_type", units[0].robot_type), "contract": contract,
        "fingerprint": Contract.from_canonical(contract).fingerprint(), "conversion": conversion(request),
        "calibrations": calibrations, "configs": configs, "episodes": episodes,
    }  # fmt: skip


def _file(kept: dict[str, Any], document: Mapping[str, Any]) -> str:
    """Keep a document once, under a name that equal ones share; nothing, and no name, for an empty one."""
    if not document:
        return ""
    name = hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:12]
    kept[name] = document
    return name


def told_by(
    config: RobotConfig, norm_mode: str | None = None, calibration: Mapping[str, Mapping[str, Any]] | None = None
) -> dict[str, str]:
    """What a robot YAML tells of a dataset that keeps nothing itself; see `EpisodeAddress.told`.

    Args:
        config: the robot YAML.
        norm_mode: the unit of the dataset's joint positions.
        calibration: joint -> fields of `JointCalibration`, for a unit that needs them.
    """
    document = json.loads(json.dumps(config.document, default=str))
    told = _described(
        Contract.from_config(config).without_signals(), document, {"told": calibration} if calibration else {}
    )
    return told | ({"norm_mode": norm_mode} if norm_mode else {})


@attrs.frozen
class Origin:
    """Where an episode of a dataset comes from."""

    metadata: Mapping[str, str]
    """As the recorder was told: contract, fingerprint, config, calibration, prompt, seed, …"""
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


def origin(root: Path, metadata: Mapping[str, Any], number: int, told: Mapping[str, str]) -> Origin:
    """Where episode `number` of a dataset comes from.

    Args:
        root: the dataset, for errors.
        metadata: what the dataset keeps; empty for one that `convert` did not make, which goes by `told`.
        number: from 0.
        told: as in `EpisodeAddress`.

    Raises:
        ContractError: when neither says what the vectors are.
        RecorderError: for metadata that cannot be read.
    """
    if "conversion" not in metadata:
        return _told(root, told)
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


def _told(root: Path, told: Mapping[str, str]) -> Origin:
    if "contract" not in told:
        raise ContractError(
            f"{root}: was not made by ibrobot convert, so it does not say which robot its vectors are of; "
            "name a robot YAML whose contract fits it"
        )
    if "norm_mode" not in told:
        raise CalibrationError(
            f"{root}: was not made by ibrobot convert, so it does not say the unit of its joints; "
            "--norm-mode does: radians, degrees or range_m100_100"
        )
    contract = Contract.from_canonical(json.loads(told["contract"]))
    calibrations = json.loads(told.get("calibration", "{}"))
    document = json.loads(told.get("config", "{}"))
    joined = {joint: numbers for each in calibrations.values() for joint, numbers in each.items()}
    return Origin(
        _described(contract, document, calibrations), contract, document, joined, told["norm_mode"]
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
