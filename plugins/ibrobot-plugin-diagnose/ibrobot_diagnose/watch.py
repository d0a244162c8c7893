"""What a run shows for some seconds, as a window with its rig."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import override

import attrs
from ibrobot_calibration.joint_units import calibrations

import ibrobot_core
from ibrobot_core.api import (
    CameraInfo,
    CompressedImage,
    Contract,
    EpisodeReader,
    EpisodeSummary,
    HardwareError,
    Recorded,
    RecorderError,
    TopicSummary,
)
from ibrobot_core.app import Received, RunView, installed_plugins
from ibrobot_diagnose.recorded_rig import rig_of
from ibrobot_diagnose.rig import Rig
from ibrobot_diagnose.window import Window, read_window

SETTLE_S = 1.0
"""Time before a window, in which automatic exposures settle [s]."""
POLL_S = 0.1
"""How often the messages of a run are taken [s]."""
_INFO = "/camera_info"
_QUEUE = 20_000


@attrs.frozen(eq=False)
class LiveWindow:
    """A window on a rig, with what its cameras say of themselves."""

    window: Window
    infos: Mapping[str, CameraInfo]
    """Key of an observation -> what its camera says."""

    @property
    def rig(self) -> Rig:
        """The rig."""
        assert self.window.rig is not None
        return self.window.rig


class Watch:
    """Takes what a run shows, from its creation to `close`."""

    def __init__(self, session: RunView) -> None:
        self._session = session
        self._contract = Contract.from_config(session.config)
        topics = frozenset(self._contract.topics)
        self._received = session.bus.subscribe(
            None, _QUEUE, wants=lambda topic: topic in topics or topic.endswith(_INFO)
        )
        self._items: list[Received] = []
        self._infos: dict[str, CameraInfo] = {}
        self._begin_ns = 0

    def begin(self) -> None:
        """Begin the window."""
        self.take()
        self._items, self._begin_ns = [], self._session.bus.snapshot_ns()

    def take(self) -> None:
        """Take the messages so far, before their queue is full."""
        for each in self._received.drain():
            if isinstance(each.message, CameraInfo):
                self._infos[each.topic.removesuffix(_INFO)] = each.message
            else:
                self._items.append(each)

    def window(self) -> LiveWindow:
        """The window, which ends now.

        Raises:
            IbrobotError: if there is nothing to compare, or a picture cannot be decoded.
        """
        self.take()
        session, contract = self._session, self._contract
        reader = _Reader(self._items, self._begin_ns, session.bus.snapshot_ns(), _metadata(session, contract))
        window = read_window(reader, session.config.robot.name)
        places = {
            part.key: part.topic.rpartition("/")[0] for part in contract.observation_parts if part.image is not None
        }
        infos = {key: self._infos[place] for key, place in places.items() if place in self._infos}
        return LiveWindow(attrs.evolve(window, rig=_described(rig_of(window), session, infos)), infos)

    def close(self) -> None:
        """Stop taking messages. Safe to call twice."""
        self._received.close()


def _metadata(session: RunView, contract: Contract) -> dict[str, str]:
    """What a recording would say of the run."""
    config = session.config
    return {
        "robot": config.robot.name, "robot_type": config.robot.robot_type, "mode": session.mode,
        "contract": json.dumps(contract.canonical()), "fingerprint": contract.fingerprint(),
        "config": json.dumps(config.document, default=str), "calibration": json.dumps(calibrations(config)),
        "ibrobot_version": ibrobot_core.__version__, "plugin_versions": json.dumps(dict(session.registry.versions())),
    }  # fmt: skip


def _described(rig: Rig | None, session: RunView, infos: Mapping[str, CameraInfo]) -> Rig:
    """The rig with what only a run knows."""
    if rig is None:
        raise HardwareError("there is nothing to compare: the contract has no joints")
    cameras = {key: attrs.evolve(camera, focal=_focal(infos.get(key))) for key, camera in rig.cameras.items()}
    faults = ({"message": fault, "severity": "fault"} for fault in session.faults)
    return attrs.evolve(
        rig, taken=datetime.now(UTC).isoformat(timespec="seconds"), cameras=cameras,
        loop_hz=None if session.request.lockstep else rig.loop_hz, conditions=(*faults, *map(dict, session.conditions)),
        absent={each.name: str(each.missing) for each in session.absent},
    )  # fmt: skip


def _focal(info: CameraInfo | None) -> float | None:
    return float(info.k[0]) / info.width if info is not None and info.width > 0 and info.k[0] > 0 else None


class _Reader(EpisodeReader):
    """The messages of a live run, as an episode."""

    def __init__(self, items: list[Received], begin_ns: int, end_ns: int, metadata: Mapping[str, str]) -> None:
        self._items, self._metadata = items, metadata
        self._begin_ns, self._end_ns = begin_ns, end_ns

    @override
    def summary(self) -> EpisodeSummary:
        types = {each.topic: each.message.ros_type for each in self._items}
        counts = Counter(each.topic for each in self._items)
        topics = {topic: TopicSummary(type_, counts[topic]) for topic, type_ in types.items()}
        return EpisodeSummary(Path("live"), True, self._begin_ns, self._end_ns, topics, self._metadata)

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        for each in self._items:
            if topics is None or each.topic in topics:
                message = each.message
                if isinstance(message, CompressedImage):
                    message = installed_plugins().decode(message)
                yield Recorded(each.topic, message, each.received_ns, each.received_ns)

    @override
    def digest(self) -> str:
        raise RecorderError("a live rig has no digest")

    @override
    def close(self) -> None:
        self._items = []
