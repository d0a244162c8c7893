"""Metadata from a robot YAML, for episodes and datasets without their own."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from ibrobot_calibration.joint_units import with_closed_ends
from ibrobot_provenance.robot_metadata import robot_metadata

from ibrobot_core.api import CalibrationError, Contract, Robot
from ibrobot_core.app import ExecutorConfig, RobotConfig, contract_alone, load_config, read_document


def load_contract(path: str | Path) -> RobotConfig:
    """Read and check a robot YAML for its contract, or a file with only a `contract` section.

    Such a file serves to convert foreign bags: its actions have `joints` in place of an executor, and the robot of
    the returned config has no name and no joints.

    Raises:
        ConfigError: with all errors, in file order.
    """
    document = read_document(path)
    if set(document.root) != {"contract"}:
        return load_config(path)
    section = document.root["contract"]
    actions = section.get("actions") if isinstance(section, Mapping) else None
    for action in actions if isinstance(actions, list) else ():
        if isinstance(action, dict):
            for key, value in (("executor", str(action.get("topic", ""))), ("foreign", True)):
                if action.setdefault(key, value) != value:
                    document.add(("contract", "actions"), f"{key} has no meaning in a contract alone; leave it out")
    contract = contract_alone(document, Path(path).absolute().parent)
    parts_of = {spec.executor: spec.joints for spec in contract.actions}
    return RobotConfig(
        robot=Robot("", ()),
        executors={name: ExecutorConfig("", None, name, "", joints) for name, joints in parts_of.items()},
        control_modes={},
        default_control_mode="",
        contract=contract,
        source=Path(path),
        document=document.root,
    )


def with_anchored(
    calibration: Mapping[str, Mapping[str, Any]], config: RobotConfig, anchored: Collection[str] | None
) -> dict[str, dict[str, Any]]:
    """A calibration with `closed_at` of each joint: of `anchored`, or if it is None, as the hardware states.

    Raises:
        CalibrationError: if the robot lacks a joint of `anchored`.
    """
    if anchored is None:
        return with_closed_ends(calibration, config)
    lower = dict(zip(config.robot.joint_names, config.robot.lower.tolist(), strict=True))
    if unknown := sorted(set(anchored) - lower.keys()):
        raise CalibrationError(f"anchored: the robot has no joint {unknown[0]!r}; it has: {', '.join(lower)}")
    return {
        joint: {**numbers, "closed_at": lower[joint] if joint in anchored else None}
        for joint, numbers in calibration.items()
    }


def metadata_from_config(
    config: RobotConfig,
    norm_mode: str | None = None,
    calibration: Mapping[str, Mapping[str, Any]] | None = None,
    names: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, str]:
    """Metadata from a robot YAML, for a dataset without its own; see `EpisodeAddress.given`.

    Args:
        config: the robot YAML.
        norm_mode: the unit of the dataset's joint positions.
        calibration: joint -> fields of `JointCalibration` with `closed_at`, for a unit that needs them.
        names: feature of the dataset -> names of its elements in their order, where the dataset does not have them.
    """
    document = json.loads(json.dumps(config.document, default=str))
    calibrations = {"given": dict(calibration)} if calibration else {}
    given = robot_metadata(Contract.from_config(config).without_signals(), document, calibrations)
    given |= {"names": json.dumps(names)} if names else {}
    return given | ({"norm_mode": norm_mode} if norm_mode else {})
