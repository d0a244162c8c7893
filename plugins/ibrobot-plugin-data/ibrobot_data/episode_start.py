"""Folder and metadata of an episode, `ROOT/DATASET/episodes/episode_000001`."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from uuid import NAMESPACE_OID, uuid4, uuid5

from ibrobot_calibration.joint_units import calibrations
from ibrobot_provenance.ownership import InUse, Ownership
from ibrobot_provenance.recorded_names import COMMANDER, GUARD
from ibrobot_terminal.authority import AGENT_LOG

import ibrobot_core
from ibrobot_core.api import MODEL_ANSWERS, Contract, EpisodeStart, ModelAnswer, RecorderError, String
from ibrobot_core.app import RecordedRun, RobotConfig
from ibrobot_data.episode_dataset import EpisodeDataset

LABELS = (COMMANDER, GUARD, AGENT_LOG)
"""Topics beside those of the contract: who commanded, what the guard of control kept apart, what agents asked for."""
_PREFIX = "episode_"


def episode_folder(dataset: Path, number: int) -> Path:
    """The folder of episode `number`, from 1, of a dataset."""
    return dataset / "episodes" / f"{_PREFIX}{number:06d}"


def take_next_folder(dataset: Path) -> Ownership:
    """Take the folder of the dataset's next episode, which does not exist yet, for as long as it is recorded.

    Raises:
        RecorderError: if no folder can be created there.
    """
    root = dataset / "episodes"
    try:
        root.mkdir(parents=True, exist_ok=True)
        numbers = [path.name.removeprefix(_PREFIX) for path in root.glob(f"{_PREFIX}*")]
        number = max((int(each) for each in numbers if each.isdigit()), default=0) + 1
        while True:
            with suppress(InUse):  # another run records into this dataset, too
                taken = Ownership(episode_folder(root.parent, number), "is being recorded", wait_s=0.0)
                if not taken.path.exists():
                    return taken
                taken.close()
            number += 1
    except OSError as error:
        raise RecorderError(f"recording.root: {root} cannot be created: {error.strerror}") from None


def episode_start(session: RecordedRun, directory: Path, *, number: int, stamp_ns: int, prompt: str) -> EpisodeStart:
    """The start of an episode.

    For `topics: contract` it has all topics of the contract, including those not published yet, who commands, and of a
    model its further observations and its answers; otherwise it has the requested topics that are on the bus, and more
    may follow (`any_topic`). With lockstep, equal runs give equal bytes.

    Args:
        session: the run.
        directory: the folder of the episode.
        number: number of the episode in the run, from 1.
        stamp_ns: start of the episode [ns].
        prompt: the operator's description of the task.

    Raises:
        RecorderError: if the dataset has another contract.
    """
    config, policy = session.config, session.command_source.described()
    recording = config.recording
    assert recording is not None
    topics = {topic: type_ for topic, (type_, _) in session.bus.topics().items()}
    contract = Contract.from_config(config)
    EpisodeDataset(recording.folder).join(contract, config.robot.name, config.robot.robot_type)
    metadata = {
        "robot": config.robot.name, "robot_type": config.robot.robot_type, "mode": session.mode, "prompt": prompt,
        "contract": json.dumps(contract.canonical()), "fingerprint": contract.fingerprint(),
        "config": json.dumps(config.document, default=str), "calibration": json.dumps(calibrations(config)),
        "ibrobot_version": ibrobot_core.__version__, "plugin_versions": json.dumps(dict(session.registry.versions())),
        "seed": str(session.request.seed + number - 1),
    }  # fmt: skip
    if policy is not None:
        metadata["policy"] = json.dumps(dict(policy))
    if session.factors:
        metadata["factors"] = json.dumps(dict(session.factors))
    metadata["uuid"] = str(uuid5(NAMESPACE_OID, json.dumps(metadata)) if session.request.lockstep else uuid4())
    guarded = GUARD if config.control.guard is not None else ""
    if recording.topics == "contract":
        kept = {
            **contract.topics,
            **{topic: String.ros_type for topic in LABELS if topic in topics or topic == guarded},
        }
        kept = {**model_topics(config, policy), **kept}
    else:
        kept = {topic: type_ for topic, type_ in topics.items() if is_kept(topic, recording.topics, contract)}
    return EpisodeStart(directory, stamp_ns, kept, metadata, any_topic=recording.topics != "contract")


def is_kept(topic: str, topics: str | Collection[str], contract: Contract) -> bool:
    """Whether `topics` of the `recording` section selects `topic`."""
    if topics == "contract":
        return topic in contract.topics or topic in LABELS
    return topics == "all" or topic in topics


def model_topics(config: RobotConfig, policy: Mapping[str, str] | None) -> dict[str, str]:
    """Topic -> type of what the acting policy observes beyond the contract, and of its answers; empty for None."""
    if policy is None:
        return {}
    observed = Contract.from_config(config, config.models[policy["model"]].extra_observations)
    return {**observed.topics, MODEL_ANSWERS: ModelAnswer.ros_type}
