"""Reader `lerobot`: an episode of a dataset as messages that its contract converts to the same rows.

The origin of an episode is as `ibrobot convert` has stored it, or as the caller states it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
from ibrobot_calibration.joint_units import JointUnits, recorded_units
from ibrobot_provenance.datasets import with_pinholes
from ibrobot_provenance.robot_metadata import robot_metadata
from ibrobot_terminal.plural import counted
from numpy.typing import NDArray

from ibrobot_core.api import (
    NS_PER_S,
    CalibrationError,
    Contract,
    ContractError,
    DatasetError,
    EpisodeAddress,
    EpisodeReader,
    EpisodeSummary,
    Feature,
    Recorded,
    RecorderError,
    TopicSummary,
)
from ibrobot_lerobot import layout
from ibrobot_lerobot.compose import Composer
from ibrobot_lerobot.rows import EpisodeRows

_POSITION = ".pos"
"""Ending of the names of joint positions."""


class LeRobotReader(EpisodeReader):
    """Reads an episode of a LeRobot dataset: one message of each topic of the contract at every tick.

    Datasets of `ibrobot convert` contain the contract, unit, robot and prompt of each episode; for others the caller
    provides them. Stamps begin at the time of the recording or, if it is unknown, at the dataset's first frame.

    Raises:
        RecorderError: if it cannot be read, or the address has no episode number.
        ContractError: if the dataset's features do not match the contract.
        CalibrationError: if the unit of the joints needs a calibration that is missing.
        PluginError: if the type of its units is not installed.
    """

    sampled = True

    def __init__(self, address: EpisodeAddress) -> None:
        root = address.path
        try:
            dataset = layout.open_dataset(root)
            assert dataset is not None
            total = dataset.info["total_episodes"]
            if address.number is None:
                raise RecorderError(f"{root}: is a dataset of {counted(total, 'episode')}; choose one, e.g. {root}:0")
            self._rows = EpisodeRows(dataset, address.number)
        except DatasetError as error:
            raise RecorderError(str(error)) from error
        self._path = root.with_name(f"{root.name}:{address.number}")
        self._origin = origin = episode_origin(root, dataset.metadata, address.number, address.given)
        self._contract = origin.contract
        _check_features(root, dataset.features, origin)
        unit = origin.norm_mode, origin.contract, origin.calibration, origin.document
        self._units = JointUnits(*unit) if origin.units is None else recorded_units(origin.units, *unit)
        self._composer = Composer(origin.contract)
        self._step_ns = round(NS_PER_S / dataset.info["fps"])
        start_ns = origin.start_ns
        self._start_ns = self._rows.begin * self._step_ns if start_ns is None else start_ns

    @override
    def summary(self) -> EpisodeSummary:
        rows, origin = self._rows, self._origin
        topics = {topic: TopicSummary(type_, rows.length) for topic, type_ in sorted(self._contract.topics.items())}
        metadata = {"prompt": "; ".join(rows.tasks), **origin.metadata}
        end_ns = self._start_ns + (rows.length - 1) * self._step_ns
        return EpisodeSummary(self._path, True, self._start_ns, end_ns, topics, metadata, origin.outcome)

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        return self.messages_since(self._start_ns, topics)

    @override
    def messages_since(self, stamp_ns: int, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        first = -(-(stamp_ns - 1 - self._start_ns) // self._step_ns)  # rounded up; some messages are 1 ns late
        first = min(max(0, first), self._rows.length)
        wanted = set(self._contract.topics if topics is None else topics)
        try:
            for row, values in enumerate(self._rows.read(self._composer.keys(wanted), first), first):
                tick_ns = self._start_ns + row * self._step_ns
                composed = self._composer(self._in_radians(values), tick_ns)
                for topic in sorted(composed, key=self._delay_ns):
                    at_ns = tick_ns + self._delay_ns(topic)
                    if topic in wanted and at_ns >= stamp_ns:
                        yield Recorded(topic, composed[topic], at_ns, at_ns)
        except DatasetError as error:
            raise RecorderError(f"{self._path}: {error}") from error

    @override
    def digest(self) -> str:
        """Digest of the vectors only: images would have to be decoded."""
        features = self._contract.features()
        content = hashlib.sha256(f"{self._start_ns}".encode())
        try:
            for values in self._rows.read([key for key, each in features.items() if len(each.shape) == 1]):
                for key in sorted(values):
                    content.update(values[key].tobytes())
        except DatasetError as error:
            raise RecorderError(f"{self._path}: {error}") from error
        return content.hexdigest()

    @override
    def close(self) -> None:
        pass

    def _delay_ns(self, topic: str) -> int:
        """Delay of a row's message after its tick [ns], for commands that must follow the tick."""
        return int(any(part.topic == topic and part.align == "next" for part in self._contract.action_parts))

    def _in_radians(self, values: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Convert to radians in full precision, so that converting back gives the same values."""
        return {
            key: self._units.radians(key, value.astype(np.float64)) if value.ndim == 1 else value
            for key, value in values.items()
        }


def _check_features(root: Path, features: Mapping[str, Feature], origin: Origin) -> None:
    """Check that the dataset has the contract's features, with the same elements in the same order."""
    for key, wanted in origin.contract.features().items():
        feature = features.get(key)
        if feature is None:
            raise ContractError(
                f"{root}: lacks {key} of the contract; available: {', '.join(features)}; "
                f"the contract: {', '.join(origin.contract.features())}"
            )
        shapes = zip(wanted.shape, feature.shape, strict=False)
        same = len(wanted.shape) == len(feature.shape) and all(a in (-1, b) for a, b in shapes)
        if same and (len(wanted.shape) > 1 or not wanted.names):
            continue
        names = origin.names.get(key, feature.names)
        if same and _are_same(names, wanted.names):
            continue
        problem = f"{key} does not match the contract:"
        if same and not (len(names) == len(set(names)) == feature.shape[0]):
            problem = (
                f"{key} does not name its elements, so their order is unknown; if you know it, state it with "
                f"--names {key}={','.join(wanted.names[:2])},…:"
            )
        raise ContractError(
            f"{root}: {problem}\n"
            f"   dataset: {feature.shape} {', '.join(names)}\n"
            f"  contract: {wanted.shape} {', '.join(wanted.names)}"
        )


def _are_same(names: Sequence[str], wanted: Sequence[str]) -> bool:
    """Whether names are the contract's in its order; joints alone name their positions."""
    joints = [name.removesuffix(_POSITION) for name in wanted if name.endswith(_POSITION)]
    return list(names) == list(wanted) or (len(joints) == len(wanted) and list(names) == joints)


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
    names: Mapping[str, Sequence[str]] = attrs.field(factory=dict)
    """Feature -> names of its elements, where the caller states them in place of the dataset."""
    units: str | None = None
    """Type of what converted to the unit, if `convert` was given one."""


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
        contract = with_pinholes(Contract.from_canonical(metadata["contract"]).without_signals())
        recorded = dict(episode.get("recorded", {}))
        norm_mode, units = metadata["conversion"]["norm_mode"], metadata["conversion"].get("units")
        own = {"prompt": episode["prompt"], "source": f"{root.resolve().name}:{number}"}
        outcome, start_ns = episode["outcome"], episode["start_ns"]
    except (KeyError, IndexError, TypeError) as error:
        raise RecorderError(f"{root}: the metadata of episode {number} cannot be read: {error!r}") from None
    recorded |= own | robot_metadata(contract, document, {"converted": calibration} if calibration else {})
    return Origin(recorded, contract, document, calibration, norm_mode, outcome, start_ns, units=units)


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
    contract = with_pinholes(Contract.from_canonical(json.loads(given["contract"])))
    calibrations = json.loads(given.get("calibration", "{}"))
    document = json.loads(given.get("config", "{}"))
    joined = {joint: numbers for each in calibrations.values() for joint, numbers in each.items()}
    described = robot_metadata(contract, document, calibrations)
    names = json.loads(given.get("names", "{}"))
    return Origin(described, contract, document, joined, given["norm_mode"], names=names)
