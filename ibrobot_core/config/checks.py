"""Checks across sections: joints, groups, poses, hardware, executors, modes, start and stop behaviours."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.config.missing import Missing
from ibrobot_core.config.structure import MODELS, ParsedComponent, ParsedSections
from ibrobot_core.config.yaml_nodes import Document
from ibrobot_core.convert import Key
from ibrobot_core.deadman import LONGEST_BRAKING_S, Deadman
from ibrobot_core.descriptors import ExecutorDescriptor
from ibrobot_core.options import OptionFault
from ibrobot_core.plugins import example_type
from ibrobot_core.robot import Robot
from ibrobot_core.run_hooks import RUN_KEYS, check_key
from ibrobot_core.schema import ControlConfig, ControlMode, ExecutorConfig, HardwareConfig, InferenceConfig, devices_of


@attrs.frozen
class Checks:
    """Checks of one document. Faults are added to it; parts with earlier faults are skipped."""

    document: Document
    sections: ParsedSections
    communicates: bool = False
    """Whether the caller uses the transport itself."""

    def run(self) -> None:
        """Run all checks."""
        if (robot := self.sections.plain.get("robot")) is not None:
            self._robot(robot)
            self._hardware(robot)
            self._executors(robot)
            self._behaviours(robot)
            self._stop_times(robot)
            self._options(robot)
        for name, mode in (self.sections.plain.get("control_modes") or {}).items():
            self._mode(name, mode, robot)
        self._default_mode()
        self._devices()
        self._recording()
        self._transport()

    def _unique(self, key: Key, names: tuple[str, ...], what: str) -> None:
        for i, name in enumerate(names):
            if name in names[:i]:
                self.document.add((*key, i), f"{what} {name!r} is given twice")

    def _name(self, key: Key, name: str) -> None:
        """Check a name, which may become part of topics, files and terminal output."""
        if not name or not name.isprintable() or "/" in name or name != name.strip():
            message = f"a name is not empty and has no slash, control character or space at its ends, got {name!r}"
            self.document.add(key, message)

    def _robot(self, robot: Robot) -> None:
        at: Key = ("robot",)
        names = list(robot.joint_names)
        if not names:
            self.document.add((*at, "joints"), "a robot needs at least one joint")
        self._name((*at, "name"), robot.name)
        grouped = {joint for members in robot.groups.values() for joint in members}
        for i, name in enumerate(names):
            self._name((*at, "joints", i, "name"), name)
            if name in names[:i]:
                self.document.add((*at, "joints", i, "name"), f"a second joint named {name!r}")
            if name not in grouped:
                message = f"joint {name!r} is in no group, so no executor can own it; add it to one under robot.groups"
                self.document.add((*at, "joints", i), message)
        for group, members in robot.groups.items():
            self._name((*at, "groups", group), group)
            for i, joint in enumerate(members):
                self.document.refer((*at, "groups", group, i), joint, names, "joint")
            self._unique((*at, "groups", group), members, "joint")
        for prefix in robot.description.arms:
            if not prefix or not any(name.startswith(prefix) for name in names):
                self.document.add((*at, "description", "arms", prefix), f"no joint's name begins with {prefix!r}")
        for pose, positions in robot.description.poses.items():
            self._name((*at, "description", "poses", pose), pose)
            self._pose((*at, "description", "poses", pose), robot, positions)
        self._models(robot)

    def _models(self, robot: Robot) -> None:
        """Check that the files of the models exist; the plugin that reads them checks what they say."""
        for model in MODELS:
            path = getattr(robot.description, model)
            if path is not None and not path.is_file():
                message = f"no such file: {path}; a relative path starts at the folder of the YAML file"
                self.document.add(("robot", "description", model), message)

    def _pose(self, key: Key, robot: Robot, positions: tuple[float, ...]) -> None:
        if len(positions) != len(robot.joints):
            self.document.add(key, f"expected a position for each joint, {len(robot.joints)}, got {len(positions)}")
            return
        for i, (joint, position) in enumerate(zip(robot.joints, positions, strict=True)):
            if not joint.lower <= position <= joint.upper:
                message = f"{position} rad is outside the limits of {joint.name}, {joint.lower} to {joint.upper}"
                self.document.add((*key, i), message)

    def _hardware(self, robot: Robot) -> None:
        owners: dict[str, str] = {}
        several = len(self.sections.hardware) > 1
        for name, part in self.sections.hardware.items():
            if several and not part.component.joints:
                self.document.add((*part.key, "joints"), "required where there is more than one hardware component")
            for i, joint in enumerate(part.component.joints):
                key: Key = (*part.key, "joints", i)
                self.document.refer(key, joint, list(robot.joint_names), "joint")
                if joint in owners:
                    self.document.add(key, f"joint {joint!r} is already owned by hardware {owners[joint]!r}")
                owners.setdefault(joint, name)
        written = self.document.root.get("hardware")
        complete = isinstance(written, Mapping) and (len(self.sections.hardware) == len(written) or "type" in written)
        missing = [joint for joint in robot.joint_names if joint not in owners]
        if owners and missing and complete and all(part.component.joints for part in self.sections.hardware.values()):
            self.document.add(("hardware",), f"no hardware owns: {', '.join(missing)}")

    def _options(self, robot: Robot) -> None:
        """Run the plugins' checks of their options for this robot."""
        for part in self.sections.all():
            keys: dict[str, str] = {}
            for seen, joints in self._seen_by(part, robot):
                for fault in part.component.options.check(seen, joints):
                    self._fault(part.key, fault)
                keys |= part.component.options.terminal_keys(seen)
            for key in keys:
                self._key(key, part.key)
            for key, does in keys.items():
                if does != (always := RUN_KEYS.get(key, does)):
                    message = f"key {key!r} is both {does} and, in every run, {always}; choose another key"
                    self.document.add(_place_of(key, part.key, self.document.get(*part.key)), message)

    def _key(self, key: str, at: Key) -> None:
        try:
            check_key(key)
        except ValueError as error:
            self.document.add(_place_of(key, at, self.document.get(*at)), str(error))

    def _fault(self, key: Key, fault: OptionFault) -> None:
        """Report a fault of a component; one that needs a model that is not installed counts as missing itself."""
        absent = self.sections.absent_models.get(fault.model)
        if fault.model and ("robot", "description", fault.model) in self.document.unread:
            return
        if absent is None:
            self.document.add((*key, *fault.option), fault.message)
        else:
            self.sections.missing.append(Missing(key, (*key, *fault.option), absent))

    def _seen_by(self, part: ParsedComponent[Any], robot: Robot) -> list[tuple[Robot, tuple[str, ...]]]:
        """The robot as a component sees it, with its joints; a device sees the groups that it moves in the modes."""
        if isinstance(part.component, HardwareConfig):
            return [(robot, part.component.joints or robot.joint_names)]
        if isinstance(part.component, ExecutorConfig):
            return [(robot, robot.groups.get(part.component.group, ()))]
        moved = {group for devices in self._used for group, name in devices.items() if part.key[1:] == (name,)}
        parts = [robot.part(group) for group in robot.groups if group in moved]
        if part.key[0] != "teleoperation" or not parts or "" in moved:
            parts.append(robot)
        return [(seen, seen.joint_names) for seen in parts]

    @property
    def _used(self) -> list[Mapping[str, str]]:
        """Joint group -> device, for the devices that drive a mode and for those that intervene in one."""
        modes: Mapping[str, ControlMode] = self.sections.plain.get("control_modes") or {}
        driving = [mode.devices for mode in modes.values()]
        return driving + [part.component.devices for part in self.sections.inference.values()]

    def _devices(self) -> None:
        """Check that no two components that are open at the same time open the same device."""
        users: dict[str, list[Key]] = {}
        for part in (*self.sections.active(), *self.sections.teleoperation.values()):
            for option, device in part.component.options.devices().items():
                for user in users.setdefault(device, []):
                    if user != part.key and self._open_together(user, part.key):
                        message = f"{device} is already used by {self.document.dotted(user)}"
                        self.document.add((*part.key, option), message)
                users[device].append(part.key)

    def _open_together(self, a: Key, b: Key) -> bool:
        """Whether a run opens both components at the same time: of the teleoperation devices, those of one mode."""
        alone = a[0] == b[0] == "teleoperation"
        return not alone or any({a[1], b[1]} <= set(devices.values()) for devices in self._used)

    def _executors(self, robot: Robot) -> None:
        for part in self.sections.executors.values():
            self.document.refer((*part.key, "group"), part.component.group, list(robot.groups), "group")

    def _behaviours(self, robot: Robot) -> None:
        control: ControlConfig | None = self.sections.plain.get("control", ControlConfig())
        if control is None:
            return
        if pose := control.load_shedding.pose:
            self.document.refer(("control", "load_shedding", "pose"), pose, list(robot.description.poses), "pose")
        for key, value, words in (("startup", control.startup, ("hold",)), ("stop", control.stop, ("hold", "relax"))):
            word, _, pose = value.partition(" ")
            if value in words:
                continue
            if word == "pose" and pose:
                self.document.refer(("control", key), pose, list(robot.description.poses), "pose")
            else:
                self.document.add(("control", key), f"{value!r} is not one of: {', '.join(words)}, pose NAME")

    def _stop_times(self, robot: Robot) -> None:
        """Check that joints with a deadman come to rest in time, whatever the limits that they brake within."""
        longest_s = (self.sections.plain.get("control") or ControlConfig()).stop_time
        groups = {group for devices in self._used for group in devices}
        moved = {joint for group in groups for joint in robot.groups.get(group, robot.joint_names)}
        for i, joint in enumerate(robot.joints):
            braking_s = float(robot.braking_s[i])
            if joint.name in moved and braking_s + Deadman.hold_s - LONGEST_BRAKING_S > longest_s:
                enough = joint.max_velocity / LONGEST_BRAKING_S
                message = (
                    f"{joint.name} brakes from {joint.max_velocity:g} rad/s in {braking_s:.2f} s, so that a released "
                    f"deadman would stop it after up to {braking_s + Deadman.hold_s - LONGEST_BRAKING_S:.2f} s; write "
                    f"{math.ceil(enough * 10) / 10:g} or more, lower max_velocity, or accept it by control.stop_time"
                )
                self.document.add(("robot", "joints", i, "max_acceleration"), message)

    def _mode(self, name: str, mode: ControlMode, robot: Robot | None) -> None:
        key: Key = ("control_modes", name)
        names = self.document.names
        for i, executor in enumerate(mode.executors):
            self.document.refer((*key, "executors", i), executor, names("executors"), "executor")
        self._unique((*key, "executors"), mode.executors, "executor")
        if not mode.executors:
            self.document.add((*key, "executors"), "a mode needs at least one executor")
        if robot is not None:
            self._claims(key, mode, robot)
        self._operated((*key, "teleop"), mode.teleop, mode, robot)
        if (part := self.sections.inference.get(name)) is not None:
            self._operated((*part.key, "intervene"), part.component.intervene, mode, robot)
            self.document.refer((*part.key, "model"), part.component.model, names("models"), "model")
            self._reaches(part)
        sources = [source for source in ("teleop", "inference", "planner") if getattr(mode, source) is not None]
        if len(sources) > 1:
            self.document.add((*key, sources[1]), f"{sources[0]} already drives this mode; make a mode for each")
        elif sources:
            self._drives(key, mode, sources[0])
        if self.document.get(*key, "inference") is None and self.document.get(*key, "dispatch") is not None:
            self.document.add((*key, "dispatch"), "applies only to a mode with inference")

    def _operated(self, at: Key, given: str | Mapping[str, str] | None, mode: ControlMode, robot: Robot | None) -> None:
        """Check the devices of a mode; where they move groups, each its own joints, by executors of its own."""
        groups = devices_of(given)
        devices = list(groups.items())
        for i, (group, device) in enumerate(devices):
            place = at if isinstance(given, str) else (*at, group)
            self.document.refer(place, device, self.document.names("teleoperation"), "teleoperation device")
            if device in (other for _, other in devices[:i]):
                self.document.add(place, f"device {device!r} is given twice")
        if robot is None or not isinstance(given, Mapping):
            return
        if not devices:
            self.document.add(at, "a joint group and its device are missing, e.g. left: leader_left")
        mover: dict[str, str] = {}
        for group in groups:
            if not self.document.refer((*at, group), group, list(robot.groups), "group"):
                continue
            if shared := [joint for joint in robot.groups[group] if joint in mover]:
                message = f"groups {mover[shared[0]]!r} and {group!r} both have joint {shared[0]!r}"
                self.document.add((*at, group), message)
            mover |= dict.fromkeys(robot.groups[group], group)
        self._keys(at, groups, robot)
        unmoved = set(mover)
        for i, name in enumerate(mode.executors):
            if (part := self.sections.executors.get(name)) is None:
                return
            joints = robot.groups.get(part.component.group, ())
            unmoved -= set(joints)
            if len({mover.get(joint) for joint in joints}) > 1:
                each = ", ".join(f"{joint} by {groups.get(mover.get(joint, ''), 'none')}" for joint in joints)
                message = f"executor {name!r} follows only one device that moves all of its joints: {each}"
                self.document.add(("control_modes", at[1], "executors", i), message)
        for group in groups:
            if left := [joint for joint in robot.groups.get(group, ()) if joint in unmoved]:
                self.document.add((*at, group), f"no executor of this mode moves {', '.join(left)}")

    def _keys(self, at: Key, devices: Mapping[str, str], robot: Robot) -> None:
        """Check that no key does two things, since each device of a mode gets every key of the terminal."""
        known: dict[str, tuple[str, str]] = {}
        for group, name in devices.items():
            part = self.sections.teleoperation.get(name)
            if part is None or group not in robot.groups:
                continue
            for key, does in part.component.options.terminal_keys(robot.part(group)).items():
                other, meaning = known.setdefault(key, (name, does))
                if meaning != does:
                    message = (
                        f"key {key!r} is both {does} ({name}) and {meaning} ({other}); give one of them another key"
                    )
                    self.document.add((*at, group), message)

    def _reaches(self, part: ParsedComponent[InferenceConfig]) -> None:
        """Check that an engine that uses the transport has one to other machines."""
        transport = self.document.root.get("transport")
        elsewhere = isinstance(transport, Mapping) and transport.get("type") != "local"
        if part.component.uses_transport and not elsewhere:
            message = (
                f"{part.component.type} needs a transport to the server, "
                f"e.g. transport: {{type: {example_type('transport')}, connect: [tcp/127.0.0.1:7447]}}"
            )
            self.document.add((*part.key, part.component.type_key()), message)

    def _claims(self, key: Key, mode: ControlMode, robot: Robot) -> None:
        owners: dict[str, str] = {}
        for i, name in enumerate(mode.executors):
            part = self.sections.executors.get(name)
            if part is None or name in mode.executors[:i]:
                continue
            for joint in dict.fromkeys(robot.groups.get(part.component.group, ())):
                if joint in owners:
                    message = f"executors {owners[joint]!r} and {name!r} both claim joint {joint!r}"
                    self.document.add((*key, "executors", i), message)
                    break
                owners[joint] = name

    def _drives(self, key: Key, mode: ControlMode, source: str) -> None:
        for i, name in enumerate(mode.executors):
            part = self.sections.executors.get(name)
            if part is None or streams(part) == (source != "planner"):
                continue
            takes, sends = ("setpoints", "goals") if streams(part) else ("goals", "setpoints")
            message = f"executor {name!r} takes {takes}, but {source} sends {sends}; use one that takes {sends}"
            self.document.add((*key, "executors", i), message)

    def _default_mode(self) -> None:
        if (name := self.sections.plain.get("default_control_mode")) is not None:
            self.document.refer(("default_control_mode",), name, self.document.names("control_modes"), "control mode")
        simulation = self.sections.simulation
        if simulation is not None and (name := simulation.component.default_control_mode) is not None:
            key = ("simulation", "default_control_mode")
            self.document.refer(key, name, self.document.names("control_modes"), "control mode")

    def _transport(self) -> None:
        part = self.sections.single.get("transport")
        faulty = any(key[:1] == ("transport",) for key in self.document.unread)
        if part is None or faulty or self.communicates or part.descriptor.type == "local":
            return
        inference = self.sections.inference.values()
        used = part.component.options.used or any(e.component.uses_transport for e in inference)
        unknown = any(each.error.kind == InferenceConfig.plugin_kind for each in self.sections.missing)
        if not used and not unknown:
            message = f"nothing uses {part.descriptor.type!r}: no mode has an execution_mode that needs a transport"
            self.document.add((*part.key, "type"), message)

    def _folder(self, key: Key, folder: Path) -> None:
        """Check that a folder exists or can be made."""
        folder = folder.absolute()
        nearest = next(each for each in (folder, *folder.parents) if each.exists())  # the innermost that is there
        if not nearest.is_dir():
            self.document.add(key, f"{nearest} is a file, not a folder")
        elif not os.access(nearest, os.W_OK | os.X_OK):
            self.document.add(key, f"{nearest} is not writable for this user")

    def _recording(self) -> None:
        if (part := self.sections.single.get("recording")) is None:
            return
        self._folder(("recording", "root"), Path(part.component.root))
        topics: Any = part.component.topics
        if isinstance(topics, str) and topics not in ("contract", "all"):
            self.document.add(("recording", "topics"), f"{topics!r} is not one of: contract, all, or a list of topics")
        elif not topics:
            message = "is empty; write contract for the contract's topics, or all for every topic"
            self.document.add(("recording", "topics"), message)
        for i, topic in enumerate(topics if isinstance(topics, tuple) else ()):
            if not topic.startswith("/"):
                message = f"{topic!r} is not a full topic name, did you mean '/{topic}'?"
                self.document.add(("recording", "topics", i), message)


def streams(part: ParsedComponent[Any]) -> bool:
    """Whether an executor follows setpoints, not goals."""
    return isinstance(part.descriptor, ExecutorDescriptor) and part.descriptor.streams


def _place_of(value: str, at: Key, node: Any) -> Key:
    """The key in the mapping at `at` that has `value`; `at` itself if none has, e.g. for a default."""
    for name, inner in node.items() if isinstance(node, Mapping) else ():
        place = (*at, name)
        if inner == value or (deeper := _place_of(value, place, inner)) != place:
            return place if inner == value else deeper
    return at
