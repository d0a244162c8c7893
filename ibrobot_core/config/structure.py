"""Document -> sections as attrs classes, with the options of each component as its plugin's options class."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core import schema
from ibrobot_core.component_config import ComponentConfig, NamedComponentConfig
from ibrobot_core.config.expand import missing_package, resolve_path
from ibrobot_core.config.missing import Missing
from ibrobot_core.config.repair import structure_rest
from ibrobot_core.config.secrets import note
from ibrobot_core.config.yaml_nodes import Document
from ibrobot_core.convert import Converter, Faults, Key, error_message, unknown_key
from ibrobot_core.descriptors import Descriptor, HardwareDescriptor, SensorDescriptor
from ibrobot_core.errors import PluginError, PluginNotInstalled, how_to_install
from ibrobot_core.options import fields
from ibrobot_core.plugins import Registry, example_type

MODELS = ("mjcf", "urdf", "srdf")
"""The keys of `robot.description` that name files."""
_SINGLE = ("recording", "transport", "viewer", "terminal")
"""The sections that are one component, and no more than that."""
_NAME = re.compile(r"[A-Za-z0-9_-]+")


@attrs.frozen
class ParsedComponent[C: ComponentConfig]:
    """A structured component with its place and its plugin's descriptor."""

    key: Key
    component: C
    descriptor: Descriptor[Any]


@attrs.define
class ParsedSections:
    """All sections. Those with faults, which are in the document, are None or left out."""

    simulated: bool
    plain: dict[str, Any] = attrs.field(factory=dict)
    """Sections without components."""
    hardware: dict[str, ParsedComponent[schema.HardwareConfig]] = attrs.field(factory=dict)
    simulation: ParsedComponent[schema.SimulationConfig] | None = None
    peripherals: dict[str, ParsedComponent[schema.PeripheralConfig]] = attrs.field(factory=dict)
    executors: dict[str, ParsedComponent[schema.ExecutorConfig]] = attrs.field(factory=dict)
    models: dict[str, ParsedComponent[schema.ModelConfig]] = attrs.field(factory=dict)
    teleoperation: dict[str, ParsedComponent[schema.TeleopConfig]] = attrs.field(factory=dict)
    planners: dict[str, ParsedComponent[schema.PlannerConfig]] = attrs.field(factory=dict)
    """Per control mode."""
    inference: dict[str, ParsedComponent[schema.InferenceConfig]] = attrs.field(factory=dict)
    """Per control mode."""
    single: dict[str, ParsedComponent[Any]] = attrs.field(factory=dict)
    """Those of `_SINGLE`."""
    guard: ParsedComponent[schema.GuardConfig] | None = None
    plugin_sections: dict[str, ParsedComponent[ComponentConfig]] = attrs.field(factory=dict)
    """The sections of plugins."""
    missing: list[Missing] = attrs.field(factory=list)
    """Components without an installed plugin."""
    absent_models: dict[str, PluginNotInstalled] = attrs.field(factory=dict)
    """Model of `robot.description` -> the package that contains it and is not installed."""

    def active(self) -> Iterator[ParsedComponent[Any]]:
        """The components that a run opens when it starts."""
        yield from () if self.simulated else self.hardware.values()
        yield from self.peripherals.values()
        yield from filter(None, (self.simulation, *self.single.values(), self.guard))
        yield from self.plugin_sections.values()

    def all(self) -> Iterator[ParsedComponent[Any]]:
        """Every component."""
        yield from self.active()
        yield from self.hardware.values() if self.simulated else ()
        for section in (self.executors, self.models, self.teleoperation, self.planners, self.inference):
            yield from section.values()


class _Outline(Converter):
    """Keeps components as mappings, to be structured later by their plugins."""

    def structure(self, value: Any, kind: Any) -> Any:
        component = ComponentConfig.within(kind)
        if component is kind or (component is not None and component.may_be_alone):
            kind = Mapping[str, Any]
        return super().structure(value, kind)


@attrs.define
class SectionParser:
    """Structures one document. Faults are added to it; nothing is raised."""

    document: Document
    registry: Registry
    base: Path
    sim: bool

    _converter: Converter = attrs.field(init=False)
    _missing: list[Missing] = attrs.field(init=False, factory=list)

    def __attrs_post_init__(self) -> None:
        self._converter = Converter(self._files)

    def _files(self, text: str) -> Path:
        return resolve_path(text, self.base)

    def sections(self) -> ParsedSections:
        """All sections."""
        given = set(self.document.root)
        simulated = self.sim or ("simulation" in given and "hardware" not in given)
        sections = ParsedSections(simulated, missing=self._missing)
        self._sections(sections)
        if simulated and "simulation" not in given:
            example = f"simulation: {{type: {example_type('hardware')}}}"
            self.document.add((), f"--sim needs a simulation section, e.g. {example}")
        elif not simulated and "hardware" not in given:
            self.document.add((), "needs a hardware section, a simulation section, or both")
        self._simulation(sections)
        self._hardware(sections)
        self._peripherals(sections)
        sections.executors = self._named("executors", schema.ExecutorConfig)
        sections.models = self._named("models", schema.ModelConfig)
        sections.teleoperation = self._named("teleoperation", schema.TeleopConfig)
        for name, mode in (sections.plain.get("control_modes") or {}).items():
            if mode.planner is not None:
                key: Key = ("control_modes", name, "planner")
                planner = self._component(key, schema.PlannerConfig)
                self._need_source(key, "planner", "type")
                sections.planners |= {name: planner} if planner is not None else {}
            if mode.inference is not None:
                key = ("control_modes", name, "inference")
                inference = self._component(key, schema.InferenceConfig)
                if inference is not None and inference.component.intervene is not None:
                    self._need_source(key, "intervene", "intervene")
                sections.inference |= {name: inference} if inference is not None else {}
        for name in _SINGLE:
            kind: Any = schema.RobotConfig.sections()[name].type
            if (part := self._component((name,), kind)) is not None:
                sections.single[name] = part
        sections.guard = self._component(("control", "guard"), schema.GuardConfig)
        return sections

    def _need_source(self, key: Key, type_: str, place: str) -> None:
        """Note that the component at `key` needs a command source of a plugin."""
        if ("source", type_) not in self.registry.entries:
            error = self.registry.not_found("source", type_)
            assert isinstance(error, PluginNotInstalled)
            self._missing.append(Missing(key, (*key, place), error))

    def contract(self) -> ParsedSections:
        """The `contract` section of a file without other sections."""
        sections = ParsedSections(simulated=False)
        self._sections(sections, ("contract",))
        return sections

    def _sections(
        self, sections: ParsedSections, names: Collection[str] = tuple(schema.RobotConfig.sections())
    ) -> None:
        """Parse the top level: sections without components; unknown and missing sections are faults."""
        known = {name: field for name, field in schema.RobotConfig.sections().items() if name in names}
        faults = Faults()
        for name, value in self.document.root.items():
            if name not in known:
                self._plugin_section(sections, name, value, faults)
            elif (entry := self.registry.entries.get(("section", name))) is not None:
                reason = f"{entry.package} adds a section of this name, which is one of ibrobot's own"
                faults.add((name,), f"{reason}: rename it there, or uninstall that package")
        root, outline = self._with_installed_models(sections), _Outline(self._files)
        sections.plain = outline.arguments(known, root, faults)
        self._report((), faults)
        for name in (name for name in known if name in root and name not in sections.plain):
            faulty = [key[1:] for key, _ in faults.found if key[0] == name]
            rest = structure_rest(name, root[name], known[name].type, faulty, outline)
            sections.plain |= {name: rest} if rest is not None else {}

    def _with_installed_models(self, sections: ParsedSections) -> Mapping[str, Any]:
        """The document without the models whose package is not installed; only what needs these is affected."""
        root: Mapping[str, Any] = self.document.root
        at: Key = ("robot", "description")
        described = self.document.get(*at)
        for model in MODELS if isinstance(described, Mapping) else ():
            path = described.get(model)
            if isinstance(path, str) and (package := missing_package(path)) is not None:
                remedy = how_to_install(package)
                reason = f"robot.description.{model}: {path} is in a package that is not installed: {remedy}"
                sections.absent_models[model] = PluginNotInstalled("model", model, package, reason)
        if not sections.absent_models:
            return root
        kept = {name: value for name, value in described.items() if name not in sections.absent_models}
        return {**root, "robot": {**root["robot"], "description": kept}}

    def _plugin_section(self, sections: ParsedSections, name: str, value: Any, faults: Faults) -> None:
        """Parse a section defined by a plugin."""
        if (entry := self.registry.entries.get(("section", name))) is None:
            error = self.registry.not_found("section", name)
            if isinstance(error, PluginNotInstalled):
                self._missing.append(Missing((name,), (name,), error))
            else:
                known = [*schema.RobotConfig.sections(), *self.registry.types("section")]
                faults.add((name,), unknown_key(name, known) + self.registry.broken)
        elif value is not None:
            if isinstance(value, Mapping):
                note(self.document, entry.descriptor.options, value, (name,))
            with faults.at(name):
                options = self._converter.structure(value, entry.descriptor.options)
                section = ComponentConfig(name, options)
                sections.plugin_sections[name] = ParsedComponent((name,), section, entry.descriptor)

    def _report(self, key: Key, faults: Faults, below_sim: Collection[str] = ()) -> None:
        for inner, message in faults.found:
            middle = ("sim",) if inner and inner[0] in below_sim else ()
            self.document.add((*key, *middle, *inner), message)
            self.document.unread.add((*key, *middle, *inner))  # other checks do not report it again

    def _component[C: ComponentConfig](
        self,
        key: Key,
        kind: type[C],
        value: Mapping[str, Any] | None = None,
        *,
        name: str | None = None,
        needed: bool = True,
        below_sim: Collection[str] = (),
    ) -> ParsedComponent[C] | None:
        """Parse the component at `key`, or `value` in its place; None if it is missing or has faults.

        Args:
            key: its key in the document.
            kind: its class.
            value: the value to structure, if not the document's.
            name: its name, if not one of its keys.
            needed: whether a missing plugin is a fault; otherwise only core's own keys are checked then.
            below_sim: keys of `value` that are under `sim` in the document.
        """
        value = self.document.get(*key) if value is None else value
        if not isinstance(value, Mapping):
            return None  # reported already, with the sections
        own = fields(kind)
        faults = Faults()
        type_key = kind.type_key()
        default = own[type_key].default if type_key not in value else None
        unknown = [name for name in value if name not in own]
        if default is attrs.NOTHING and (close := get_close_matches(type_key, unknown, 1)):
            self.document.add((*key, close[0]), f"unknown key, did you mean {type_key!r}?")
            return None
        arguments = self._converter.arguments(own, value, faults)
        options = None
        type_ = arguments.get(type_key, default)
        descriptor = self._find(key, kind, type_, needed, faults) if isinstance(type_, str) else None
        if descriptor is not None:
            note(self.document, descriptor.options, value, key)
            options = self._options(key, descriptor, kind, value, faults)
        self._report(key, faults, below_sim)
        if options is None or descriptor is None:
            return None
        named = {} if name is None else {"name": name}
        kept = {name: value for name, value in descriptor.kept().items() if name in attrs.fields_dict(kind)}
        try:
            return ParsedComponent(key, kind(**arguments, **named, **kept, options=options), descriptor)
        except TypeError:
            if not faults.found:
                raise
            return None  # without a required key

    def _find(
        self, key: Key, kind: type[ComponentConfig], type_: str, needed: bool, faults: Faults
    ) -> Descriptor[Any] | None:
        if not needed and (kind.plugin_kind, type_) not in self.registry.entries:
            return None
        try:
            return self.registry.find(kind.plugin_kind, type_)
        except PluginNotInstalled as error:
            self._missing.append(Missing(key, (*key, kind.type_key()), error))
        except PluginError as error:
            faults.add((kind.type_key(),), str(error))
        return None

    def _options(
        self,
        key: Key,
        descriptor: Descriptor[Any],
        kind: type[ComponentConfig],
        value: Mapping[str, Any],
        faults: Faults,
    ) -> Any:
        own, known = fields(kind), fields(descriptor.options)
        for name in own.keys() & known.keys():
            faults.add((), f"the plugin calls an option {name!r}, which is a key of every section of its kind")
        for name in value:
            if name not in own and name not in known:
                others = [other for other in self.registry.of_kind(kind.plugin_kind) if name in fields(other.options)]
                types = ", ".join(other.type for other in others)
                message = f"unknown key with {kind.type_key()} {descriptor.type!r}; it belongs to {types}"
                faults.add((name,), message if others else unknown_key(name, [*own, *known]))
        before = len(faults.found)
        kinds = {name: ComponentConfig.within(field.type) for name, field in known.items()}
        inner = {name: each for name, each in kinds.items() if each is not None}
        plain = {name: field for name, field in known.items() if name not in inner}
        arguments = self._converter.arguments(plain, value, faults)
        for name in (name for name in inner if name in value):
            alone = value[name] if isinstance(value[name], Mapping) else {"type": value[name]}
            if (part := self._component((*key, name), inner[name], alone)) is not None:
                arguments[name] = part.component
        try:  # without faulty options, for the checks of the others
            return descriptor.options(**arguments)
        except (ValueError, TypeError) as error:
            if len(faults.found) == before:
                faults.add((), error_message(error))
            return None

    def _named[C: NamedComponentConfig](self, section: str, kind: type[C]) -> dict[str, ParsedComponent[C]]:
        by_name = {}
        for name in self.document.names(section):
            self._check_name((section, name), name)
            if (part := self._component((section, name), kind, name=name)) is not None:
                by_name[name] = part
        return by_name

    def _check_name(self, key: Key, name: str) -> None:
        if not _NAME.fullmatch(name):
            self.document.add(key, f"a name may contain only letters, digits, _ and -, got {name!r}")

    def _simulation(self, sections: ParsedSections) -> None:
        if "simulation" not in self.document.root:
            return
        part = self._component(("simulation",), schema.SimulationConfig, needed=sections.simulated or self._elsewhere)
        if part is None:
            return
        if not part.descriptor.fits(schema.SimulationConfig):
            message = f"{part.descriptor.type!r} is not a simulation; it belongs in the hardware section"
            self.document.add(("simulation", "type"), message)
        elif sections.simulated or self._elsewhere:
            sections.simulation = part

    @property
    def _elsewhere(self) -> bool:
        """Whether a simulation runs in another process; peripherals of kind `simulation` then provide its state."""
        return any(item.get("kind") == "simulation" for _, item in self.document.items("peripherals"))

    def _hardware(self, sections: ParsedSections) -> None:
        value = self.document.root.get("hardware")
        if not isinstance(value, Mapping):
            return
        several = value and "type" not in value and all(isinstance(item, Mapping) for item in value.values())
        for name in value if several else ("hardware",):
            key: Key = ("hardware", name) if several else ("hardware",)
            self._check_name(key, name)
            part = self._component(key, schema.HardwareConfig, name=name, needed=not sections.simulated)
            if part is None:
                continue
            if not part.descriptor.fits(schema.HardwareConfig):
                message = f"{part.descriptor.type!r} is a simulation; it belongs in the simulation section"
                self.document.add((*key, "type"), message)
            sections.hardware[name] = part

    def _peripherals(self, sections: ParsedSections) -> None:
        descriptor = sections.simulation.descriptor if sections.simulation and sections.simulated else None
        stand_ins = descriptor.sensors if isinstance(descriptor, HardwareDescriptor) else {}
        lines: dict[str, int] = {}
        for key, item in self.document.items("peripherals"):
            name = item.get("name")
            if isinstance(name, str):
                self._check_name((*key, "name"), name)
                if name in lines:
                    message = f"a second peripheral named {name!r}, first in line {lines[name]}"
                    self.document.add((*key, "name"), message)
                lines.setdefault(name, self.document.place((*key, "name")).line)
            stand_in = stand_ins.get(str(item.get("kind")))
            needed = not sections.simulated or (sections.simulation is not None and stand_in is None)
            part = self._peripheral(key, item, stand_in, needed=needed, simulated=sections.simulated)
            if part is not None:
                sections.peripherals[part.component.name] = part

    def _peripheral(
        self, key: Key, item: Mapping[str, Any], stand_in: str | None, *, needed: bool, simulated: bool
    ) -> ParsedComponent[schema.PeripheralConfig] | None:
        """Parse a sensor, or in simulation the simulated sensor of its kind, with the options that both have."""
        before = len(self.document.problems)
        as_is = self._component(key, schema.PeripheralConfig, needed=needed)
        sound = len(self.document.problems) == before
        if sound and as_is is not None and isinstance(as_is.descriptor, SensorDescriptor):
            kind, type_ = as_is.component.kind, as_is.component.type
            if as_is.descriptor.kind != kind:
                actual_kind = as_is.descriptor.kind
                self.document.add((*key, "kind"), f"sensor type {type_!r} is of kind {actual_kind!r}")
            if not simulated and not self._elsewhere and self._only_simulated(kind, type_):
                message = f"{type_!r} exists only in simulation; run with --sim, or name a real sensor"
                self.document.add((*key, "type"), message)
        if stand_in is None or len(self.document.problems) > before:
            return as_is
        entry = self.registry.entries.get(("sensor", stand_in))
        shared = [*fields(schema.PeripheralConfig), *(fields(entry.descriptor.options) if entry else ())]
        kept = {name: value for name, value in item.items() if name in shared}
        added = item.get("sim", {})
        return self._component(key, schema.PeripheralConfig, {**kept, **added, "type": stand_in}, below_sim=added)

    def _only_simulated(self, kind: str, type_: str) -> bool:
        descriptors = (entry.descriptor for entry in self.registry.entries.values())
        return any(isinstance(d, HardwareDescriptor) and d.sensors.get(kind) == type_ for d in descriptors)
