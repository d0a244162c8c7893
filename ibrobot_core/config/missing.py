"""Plugins that are not installed: an error if the entered mode needs them; other modes become unavailable."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import attrs

from ibrobot_core.config.yaml_nodes import Document
from ibrobot_core.convert import Key
from ibrobot_core.errors import PluginNotInstalled, how_to_install, plugin_type
from ibrobot_core.schema import ContractConfig

_OPTIONAL_SENSORS = ("camera",)
"""Kinds of sensors without which a run may continue, if nothing in it needs them."""


@attrs.frozen
class Missing:
    """A component that cannot be created, since its plugin is not installed or is broken."""

    key: Key
    place: Key
    """The key in the file that names the plugin."""
    error: PluginNotInstalled


def split(
    document: Document, plain: Mapping[str, Any], missing: Sequence[Missing], entered: str | None, *,
    everything: bool, simulable: bool,
) -> Mapping[str, str]:  # fmt: skip
    """Add the missing plugins of the entered mode as one problem of the document.

    Args:
        document: the robot YAML.
        plain: its structured sections that need no plugin.
        missing: all missing components.
        entered: the first mode of the run.
        everything: whether all components are needed.
        simulable: whether `--sim` would run the robot with the installed plugins.

    Returns:
        For the other modes, mode -> why it is unavailable.
    """
    modes: Mapping[str, Any] = plain.get("control_modes") or {}
    contract = plain.get("contract") or ContractConfig()
    # The executors of the contract, whose commands a run publishes in every mode, and the peripherals that it observes.
    acting: set[Key] = {("executors", spec.executor) for spec in contract.actions}
    names = {spec.peripheral for spec in contract.observations}
    observed: set[Key] = {key for key, item in document.items("peripherals") if str(item.get("name")) in names}
    used = {name: _used(name, mode, observed) for name, mode in modes.items()}
    now = acting | (observed if "recording" in document.root else set()) | used.get(entered or "", set())
    needed = [each for each in missing if everything or each.key in now or not _may_wait(document, each.key)]
    if needed:
        hardware = simulable and any(each.key[0] == "hardware" for each in needed)
        instead = "; or run it in simulation: --sim" if hardware else ""
        document.add(needed[0].place, describe(each.error for each in needed) + instead)
    lacking = {name: [each.error for each in missing if each.key in keys] for name, keys in used.items()}
    return {name: describe(errors) for name, errors in lacking.items() if errors and name != entered}


def unavailable_modes(unavailable: Mapping[str, str]) -> list[str]:
    """One line per reason for unavailable modes."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in unavailable.items():
        by_reason.setdefault(reason, []).append(name)
    return [
        f"{f'mode {names[0]} is' if len(names) == 1 else f'modes {", ".join(names)} are'} unavailable: {reason}"
        for reason, names in by_reason.items()
    ]


def absent_models(absent: Mapping[str, PluginNotInstalled]) -> list[str]:
    """One line per package that is not installed and contains or reads models of `robot.description`."""
    by_package: dict[str, list[str]] = {}
    for model, error in absent.items():
        by_package.setdefault(error.package, []).append(model)
    return [
        f"joint limits are not compared with robot.description.{' and '.join(models)}, since {package} is not "
        f"installed: {how_to_install(package)}"
        for package, models in by_package.items()
    ]


def describe(errors: Iterable[PluginNotInstalled]) -> str:
    """The missing plugins with one command that installs them all, and broken plugins with the reason."""
    distinct = list(dict.fromkeys(errors))
    absent = list(dict.fromkeys((error.kind, error.type) for error in distinct if not error.reason))
    texts = [error.reason for error in distinct if error.reason]
    if absent:
        names = ", ".join(plugin_type(kind, type_) for kind, type_ in absent)
        needs = "needs a plugin that is" if len(absent) == 1 else "need plugins that are"
        command = how_to_install(*(error.package for error in distinct if not error.reason))
        texts.append(f"{names} {needs} not installed: {command}")
    return "; ".join(texts)


def _used(name: str, mode: Any, observed: set[Key]) -> set[Key]:
    """The components that drive a mode and move its joints; with a model, also those observed by the contract."""
    keys: set[Key] = {("control_modes", name, "planner"), ("control_modes", name, "inference")}
    keys |= {("executors", executor) for executor in mode.executors}
    keys |= {("teleoperation", device) for device in mode.devices.values()}
    if mode.inference is not None:
        given = mode.inference.get("intervene")
        keys |= {("models", str(mode.inference.get("model"))), *observed}
        keys |= {
            ("teleoperation", str(device)) for device in (given.values() if isinstance(given, Mapping) else (given,))
        }
    return keys


def _may_wait(document: Document, key: Key) -> bool:
    """Whether only some modes need the component at `key`."""
    if key[0] == "peripherals":
        return str(document.get(*key, "kind")) in _OPTIONAL_SENSORS
    return key[0] in ("executors", "models", "teleoperation", "control_modes")
