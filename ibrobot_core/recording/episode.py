"""Where an episode is recorded and what is known of it: `ROOT/DATASET/episodes/episode_000001`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_OID, uuid4, uuid5

import ibrobot_core
from ibrobot_core.config import RobotConfig
from ibrobot_core.config.schema import RecordingConfig
from ibrobot_core.contract.joint_units import calibrations
from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import RecorderError
from ibrobot_core.interfaces import EpisodeStart
from ibrobot_core.recording.dataset import EpisodeDataset

_PREFIX = "episode_"


def episode_folder(dataset: Path, number: int) -> Path:
    """Where episode `number`, from 1, of a dataset lies."""
    return dataset / "episodes" / f"{_PREFIX}{number:06d}"


def episode_start(
    config: RobotConfig, recording: RecordingConfig, topics: Mapping[str, str], *, mode: str, seed: int, stamp_ns: int,
    lockstep: bool, prompt: str = "", plugins: Mapping[str, str] | None = None,
    policy: Mapping[str, str] | None = None,
) -> EpisodeStart:  # fmt: skip
    """The start of the next episode of the dataset.

    Args:
        config: the robot.
        recording: its `recording` section.
        topics: every topic on the bus: topic -> message type; those that the section asks for are kept. Where it
            asks for the contract's, they are all there from the start, also the ones that nobody published yet; where
            it asks for all, or names some, others may come later (`any_topic`).
        mode: the control mode.
        seed: of the scene.
        stamp_ns: when it begins [ns].
        lockstep: whether equal runs must give equal bytes.
        prompt: what the operator calls the task.
        plugins: packages of the plugins, and their versions.
        policy: which policy acts, and with which weights; None where none does.

    Raises:
        RecorderError: when the folder cannot be made, or the dataset has episodes of another contract.
    """
    contract = Contract.from_config(config)
    root = recording.folder / "episodes"
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecorderError(f"recording.root: {root} cannot be made: {error.strerror}") from None
    EpisodeDataset(root.parent).join(contract, config.robot.name, config.robot.robot_type)
    metadata = {
        "robot": config.robot.name, "robot_type": config.robot.robot_type, "mode": mode, "prompt": prompt,
        "contract": json.dumps(contract.canonical()), "fingerprint": contract.fingerprint(),
        "config": json.dumps(config.document, default=str), "calibration": json.dumps(calibrations(config)),
        "ibrobot_version": ibrobot_core.__version__, "plugin_versions": json.dumps(dict(plugins or {})),
        "seed": str(seed),
    }  # fmt: skip
    if policy is not None:
        metadata["policy"] = json.dumps(dict(policy))
    metadata["uuid"] = str(uuid5(NAMESPACE_OID, json.dumps(metadata)) if lockstep else uuid4())
    if recording.topics == "contract":
        kept = contract.topics
    else:
        kept = {topic: type_ for topic, type_ in topics.items() if is_kept(topic, recording, contract)}
    directory = episode_folder(root.parent, _next_number(root))
    return EpisodeStart(directory, stamp_ns, kept, metadata, any_topic=recording.topics != "contract")


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


def is_kept(topic: str, recording: RecordingConfig, contract: Contract) -> bool:
    """Whether the `recording` section asks for `topic`."""
    if recording.topics == "contract":
        return topic in contract.topics
    return recording.topics == "all" or topic in recording.topics


def _next_number(root: Path) -> int:
    numbers = [path.name.removeprefix(_PREFIX) for path in root.glob(f"{_PREFIX}*")]
    return max((int(number) for number in numbers if number.isdigit()), default=0) + 1
