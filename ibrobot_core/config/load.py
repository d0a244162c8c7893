"""Robot YAML -> `RobotConfig`; reports all faults at once."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.component_config import ComponentConfig
from ibrobot_core.config.checks import Checks
from ibrobot_core.config.contract_checks import ContractChecks
from ibrobot_core.config.missing import split
from ibrobot_core.config.name_checks import check_names
from ibrobot_core.config.overrides import apply_overrides, put
from ibrobot_core.config.secrets import check_known, expanded_again, public, warn_of_secrets
from ibrobot_core.config.structure import MODELS, ParsedComponent, ParsedSections, SectionParser
from ibrobot_core.config.yaml_nodes import MAX_BYTES, Document, Place, parse_yaml
from ibrobot_core.convert import shown
from ibrobot_core.descriptors import Options, SectionDescriptor
from ibrobot_core.errors import ConfigError, PluginNotInstalled, Problem
from ibrobot_core.options import did_you_mean
from ibrobot_core.plugins import Registry, installed_plugins
from ibrobot_core.robot import Robot
from ibrobot_core.schema import ContractConfig, ControlConfig, PeripheralConfig, RobotConfig

DEFAULT_CONFIG = "so101"


def load_config(
    path: str | Path,
    *,
    overrides: Sequence[str] = (),
    mode: str | None = None,
    sim: bool = False,
    registry: Registry | None = None,
    communicates: bool = False,
) -> RobotConfig:
    """Read and check a robot YAML.

    Args:
        path: the file.
        overrides: `path.to.key=value`, each checked like the file.
        mode: the first mode, in place of the file's `default_control_mode` and that of the simulation.
        sim: use the `simulation` section even if there is `hardware`.
        registry: the plugins; None for the installed ones.
        communicates: whether the caller uses the transport itself, as a server does; otherwise a `transport` that the
            robot does not use is a fault.

    Raises:
        ConfigError: with all faults, in file order.
    """
    document = read_document(path)
    for command in (registry or installed_plugins()).commands.values():
        if file_problem := command.takes(document.root):
            raise ConfigError([Problem(path, 0, "", f"this is {file_problem}: ibrobot {command.name} {path}")])
    _override(document, overrides, mode)
    config = _build(document, Path(path), sim, registry or installed_plugins(), communicates)
    warn_of_secrets(document)
    return config


def contract_alone(document: Document, base: Path, registry: Registry | None = None) -> ContractConfig:
    """The contract of a document without other sections, for converting foreign bags.

    Its actions have `joints`, since there are no executors to determine them.

    Args:
        document: the document from `read_document`.
        base: the folder of relative paths.
        registry: the plugins; None for the installed ones.

    Raises:
        ConfigError: with all faults, in file order.
    """
    sections = SectionParser(document, registry or installed_plugins(), base, sim=False).contract()
    contract = ContractChecks(document, sections, alone=True).run()
    document.raise_problems()
    return contract


def read_document(path: str | Path, overrides: Sequence[str] = ()) -> Document:
    """Read a YAML file that is a mapping of sections, and apply overrides; does not check their content.

    Raises:
        ConfigError: if it cannot be read, or is not a mapping.
    """
    try:
        with Path(path).open(encoding="utf-8") as file:
            text = file.read(MAX_BYTES + 1)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError([Problem(str(path), 0, "", f"cannot be read: {reason}")]) from None
    document = parse_yaml(text, str(path))
    if not isinstance(document.root, Mapping):
        document.add((), f"expected a mapping of sections, got {shown(document.root)}")
        document.raise_problems()
    apply_overrides(document, overrides)
    return document


def from_document(
    document: Mapping[str, Any],
    *,
    source: Path,
    sim: bool,
    registry: Registry | None = None,
    overrides: Sequence[str] = (),
    mode: str | None = None,
) -> RobotConfig:
    """A config from the `document` of another config, e.g. of another process or an earlier run.

    Raises:
        ConfigError: with all faults, e.g. if other plugins are installed than when the config was made.
    """
    copied = expanded_again(Document(copy.deepcopy(dict(document)), {}, [], str(source)))
    _override(copied, overrides, mode)
    return _build(copied, source, sim, registry or installed_plugins())


def _override(document: Document, overrides: Sequence[str], mode: str | None) -> None:
    apply_overrides(document, overrides)
    if mode is not None:
        place = Place(len(overrides) + 1, 0, 0, f"--mode {mode}")
        put(document, "default_control_mode", Document(mode, {}, [], place.file), place)
        if isinstance(simulation := document.root.get("simulation"), dict):
            simulation.pop("default_control_mode", None)


def _build(document: Document, source: Path, sim: bool, registry: Registry, communicates: bool = False) -> RobotConfig:
    for each in registry.of_kind("guard"):
        if (unsaid := each.unsaid(document.root)) is not None:
            put(document, "control.guard", Document(dict(unsaid), {}, [], ""), Place(0, 0, 0, "the default of control"))
    sections = SectionParser(document, registry, source.absolute().parent, sim).sections()
    check_known(document)
    simulated = document.get("simulation", "default_control_mode") if sections.simulated else None
    entered = simulated or sections.plain.get("default_control_mode")
    Checks(document, sections, communicates).run()
    check_names(document, sections)
    simulable = ("hardware", str(document.get("simulation", "type"))) in registry.entries
    unavailable = split(
        document, sections.plain, sections.missing, entered, everything=communicates, simulable=simulable
    )
    contract_checks = ContractChecks(document, sections)
    contract, observed = contract_checks.run(), contract_checks.observations
    document.raise_problems()
    shown, secrets = public(document)
    robot = sections.plain["robot"]
    executors, models = _components(sections.executors), _components(sections.models)
    planners, inference = _components(sections.planners), _components(sections.inference)
    hardware = {} if sections.simulated else _components(sections.hardware)
    arguments = {
        **sections.plain,
        "executors": {name: attrs.evolve(each, joints=robot.groups[each.group]) for name, each in executors.items()},
        "control_modes": {
            name: attrs.evolve(mode, name=name, planner=planners.get(name), inference=inference.get(name))
            for name, mode in sections.plain["control_modes"].items()
        },
        "default_control_mode": entered,
        "hardware": {
            name: attrs.evolve(each, joints=each.joints or robot.joint_names) for name, each in hardware.items()
        },
        "simulation": _component(sections.simulation),
        "peripherals": {name: attrs.evolve(part.component, sim={}) for name, part in sections.peripherals.items()}
        | _not_installed(document, sections),
        "models": {
            name: attrs.evolve(each, extra_observations=observed(sections.models[name].key, each.extra_observations))
            for name, each in models.items()
        },
        "teleoperation": _components(sections.teleoperation),
        "contract": contract,
        "control": attrs.evolve(sections.plain.get("control") or ControlConfig(), guard=_component(sections.guard)),
        **_components(sections.single),
        "plugin_sections": _components(sections.plugin_sections),
    }
    absent = {**_unread(robot, registry), **sections.absent_models}
    missing = (*(each.error for each in sections.missing), *sections.absent_models.values())
    config = RobotConfig(
        **arguments, simulated=sections.simulated, closed_ends=_closed_ends(robot, sections), unavailable=unavailable,
        missing=missing, absent_models=absent, source=source, document=shown, complete=document.root,
        secrets=secrets,
    )  # fmt: skip
    checks = [each.check_config for each in registry.of_kind("section") if isinstance(each, SectionDescriptor)]
    for check in (*checks, *(each.check_config for each in registry.features.values())):
        for fault in check(config):
            document.add(fault.option, fault.message)
    document.raise_problems()
    return config


def _unread(robot: Robot, registry: Registry) -> dict[str, PluginNotInstalled]:
    """The models that no installed plugin reads, with the plugin that would."""
    error = registry.not_found("section", "description")
    if ("section", "description") in registry.entries or not isinstance(error, PluginNotInstalled):
        return {}
    return {model: error for model in MODELS if getattr(robot.description, model) is not None}


def _closed_ends(robot: Robot, sections: ParsedSections) -> dict[str, float | None]:
    lower = dict(zip(robot.joint_names, robot.lower.tolist(), strict=True))
    components = [part.component for part in sections.hardware.values()]
    return {
        joint: lower[joint] if joint in each.options.anchored else None
        for each in components
        for joint in each.joints or robot.joint_names
    }


def _component[C: ComponentConfig](part: ParsedComponent[C] | None) -> C | None:
    return part.component if part is not None else None


def _components[C: ComponentConfig](sections: Mapping[str, ParsedComponent[C]]) -> dict[str, C]:
    return {name: part.component for name, part in sections.items()}


def _not_installed(document: Document, sections: ParsedSections) -> dict[str, PeripheralConfig]:
    """The peripherals without an installed plugin; they have no options."""
    items = [(each.error.type, document.get(*each.key)) for each in sections.missing if each.key[0] == "peripherals"]
    return {
        item["name"]: PeripheralConfig(type=type_, options=Options(), name=item["name"], kind=item["kind"])
        for type_, item in items
    }


def find_config(name: str | None, registry: Registry) -> Path:
    """Find a config by `name`: a path, or the name of a shipped config with or without `.yaml`.

    Raises:
        ConfigError: if it does not exist; lists the known names.
    """
    name = name or DEFAULT_CONFIG
    if Path(name).is_file():
        return Path(name)
    known = registry.shipped_configs()
    stem = name.removesuffix(".yaml")
    if stem in known:
        return known[stem]
    if Path(name).name != name:
        raise ConfigError([Problem(name, 0, "", "no such file")])
    remark = did_you_mean(stem, list(known), "the configs are")
    raise ConfigError([Problem(name, 0, "", f"no such file, and no config of this name{remark}")])
