"""A document -> its sections as attrs classes: each component by the options class of its plugin."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import attrs
from cattrs import Converter

from ibrobot_core.config.convert import Faults, fields, make_converter, said, structure_fields, unknown_key
from ibrobot_core.config.keys import (
    ComponentKeys,
    ExecutorKeys,
    HardwareKeys,
    ModelKeys,
    PeripheralKeys,
    RecordingKeys,
    Sections,
    SimulationKeys,
    TransportKeys,
)
from ibrobot_core.config.schema import Component
from ibrobot_core.config.secrets import note
from ibrobot_core.config.yaml_nodes import Document, Key
from ibrobot_core.descriptors import Descriptor, HardwareDescriptor, SensorDescriptor
from ibrobot_core.errors import PluginError
from ibrobot_core.plugins import Registry, example

_NAME = re.compile(r"[A-Za-z0-9_-]+")


@attrs.frozen
class Part:
    """A structured component: core's own keys of it, its descriptor and its options."""

    key: Key
    keys: Any
    descriptor: Descriptor[Any]
    options: Any

    @property
    def component(self) -> Component:
        """Type and options."""
        return Component(self.descriptor.type, self.options)


@attrs.define
class Parts:
    """All sections; what could not be structured is None or left out, with its faults in the document."""

    simulated: bool
    plain: dict[str, Any] = attrs.field(factory=dict)
    """Sections that are attrs classes by themselves."""
    hardware: dict[str, Part] = attrs.field(factory=dict)
    simulation: Part | None = None
    peripherals: dict[str, Part] = attrs.field(factory=dict)
    executors: dict[str, Part] = attrs.field(factory=dict)
    models: dict[str, Part] = attrs.field(factory=dict)
    teleoperation: dict[str, Part] = attrs.field(factory=dict)
    planners: dict[str, Part] = attrs.field(factory=dict)
    """By control mode."""
    recording: Part | None = None
    transport: Part | None = None
    viewer: Part | None = None

    def active(self) -> Iterator[Part]:
        """The components that a run opens at its start."""
        yield from () if self.simulated else self.hardware.values()
        yield from self.peripherals.values()
        yield from (part for part in (self.simulation, self.recording, self.transport, self.viewer) if part is not None)

    def all(self) -> Iterator[Part]:
        """Every component."""
        yield from self.active()
        yield from self.hardware.values() if self.simulated else ()
        for section in (self.executors, self.models, self.teleoperation, self.planners):
            yield from section.values()


@attrs.define
class Structurer:
    """Structures one document. Faults are noted in it; nothing is raised."""

    document: Document
    registry: Registry
    base: Path
    sim: bool

    _converter: Converter = attrs.field(init=False)

    def __attrs_post_init__(self) -> None:
        self._converter = make_converter(self.base)

    def parts(self) -> Parts:
        """All sections."""
        given = set(self.document.root)
        simulated = self.sim or ("simulation" in given and "hardware" not in given)
        parts = Parts(simulated)
        self._sections(parts)
        if simulated and "simulation" not in given:
            self.document.add((), f"--sim needs a simulation section, e.g. simulation: {{type: {example('hardware')}}}")
        elif not simulated and "hardware" not in given:
            self.document.add((), "needs a hardware section, a simulation section, or both")
        self._simulation(parts)
        self._hardware(parts)
        self._peripherals(parts)
        parts.executors = self._named("executor", "executors", ExecutorKeys)
        parts.models = self._named("policy", "models", ModelKeys)
        parts.teleoperation = self._named("teleop", "teleoperation", ComponentKeys)
        for name, mode in (parts.plain.get("control_modes") or {}).items():
            if mode.planner is not None:
                planner = self._component("planner", ("control_modes", name, "planner"), ComponentKeys)
                parts.planners |= {name: planner} if planner is not None else {}
        if "transport" in given:
            parts.transport = self._component("transport", ("transport",), TransportKeys)
        if "viewer" in given:
            parts.viewer = self._component("viewer", ("viewer",), ComponentKeys)
        if "recording" in given:
            parts.recording = self._component("recorder", ("recording",), RecordingKeys)
        return parts

    def contract(self) -> Parts:
        """The `contract` section of a file that has no other."""
        parts = Parts(simulated=False)
        self._sections(parts, ("contract",))
        return parts

    def _sections(self, parts: Parts, names: Collection[str] = tuple(fields(Sections))) -> None:
        """The file's own level: unknown and missing sections, and those that need no plugin."""
        known = {name: field for name, field in fields(Sections).items() if name in names}
        faults = Faults()
        for name in self.document.root:
            if name not in known:
                faults.add((name,), unknown_key(name, list(known)))
        parts.plain = structure_fields(known, self.document.root, self._converter, faults)
        self._report((), faults)

    def _report(self, key: Key, faults: Faults, below_sim: Collection[str] = ()) -> None:
        for inner, message in faults.found:
            middle = ("sim",) if inner and inner[0] in below_sim else ()
            self.document.add((*key, *middle, *inner), message)

    def _component(
        self,
        kind: str,
        key: Key,
        keys_class: type,
        value: Mapping[str, Any] | None = None,
        *,
        needed: bool = True,
        below_sim: Collection[str] = (),
    ) -> Part | None:
        """The component at `key` (or `value` in its place); None with its faults noted.

        Args:
            kind: plugin kind.
            key: where it is in the document.
            keys_class: core's own keys of such a component.
            value: what to structure, where it is not what the document says.
            needed: whether a plugin that is not installed is a fault; where not, only core's own keys are checked.
            below_sim: keys of `value` that the document has under `sim`.
        """
        value = self.document.get(*key) if value is None else value
        if not isinstance(value, Mapping):
            return None  # told already, with the sections
        own = fields(keys_class)
        faults = Faults()
        if "type" not in value and (close := get_close_matches("type", [k for k in value if k not in own], 1)):
            self.document.add((*key, close[0]), "unknown key, did you mean 'type'?")
            return None
        arguments = structure_fields(own, value, self._converter, faults)
        options = None
        descriptor = self._find(kind, arguments["type"], needed, faults) if "type" in arguments else None
        if descriptor is not None:
            note(self.document, descriptor.options, value, key)
            options = self._options(descriptor, own, value, faults)
        self._report(key, faults, below_sim)
        if faults.found or descriptor is None:
            return None
        return Part(key, keys_class(**arguments), descriptor, options)

    def _find(self, kind: str, type_: str, needed: bool, faults: Faults) -> Descriptor[Any] | None:
        if not needed and (kind, type_) not in self.registry.entries:
            return None
        try:
            return self.registry.find(kind, type_)
        except PluginError as error:
            faults.add(("type",), str(error))
            return None

    def _options(
        self, descriptor: Descriptor[Any], own: Mapping[str, Any], value: Mapping[str, Any], faults: Faults
    ) -> Any:
        known = {name: field for name, field in fields(descriptor.options).items() if name not in own}
        for name in value:
            if name not in own and name not in known:
                faults.add((name,), unknown_key(name, [*own, *known]))
        before = len(faults.found)
        arguments = structure_fields(known, value, self._converter, faults)
        if len(faults.found) > before:
            return None
        try:
            return descriptor.options(**arguments)
        except (ValueError, TypeError) as error:
            faults.add((), said(error))
            return None

    def _named(self, kind: str, section: str, keys_class: type) -> dict[str, Part]:
        value = self.document.root.get(section)
        found = {}
        for name in value if isinstance(value, Mapping) else ():
            self._check_name((section, name), name)
            part = self._component(kind, (section, name), keys_class)
            if part is not None:
                found[name] = part
        return found

    def _check_name(self, key: Key, name: str) -> None:
        if not _NAME.fullmatch(name):
            self.document.add(key, f"a name has letters, digits, _ and - only, got {name!r}")

    def _simulation(self, parts: Parts) -> None:
        if "simulation" not in self.document.root:
            return
        part = self._component("hardware", ("simulation",), SimulationKeys, needed=parts.simulated or self._elsewhere)
        if part is None:
            return
        if not getattr(part.descriptor, "simulated", False):
            message = f"{part.descriptor.type!r} is no simulation; it belongs in the hardware section"
            self.document.add(("simulation", "type"), message)
        elif parts.simulated or self._elsewhere:
            parts.simulation = part

    @property
    def _elsewhere(self) -> bool:
        """Whether a simulation runs in another process: peripherals of kind `simulation` bring its state here."""
        peripherals = self.document.root.get("peripherals")
        items = peripherals if isinstance(peripherals, list) else ()
        return any(isinstance(item, Mapping) and item.get("kind") == "simulation" for item in items)

    def _hardware(self, parts: Parts) -> None:
        value = self.document.root.get("hardware")
        if not isinstance(value, Mapping):
            return
        several = value and "type" not in value and all(isinstance(item, Mapping) for item in value.values())
        for name in value if several else ("hardware",):
            key: Key = ("hardware", name) if several else ("hardware",)
            self._check_name(key, name)
            part = self._component("hardware", key, HardwareKeys, needed=not parts.simulated)
            if part is None:
                continue
            if getattr(part.descriptor, "simulated", False):
                message = f"{part.descriptor.type!r} is a simulation; it belongs in the simulation section"
                self.document.add((*key, "type"), message)
            parts.hardware[name] = part

    def _peripherals(self, parts: Parts) -> None:
        descriptor = parts.simulation.descriptor if parts.simulation and parts.simulated else None
        stand_ins = descriptor.sensors if isinstance(descriptor, HardwareDescriptor) else {}
        lines: dict[str, int] = {}
        value = self.document.root.get("peripherals")
        for i, item in enumerate(value if isinstance(value, list) else ()):
            if not isinstance(item, Mapping):
                continue
            key: Key = ("peripherals", i)
            name = item.get("name")
            if isinstance(name, str):
                self._check_name((*key, "name"), name)
                if name in lines:
                    message = f"a second peripheral named {name!r}, first in line {lines[name]}"
                    self.document.add((*key, "name"), message)
                lines.setdefault(name, self.document.place((*key, "name")).line)
            stand_in = stand_ins.get(str(item.get("kind")))
            needed = not parts.simulated or (parts.simulation is not None and stand_in is None)
            part = self._peripheral(key, item, stand_in, needed=needed, simulated=parts.simulated)
            if part is not None:
                parts.peripherals[part.keys.name] = part

    def _peripheral(
        self, key: Key, item: Mapping[str, Any], stand_in: str | None, *, needed: bool, simulated: bool
    ) -> Part | None:
        """The sensor as it is, or the simulation's of its kind with the options that both have."""
        before = len(self.document.problems)
        as_is = self._component("sensor", key, PeripheralKeys, needed=needed)
        if as_is is not None and isinstance(as_is.descriptor, SensorDescriptor):
            if as_is.descriptor.kind != as_is.keys.kind:
                found = as_is.descriptor.kind
                self.document.add((*key, "kind"), f"sensor type {as_is.descriptor.type!r} is of kind {found!r}")
            if not simulated and not self._elsewhere and self._only_simulated(as_is.keys.kind, as_is.descriptor.type):
                message = f"{as_is.descriptor.type!r} exists only in simulation; run with --sim, or name a real sensor"
                self.document.add((*key, "type"), message)
        if stand_in is None or len(self.document.problems) > before:
            return as_is
        entry = self.registry.entries.get(("sensor", stand_in))
        shared = [*fields(PeripheralKeys), *(fields(entry.descriptor.options) if entry else ())]
        kept = {name: value for name, value in item.items() if name in shared}
        added = item.get("sim", {})
        return self._component("sensor", key, PeripheralKeys, {**kept, **added, "type": stand_in}, below_sim=added)

    def _only_simulated(self, kind: str, type_: str) -> bool:
        descriptors = (entry.descriptor for entry in self.registry.entries.values())
        return any(isinstance(d, HardwareDescriptor) and d.sensors.get(kind) == type_ for d in descriptors)
