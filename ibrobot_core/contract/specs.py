"""The contract: observations, actions and signals with their shapes, and a stable fingerprint."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any

import attrs

from ibrobot_core.config.contract_checks import completed
from ibrobot_core.errors import ContractError
from ibrobot_core.interfaces.feature import Feature
from ibrobot_core.messages import MESSAGE_TYPES, CompressedImage, Image, JointState, Message
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.robot import Robot
from ibrobot_core.schema import MAX_AGE, ActionSpec, Align, ImageSpec, ObservationSpec, RobotConfig
from ibrobot_core.selection import JointFeature, Selection, value_at
from ibrobot_core.units import NS_PER_S

_IMAGE_DTYPES = {"16UC1": "uint16", "32FC1": "float32"}


@attrs.frozen
class ObservationPart:
    """One topic's part of an observation, with defaults filled in."""

    key: str
    topic: str
    type: str
    select: tuple[str, ...]
    """Paths into the message; none for an image."""
    image: ImageSpec | None
    align: Align
    """Its `stamp` is `receive` for message types without a header."""
    feature: Feature
    """Shape of this part alone; -1 for a dimension that only the messages determine."""
    model: Mapping[str, Any] = attrs.field(factory=dict)
    """What computed numbers depend on: first word of their paths -> `FeatureDescriptor.model`. Of a rectified image,
    `rectify` -> the intrinsics of its camera."""

    @property
    def rectifier(self) -> Callable[[Any], Any] | None:
        """Removes the distortion of the lens from an image; None if the contract does not ask for it."""
        return installed_plugins().rectifier(self.model["rectify"]) if "rectify" in self.model else None

    @property
    def selection(self) -> Selection:
        """Reads the vector from a message."""
        return _selection(self.type, self.select, self.model)


@attrs.frozen
class ActionPart:
    """The part of the action vector for one executor."""

    executor: str
    topic: str
    type: str
    safety_behavior: str
    joints: tuple[str, ...]
    select: tuple[str, ...] = ()
    """Paths to the joints' numbers in foreign messages; empty if `data` has them in order."""
    align: str = "hold"
    """The command that is a tick's action: `hold`, the newest sent by the tick; `next`, the first sent after it."""
    max_age: float | None = None
    """How far a command may be from the tick whose action it is [s]; None for the contract's."""
    features: tuple[str, ...] = ()
    """Paths to numbers computed from the joints, which are the action instead of them, e.g. `tool.position`."""
    model: Mapping[str, Any] = attrs.field(factory=dict)
    """As `ObservationPart.model`."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its numbers in the action vector: its joints, or as the features name them."""
        return _made(self.model, self.features, self.joints).names if self.features else self.joints


@attrs.frozen
class SignalPart:
    """A topic that fills a column of a dataset that policies do not see."""

    key: str
    """`TASK`, `next.reward` or `next.done`."""
    topic: str
    type: str
    path: str
    """Path to the text or number in a message."""
    align: str = "hold"
    """As `ActionPart.align`."""

    def value(self, message: Message) -> Any:
        """The value at its path; None if the path continues beyond a number or text.

        Raises:
            ContractError: for a missing field or element.
        """
        return value_at(message, self.path.split("."))

    @property
    def feature(self) -> Feature:
        """The column of a dataset that it fills, except for a task."""
        return Feature("bool" if self.key == "next.done" else "float32", (1,))


@attrs.frozen(slots=False)
class Contract:
    """Rate, observations, actions and signals of a robot, shared by recorder, converter and inference.

    Units are SI: radians, metres, seconds; vectors are float32, images (H, W, C).
    """

    rate_hz: float
    observation_parts: tuple[ObservationPart, ...]
    """Observation parts in file order; the parts of one key concatenate."""
    action_parts: tuple[ActionPart, ...]
    """Action parts in file order; their joints concatenate to the action vector."""
    signal_parts: tuple[SignalPart, ...] = ()
    """Signals, used only in datasets."""
    max_age: float = MAX_AGE
    """Greatest age of a sample that `hold` gives [s]."""

    @classmethod
    def from_config(cls, config: RobotConfig, extra: Sequence[ObservationSpec] = ()) -> Contract:
        """The contract of a robot YAML, checked by loading.

        Args:
            config: the robot.
            extra: further observations, e.g. a model's `extra_observations`; they concatenate under existing keys.
        """
        parts = tuple(_observation(spec, config) for spec in (*config.contract.observations, *extra))
        actions = tuple(_action(spec, config) for spec in config.contract.actions)
        signals = tuple(
            SignalPart(spec.key, spec.topic, spec.type, spec.select[0], spec.align) for spec in config.contract.signals
        )
        return cls(float(config.contract.rate_hz), parts, actions, signals, config.contract.max_age)

    @classmethod
    def from_canonical(cls, canonical: Mapping[str, Any]) -> Contract:
        """The contract with this `canonical` form, e.g. from an episode; it has the same fingerprint.

        The canonical form lacks what does not affect data: names of executors, which are named by their topics here,
        and the behaviour for stale setpoints.

        Raises:
            ContractError: if it is not a canonical form.
        """
        try:
            parts = [
                _recorded_observation(key, part) for key, each in canonical["observations"].items() for part in each
            ]
            actions = [_recorded_action(**part) for part in canonical["action"]]
            signals = [SignalPart(**each) for each in canonical.get("signals", ())]
            max_age = _recorded_age(canonical.get("max_age", MAX_AGE))
            contract = cls(float(canonical["rate_hz"]), tuple(parts), tuple(actions), tuple(signals), max_age)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ContractError(f"not a recorded contract: {error!r}") from None
        if canonical.get("version") != contract.canonical()["version"]:
            raise ContractError(f"a contract of version {canonical.get('version')}; the only known version is 1")
        return contract

    @classmethod
    def of_episode(cls, metadata: Mapping[str, str]) -> Contract | None:
        """The contract in an episode's metadata; None if it has none."""
        try:
            return cls.from_canonical(json.loads(metadata["contract"])) if "contract" in metadata else None
        except (ValueError, ContractError):
            return None  # a foreign key of the same name

    @cached_property
    def step_ns(self) -> int:
        """Time between ticks [ns]."""
        return round(NS_PER_S / self.rate_hz)

    @cached_property
    def observations(self) -> Mapping[str, Feature]:
        """Observation key -> dtype, shape and names, with parts concatenated, in file order."""
        keys = dict.fromkeys(part.key for part in self.observation_parts)
        return {key: _joined([part.feature for part in self.parts(key)]) for key in keys}

    @cached_property
    def action_joints(self) -> tuple[str, ...]:
        """The joints of the action vector, in order."""
        return tuple(joint for part in self.action_parts for joint in part.joints)

    @cached_property
    def action_names(self) -> tuple[str, ...]:
        """Names of the numbers of the action vector: `action_joints`, unless it has features."""
        return tuple(name for part in self.action_parts for name in part.names)

    @cached_property
    def topics(self) -> Mapping[str, str]:
        """Topic -> message type, for all observations, actions and signals."""
        parts: Iterable[ObservationPart | ActionPart | SignalPart]
        parts = (*self.observation_parts, *self.action_parts, *self.signal_parts)
        return {part.topic: part.type for part in parts}

    def without_signals(self) -> Contract:
        """The contract without signals, as shared by robots and policies."""
        return attrs.evolve(self, signal_parts=())

    def parts(self, key: str) -> tuple[ObservationPart, ...]:
        """The parts of an observation key, in file order."""
        return tuple(part for part in self.observation_parts if part.key == key)

    def features(self) -> dict[str, Feature]:
        """Columns of a dataset with this contract, in LeRobot's format: observations, then `action`."""
        joints = self.action_joints
        names = tuple(f"{name}.pos" if name in joints else name for name in self.action_names)
        action = {"action": Feature("float32", (len(names),), names)} if names else {}
        return {**self.observations, **action}

    def canonical(self) -> dict[str, Any]:
        """Everything that affects data, as plain JSON values; `fingerprint` hashes and `difference` compares it.

        The order of observation keys does not affect data and is not hashed; the order of parts and of joints is.
        Fields that contracts of earlier versions lack are left out at their defaults, so that fingerprints stay equal.
        """
        return {
            "version": 1,
            "units": "SI",
            "rate_hz": self.rate_hz,
            **({"max_age": self.max_age} if self.max_age != MAX_AGE else {}),
            "observations": {key: [_canonical(p) for p in self.parts(key)] for key in self.observations},
            "action": [
                {"topic": p.topic, "type": p.type, "joints": list(p.joints)}
                | ({"select": list(p.select)} if p.select else {})
                | ({"align": p.align} if p.align != "hold" else {})
                | ({"max_age": p.max_age} if p.max_age is not None else {})
                | ({"features": list(p.features), "model": p.model} if p.features else {})
                for p in self.action_parts
            ],
        } | ({"signals": [attrs.asdict(p) for p in self.signal_parts]} if self.signal_parts else {})

    def fingerprint(self) -> str:
        """SHA-256, 64 hexadecimal digits, of `canonical`: equal if and only if the same messages give the same data."""
        text = json.dumps(self.canonical(), sort_keys=True, separators=(",", ":"), ensure_ascii=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def difference(self, other: Contract | Mapping[str, Any], names: tuple[str, str] = ("this", "other")) -> str:
        """The differences that affect data, showing both sides; empty if the fingerprints are equal.

        Args:
            other: a contract, or its `canonical` form, e.g. from a bag.
            names: names of the two sides.
        """
        sides = [_flat(self.canonical()), _flat(other.canonical() if isinstance(other, Contract) else other)]
        width = max(len(name) for name in names)
        lines = []
        for row in dict.fromkeys((*sides[0], *sides[1])):
            cells = [side.get(row, "(none)") for side in sides]
            if cells[0] != cells[1]:
                pairs = zip(names, cells, strict=True)
                lines += [row, *(f"  {name.rjust(width)}: {cell}" for name, cell in pairs)]
        return "\n".join(lines)


def _observation(spec: ObservationSpec, config: RobotConfig) -> ObservationPart:
    """The observation part of a spec, with paths and shape."""
    peripheral = config.peripherals[spec.peripheral] if spec.peripheral is not None else None
    spec = completed(spec, peripheral)
    # The type of image message does not affect data.
    type_ = Image.ros_type if spec.type == CompressedImage.ros_type else spec.type
    known = MESSAGE_TYPES.get(type_)
    has_header = known is None or "header" in attrs.fields_dict(known)
    align = spec.align if has_header else attrs.evolve(spec.align, stamp="receive")
    if type_ == Image.ros_type:
        image = spec.image or ImageSpec()
        size = peripheral.options.picture if peripheral is not None else None
        lens = {"rectify": peripheral.options.lens} if peripheral is not None and image.rectify else {}
        return ObservationPart(spec.key, spec.topic, type_, (), image, align, _image_feature(image, size), lens)
    model = _model(config.robot, spec.select)
    return _vector(spec.key, spec.topic, type_, spec.select, align, model, config.robot.joint_names)


def _vector(
    key: str, topic: str, type_: str, paths: Sequence[str], align: Align, model: Mapping[str, Any],
    joints: Sequence[str] = (),
) -> ObservationPart:  # fmt: skip
    selection = _selection(type_, paths, model, joints)
    feature = Feature("float32", (selection.size,), selection.names)
    return ObservationPart(key, topic, type_, selection.paths, None, align, feature, model)


def joint_selection(robot: Robot, paths: Sequence[str]) -> Selection:
    """Reads numbers of a JointState, also those that plugins compute from positions, as `select` names them.

    Raises:
        ContractError: for a path that leads to no number.
    """
    return _selection(JointState.ros_type, paths, _model(robot, paths), robot.joint_names)


def _model(robot: Robot, paths: Sequence[str]) -> dict[str, Any]:
    """What the computed numbers among the paths depend on."""
    features = installed_plugins().features
    names = dict.fromkeys(name for path in paths if (name := path.partition(".")[0]) in features)
    return {name: features[name].model(robot, [p for p in paths if p.startswith(f"{name}.")]) for name in names}


def _made(model: Mapping[str, Any], paths: Sequence[str], joints: Sequence[str] = ()) -> JointFeature:
    name = paths[0].partition(".")[0]
    if (descriptor := installed_plugins().features.get(name)) is None:
        raise installed_plugins().not_found("feature", name)
    return descriptor.make(model.get(name, {}), paths, joints)


def _selection(type_: str, paths: Sequence[str], model: Mapping[str, Any], joints: Sequence[str] = ()) -> Selection:
    computed = {path: _made(model, [path]) for path in paths if path.partition(".")[0] in model}
    return Selection(type_, paths, joints, computed)


def _recorded_observation(key: str, part: Mapping[str, Any]) -> ObservationPart:
    """The observation part of a canonical form."""
    align, model = Align(**part["align"]), dict(part.get("model", {}))
    if part["encoding"] is None:
        return _vector(key, part["topic"], part["type"], part["select"], align, model)
    height, width, _ = part["shape"]
    image = ImageSpec((height, width) if min(height, width) > 0 else None, part["encoding"], "rectify" in model)
    return ObservationPart(key, part["topic"], part["type"], (), image, align, _image_feature(image, None), model)


def _recorded_action(topic: str, max_age: float | None = None, **part: Any) -> ActionPart:
    lists: dict[str, Any] = {name: tuple(part.pop(name, ())) for name in ("joints", "select", "features")}
    max_age = None if max_age is None else _recorded_age(max_age)
    return ActionPart(topic, topic, safety_behavior="hold", max_age=max_age, **lists, **part)


def _recorded_age(value: Any) -> float:
    if not 0 < (age := float(value)) < math.inf:
        raise ValueError(f"max_age {value!r} must be above 0 s")
    return age


def _image_feature(image: ImageSpec, size: tuple[int, int] | None) -> Feature:
    height, width = image.resize or size or (-1, -1)
    channels = 3 if image.encoding in ("rgb8", "bgr8") else 1
    dtype = _IMAGE_DTYPES.get(image.encoding, "image")
    return Feature(dtype, (height, width, channels), ("height", "width", "channels"))


def _action(spec: ActionSpec, config: RobotConfig) -> ActionPart:
    executor = config.executors[spec.executor]
    model = _model(config.robot, spec.select)
    select, features = ((), spec.select) if model else (spec.select, ())
    if not select and spec.type == JointState.ros_type:
        select = tuple(f"position.{joint}" for joint in executor.joints)
    return ActionPart(
        executor.name, spec.topic, spec.type, spec.safety_behavior, executor.joints, select, spec.align, spec.max_age,
        features, model,
    )  # fmt: skip


def _joined(features: list[Feature]) -> Feature:
    if len(features) == 1:
        return features[0]
    sizes = [feature.shape[0] for feature in features]
    if -1 in sizes:
        return Feature("float32", (-1,))
    return Feature("float32", (sum(sizes),), tuple(name for feature in features for name in feature.names))


def _canonical(part: ObservationPart) -> dict[str, Any]:
    tol_ms = None if part.align.tol_ms is None else float(part.align.tol_ms)
    return {
        "topic": part.topic,
        "type": part.type,
        "select": list(part.select),
        "encoding": part.image.encoding if part.image else None,
        "shape": list(part.feature.shape),
        "align": {"strategy": part.align.strategy, "stamp": part.align.stamp, "tol_ms": tol_ms},
    } | ({"model": part.model} if part.model else {})


def _flat(canonical: Mapping[str, Any]) -> dict[str, str]:
    """One line per observation and one for the action, to print and compare."""
    rows = {name: str(canonical[name]) for name in ("version", "units", "rate_hz")}
    rows["max_age"] = str(canonical.get("max_age", MAX_AGE))
    for key, parts in canonical["observations"].items():
        for i, part in enumerate(parts):
            rows[f"{key}[{i}]" if len(parts) > 1 else key] = _line(part)
    rows |= {each["key"]: _line(each) for each in canonical.get("signals", ())}
    rows["action"] = "; ".join(_line(part) for part in canonical["action"]) or "(none)"
    return rows


def _line(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {_line(v)}" for k, v in value.items() if v is not None and v != [])
    return f"[{', '.join(_line(v) for v in value)}]" if isinstance(value, list) else str(value)
