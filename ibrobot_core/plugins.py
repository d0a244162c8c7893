"""Discovery of plugins through entry points, each in its own manager, so that a broken plugin affects no other."""

from __future__ import annotations

import gc
import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from difflib import get_close_matches
from functools import cache, partial
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

import attrs
import pluggy

from ibrobot_core import descriptors, hookspecs, plugin_messages
from ibrobot_core.bug_reports import describe_bug
from ibrobot_core.errors import (
    ContractError,
    IbrobotError,
    MissingDependency,
    PluginError,
    PluginNotInstalled,
    RecorderError,
    how_to_install,
    plugin_type,
)
from ibrobot_core.options import did_you_mean

if TYPE_CHECKING:
    from ibrobot_core.interfaces import EpisodeReader, Policy
    from ibrobot_core.interfaces.run_state import AbsentSensor
    from ibrobot_core.messages import CompressedImage, Image
    from ibrobot_core.schema import RobotConfig

ENTRY_POINT_GROUP = "ibrobot"
CORE = "ibrobot-core"
"""The package whose plugin is loaded before all others."""

KINDS: Mapping[str, str] = {
    "hardware": "ibrobot_hardware",
    "sensor": "ibrobot_sensors",
    "teleop": "ibrobot_teleop",
    "policy": "ibrobot_policies",
    "engine": "ibrobot_engines",
    "executor": "ibrobot_executors",
    "source": "ibrobot_sources",
    "transport": "ibrobot_transports",
    "recorder": "ibrobot_recorders",
    "viewer": "ibrobot_viewers",
    "terminal": "ibrobot_terminals",
    "units": "ibrobot_units",
    "section": "ibrobot_sections",
}
"""Plugin kind -> its registration hook."""
_UNTYPED = tuple(f"ibrobot_{name}s" for name in ("reader", "decoder", "feature", "message", "config", "command"))
"""Registration hooks for objects that the YAML does not name by `type`."""

OFFICIAL = Path(__file__).with_name("official_plugins.json")
"""The types in this project's packages: package -> kind -> types; kind `default` lists the kinds whose default type the
package contains. Errors name missing plugins from it. `python tests/house/official_plugins.py` writes it."""
RECORDS = "records"
"""The key in `OFFICIAL` for the section whose component records episodes."""

_CLASSES = {"str": str, "Path": Path, "builtins.type[Any]": type, "Late": descriptors.Late}
"""Annotation -> class, for the fields of descriptors that commands read even if they use nothing of the plugin."""
_NOT_THEIRS: Mapping[str, object] = {"reads": False, "takes": "", "without_section": False, "questions": ()}
"""Function of a descriptor that is asked about any file or robot -> its answer for what is not the plugin's."""

_log = logging.getLogger("ibrobot.plugins")


@attrs.frozen
class Failure:
    """A plugin that failed to load, and why."""

    plugin: str
    package: str
    stage: str
    """`import`, `hooks` (for a misspelt or malformed hook), or the name of the hook that raised."""
    reason: str

    def __str__(self) -> str:
        doing = {"import": "failed to import", "hooks": "has a wrong hook"}.get(self.stage, f"failed in {self.stage}")
        return f"plugin {self.plugin!r} ({self.package}) {doing}: {self.reason}"


@attrs.frozen
class Entry:
    """A descriptor with its plugin and package."""

    kind: str
    descriptor: descriptors.Descriptor[Any]
    plugin: str
    package: str
    version: str


@attrs.define
class Registry:
    """The descriptors of all installed plugins, and the plugins that failed."""

    entries: dict[tuple[str, str], Entry] = attrs.field(factory=dict)
    failures: list[Failure] = attrs.field(factory=list)
    configs: list[descriptors.ConfigFile] = attrs.field(factory=list)
    readers: list[descriptors.ReaderDescriptor] = attrs.field(factory=list)
    decoders: list[descriptors.DecoderDescriptor] = attrs.field(factory=list)
    features: dict[str, descriptors.FeatureDescriptor] = attrs.field(factory=dict)
    messages: dict[str, descriptors.MessageDescriptor] = attrs.field(factory=dict)
    """Message types that plugins define, by ROS name."""
    kinds: dict[str, descriptors.Kind] = attrs.field(factory=dict)
    """The kinds that plugins define; `KINDS` has those of core."""
    commands: dict[str, descriptors.Command] = attrs.field(factory=dict)
    command_packages: dict[str, str] = attrs.field(factory=dict)
    """Command -> the package that offers it."""
    managers: dict[str, pluggy.PluginManager] = attrs.field(factory=dict)
    doubles: dict[tuple[str, str], list[str]] = attrs.field(factory=dict)
    """Kind (or `command`) and type (or name) -> the packages that offer it, if these are several."""

    @property
    def all_kinds(self) -> dict[str, str]:
        """Kind -> its hook, of core and of plugins."""
        return {**KINDS, **{kind.name: kind.hook for kind in self.kinds.values()}}

    def types(self, kind: str) -> list[str]:
        """The available types of a kind, sorted."""
        return sorted(t for k, t in self.entries if k == kind)

    def of_kind(self, kind: str) -> list[descriptors.Descriptor[Any]]:
        """The descriptors of a kind, sorted by type."""
        return [self.entries[kind, type_].descriptor for type_ in self.types(kind)]

    def versions(self) -> dict[str, str]:
        """Package -> version of the packages that provide descriptors, sorted."""
        return dict(sorted({entry.package: entry.version for entry in self.entries.values()}.items()))

    def find(self, kind: str, type_: str) -> descriptors.Descriptor[Any]:
        """The descriptor of `type_`.

        Raises:
            PluginError: if no installed plugin provides it; names the package to install, or the broken plugin.
        """
        if (entry := self.entries.get((kind, type_))) is None or (kind, type_) in self.doubles:
            raise self.not_found(kind, type_)
        return entry.descriptor

    def create(self, kind: str, type_: str, *arguments: Any) -> Any:
        """An object of a type, made of options and context.

        Raises:
            PluginError: as `find`, or if `make` of the descriptor returns something else or has a bug: any error but an
                IbrobotError.
        """
        interfaces = import_module("ibrobot_core.interfaces")
        try:
            made = self.find(kind, type_).make(*arguments)
        except Exception as error:
            if isinstance(error, IbrobotError):
                raise
            (name,) = [each.name for each in arguments if isinstance(each, interfaces.Context)] or [kind]
            failed = f"{name}: plugin {self.entries[kind, type_].plugin!r} failed in make of {plugin_type(kind, type_)}"
            raise PluginError(f"{failed}: {describe_bug(error, placed=False)}") from error
        wanted = vars(interfaces).get(kind.capitalize(), object)
        if made is None or not isinstance(made, wanted):
            raise PluginError(f"make of {plugin_type(kind, type_)} returned {made!r}; expected {wanted.__name__}")
        return made

    def command(self, name: str) -> descriptors.Command:
        """A command.

        Raises:
            PluginError: if no installed plugin offers it; names the package to install, or the broken plugin.
        """
        if name not in self.commands or ("command", name) in self.doubles:
            raise self.not_found("command", name.partition(" ")[0])
        return self.commands[name]

    def sections(self, config: RobotConfig) -> Iterator[tuple[descriptors.SectionDescriptor, Any]]:
        """The plugins' sections for a robot with their options; None for a section that the file lacks."""
        for descriptor in self.of_kind("section"):
            assert isinstance(descriptor, descriptors.SectionDescriptor)
            section = config.plugin_sections.get(descriptor.type)
            if section is not None or descriptor.without_section(config):
                yield descriptor, None if section is None else section.options

    def require_episode_recorder(self) -> None:
        """Check that a plugin records the episodes of runs with a section `recording`.

        Raises:
            PluginNotInstalled: if none does.
        """
        sections = self.of_kind("section")
        if not any(isinstance(each, descriptors.SectionDescriptor) and each.records_episodes for each in sections):
            (type_,) = self.official(RECORDS)
            error = self.not_found("section", type_)
            assert isinstance(error, PluginNotInstalled)
            raise PluginNotInstalled("section", "recording", error.package, error.reason)

    def default(self, kind: str) -> str:
        """The default type of a kind for commands.

        Raises:
            PluginError: if none or several of the installed plugins provide a default; names a package to install.
        """
        defaults = [entry for (k, _), entry in self.entries.items() if k == kind and entry.descriptor.default]
        if len(defaults) == 1:
            return defaults[0].descriptor.type
        if defaults:
            packages = ", ".join(f"{entry.descriptor.type} ({entry.package})" for entry in defaults)
            raise PluginError(f"name the type of the {kind}: several plugins offer a default: {packages}")
        package = self.official("default")[kind]
        raise PluginError(f"no {kind} is named, and no installed plugin has a default: {how_to_install(package)}")

    def missing(self, kind: str, type_: str, options: descriptors.Options | None = None) -> MissingDependency | None:
        """The dependency that this machine lacks for `type_`, or None. A check that raises is reported too.

        With the options of a sensor, also the device that they name.

        Raises:
            PluginError: as `find`.
        """
        descriptor = self.find(kind, type_)
        try:
            descriptor.check()
            if options is not None:
                options.find_device()
        except MissingDependency as missing:
            return missing
        except BaseException as error:  # noqa: BLE001 - contained: a plugin's fault must not hide the other checks
            package = self.entries[kind, type_].package
            return MissingDependency(f"its check failed: {_reason(error)}", remedy=f"report it to {package}")
        return None

    def shipped_configs(self) -> dict[str, Path]:
        """Name -> file of the robot YAMLs shipped with ibrobot and plugins; ibrobot's own first."""
        package = Path(__file__).parent
        in_wheel = package / "_configs"
        folder = in_wheel if in_wheel.is_dir() else package.parent / "configs"
        configs = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
        for config in self.configs:
            configs.setdefault(config.name, config.path)
        return configs

    def absent_sensors(self, config: RobotConfig) -> tuple[AbsentSensor, ...]:
        """The peripherals whose plugins lack a dependency on this machine, and those that are not connected.

        Raises:
            MissingDependency: for a peripheral whose topic is unknown before it runs, so that its users are unknown
                too.
        """
        from ibrobot_core.interfaces.run_state import AbsentSensor

        absent = []
        for name, peripheral in config.peripherals.items():
            try:
                missing = self.missing("sensor", peripheral.type, peripheral.options)
            except PluginNotInstalled as error:
                missing = MissingDependency(error.missing, remedy=error.remedy)
            if missing is None:
                continue
            if not peripheral.published:
                raise missing
            absent.append(AbsentSensor(name, f"{peripheral.kind} {name}", peripheral.published, missing))
        return tuple(absent)

    def build_policy(self, config: RobotConfig, name: str, seed: int = 0) -> Policy:
        """The model `name` of a robot, which is not loaded yet; for a process that runs no other part of the robot.

        Raises:
            PluginError: if its plugin is not installed.
            PolicyError: e.g. for a checkpoint without its statistics.
        """
        from ibrobot_core.clock import RealClock
        from ibrobot_core.interfaces import Context

        model = config.models[name]
        policy: Policy = self.create("policy", model.type, model.options, Context.of(config, name, RealClock(), seed))
        return policy

    def open_episode(self, path: Path, given: Mapping[str, str] | None = None) -> EpisodeReader:
        """A reader of an episode.

        Args:
            path: path of the episode; `DATASET:N` is episode N, from 0, of a dataset.
            given: metadata for an episode without its own; see `EpisodeAddress`.

        Raises:
            RecorderError: if the path does not exist, no installed plugin reads its format, or it cannot be read.
        """
        from ibrobot_core.interfaces import EpisodeAddress

        address = EpisodeAddress.of(path, given)
        for reader in self.readers:
            if reader.reads(address.path):
                if address.number is not None and not reader.numbered:
                    raise RecorderError(f"{path}: {address.path} is a single episode; leave :{address.number} out")
                return reader.make(address)
        formats = ", ".join(f"{reader.type} ({reader.summary})" for reader in self.readers)
        packages = " or ".join(dict.fromkeys(self.official("reader").values()))
        hint = "" if formats else f"; {how_to_install(packages)}"
        raise RecorderError(f"{path}: not an episode of a known format; installed: {formats or 'none'}{hint}")

    def decode(self, picture: CompressedImage) -> Image:
        """Decode a compressed image.

        Raises:
            ContractError: if no installed plugin decodes its format, or the image is damaged.
        """
        for decoder in self.decoders:
            if (image := decoder.make()(picture)) is not None:
                return image
        formats = ", ".join(sorted({each for decoder in self.decoders for each in decoder.formats})) or "none"
        raise ContractError(f"no installed plugin decodes a {picture.format!r} picture; those decoded are: {formats}")

    def rectifier(self, lens: Mapping[str, Any]) -> Callable[[Any], Any]:
        """What removes the distortion of a lens from images.

        Raises:
            PluginError: if no installed plugin can.
            ContractError: if the intrinsics are not those of a camera.
        """
        for decoder in self.decoders:
            if decoder.rectifier is not None:
                return decoder.rectifier(lens)
        raise self.not_found("rectifier", "lens")

    def not_found(self, kind: str, type_: str) -> PluginError:
        """The error for an unavailable type or command (kind `command`), with the package to install or to repair."""
        what = plugin_type(kind, type_)
        if packages := self.doubles.get((kind, type_)):
            return PluginError(f"{what} is offered by {' and '.join(packages)}: uninstall all but one of them")
        package = self.official(kind).get(type_)
        for failure in self.failures:
            if failure.package == package:
                return PluginNotInstalled(kind, type_, package, f"{what} is not available: {failure}")
        if package is not None:
            return PluginNotInstalled(kind, type_, package)
        return PluginError(f"unknown {what}{did_you_mean(type_, self.types(kind), 'installed')}{self.broken}")

    def official(self, kind: str) -> Mapping[str, str]:
        """Types of a kind, or commands, of this project's packages, installed or not -> the package."""
        return {type_: package for package, offers in official_plugins().items() for type_ in offers.get(kind, ())}

    @property
    def broken(self) -> str:
        """The plugins that failed, for appending to errors about unknown names."""
        return "".join(f"; {failure}" for failure in self.failures)

    def doctor(self) -> list[descriptors.Check]:
        """The checks of all plugins; a check that raises becomes a failed check."""
        checks: list[descriptors.Check] = []
        for name, manager in self.managers.items():
            try:
                checks += _offered(manager, "ibrobot_doctor")
            except BaseException as error:  # noqa: BLE001 - contained: a plugin's fault must not hide the other checks
                failure = f"its doctor check failed: {_reason(error)}"
                checks.append(descriptors.Check(f"plugin {name}", False, failure, "report it"))
        return checks

    def emit(self, event: str, **facts: Any) -> None:
        """Call the event hook of every plugin. Errors are logged and do not affect other plugins."""
        for name, manager in self.managers.items():
            try:
                getattr(manager.hook, event)(**facts)
            except BaseException as error:  # noqa: BLE001 - contained: an observer must not stop the robot
                _log.error("plugin %r failed in %s: %s", name, event, _reason(error))


@cache
def official_plugins() -> Mapping[str, Mapping[str, list[str]]]:
    """The content of `OFFICIAL`."""
    packages: dict[str, dict[str, list[str]]] = json.loads(OFFICIAL.read_bytes())
    return packages


def example_type(kind: str) -> str:
    """A type of a kind as an example for messages: this project's default, even if not installed."""
    return next(offers[kind][0] for offers in official_plugins().values() if kind in offers.get("default", ()))


def _reason(error: BaseException) -> str:
    try:
        lines = str(error).strip().splitlines()
    except Exception:  # noqa: BLE001 - contained: a plugin's error may be as broken as the plugin
        lines = []
    if isinstance(error, pluggy.PluginValidationError):
        return f"{lines[0]}: {lines[-1]}"  # the last line has the cause
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def _check_names(plugin: Any, kinds: Iterable[descriptors.Kind]) -> None:
    """Refuse functions with the name prefix of hooks that are not hooks, so that typos do not go unnoticed."""
    known = {name for name in vars(hookspecs) if name.startswith("ibrobot_")} | {kind.hook for kind in kinds}
    for name in vars(plugin) if isinstance(plugin, ModuleType) else dir(plugin):
        hook: Any = getattr(plugin, name) if name.startswith("ibrobot_") and name not in known else None
        if name in known and callable(written := getattr(plugin, name)) and not hasattr(written, "ibrobot_impl"):
            raise ValueError(f"{name} is not marked with @hookimpl")
        if hasattr(hook, "ibrobot_impl") and not hook.ibrobot_impl["optionalhook"]:
            close = get_close_matches(name, known, 1)
            raise ValueError(f"unknown hook {name!r}" + (f", did you mean {close[0]!r}?" if close else ""))


@cache
def _expected(hook: str) -> type[Any]:
    """The class of what a hook of core yields."""
    names = {"Iterable": list, "descriptors": descriptors}
    expected: type[Any] = get_args(get_type_hints(getattr(hookspecs, hook), names)["return"])[0]
    return expected


def _offered(manager: pluggy.PluginManager, hook: str, expected: type[Any] | None = None) -> list[Any]:
    """Objects that a plugin yields for a hook; core's hooks have their class as annotation. Their names are texts."""
    expected = expected or _expected(hook)
    caller = getattr(manager.hook, hook)
    results = caller()
    wrong = next((type(each).__name__ for each in results if not isinstance(each, Iterable)), None)
    if wrong or len(results) < len(caller.get_hookimpls()):
        raise TypeError(f"it returned {wrong}: yield what it offers")
    offers = [each for result in results for each in result]
    for each in offers:
        if not isinstance(each, expected) or (expected is descriptors.Descriptor and type(each) is not expected):
            raise TypeError(f"expected a {expected.__name__}, got {each!r}")
        for field in attrs.fields(type(each)):
            if not isinstance(value := getattr(each, field.name), _CLASSES.get(field.type, object)):
                raise TypeError(f"{expected.__name__}.{field.alias} must be a {field.type}, not {value!r}")
        if isinstance(each, descriptors.Descriptor | descriptors.MessageDescriptor):
            for mistake in each.mistakes():
                raise TypeError(f"{expected.__name__} {each.type!r}: {mistake}")
    ((plugin, _),) = manager.list_name_plugin()
    return [attrs.evolve(each, **_contained(each, f"plugin {plugin!r} failed in %s of {hook}: %s")) for each in offers]


def _contained(offer: Any, message: str) -> dict[str, Callable[..., Any]]:
    """The functions of an offer that are asked about any file or robot. If they raise, it is not theirs."""

    def ask(name: str, *arguments: Any) -> Any:
        try:
            return list(offer.check_config(*arguments)) if name == "check_config" else getattr(offer, name)(*arguments)
        except (Exception, SystemExit, GeneratorExit) as error:  # other plugins' are asked, too
            if name not in _NOT_THEIRS:
                raise PluginError(message % (name, _reason(error))) from error
            _log.error(message, name, _reason(error))
            return _NOT_THEIRS[name]

    asked = (*_NOT_THEIRS, "make" if isinstance(offer, descriptors.DecoderDescriptor) else "check_config")
    return {name: partial(ask, name) for name in asked if name in attrs.fields_dict(type(offer))}


@attrs.define
class _Plugin:
    """A plugin on its way into a registry."""

    name: str
    package: str
    version: str
    entry: EntryPoint
    manager: pluggy.PluginManager
    stage: str = "import"

    @classmethod
    def of(cls, entry: EntryPoint) -> _Plugin:
        manager = pluggy.PluginManager("ibrobot")
        manager.add_hookspecs(hookspecs)
        facts = entry.dist.metadata if entry.dist else {"Name": "?", "Version": "?"}  # each access reads a file
        return cls(entry.name, facts["Name"], facts["Version"], entry, manager)

    def succeeds(self, step: Callable[[Registry], None], registry: Registry) -> bool:
        """Take a step; if it raises, the plugin is registered as a failure."""
        try:
            step(registry)
        except BaseException as error:  # noqa: BLE001 - contained: reported where the plugin is asked for
            registry.failures.append(Failure(self.name, self.package, self.stage, _reason(error)))
            return False
        return True

    def load(self, registry: Registry) -> None:
        """Import it, and register its kinds."""
        if made_for := self.entry.group.removeprefix(ENTRY_POINT_GROUP):
            raise PluginError(f"it needs version {made_for[1:]} of the plugin interface; {CORE} has 1: update {CORE}")
        loaded = self.entry.load()
        self.stage = "hooks"
        self.manager.register(loaded, self.name)
        self.stage = "ibrobot_kinds"
        for kind in _offered(self.manager, self.stage):
            if kind.name in KINDS or registry.kinds.setdefault(kind.name, kind) != kind:
                self.refuse(registry, f"kind {kind.name!r} is defined by another package already")

    def offer(self, registry: Registry) -> None:
        """Register what it offers; nothing of it if one of its hooks raises."""
        kinds = list(registry.kinds.values())
        self.stage = "hooks"
        if kinds:  # all at once: pluggy looks at every attribute of what it is given
            self.manager.add_hookspecs(type("Kinds", (), {kind.hook: hookspecs.hookspec(lambda: ()) for kind in kinds}))
        ((_, loaded),) = self.manager.list_name_plugin()
        _check_names(loaded, kinds)
        if not self.manager.get_hookcallers(loaded):
            raise ValueError(f"{self.entry.value} has no hooks: functions that are marked with @hookimpl")
        self.manager.check_pending()
        classes = {kind.hook: kind.descriptor for kind in kinds}
        offers: dict[str, list[Any]] = {}
        for self.stage in (*registry.all_kinds.values(), *_UNTYPED):
            offers[self.stage] = _offered(self.manager, self.stage, classes.get(self.stage))
        for name, hook in registry.all_kinds.items():
            for each in offers[hook]:
                entry = Entry(name, each, self.name, self.package, self.version)
                if (other := registry.entries.setdefault((name, each.type), entry)) is not entry:
                    self.double(registry, name, each.type, other.package, hook)
        for name in ("readers", "decoders", "configs"):
            getattr(registry, name).extend(offers[f"ibrobot_{name}"])
        for each in offers["ibrobot_commands"]:
            if registry.commands.setdefault(each.name, each) is each:
                registry.command_packages[each.name] = self.package
            else:
                self.double(registry, "command", each.name, registry.command_packages[each.name], "ibrobot_commands")
        for each in offers["ibrobot_messages"]:
            if registry.messages.setdefault(each.type, each) is not each:
                first = registry.messages[each.type].message.place
                self.refuse(registry, f"message type {each.type} is defined by {first} already", "ibrobot_messages")
        registry.features |= {each.name: each for each in offers["ibrobot_features"]}
        registry.managers[self.name] = self.manager

    def double(self, registry: Registry, kind: str, name: str, owner: str, hook: str) -> None:
        """Register that another package offers it, too. It is refused where it is used; what core offers stays."""
        if owner not in (CORE, self.package):  # a package that is on the path twice is one
            registry.doubles.setdefault((kind, name), [owner]).append(self.package)
        self.refuse(registry, f"{plugin_type(kind, name)} is offered by {owner} already", hook)

    def refuse(self, registry: Registry, reason: str, stage: str = "ibrobot_kinds") -> None:
        """Register that one of its offers is not used."""
        registry.failures.append(Failure(self.name, self.package, stage, reason))


def discover(points: Iterable[EntryPoint] | None = None) -> Registry:
    """Load core's own plugin, then others. A plugin's failure raises nothing; see `Registry.failures`.

    Args:
        points: entry points of the others; None for all that are installed.

    Raises:
        PluginError: if the installation of core lacks its entry point, as one from before it had one.
    """
    installed = [entry for entry in entry_points() if entry.group.partition(".")[0] == ENTRY_POINT_GROUP]
    own = [entry for entry in installed if entry.dist is not None and entry.dist.name == CORE]
    if not own:
        raise PluginError(f"the installed {CORE} has no plugin of its own: install it again, in a clone with `uv sync`")
    others = [entry for entry in (installed if points is None else points) if entry not in own]
    registry = Registry()
    plugins = [_Plugin.of(entry) for entry in (*own, *sorted(others, key=lambda entry: entry.name))]
    for plugin in [plugin for plugin in plugins if plugin.succeeds(plugin.load, registry)]:
        plugin.succeeds(plugin.offer, registry)
    registry.failures.sort(key=lambda failure: failure.plugin)
    return registry


@cache
def installed_plugins() -> Registry:
    """The registry of the installed plugins, discovered once per process."""
    collects = gc.isenabled()
    gc.disable()  # what imports make stays: no garbage is looked for in it, now, later, or when Python ends
    try:
        return discover()
    finally:
        gc.freeze()
        if collects:
            gc.enable()


plugin_messages.source = lambda: installed_plugins().messages
