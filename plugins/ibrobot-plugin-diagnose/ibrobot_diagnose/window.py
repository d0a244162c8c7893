"""What causes look at: the streams of a run, a recording or an episode of a dataset, aligned by its contract."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from ibrobot_provenance.recorded_names import COMMANDER, GUARD
from ibrobot_terminal.plural import counted
from numpy.typing import NDArray

from ibrobot_core.api import (
    MODEL_ANSWERS,
    NS_PER_S,
    Contract,
    ContractError,
    EpisodeReader,
    EpisodeSummary,
    Float64MultiArray,
    Image,
    JointState,
    ModelAnswer,
    RecorderError,
    String,
    pixels,
)
from ibrobot_diagnose.pictures import SMALL, Picture, shrink, small_of
from ibrobot_diagnose.rig import STILL_WIDTH, Rig

type Floats = NDArray[np.float64]
type Times = NDArray[np.int64]

COMPARED = 60
"""Pictures of each camera that are compared with the data."""
KEPT = 48
"""Pictures of each camera that are kept in a larger size, evenly over the window."""
_STILLS = 3
"""Pictures of each camera that are kept in a still larger size."""
_LOWEST_RATE, _HIGHEST_RATE = 0.01, 10_000.0
"""Rates of a contract that are plausible [Hz]."""
_MOST_TICKS = 1_000_000
"""Ticks of the longest recording that is read; at 30 Hz these are nine hours."""
_FARTHEST = 1e9
"""Numbers beyond it are no positions, in whatever unit."""
_SECTIONS: Mapping[str, type[Any]] = {
    "robot": dict, "control": dict, "control_modes": dict, "models": dict, "peripherals": list, "contract": dict,
}  # fmt: skip
"""Sections of the robot YAML that causes look at."""


@attrs.frozen(eq=False)
class Track:
    """Vectors at their own rate."""

    names: tuple[str, ...]
    times_ns: Times
    """Times of receipt [ns], shape (N,)."""
    stamps_ns: Times
    """Stamps of the sender [ns], shape (N,)."""
    values: Floats
    """Shape (N, J); NaN for what a message lacks."""

    @classmethod
    def of(cls, names: Sequence[str], rows: Sequence[tuple[int, int, Sequence[float]]]) -> Track:
        """A track of rows: time of receipt, stamp [ns], values."""
        values = np.array([row[2] for row in rows], np.float64).reshape(len(rows), len(names))
        values[~(np.abs(values) <= _FARTHEST)] = np.nan
        times = [np.array([row[column] for row in rows], np.int64) for column in (0, 1)]
        return cls(tuple(names), times[0], times[1], values)

    def at(self, t_ns: Times) -> Floats:
        """The newest value at each time, shape (T, J); NaN before the first."""
        if not len(self.times_ns):
            return np.full((len(t_ns), len(self.names)), np.nan)
        index = np.searchsorted(self.times_ns, t_ns, side="right") - 1
        values = self.values[np.maximum(index, 0)]
        values[index < 0] = np.nan
        return values

    def between(self, t_ns: Times) -> Floats:
        """The values at these times, interpolated, shape (T, J); NaN outside."""
        if len(self.times_ns) < 2:
            return np.full((len(t_ns), len(self.names)), np.nan)
        own = (self.times_ns - self.times_ns[0]).astype(np.float64)
        asked = (t_ns - self.times_ns[0]).astype(np.float64)
        columns = [np.interp(asked, own, column, np.nan, np.nan) for column in self.values.T]
        return np.stack(columns, axis=1) if columns else np.empty((len(t_ns), 0))


@attrs.frozen(eq=False)
class Asked:
    """A request to the model, and its answer."""

    answer: ModelAnswer
    chunk: Floats
    """The actions [rad], shape (N, J); empty without an answer."""

    @property
    def used(self) -> bool:
        """Whether the robot used the chunk."""
        return self.answer.outcome == "used" and len(self.chunk) > 0

    @property
    def times_ns(self) -> Times:
        """The time of each action [ns]."""
        return self.answer.observed_ns + np.arange(len(self.chunk), dtype=np.int64) * self.answer.step_ns

    @property
    def past(self) -> int:
        """Number of actions whose step was over when the answer came."""
        over = (self.answer.header.stamp_ns - self.answer.observed_ns) // max(1, self.answer.step_ns)
        return int(np.clip(over, 0, len(self.chunk)))


@attrs.define(eq=False)
class Camera:
    """The pictures of a camera."""

    key: str
    topic: str
    times_ns: list[int] = attrs.field(factory=list)
    """Times of receipt [ns]."""
    stamps_ns: list[int] = attrs.field(factory=list)
    pictures: list[Picture] = attrs.field(factory=list)
    """What is known of each picture."""
    kept: dict[int, NDArray[np.uint8]] = attrs.field(factory=dict)
    """Index of a picture -> the picture, some 160 pixels wide."""
    size: tuple[int, int] = (0, 0)
    """Height and width of the pictures [pixels]."""
    stills: dict[int, NDArray[np.uint8]] = attrs.field(factory=dict)
    """Time of receipt [ns] -> the picture, some 320 pixels wide; a few, evenly over the window."""

    @property
    def name(self) -> str:
        """Name of the camera: the last part of the key."""
        return self.key.rpartition(".")[2]

    @cached_property
    def small(self) -> NDArray[np.float32]:
        """All pictures at the size of a thumbnail, shape (N, H, W, 3), from 0 to 255."""
        shown = [each.small for each in self.pictures]
        return np.stack(shown).astype(np.float32) if shown else np.empty((0, *SMALL, 3), np.float32)

    @cached_property
    def sample(self) -> NDArray[np.float32]:
        """Some of these, evenly over the window."""
        count = len(self.small)
        chosen = np.unique(np.linspace(0, count - 1, min(COMPARED, count)).round().astype(int))
        result: NDArray[np.float32] = self.small[chosen]
        return result


@attrs.frozen
class Limits:
    """Limits of a joint, as the robot YAML states them; infinite for one that it does not."""

    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    acceleration: float = np.inf


@attrs.frozen(eq=False)
class Window:
    """A stretch of time on a robot: what was observed, asked, answered, commanded and measured."""

    name: str
    contract: Contract
    ticks_ns: Times
    """The contract's ticks from the first to the last message [ns], shape (T,)."""
    joints: tuple[str, ...]
    """The joints of the action vector, in order."""
    state: Track
    """Measured positions of these joints [rad], as received."""
    command: Track
    """Commands to these joints after the safety layer [rad], as received."""
    asked: tuple[Asked, ...] = ()
    """Requests to a model, in the order of their answers."""
    cameras: Mapping[str, Camera] = attrs.field(factory=dict)
    """Key of an observation -> its camera."""
    commanders: tuple[tuple[int, str], ...] = ()
    """Time from which [ns] the commander changes, and who: policy, operator or handover."""
    guarded: tuple[tuple[int, str], ...] = ()
    """Time from which [ns] the guard says something else, and what: JSON of a pair, or nothing."""
    metadata: Mapping[str, str] = attrs.field(factory=dict)
    outcome: str = "unknown"
    sampled: bool = False
    """Whether states and commands are rows of a dataset, one at each tick."""
    rig: Rig | None = None
    """The rig at rest that it shows; None for a run or a demonstration."""
    teaches: bool = False
    """Whether it is an episode of a dataset: a demonstration also if a policy acted."""

    @property
    def start_ns(self) -> int:
        """Time of the first tick [ns]."""
        return int(self.ticks_ns[0]) if len(self.ticks_ns) else 0

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return float(self.ticks_ns[-1] - self.ticks_ns[0]) / NS_PER_S if len(self.ticks_ns) else 0.0

    def since(self, t_ns: int) -> float:
        """A time as seconds since the beginning [s]."""
        return (int(t_ns) - self.start_ns) / NS_PER_S

    @cached_property
    def streams(self) -> frozenset[str]:
        """Names of what it has, as in `Cause.needs`."""
        has = {
            "state": len(self.state.times_ns) > 1, "commands": len(self.command.times_ns) > 1,
            "answers": bool(self.asked), "chunks": any(each.used for each in self.asked),
            "pictures": any(each.pictures for each in self.cameras.values()),
            "guard": bool((self.document.get("control") or {}).get("guard")),
            "outcome": self.outcome in ("success", "failure"),
            "demonstration": self.rig is None and (self.teaches or not self.asked),
            "motion": self.rig is None, "rig": self.rig is not None,
        }  # fmt: skip
        return frozenset(name for name, there in has.items() if there)

    @cached_property
    def states(self) -> Floats:
        """Measured positions at the ticks [rad], shape (T, J)."""
        return self.state.at(self.ticks_ns)

    @cached_property
    def commands(self) -> Floats:
        """Commands in effect at the ticks [rad], shape (T, J)."""
        return self.command.at(self.ticks_ns)

    @cached_property
    def speeds(self) -> Floats:
        """Measured speeds at the ticks [rad/s], shape (T, J); 0 at the first."""
        if len(self.ticks_ns) < 2:
            return np.zeros_like(self.states)
        moved = np.diff(self.states, axis=0, prepend=self.states[:1])
        return np.nan_to_num(np.abs(moved)) * self.contract.rate_hz

    @cached_property
    def document(self) -> Mapping[str, Any]:
        """The robot YAML as plain values; empty if the recording has none.

        Raises:
            RecorderError: if it is damaged.
        """
        document = _object(self.metadata, "config", self.name)
        for section, kind in _SECTIONS.items():
            if not isinstance(document.get(section) or kind(), kind):
                raise RecorderError(f"{self.name}: config: {section}: must be a {kind.__name__}")
        joints = (document.get("robot") or {}).get("joints") or []
        lists = {"robot.joints": joints, "peripherals": document.get("peripherals") or []}
        modes = list((document.get("control_modes") or {}).values())
        for name, listed in {**lists, "control_modes": modes}.items():
            if not isinstance(listed, list) or not all(isinstance(each, dict) for each in listed):
                raise RecorderError(f"{self.name}: config: {name}: must contain only objects")
        for mode in modes:
            dispatch = mode.get("dispatch") or {}
            smoothing = dispatch.get("smoothing") or {} if isinstance(dispatch, dict) else None
            coefficient = smoothing.get("temporal_ensemble_coeff", 0.0) if isinstance(smoothing, dict) else None
            if not isinstance(coefficient, int | float) or abs(coefficient) > _FARTHEST:
                raise RecorderError(f"{self.name}: config: control_modes: dispatch: is not valid in a robot YAML")
        return document

    @cached_property
    def policy(self) -> Mapping[str, Any]:
        """Name, type, fingerprint and weights of the policy that acted; empty without one.

        Raises:
            RecorderError: if it is damaged.
        """
        return _object(self.metadata, "policy", self.name)

    @property
    def mode(self) -> Mapping[str, Any]:
        """The control mode in the robot YAML; empty if it is unknown."""
        mode: Mapping[str, Any] = (self.document.get("control_modes") or {}).get(self.metadata.get("mode", ""), {})
        return mode

    @property
    def prompt(self) -> str:
        """The task that the model was given or, without a model, that of the recording."""
        asked = [each.answer.prompt for each in self.asked if each.answer.prompt]
        return asked[0] if asked else self.metadata.get("prompt", "")

    @cached_property
    def limits(self) -> tuple[Limits, ...]:
        """The limits of the joints, as the robot YAML states them."""
        return tuple(map(_limits, self._described))

    @cached_property
    def leads(self) -> Floats:
        """How far commands may be from the measured positions [rad], shape (J,); infinite where no YAML says it."""
        stated = (each.get("max_lead") for each in self._described)
        return np.array([float(each) if isinstance(each, int | float) else np.inf for each in stated])

    @cached_property
    def _described(self) -> Sequence[Mapping[str, Any]]:
        """What the robot YAML says of each joint; nothing of one that it does not have."""
        known = {str(each.get("name")): each for each in (self.document.get("robot") or {}).get("joints") or ()}
        return [known.get(joint, {}) for joint in self.joints]

    def commander_at(self, t_ns: Times) -> list[str]:
        """Who commanded at these times; empty if it is unknown."""
        times = [since for since, _ in self.commanders]
        index = np.searchsorted(np.array(times, np.int64), t_ns, side="right") - 1
        return [self.commanders[i][1] if i >= 0 else "" for i in index]


def grips(joint: str) -> bool:
    """Whether a joint is that of a gripper, by its name."""
    return any(part in joint.lower() for part in ("grip", "jaw"))


def holds(joint: str) -> bool:
    """Whether a joint is that of a gripper or a hand, by its name: it stops at what it holds, and where it is shut."""
    return grips(joint) or any(part in joint.lower() for part in ("hand", "finger", "thumb"))


def _object(metadata: Mapping[str, str], key: str, name: str) -> Mapping[str, Any]:
    """An object in the metadata of a recording, which may come from anywhere; empty if it has none."""
    try:
        value = json.loads(metadata.get(key, "{}"))
    except (ValueError, RecursionError) as error:
        raise RecorderError(f"{name}: its metadata {key} cannot be read: {error}") from None
    if not isinstance(value, dict):
        raise RecorderError(f"{name}: its metadata {key} is not an object")
    return value


def _limits(joint: Mapping[str, Any]) -> Limits:
    keys = {"lower": "lower", "upper": "upper", "velocity": "max_velocity", "acceleration": "max_acceleration"}
    return Limits(**{name: float(joint[key]) for name, key in keys.items() if isinstance(joint.get(key), int | float)})


def read_window(reader: EpisodeReader, name: str = "") -> Window:
    """Read an episode.

    Raises:
        RecorderError: if it cannot be read, or has no contract.
    """
    summary = reader.summary()
    name = name or summary.path.name
    try:
        return _Reading(_contract_of(summary), reader).window(name)
    except ContractError as error:  # e.g. intrinsics of a camera with pictures of another size
        raise RecorderError(f"{summary.path}: {error}") from error


def _contract_of(summary: EpisodeSummary) -> Contract:
    """The contract of a recording, which may come from anywhere.

    Raises:
        RecorderError: if it has none, or one that is damaged.
    """
    try:
        contract = Contract.of_episode(summary.metadata)
    except RecursionError:
        contract = None
    if contract is None:
        raise RecorderError(
            f"{summary.path}: has no contract, so it is unknown what was observed and commanded; ibrobot records one "
            "with every episode, and `ibrobot contract init` drafts one for foreign bags"
        )
    if not _LOWEST_RATE <= contract.rate_hz <= _HIGHEST_RATE:
        raise RecorderError(
            f"{summary.path}: the rate of its contract is {contract.rate_hz} Hz; it must be from {_LOWEST_RATE} to "
            f"{_HIGHEST_RATE:g} Hz"
        )
    names: list[object] = [name for part in contract.action_parts for name in part.joints]
    topics = [*(part.topic for part in contract.observation_parts), *(part.topic for part in contract.action_parts)]
    if not all(isinstance(each, str) for each in (*topics, *names)):
        raise RecorderError(f"{summary.path}: its contract has a topic or a joint whose name is not text")
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise RecorderError(f"{summary.path}: its contract commands {twice[0]} twice, so its joints are unknown")
    return contract


class _Reading:
    """Sorts the messages of an episode into tracks."""

    def __init__(self, contract: Contract, reader: EpisodeReader) -> None:
        self._contract, self._reader = contract, reader
        self._joints = contract.action_joints
        parts = contract.observation_parts
        self._pictures = {part.topic: Camera(part.key, part.topic) for part in parts if part.image is not None}
        self._rectifiers = {part.topic: part.rectifier for part in parts}
        self._states: list[tuple[int, int, list[float]]] = []
        self._newest = dict.fromkeys(self._joints, float("nan"))
        self._command_topics: dict[str, list[Any]] = {}
        for part in contract.action_parts:
            self._command_topics.setdefault(part.topic, []).append(part)
        self._commands: list[tuple[int, int, list[float]]] = []
        self._of_tick: set[str] = set()
        """Topics of the commands of the present tick."""
        self._commanded = dict.fromkeys(self._joints, float("nan"))
        self._asked: list[Asked] = []
        self._commanders: list[tuple[int, str]] = []
        self._guarded: list[tuple[int, str]] = []
        self._keep_every_ns = self._still_every_ns = 1

    def window(self, name: str) -> Window:
        """Read everything."""
        summary, contract = self._reader.summary(), self._contract
        self._keep_every_ns = max(1, (summary.end_ns - summary.start_ns) // KEPT)
        self._still_every_ns = max(1, (summary.end_ns - summary.start_ns) // _STILLS)
        state_topics = {part.topic for part in contract.observation_parts if part.type == JointState.ros_type}
        wanted = {*state_topics, *self._pictures, *self._command_topics, MODEL_ANSWERS, COMMANDER, GUARD}
        there = {topic for topic, each in summary.topics.items() if each.count}
        for item in self._reader.messages(wanted & there):
            message, t_ns = item.message, item.received_ns
            if isinstance(message, ModelAnswer):
                self._asked.append(_asked_of(message, summary.path))
            elif item.topic in self._command_topics:
                self._take_command(item.topic, message, t_ns)
            elif item.topic in self._pictures:
                if isinstance(message, Image):
                    self._take_picture(self._pictures[item.topic], message, t_ns)
            elif isinstance(message, JointState):
                self._take_state(message, t_ns)
            elif isinstance(message, String) and item.topic == GUARD:
                self._guarded.append((t_ns, message.data))
            elif isinstance(message, String) and [who for _, who in self._commanders[-1:]] != [message.data]:
                self._commanders.append((t_ns, message.data))
        step_ns = contract.step_ns
        count = (summary.end_ns - summary.start_ns) // step_ns + 1 if there else 0
        if count > _MOST_TICKS:
            raise RecorderError(
                f"{summary.path}: its messages span {(summary.end_ns - summary.start_ns) / NS_PER_S:.0f} s, {count} "
                f"ticks of its contract; at most {_MOST_TICKS} are allowed. If the clock was set while it was "
                "recorded, keep the part before or after: `ibrobot episodes trim`"
            )
        ticks = summary.start_ns + np.arange(count, dtype=np.int64) * step_ns
        made = Window(
            name, contract, ticks, self._joints, Track.of(self._joints, self._states),
            Track.of(self._joints, self._commands), tuple(self._asked),
            {each.key: each for each in self._pictures.values()}, tuple(self._commanders), tuple(self._guarded),
            summary.metadata, summary.outcome, self._reader.sampled,
        )  # fmt: skip
        _ = made.document, made.policy  # what is damaged is named at once, not by a cause that needs it
        return made

    def _take_state(self, message: JointState, t_ns: int) -> None:
        taken = False
        for joint, position in zip(message.name, message.position.tolist(), strict=False):
            if joint in self._newest:
                self._newest[joint], taken = position, True
        if taken:
            self._states.append((t_ns, message.header.stamp_ns, list(self._newest.values())))

    def _take_command(self, topic: str, message: Any, t_ns: int) -> None:
        for part in self._command_topics[topic]:
            if isinstance(message, Float64MultiArray):
                values = message.data.tolist()
            elif isinstance(message, JointState):
                known = dict(zip(message.name, message.position.tolist(), strict=False))
                values = [known.get(joint, float("nan")) for joint in part.joints]
            else:
                continue
            self._commanded |= dict(zip(part.joints, values, strict=False))
        if topic in self._of_tick or not self._commands:
            self._of_tick = {topic}
            self._commands.append((t_ns, t_ns, list(self._commanded.values())))
        else:  # another executor's, of the same tick
            self._of_tick.add(topic)
            self._commands[-1] = (*self._commands[-1][:2], list(self._commanded.values()))

    def _take_picture(self, camera: Camera, message: Image, t_ns: int) -> None:
        camera.times_ns.append(t_ns)
        camera.stamps_ns.append(message.header.stamp_ns)
        digest = hashlib.blake2b(message.data, digest_size=8).digest()
        if camera.pictures and camera.pictures[-1].digest == digest:
            camera.pictures.append(camera.pictures[-1])
            return
        shown = _rgb(message)
        camera.size = shown.shape[:2]
        if not camera.stills or t_ns - max(camera.stills) >= self._still_every_ns:
            camera.stills[t_ns] = shrink(shown, STILL_WIDTH)
        if (rectify := self._rectifiers[camera.topic]) is not None:  # as the policy and datasets have it
            shown = rectify(shown)
        index = len(camera.pictures)
        camera.pictures.append(small_of(shown, digest))
        if not camera.kept or t_ns - camera.times_ns[max(camera.kept)] >= self._keep_every_ns:
            camera.kept[index] = shrink(shown)


def _asked_of(message: ModelAnswer, path: Path) -> Asked:
    """A request with its actions.

    Raises:
        RecorderError: if its numbers do not belong together, as in a recording that is damaged.
    """
    size, what = len(message.joint_names), f"{path}: answer {message.request} of the model"
    if message.actions.size % max(1, size):
        raise RecorderError(f"{what} has {message.actions.size} numbers for {counted(size, 'joint')}")
    if message.actions.size and (message.step_ns <= 0 or not size):
        raise RecorderError(f"{what} has actions for {counted(size, 'joint')}, {message.step_ns} ns apart")
    if not 0 <= message.latency_ms <= _FARTHEST:
        raise RecorderError(f"{what} took {message.latency_ms} ms")
    chunk = message.actions.reshape(-1, size) if size else np.empty((0, 0))
    if not (np.abs(chunk) <= _FARTHEST).all():
        raise RecorderError(f"{what} has an action that is not a finite number")
    return Asked(message, chunk)


def _rgb(message: Image) -> NDArray[np.uint8]:
    """The picture in colours, shape (H, W, 3); depth in grey."""
    shown = np.asarray(pixels(message))
    if shown.dtype != np.uint8:
        top = float(np.nanmax(shown)) or 1.0
        shown = (np.nan_to_num(shown.astype(np.float32)) / top * 255).astype(np.uint8)
    if shown.ndim == 2 or shown.shape[-1] == 1:
        shown = np.repeat(shown.reshape(*shown.shape[:2], 1), 3, axis=2)
    shown = shown[..., :3]
    return np.ascontiguousarray(shown[..., ::-1]) if message.encoding.startswith("bgr") else shown
