"""`RobotConfig` -> YAML with all defaults filled in, which loads to the same config."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import attrs
import yaml

from ibrobot_core import schema
from ibrobot_core.component_config import ComponentConfig
from ibrobot_core.config.yaml_nodes import is_text
from ibrobot_core.options import HIDDEN, fields
from ibrobot_core.safe_output import without_credentials

_RESOLVED: Mapping[type, str] = {schema.PeripheralConfig: "sim", schema.SimulationConfig: "default_control_mode"}
"""Component -> a key resolved by loading: a simulated sensor's options, or the first mode in simulation."""


def plain(value: Any) -> Any:
    """A config value as plain YAML or JSON: attrs classes as mappings, tuples as lists, paths as text."""
    match value:
        case ComponentConfig():
            return _fields(value, but=(_RESOLVED.get(type(value)),)) | plain(value.options)
        case schema.ControlMode():
            left_out = ("dispatch",) if value.inference is None else ()
            return {name: item for name, item in _fields(value, but=left_out).items() if item is not None}
        case Mapping():
            return {name: plain(item) for name, item in value.items()}
        case list() | tuple():
            return [plain(item) for item in value]
        case _ if attrs.has(type(value)):
            # Loading filled in topic and type of the peripheral; a file states either these or the peripheral.
            filled = isinstance(value, schema.ObservationSpec) and value.peripheral is not None
            return _fields(value, but=("topic", "type") if filled else ())
        case _:
            return str(value) if isinstance(value, Path) else value


class _Secret(str):
    """The value of a secret option, until it is replaced by the text to show."""


def _fields(value: Any, but: Collection[str | None] = ()) -> dict[str, Any]:
    return {
        name: _Secret(item) if field.metadata.get("secret") and isinstance(item, str) else plain(item)
        for name, field in fields(type(value)).items()
        for item in (getattr(value, field.name),)
        if name not in but
    }


def _without_secrets(value: Any, shown: Mapping[str, str]) -> Any:
    if isinstance(value, str):
        hidden = HIDDEN if isinstance(value, _Secret) else without_credentials(value)
        return value if hidden == value else shown.get(str(value), hidden)
    if isinstance(value, Mapping):
        return {name: _without_secrets(item, shown) for name, item in value.items()}
    return [_without_secrets(item, shown) for item in value] if isinstance(value, list) else value


def document(config: schema.RobotConfig) -> dict[str, Any]:
    """The complete robot YAML of this run as plain values, with `${…}` or `***` for secrets."""
    sections = {name: plain(getattr(config, name)) for name in config.sections()}
    sections |= {name: plain(section.options) for name, section in config.plugin_sections.items()}
    sections["peripherals"] = list(sections["peripherals"].values())
    if list(config.hardware) == ["hardware"]:
        sections["hardware"] = sections["hardware"]["hardware"]
    if config.contract == schema.ContractConfig():
        del sections["contract"]
    given = {name: section for name, section in sections.items() if section not in (None, {}, [])}
    without: dict[str, Any] = _without_secrets(given, config.secrets)
    return without


class _Dumper(yaml.SafeDumper):
    """Quotes text that YAML 1.2 would not read as text, e.g. `1e-3`."""

    def ignore_aliases(self, data: Any) -> bool:
        """Write values out instead of aliases."""
        return True


def _text(dumper: yaml.SafeDumper, value: str) -> yaml.ScalarNode:
    style = None if is_text(value) else "'"
    if not value.isprintable():
        style = '"'  # the only style with escapes; the others fold line breaks such as U+0085
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style=style)


_Dumper.add_representer(str, _text)


def dump_yaml(value: Any) -> str:
    """Plain values as YAML text, which the config reader reads back unchanged."""
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, width=120, allow_unicode=True)


def to_yaml(config: schema.RobotConfig) -> str:
    """The whole config as YAML text."""
    return dump_yaml(document(config))
