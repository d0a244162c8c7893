"""Services and actions of ROS 2: the messages that they consist of, their hashes, and requests as plain data.

A service is two messages, `PKG/srv/NAME_Request` and `PKG/srv/NAME_Response`. An action is three services, of which
canceling is the same for all, and two topics.

Sources: https://design.ros2.org/articles/actions.html and REP 2016 for the hashes.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import attrs
import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import TypesysError, get_types_from_msg
from rosbags.typesys.store import Typestore

from ibrobot_ros2.convert import dtype_of
from ibrobot_ros2.definitions import DEFINING, EVENT, CodecError, known, register, renamed, standard_types, type_hash

FOLDER = files(__package__) / "interfaces"
"""The texts of services, actions and messages that ROS 2 nodes often have: PACKAGE/KIND/NAME.KIND."""
_EMPTY = "uint8 structure_needs_at_least_one_member\n"
"""Field that ROS 2 puts into a message without fields."""
_PARTS = "{name}_Request request_message\n{name}_Response response_message\n{name}_Event event_message\n"
_UUID = "unique_identifier_msgs/UUID goal_id\n"
_LITTLE_ENDIAN = b"\x00\x01"


@attrs.frozen
class ServiceType:
    """A service: the types of its messages, e.g. `std_srvs/srv/Trigger_Request`, and its hash."""

    name: str
    request: str
    response: str
    hash: str


@attrs.frozen
class ActionType:
    """An action: its services, and the types of its messages."""

    name: str
    send_goal: ServiceType
    cancel_goal: ServiceType
    get_result: ServiceType
    feedback: str
    status: str = "action_msgs/msg/GoalStatusArray"


@cache
def service_type(name: str) -> ServiceType:
    """A service, e.g. `std_srvs/srv/Trigger`. Thread-safe.

    Raises:
        CodecError: if it is not defined here.
    """
    with DEFINING:
        request, response = _text(name, "srv", 2)
        return _service(name, request, response)


@cache
def action_type(name: str) -> ActionType:
    """An action, e.g. `control_msgs/action/GripperCommand`. Thread-safe.

    Raises:
        CodecError: if it is not defined here.
    """
    with DEFINING:
        return _action(name)


def _action(name: str) -> ActionType:
    """An action; called with `DEFINING` held."""
    for part, text in zip(("Goal", "Result", "Feedback"), _text(name, "action", 3), strict=True):
        _define(f"{name}_{part}", text)
    _define(f"{name}_FeedbackMessage", f"{_UUID}{name}_Feedback feedback\n")
    return ActionType(
        name,
        _service(
            f"{name}_SendGoal", f"{_UUID}{name}_Goal goal\n", "bool accepted\nbuiltin_interfaces/Time stamp\n"
        ),
        service_type("action_msgs/srv/CancelGoal"),
        _service(f"{name}_GetResult", _UUID, f"int8 status\n{name}_Result result\n"),
        f"{name}_FeedbackMessage",
    )  # fmt: skip


def to_cdr(type_name: str, value: Mapping[str, Any]) -> bytes:
    """CDR of a message from plain data, whose keys are ROS's names of fields; fields that it lacks are zero or empty.

    Raises:
        CodecError: for a type that nobody defined, and data that does not fit, with the field.
    """
    store = known(type_name, standard_types())
    made = _to_ros(store, type_name, value, "")
    try:
        return bytes(store.serialize_cdr(made, type_name, little_endian=True))
    except (SerdeError, struct.error, ValueError, OverflowError, TypeError, AttributeError) as error:
        raise CodecError(f"{type_name}: cannot be encoded: {error}") from error


def from_cdr(type_name: str, data: bytes) -> dict[str, Any]:
    """The plain data of a message.

    Raises:
        CodecError: for a type that nobody defined, or data that is not such a message.
    """
    store = known(type_name, standard_types())
    if data[:2] not in (_LITTLE_ENDIAN, b"\x00\x00"):
        raise CodecError(f"{type_name}: not plain CDR: begins with {data[:4].hex(' ') or 'nothing'}")
    try:
        made = store.deserialize_cdr(data, type_name)
    except (SerdeError, struct.error, ValueError, IndexError, AssertionError) as error:
        raise CodecError(f"{type_name}: {len(data)} bytes cannot be decoded: {error}") from error
    plain: dict[str, Any] = _to_plain(store, type_name, made)
    return plain


def fields_of(type_name: str) -> list[str]:
    """The names of the fields of a message, as ROS has them."""
    return [name for name, _ in standard_types().fielddefs[type_name][1]]


def _service(name: str, request: str, response: str) -> ServiceType:
    _define(f"{name}_Request", request)
    _define(f"{name}_Response", response)
    _define(f"{name}_Event", EVENT.format(name=name))
    _define(name, _PARTS.format(name=name))
    return ServiceType(name, f"{name}_Request", f"{name}_Response", type_hash(name))


def _text(name: str, kind: str, count: int) -> list[str]:
    """The parts of an interface's text; what it needs of its package is defined first."""
    package, folder, base = ([*name.split("/"), "", ""])[:3]
    file = FOLDER / package / kind / f"{base}.{kind}"
    if folder != kind or not base.isidentifier() or not package.isidentifier() or not file.is_file():
        raise CodecError(f"{name!r} is not defined here; defined are {', '.join(sorted(interfaces(kind)))}")
    messages = FOLDER / package / "msg"
    for each in messages.iterdir() if messages.is_dir() else ():
        _define(f"{package}/msg/{each.name.removesuffix('.msg')}", each.read_text(encoding="utf-8"))
    parts = file.read_text(encoding="utf-8").split("---\n")
    assert len(parts) == count, file
    return parts


def interfaces(kind: str) -> list[str]:
    """The names of the services (`srv`) or actions (`action`) that are defined here."""
    return [
        f"{package.name}/{kind}/{file.name.removesuffix(f'.{kind}')}"
        for package in FOLDER.iterdir()
        if package.is_dir() and (package / kind).is_dir()
        for file in (package / kind).iterdir()
    ]


def _define(name: str, text: str) -> None:
    """Add a message to the standard types, under a name that need not be that of a message; with `DEFINING` held."""
    store = standard_types()
    if name in store.fielddefs:
        return
    package = name.split("/", maxsplit=1)[0]
    try:
        (constants, fields) = next(iter(get_types_from_msg(text or _EMPTY, f"{package}/msg/X").values()))
    except TypesysError as error:
        raise CodecError(f"{name}: its definition cannot be read: {error}") from error
    register(store, {name: (constants, [(field, renamed(desc)) for field, desc in fields])})


def _to_ros(store: Typestore, type_name: str, value: Any, where: str) -> Any:
    fields = dict(store.fielddefs[type_name][1])
    if not isinstance(value, Mapping):
        raise CodecError(
            f"{where or type_name}: expected a mapping with {', '.join(fields) or 'nothing'}, got {value!r}"
        )
    unknown = [name for name in value if name not in fields]
    if unknown:
        raise CodecError(f"{where}{'.' if where else ''}{unknown[0]}: unknown; the fields are {', '.join(fields)}")
    made = {name: _field(store, desc, value.get(name), f"{where}.{name}".lstrip(".")) for name, desc in fields.items()}
    return store.types[type_name](*made.values())


def _field(store: Typestore, desc: Any, value: Any, where: str) -> Any:
    kind, inner = desc
    if kind == Nodetype.NAME:
        return _to_ros(store, inner, {} if value is None else value, where)
    if kind == Nodetype.BASE:
        return _number(inner[0], value, where)
    item, size = inner
    fixed = size if kind == Nodetype.ARRAY else 0
    if value is None:
        value = [None] * fixed
    if not isinstance(value, list | tuple | np.ndarray | bytes):
        raise CodecError(f"{where}: expected a list, got {value!r}")
    if fixed and len(value) != fixed:
        raise CodecError(f"{where}: needs {fixed} values, got {len(value)}")
    made = [_field(store, item, each, f"{where}[{i}]") for i, each in enumerate(value)]
    dtype = dtype_of(item)
    return made if dtype is None else np.array(made, dtype)


def _number(kind: str, value: Any, where: str) -> Any:
    """A text, a truth value or a number, strictly."""
    if kind in ("string", "wstring"):
        if not isinstance(value, str | None):
            raise CodecError(f"{where}: expected a text, got {value!r}")
        return value or ""
    if kind == "bool":
        if not isinstance(value, bool | np.bool_ | None):
            raise CodecError(f"{where}: expected true or false, got {value!r}")
        return bool(value)
    if value is None:
        return 0.0 if kind.startswith("float") else 0
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise CodecError(f"{where}: expected a number, got {value!r}")
    if kind.startswith("float"):
        return float(value)
    if int(value) != value:
        raise CodecError(f"{where}: expected a whole number, got {value!r}")
    bits, signed = int(kind.lstrip("uint") or 8) if kind not in ("byte", "char", "octet") else 8, kind.startswith("i")
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    if not low <= value <= high:
        raise CodecError(f"{where}: {value} is beyond {low} to {high}")
    return int(value)


def _to_plain(store: Typestore, type_name: str, made: Any) -> dict[str, Any]:
    plain = {}
    for name, desc in store.fielddefs[type_name][1]:
        if name != "structure_needs_at_least_one_member":
            plain[name] = _plain_field(store, desc, getattr(made, name))
    return plain


def _plain_field(store: Typestore, desc: Any, value: Any) -> Any:
    kind, inner = desc
    if kind == Nodetype.NAME:
        return _to_plain(store, inner, value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return [_plain_field(store, inner[0], each) for each in value]
    return value
