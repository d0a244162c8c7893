"""A window on a live rig: the robot runs as `ibrobot launch` runs it, but nothing commands it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
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
    IbrobotError,
    Recorded,
    RecorderError,
    TopicSummary,
    ns,
)
from ibrobot_core.app import (
    ControlMode,
    LaunchRequest,
    Received,
    RobotConfig,
    Runtime,
    RunView,
    Session,
    SourceWorker,
    installed_plugins,
)
from ibrobot_diagnose.cause import DEVICE_POSE
from ibrobot_diagnose.rig import Rig, rig_of
from ibrobot_diagnose.window import Window, read_window

SETTLE_S = 1.0
"""Time before the window, in which automatic exposures settle [s]."""
_POLL_S = 0.1
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


def still(config: RobotConfig) -> RobotConfig:
    """The robot as it is looked at: without poses to move to, recording, viewer and transport."""
    control = config.control
    kept = attrs.evolve(control, startup="hold", stop="hold" if control.stop.startswith("pose") else control.stop)
    return attrs.evolve(config, control=kept, recording=None, viewer=None, transport=None)


def look(
    config: RobotConfig, seconds: float, *, lockstep: bool = False, seed: int = 0,
    tell: Callable[[str], None] = lambda what: None,
) -> LiveWindow:  # fmt: skip
    """Look at a rig for some seconds; nothing moves.

    Args:
        config: the robot.
        seconds: length of the window [s].
        lockstep: whether to run in simulated time.
        seed: of a simulated scene.
        tell: called with what is done.

    Raises:
        IbrobotError: if a part of the robot does not start, or dies.
    """
    config = still(config)
    runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(lockstep, seed, source=_Still)))
    session = runtime.session
    contract = Contract.from_config(config)
    topics = frozenset(contract.topics)
    received = session.bus.subscribe(
        None, _QUEUE, wants=lambda topic: topic in topics or topic.endswith("/camera_info")
    )
    try:
        runtime.start(tell)
        tell("the window")
        _run(runtime, SETTLE_S)
        said = _infos(received.drain())
        begin_ns = session.bus.snapshot_ns()
        items: list[Received] = []
        while session.bus.snapshot_ns() < begin_ns + ns(seconds):
            _run(runtime, _POLL_S)
            items += received.drain()
        end_ns = session.bus.snapshot_ns()
        reader = _Reader(items, begin_ns, end_ns, _metadata(session, contract))
        window = read_window(reader, config.robot.name)
        places = {
            part.key: part.topic.rpartition("/")[0] for part in contract.observation_parts if part.image is not None
        }
        infos = {key: said[place] for key, place in places.items() if place in said}
        rig = _with_leaders(_described(rig_of(window), session, infos), session)
    finally:
        received.close()
        runtime.stop()
    runtime.raise_failure()
    return LiveWindow(attrs.evolve(window, rig=rig), infos)


class _Still(SourceWorker):
    """Commands nothing."""

    def __init__(self, session: RunView, mode: ControlMode) -> None:
        super().__init__(session, mode, "nothing moves")

    @override
    def begin_mode(self, seed: int) -> None:
        """Begin nothing."""

    @override
    def work(self, timeout_s: float) -> None:
        if timeout_s > 0:
            self.pause(timeout_s)


def _run(runtime: Runtime, seconds: float) -> None:
    """Let the run go on, in its own time.

    Raises:
        IbrobotError: if it ends.
    """
    session = runtime.session
    until_ns = session.clock.now_ns() + ns(seconds)
    while session.clock.now_ns() < until_ns:
        if runtime.step() if session.request.lockstep else runtime.wait(min(seconds, _POLL_S)):
            runtime.raise_failure()
            raise HardwareError(f"the run ended while the rig was looked at: {'; '.join(session.faults) or 'stopped'}")


def _infos(items: list[Received]) -> dict[str, CameraInfo]:
    """Name of a camera's topics -> what it says of itself."""
    return {each.topic.rpartition("/")[0]: each.message for each in items if isinstance(each.message, CameraInfo)}


def _metadata(session: Session, contract: Contract) -> dict[str, str]:
    """What a recording would say of the run."""
    config = session.config
    return {
        "robot": config.robot.name, "robot_type": config.robot.robot_type, "mode": session.mode,
        "contract": json.dumps(contract.canonical()), "fingerprint": contract.fingerprint(),
        "config": json.dumps(config.document, default=str), "calibration": json.dumps(calibrations(config)),
        "ibrobot_version": ibrobot_core.__version__, "plugin_versions": json.dumps(dict(session.registry.versions())),
    }  # fmt: skip


def _described(rig: Rig | None, session: Session, infos: Mapping[str, CameraInfo]) -> Rig:
    """The rig with what only a run knows."""
    if rig is None:
        raise HardwareError("there is nothing to compare: the contract has no joints")
    cameras = {
        key: attrs.evolve(camera, focal=float(infos[key].k[0]) / infos[key].width if key in infos else None)
        for key, camera in rig.cameras.items()
    }
    return attrs.evolve(
        rig, taken=datetime.now(UTC).isoformat(timespec="seconds"), cameras=cameras,
        loop_hz=None if session.request.lockstep else rig.loop_hz, conditions=tuple(map(dict, session.conditions)),
        absent={each.name: str(each.missing) for each in session.absent},
    )  # fmt: skip


def _with_leaders(rig: Rig, session: Session) -> Rig:
    """The rig with how far its leaders stand from it."""
    config, measured = session.config, session.measured()
    at = dict(zip(config.robot.joint_names, measured.position.tolist(), strict=True))
    known = {each.type for each in session.registry.of_kind(DEVICE_POSE)}
    groups = {name: group for mode in config.control_modes.values() for group, name in mode.devices.items()}
    leaders: dict[str, dict[str, float]] = {}
    notes: list[str] = []
    for name, group in () if config.simulated else groups.items():
        device = config.teleoperation[name]
        if device.type not in known:
            continue
        part = config.robot.part(group) if group else config.robot
        try:
            poses = session.make(DEVICE_POSE, device, name, robot=part)
        except IbrobotError as error:
            notes.append(f"{name} cannot be read: {error}")
            continue
        leaders[name] = {joint: position - at[joint] for joint, position in poses.items()}
    return attrs.evolve(rig, leaders=leaders, notes=tuple(notes))


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
