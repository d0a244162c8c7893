"""Device types of the installed LeRobot, read once in a separate process and cached in a file; checks of options."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from functools import lru_cache
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from ibrobot_provenance.files import replace_file

from ibrobot_core.api import OptionFault, did_you_mean
from ibrobot_lerobot_devices.link import INSTALL, DeviceLink, DeviceProblem, is_installed
from ibrobot_lerobot_devices.packages import KEEPS_TORQUE, module_of, third_parties

_TIMEOUT_S = 90.0
_PYTHON: Mapping[str, tuple[type, ...]] = {
    "int": (int,),
    "float": (int, float),
    "bool": (bool,),
    "str": (str, int),
    "None": (type(None),),
    "dict": (Mapping,),
    "list": (list, tuple),
    "tuple": (list, tuple),
    "set": (list, tuple),
}


def registry() -> Mapping[str, Any]:
    """Kind -> type -> its config's fields, of LeRobot and of third-party packages; see `library.describe`.

    Raises:
        DeviceProblem: if LeRobot is not installed, or cannot be imported.
    """
    if not is_installed():
        raise DeviceProblem(f"LeRobot is not installed here: {INSTALL}")
    return _registry(_installed())


@lru_cache(maxsize=1)
def _registry(key: str) -> Mapping[str, Any]:
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ibrobot" / f"lerobot-{key}.json"
    try:
        devices: Mapping[str, Any] = json.loads(cache.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        # Packages of others may use torch.
        link = DeviceLink("describe", "LeRobot", {}, torch=bool(third_parties(distributions())))
        try:
            devices = link.start(_TIMEOUT_S)
        finally:
            link.end()
        try:
            cache.parent.mkdir(parents=True, exist_ok=True)
            replace_file(cache, json.dumps(devices).encode())
        except OSError:
            pass  # it is read again the next time
    return devices


def _installed() -> str:
    """A fingerprint of LeRobot and the packages that add to it, with their versions."""
    names = {"lerobot", *third_parties(distributions())}
    installed = sorted(
        (module_of(each), each.version, str(each.locate_file("")))
        for each in distributions()
        if module_of(each) in names
    )
    return hashlib.sha256(json.dumps(installed).encode()).hexdigest()[:16]


def check_device(kind: str, option: str, type_: str, config: Mapping[str, Any]) -> Iterator[OptionFault]:
    """Yield faults of a device's type and config; none if LeRobot is not installed here.

    Args:
        kind: robot, teleoperator or camera.
        option: the option with the type.
        type_: LeRobot's type.
        config: its config.
    """
    try:
        known = registry()[kind]
    except DeviceProblem:
        return  # the robot's computer may have it
    if type_ not in known:
        yield OptionFault((option,), f"LeRobot has no {kind} {type_!r}{did_you_mean(type_, list(known), 'it has')}")
        return
    yield from _check(("config",), known[type_]["fields"], config, type_)


def _check(
    at: tuple[str | int, ...], fields: Mapping[str, Any], given: Mapping[str, Any], type_: str
) -> Iterator[OptionFault]:
    for key, value in given.items():
        if key not in fields:
            yield OptionFault(
                (*at, key), f"LeRobot's {type_} has no {key!r}{did_you_mean(key, list(fields), 'it has')}"
            )
        elif key == KEEPS_TORQUE:
            yield OptionFault(
                (*at, key), "is control.stop here: relax switches the torque off at the end, hold does not"
            )
        elif key == "cameras" and value:
            yield OptionFault((*at, key), "cameras are peripherals here: {name: top, kind: camera, type: lerobot, ...}")
        elif "fields" in fields[key] and isinstance(value, Mapping):
            yield from _check((*at, key), fields[key]["fields"], value, type_)
        elif fault := _wrong_type(fields[key]["type"], value):
            yield OptionFault((*at, key), fault)
    for key, field in fields.items():
        if field["required"] and key not in given:
            yield OptionFault(at, f"LeRobot's {type_} needs {key}")


def _wrong_type(words: list[str], value: object) -> str:
    if "any" in words or any(_fits(word, value) for word in words):
        return ""
    return f"must be {' or '.join(words)}, not {value!r}"


def _fits(word: str, value: object) -> bool:
    if isinstance(value, bool) and word != "bool":
        return False
    return isinstance(value, _PYTHON.get(word, (object,)))
