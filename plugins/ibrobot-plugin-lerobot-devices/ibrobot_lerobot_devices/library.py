"""LeRobot's own registry and devices: imported in device processes alone."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import logging
import pkgutil
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import distributions, version
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from ibrobot_core.api import did_you_mean
from ibrobot_lerobot_devices.packages import KEEPS_TORQUE, third_parties
from ibrobot_lerobot_devices.units import AXES, POSITION, RADIANS, bases, driven

Kind = Literal["robot", "teleoperator", "camera"]
KINDS: tuple[Kind, ...] = ("robot", "teleoperator", "camera")
_PACKAGES: Mapping[str, tuple[str, str]] = {
    "robot": ("lerobot.robots", "RobotConfig"),
    "teleoperator": ("lerobot.teleoperators", "TeleoperatorConfig"),
    "camera": ("lerobot.cameras", "CameraConfig"),
}


class DeviceError(Exception):
    """A device cannot be made, e.g. because its type is unknown; the text is for the operator."""


def choices(kind: Kind, wanted: str = "") -> Mapping[str, type[Any]]:
    """The config classes of a kind, by type, of LeRobot and of third-party packages.

    Args:
        kind: the kind of device.
        wanted: a type; then only what may define it is imported.
    """
    name, base = _PACKAGES[kind]
    package = importlib.import_module(name)
    registry = getattr(package, base)
    for module in pkgutil.iter_modules(package.__path__):
        if module.ispkg and (not wanted or _registers(Path(package.__path__[0]) / module.name, wanted)):
            try:
                importlib.import_module(f"{name}.{module.name}")
            except ImportError as error:
                logging.getLogger("ibrobot.lerobot").info("%s.%s: %s", name, module.name, error)
    if wanted not in registry.get_known_choices():
        _import_third_parties()
    classes: Mapping[str, type[Any]] = registry.get_known_choices()
    return dict(sorted(classes.items()))


@cache
def _import_third_parties() -> None:
    """Import the packages that LeRobot would import, once; its own function also imports policies, with torch."""
    for name in third_parties(distributions()):
        try:
            importlib.import_module(name)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - of a package of others, which is named
            logging.getLogger("ibrobot.lerobot").warning("package %s cannot be imported: %s", name, error)


def _registers(folder: Path, wanted: str) -> bool:
    """Whether a module in `folder` registers a type."""
    pattern = re.compile(rf"register_subclass\(\s*[\"']{re.escape(wanted)}[\"']")
    return any(pattern.search(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.py")))


def make(kind: Kind, wanted: str, config: Mapping[str, Any]) -> Any:
    """LeRobot's object for a device, which is not connected yet.

    Raises:
        DeviceError: for an unknown type, a wrong config, or a missing library.
    """
    known = choices(kind, wanted)
    if wanted not in known:
        raise DeviceError(f"LeRobot has no {kind} {wanted!r}{did_you_mean(wanted, list(choices(kind)), 'it has')}")
    given = dict(config)
    if kind != "camera":
        _keep_torque(known[wanted], given)
    import draccus

    name, base = _PACKAGES[kind]
    package = importlib.import_module(name)
    try:
        decoded = draccus.decode(getattr(package, base), {"type": wanted, **given})
    except Exception as error:  # of draccus and of what the dataclass checks
        raise DeviceError(f"LeRobot's {wanted} refuses its config: {_cause(error)}") from error
    utils = importlib.import_module(f"{name}.utils")
    try:
        if kind == "camera":
            return utils.make_cameras_from_configs({"camera": decoded})["camera"]
        return getattr(utils, f"make_{kind}_from_config")(decoded)
    except Exception as error:  # also of a library that is not installed
        raise DeviceError(f"LeRobot cannot make {wanted}: {error}") from error


def _cause(error: BaseException) -> BaseException:
    """The cause of an error: draccus repeats the whole config before it."""
    while error.__cause__ is not None:
        error = error.__cause__
    return error


def _keep_torque(kind: type[Any], given: dict[str, Any]) -> None:
    """Let a device keep its torque when it is disconnected, also those within it."""
    for name, nested in _nested(kind):
        if isinstance(given.get(name), Mapping):
            given[name] = dict(given[name])
            _keep_torque(nested, given[name])
    if KEEPS_TORQUE in {field.name for field in dataclasses.fields(kind)}:
        given[KEEPS_TORQUE] = False


def _nested(kind: type[Any]) -> Iterator[tuple[str, type[Any]]]:
    for name, hint in get_type_hints(kind).items():
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            yield name, hint


def describe() -> dict[str, Any]:
    """What LeRobot has, as plain data: kind -> type -> fields, and its version."""
    description: dict[str, Any] = {"version": version("lerobot")}
    for kind in KINDS:
        description[kind] = {name: _described(each) for name, each in choices(kind).items()}
    return description


def _described(kind: type[Any]) -> dict[str, Any]:
    doc = inspect.getmodule(kind)
    return {"module": doc.__name__ if doc else "", "class": kind.__name__, "fields": _fields(kind)}


def _fields(kind: type[Any]) -> dict[str, Any]:
    """Each field of a dataclass: its type in words, whether it is required, its plain default, and fields within."""
    hints = get_type_hints(kind)
    fields: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        if not field.init:
            continue
        hint = hints[field.name]
        default = field.default
        if default is dataclasses.MISSING and field.default_factory is not dataclasses.MISSING:
            default = None
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        row: dict[str, Any] = {"type": _words(hint), "required": required}
        if isinstance(default, str | int | float | bool):
            row["default"] = default
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            row["fields"] = _fields(hint)
        fields[field.name] = row
    return fields


def _words(hint: Any) -> list[str]:
    """The plain types that a field takes, e.g. `["int", "None"]`; `["any"]` if it takes others."""
    if get_origin(hint) is not None and get_args(hint) and hasattr(hint, "__args__"):
        if get_origin(hint) in (dict, list, tuple, set):
            return [get_origin(hint).__name__]
        return [word for each in get_args(hint) for word in _words(each)]
    if hint is type(None):
        return ["None"]
    if hint in (int, float, bool, str):
        return [hint.__name__]
    if isinstance(hint, type) and issubclass(hint, Path):
        return ["str"]
    return ["any"]


def motors(device: Any) -> dict[str, dict[str, Any]]:
    """Feature -> its unit, and the resolution and calibration of its motor, for every motor bus in a device.

    A base's axis has `rate`, its unit per second. What names of features mean is known of LeRobot's own code alone.
    """
    by_name: dict[str, dict[str, Any]] = {}
    for prefix, bus in buses(device):
        for name, motor in getattr(bus, "motors", {}).items():
            mode = getattr(motor, "norm_mode", None)
            row: dict[str, Any] = {"unit": getattr(mode, "value", None)}
            calibration = (getattr(bus, "calibration", None) or {}).get(name)
            resolution = getattr(bus, "model_resolution_table", {}).get(getattr(motor, "model", ""))
            if calibration is not None and resolution:
                row |= {
                    "resolution": resolution,
                    "range_min": calibration.range_min,
                    "range_max": calibration.range_max,
                    "reversed": bool(getattr(bus, "apply_drive_mode", False) and calibration.drive_mode),
                }
            by_name[f"{prefix}{name}"] = row
    if _moves_by_lerobot(device):
        features = list(device.action_features)
        for name in bases(features, (".q",)):
            by_name.setdefault(name, {"unit": RADIANS})
        for name in driven(features):
            by_name.setdefault(name, {})["rate"] = AXES.get(name)
    return by_name


def _moves_by_lerobot(device: Any) -> bool:
    """Whether LeRobot's own code, and not that of another package, sends or reads the positions of a device."""
    function = getattr(type(device), "send_action", None) or getattr(type(device), "get_action", None)
    return str(getattr(function, "__module__", "")).startswith("lerobot.")


def buses(device: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The motor buses of a device, with the prefix of their features, e.g. `left_` for `left_arm.bus`."""
    for name, each in vars(device).items():
        if hasattr(each, "motors") and hasattr(each, "disable_torque"):
            yield prefix, each
        elif name.endswith("arm") and hasattr(
            each, "get_observation" if hasattr(each, "send_action") else "get_action"
        ):
            yield from buses(each, f"{prefix}{name.removesuffix('arm')}")


def facts(device: Any) -> dict[str, Any]:
    """What a robot or teleoperator says about itself: features, motors, torque, and its calibration's file."""
    names = ("action_features", "observation_features")
    features = {name: _plain(getattr(device, name)) if hasattr(device, name) else [] for name in names}
    return features | {
        "motors": motors(device),
        "torque": bool(torque_switches(device)),
        "keeps_torque": KEEPS_TORQUE in _names(getattr(device, "config", None)),
        "calibration": str(device.calibration_fpath),
    }


def torque_switches(device: Any) -> list[Any]:
    """The objects that switch the torque of a device off and on: itself, or its motor buses."""
    if hasattr(device, "disable_torque") and hasattr(device, "enable_torque"):
        return [device]
    return [bus for _, bus in buses(device) if hasattr(bus, "enable_torque")]


def stop_base(device: Any) -> bool:
    """Call LeRobot's own stop of the base; false if the robot has none, unlike LeKiwi."""
    if not hasattr(device, "stop_base"):
        return False
    device.stop_base()
    return True


def wheels(device: Any) -> list[tuple[Any, list[str]]]:
    """The motors of a device that no position commands, by bus."""
    driven = bases(list(device.action_features), POSITION)
    by_bus = [(bus, [name for name in bus.motors if f"{prefix}{name}" not in driven]) for prefix, bus in buses(device)]
    return [(bus, names) for bus, names in by_bus if names]


def numbers(values: Mapping[str, Any]) -> dict[str, float]:
    """The plain numbers among the values of a reading."""
    by_name: dict[str, float] = {}
    for name, value in values.items():
        if not isinstance(value, str) and getattr(value, "ndim", 0) == 0:
            with suppress(TypeError, ValueError):
                by_name[name] = float(value)
    return by_name


def taken_s(camera: Any) -> float | None:
    """When a camera's newest picture was taken, by `time.perf_counter` [s]; None if LeRobot does not say it."""
    stamp = getattr(camera, "latest_timestamp", None)
    return stamp if isinstance(stamp, float) else None


def fps(camera: Any) -> float | None:
    """How many pictures a second a camera takes; None if LeRobot does not say it."""
    rate = getattr(camera, "fps", None) or getattr(getattr(camera, "config", None), "fps", None)
    return float(rate) if isinstance(rate, int | float) and rate > 0 else None


def color_order(camera: Any) -> str:
    """The order of colours in a camera's pictures: `rgb` or `bgr`; `rgb`, as LeRobot's own, if it does not say it.

    Raises:
        DeviceError: if it is another one.
    """
    mode = getattr(camera, "color_mode", None) or getattr(getattr(camera, "config", None), "color_mode", None) or "rgb"
    order = str(getattr(mode, "value", mode)).lower()
    if order not in ("rgb", "bgr"):
        raise DeviceError(f"gives pictures with color_mode {order!r}; ibrobot takes rgb and bgr")
    return order


def _plain(features: Mapping[str, Any]) -> list[str]:
    """The names of the features that are numbers, and not pictures."""
    return [name for name, kind in features.items() if not isinstance(kind, tuple | list)]


def _names(config: Any) -> set[str]:
    """The names of a config's fields, and of those of configs within it."""
    own = getattr(config, "__dataclass_fields__", {})
    return set(own).union(*(_names(getattr(config, name, None)) for name in own))
