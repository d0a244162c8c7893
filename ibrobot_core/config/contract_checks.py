"""Checks of the contract: its references must exist and be consistent. Omitted values are filled in."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import attrs

from ibrobot_core import messages, schema
from ibrobot_core.config.checks import streams
from ibrobot_core.config.structure import ParsedComponent, ParsedSections
from ibrobot_core.config.yaml_nodes import Document
from ibrobot_core.convert import Key
from ibrobot_core.descriptors import Options, StreamOptions
from ibrobot_core.errors import ContractError, IbrobotError
from ibrobot_core.options import did_you_mean
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.schema import TASK_KEY, ActionSpec, ContractConfig, ExecutorConfig, ObservationSpec, SignalSpec
from ibrobot_core.selection import Selection

SIGNAL_TYPES: Mapping[str, str] = {
    TASK_KEY: messages.String.ros_type,
    "next.reward": "std_msgs/msg/Float32",
    "next.done": messages.Bool.ros_type,
}
"""Key of a signal -> default type of its messages."""

_IMAGES = (messages.Image.ros_type, messages.CompressedImage.ros_type)
_IMAGE_KEYS = "observation.images."
_TYPE_NAME = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*", re.ASCII)
_NO_FEATURE = "{0!r} is computed by no installed plugin; paths into messages are for foreign bags: set foreign: true"
_JOINT_FIELDS = ("position", "velocity", "effort")


def completed(spec: ObservationSpec, peripheral: schema.PeripheralConfig | None = None) -> ObservationSpec:
    """Complete an observation with the topic and type of its peripheral, or with the type implied by its topic."""
    if peripheral is not None and peripheral.topic:
        return attrs.evolve(spec, topic=peripheral.published, type=peripheral.message)
    if spec.topic == messages.JOINT_STATES and not spec.type:
        return attrs.evolve(spec, type=messages.JointState.ros_type)
    return spec


@attrs.frozen
class ContractChecks:
    """Checks and completes the contract; faults are added to the document."""

    document: Document
    sections: ParsedSections
    alone: bool = False
    """Whether the file has no robot; actions then have no executor, but their own `joints`."""

    def run(self) -> ContractConfig:
        """Return the completed contract."""
        contract: ContractConfig = self.sections.plain.get("contract", ContractConfig())
        if "contract" in self.document.root and "contract" not in self.sections.plain:
            return contract
        key: Key = ("contract",)
        observations = self.observations((*key, "observations"), contract.observations)
        for name, part in self.sections.models.items():
            extra: Key = ("models", name, "extra_observations")
            self._same_kind(extra, self.observations(extra, part.component.extra_observations), observations)
        self._same_kind((*key, "observations"), observations, ())
        given = contract.actions
        before = len(self.document.problems)
        actions = tuple(self._action((*key, "actions", i), spec, given[:i]) for i, spec in enumerate(given))
        self._each_joint_once((*key, "actions"), actions)
        for mode_name, mode in (self.sections.plain.get("control_modes") or {}).items():
            if mode.inference is not None and len(self.document.problems) == before:
                self._driven(("control_modes", mode_name), mode.executors, contract)
        control = self.sections.plain.get("control")
        if control is not None and contract.rate_hz > control.rate_hz:
            message = f"{contract.rate_hz} Hz is faster than the control loop, {control.rate_hz} Hz"
            self.document.add((*key, "rate_hz"), message)
        signals = tuple(
            self._signal((*key, "signals", i), spec, contract.signals[:i]) for i, spec in enumerate(contract.signals)
        )
        return attrs.evolve(contract, observations=observations, actions=actions, signals=signals)

    def observations(self, key: Key, specs: Sequence[ObservationSpec]) -> tuple[ObservationSpec, ...]:
        """Complete observations with topic and type."""
        return tuple(self._observation((*key, i), spec) for i, spec in enumerate(specs))

    def _observation(self, key: Key, spec: ObservationSpec) -> ObservationSpec:
        if spec.peripheral is not None:
            return self._of_peripheral(key, spec)
        if not spec.topic:
            self.document.add(key, "needs a topic, or a peripheral")
            return spec
        if not spec.topic.startswith("/"):
            self.document.add((*key, "topic"), f"a topic starts with /, got {spec.topic!r}")
        if spec.image is not None and spec.image.rectify:
            self.document.add((*key, "image", "rectify"), "needs a peripheral's lens: camera_info is not read")
        spec = completed(spec)
        if not spec.type:
            self.document.add(key, f"needs a type, which topic {spec.topic} does not determine")
        elif spec.foreign:
            self._foreign(key, spec)
        elif spec.type not in messages.MESSAGE_TYPES:
            remark = did_you_mean(spec.type, sorted(messages.MESSAGE_TYPES), "known")
            hint = "(set `foreign: true` for a type that only bags define)"
            self.document.add((*key, "type"), f"unknown message type {spec.type!r}{remark} {hint}")
        elif spec.topic == messages.JOINT_STATES and spec.type != messages.JointState.ros_type:
            message = f"{messages.JOINT_STATES} carries {messages.JointState.ros_type}, not {spec.type}"
            self.document.add((*key, "type"), message)
        else:
            self._fits(key, spec)
        return spec

    def _foreign(self, key: Key, spec: ObservationSpec) -> None:
        """Check an observation of a type that only the bag to convert defines."""
        if spec.type in messages.MESSAGE_TYPES:
            self.document.add((*key, "foreign"), f"{spec.type} is a known type; leave foreign out")
        elif not _TYPE_NAME.fullmatch(spec.type):
            self.document.add((*key, "type"), f"expected PACKAGE/msg/NAME, got {spec.type!r}")
        elif not spec.select:
            self.document.add(key, f"needs a select: paths to numbers of {spec.type}, e.g. wrench.force.x or data.0")
        elif spec.image is not None or spec.key.startswith(_IMAGE_KEYS):
            self.document.add(key, f"{spec.type} gives only numbers, no images; use a topic with images")

    def _of_peripheral(self, key: Key, spec: ObservationSpec) -> ObservationSpec:
        for other in ("topic", "type", "foreign"):
            if getattr(spec, other):
                self.document.add((*key, other), f"comes from peripheral {spec.peripheral!r}; give one or the other")
                return spec
        items = reversed(self.document.items("peripherals"))
        kinds = {str(item.get("name")): str(item.get("kind")) for _, item in items}
        if not self.document.refer((*key, "peripheral"), str(spec.peripheral), list(kinds), "peripheral"):
            return spec
        kind = kinds[str(spec.peripheral)]
        part = self.sections.peripherals.get(str(spec.peripheral))
        without_plugin = schema.PeripheralConfig(type="", options=Options(), name=str(spec.peripheral), kind=kind)
        peripheral = part.component if part is not None and part.component.kind == kind else without_plugin
        if not peripheral.topic:
            if part is not None:  # otherwise its own fault is reported
                message = f"a peripheral of kind {kind!r} does not determine topic and type; give them instead"
                self.document.add((*key, "peripheral"), message)
            return spec
        spec = completed(spec, peripheral)
        self._fits(key, spec)
        if spec.image is not None and spec.image.rectify and part is not None:
            self._rectified((*key, "image", "rectify"), peripheral)
        return spec

    def _rectified(self, key: Key, camera: schema.PeripheralConfig) -> None:
        """Check that the intrinsics of a camera are known."""
        try:
            if (lens := camera.options.lens) is not None:
                installed_plugins().rectifier(lens)
                return
            reason = f"a peripheral of type {camera.type!r} does not know the intrinsics of its camera"
        except IbrobotError as error:
            reason = str(error)
        self.document.add(key, reason)

    def _fits(self, key: Key, spec: ObservationSpec) -> None:
        """Check that `image` and `select` fit the message type."""
        is_image = spec.type in _IMAGES
        if spec.image is not None and not is_image:
            self.document.add((*key, "image"), f"needs a camera; {spec.topic} carries {spec.type}")
        if spec.key.startswith(_IMAGE_KEYS) and not is_image:
            self.document.add((*key, "key"), f"{spec.key} needs a camera; {spec.topic} carries {spec.type}")
        elif not spec.select and not is_image:
            self._size(key, spec.type, ())
        for i, path in enumerate(spec.select):
            self._select((*key, "select", i), path, spec)

    def _select(self, key: Key, path: str, spec: ObservationSpec) -> None:
        if spec.type == messages.JointState.ros_type and path.partition(".")[0] in installed_plugins().features:
            return  # its plugin checks it
        if spec.type in _IMAGES:
            self.document.add(key, "images have no numbers to select")
            return
        if spec.type == messages.JointState.ros_type:
            field, _, joint = path.partition(".")
            if field not in _JOINT_FIELDS or not joint:
                fields = " or ".join(f"{field}.JOINT" for field in _JOINT_FIELDS)
                self.document.add(key, f"expected {fields}, got {path!r}")
                return
            robot = self.sections.plain.get("robot")
            joints = list(robot.joint_names) if robot is not None else [joint]
            if spec.topic == messages.JOINT_STATES:
                self.document.refer(key, joint, joints, "joint")
        self._size(key, spec.type, (path,))

    def _size(self, key: Key, type_: str, select: Sequence[str]) -> int | None:
        """The number of values selected from messages of a type; None, with a fault added, if a path is wrong."""
        try:
            return Selection(type_, select).size
        except ContractError as error:
            self.document.add(key, str(error))
            return None

    def _same_kind(self, key: Key, specs: Sequence[ObservationSpec], others: Sequence[ObservationSpec]) -> None:
        """Check that values under one key can concatenate: not an image and a vector."""
        kinds = {spec.key: spec.type in _IMAGES for spec in others if spec.type}
        pictures = {spec.key for spec in others if spec.type in _IMAGES}
        for i, spec in enumerate(specs):
            if spec.type in _IMAGES and spec.key in pictures:
                message = f"a second image under {spec.key}; only vectors concatenate, so give it its own key"
                self.document.add((*key, i, "key"), message)
            pictures |= {spec.key} if spec.type in _IMAGES else set()
            if spec.key.startswith(_IMAGE_KEYS) and spec.type not in _IMAGES:
                continue  # reported already
            if spec.type and kinds.setdefault(spec.key, spec.type in _IMAGES) != (spec.type in _IMAGES):
                message = f"{spec.key} is an image in one observation and a vector in another; give them different keys"
                self.document.add((*key, i, "key"), message)

    def _action(self, key: Key, spec: ActionSpec, earlier: Sequence[ActionSpec]) -> ActionSpec:
        if not spec.topic.startswith("/"):
            self.document.add((*key, "topic"), f"a topic starts with /, got {spec.topic!r}")
        if self.alone:
            self._commands(key, spec)
            if not spec.joints:
                self.document.add(key, "needs joints: the names of its numbers, in order, e.g. [pan, lift, gripper]")
            return spec
        if spec.joints:
            self.document.add((*key, "joints"), f"are given by executor {spec.executor!r}; leave them out")
        known = self.document.names("executors")
        if not self.document.refer((*key, "executor"), spec.executor, known, "executor"):
            return spec
        self._commands(key, spec)
        if any(other.executor == spec.executor for other in earlier):
            self.document.add((*key, "executor"), f"executor {spec.executor!r} already has an action")
        for other in earlier:
            if other.topic == spec.topic and not (other.foreign or spec.foreign):
                message = f"executor {other.executor!r} has its commands on {spec.topic}; give each its own topic"
                self.document.add((*key, "topic"), message)
                break
        if (part := self.sections.executors.get(spec.executor)) is None:
            return spec
        if not streams(part):
            message = f"executor {spec.executor!r} takes goals; an action needs one for setpoints, e.g. type position"
            self.document.add((*key, "executor"), message)
        return self._safety(key, spec, part)

    def _commands(self, key: Key, spec: ActionSpec) -> None:
        """Check type and paths: of messages that this robot publishes, or of foreign ones."""
        own = messages.Float64MultiArray.ros_type
        if any(path.partition(".")[0] in installed_plugins().features for path in spec.select):
            spec = attrs.evolve(spec, select=())  # their plugin checks them
        if not spec.foreign:
            if spec.type != own:
                message = f"this robot publishes {own}, not {spec.type!r}"
                self.document.add((*key, "type"), f"{message}; set foreign: true for the commands of foreign bags")
            elif spec.select:
                self.document.add((*key, "select"), _NO_FEATURE.format(spec.select[0]))
        elif not _TYPE_NAME.fullmatch(spec.type):
            self.document.add((*key, "type"), f"expected PACKAGE/msg/NAME, got {spec.type!r}")
        elif not spec.select and spec.type not in (own, messages.JointState.ros_type):
            example = "points.0.positions.0" if spec.type.endswith("JointTrajectory") else "data.0"
            message = f"needs a select: paths to numbers of {spec.type}, one for each joint, e.g. {example}"
            self.document.add(key, message)
        elif spec.select:
            self._one_number_a_joint((*key, "select"), spec)

    def _one_number_a_joint(self, key: Key, spec: ActionSpec) -> None:
        size, joints = self._size(key, spec.type, spec.select), self._joints(spec)
        if size is not None and joints and size != len(joints):
            given = "a length that only messages determine" if size < 0 else f"{size} numbers"
            message = f"gives {given}, but {spec.executor!r} commands {len(joints)}: {', '.join(joints)}"
            self.document.add(key, message)

    def _joints(self, spec: ActionSpec) -> tuple[str, ...]:
        """The joints of an action's numbers; empty if other faults leave them unknown."""
        part, robot = self.sections.executors.get(spec.executor), self.sections.plain.get("robot")
        if part is None or robot is None:
            return spec.joints
        return tuple(dict.fromkeys(robot.groups.get(part.component.group, ())))

    def _each_joint_once(self, key: Key, actions: Sequence[ActionSpec]) -> None:
        owners: dict[str, str] = {}
        for i, spec in enumerate(actions):
            joints = self._joints(spec)
            twice = next((each for n, each in enumerate(joints) if each in owners or each in joints[:n]), None)
            if twice is not None and owners.get(twice) != spec.executor:
                self.document.add((*key, i), f"joint {twice!r} is already in the action vector; list each joint once")
            owners |= dict.fromkeys(joints, spec.executor)

    def _signal(self, key: Key, spec: SignalSpec, earlier: Sequence[SignalSpec]) -> SignalSpec:
        spec = attrs.evolve(spec, type=spec.type or SIGNAL_TYPES[spec.key])
        if not spec.topic.startswith("/"):
            self.document.add((*key, "topic"), f"a topic starts with /, got {spec.topic!r}")
        if not _TYPE_NAME.fullmatch(spec.type):
            self.document.add((*key, "type"), f"expected PACKAGE/msg/NAME, got {spec.type!r}")
        if any(other.key == spec.key for other in earlier):
            self.document.add((*key, "key"), f"{spec.key} is given twice; give it once")
        if len(spec.select) != 1:
            self.document.add((*key, "select"), f"{spec.key} takes one path, e.g. [data]")
        elif spec.key == TASK_KEY:
            self._text((*key, "select", 0), spec)
        elif self._size((*key, "select", 0), spec.type, spec.select) not in (1, None):
            path = spec.select[0]
            self.document.add((*key, "select", 0), f"{path!r} must lead to one number, e.g. {path}.0")
        return spec

    def _text(self, key: Key, spec: SignalSpec) -> None:
        """Check that a known type has the first field of the path to its text."""
        first = spec.select[0].partition(".")[0]
        known = messages.MESSAGE_TYPES.get(spec.type)
        names = [field.name for field in attrs.fields(known)] if known is not None else [first]
        if first not in names:
            self.document.add(key, f"{spec.type} has no field {first!r}{did_you_mean(first, names, 'its fields')}")

    def _safety(self, key: Key, spec: ActionSpec, part: ParsedComponent[ExecutorConfig]) -> ActionSpec:
        """Copy the behaviour for stale setpoints between action and executor, whichever states it."""
        executor = part.component.options
        if not isinstance(executor, StreamOptions):
            return spec
        stated = executor.safety_behavior
        if self.document.get(*part.key, "safety_behavior") is None:
            options = attrs.evolve(executor, safety_behavior=spec.safety_behavior)
            component = attrs.evolve(part.component, options=options)
            self.sections.executors[spec.executor] = attrs.evolve(part, component=component)
        elif self.document.get(*key, "safety_behavior") is None:
            spec = attrs.evolve(spec, safety_behavior=stated)
        elif stated != spec.safety_behavior:
            message = f"{spec.safety_behavior!r} contradicts {stated!r} of executor {spec.executor!r}"
            self.document.add((*key, "safety_behavior"), message)
        return spec

    def _driven(self, key: Key, executors: Sequence[str], contract: ContractConfig) -> None:
        """Check that the action vector of a policy drives exactly the executors of its mode."""
        acted = [action.executor for action in contract.actions]
        for i, name in enumerate(executors):
            if name in self.sections.executors and name not in acted:
                message = f"no action of the contract drives executor {name!r}; add one under contract.actions"
                self.document.add((*key, "executors", i), message)
        for name in acted:
            if name in self.sections.executors and name not in executors:
                message = f"lacks executor {name!r}, which an action of the contract drives; add it to this mode"
                self.document.add((*key, "executors"), message)
