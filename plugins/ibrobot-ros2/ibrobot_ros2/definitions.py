"""Definitions of message types: ROS 2's own, `ibrobot_msgs`, and those that a bag brings along."""

from __future__ import annotations

import threading
from importlib.resources import files
from typing import Any

import attrs
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

from ibrobot_core.api import MESSAGE_TYPES, IbrobotError, Message

TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_PACKAGE = "ibrobot_msgs"
_SEPARATOR = "=" * 80 + "\n"
_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
_EVENT_TEXT = "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number\n"
"""The events of services as ROS defines them: rosbags has characters where ROS has numbers, so its hash differs."""
EVENT = "service_msgs/ServiceEventInfo info\n{name}_Request[<=1] request\n{name}_Response[<=1] response\n"
"""The definition of the events of a service."""

DEFINING = threading.RLock()
"""Held while a store of types changes: by `define`, and by what makes several changes. Readers do not need it."""
_standard: list[Typestore] = []
"""The store of `standard_types`, once it is made."""


class CodecError(IbrobotError):
    """A message that cannot be encoded or decoded, e.g. of a type that nobody defined."""


def is_idl(text: str) -> bool:
    """Whether a definition is `ros2idl` rather than `ros2msg` text."""
    return text.startswith(f"{_SEPARATOR}IDL: ")


def parse_definition(type_name: str, text: str) -> dict[str, Any]:
    """The types in a `.msg` text, or in a `ros2msg` or `ros2idl` text with its dependencies.

    Raises:
        CodecError: for a text that is no definition.
    """
    try:
        if not is_idl(text):
            return _of_services(get_types_from_msg(_with_event(type_name, text), type_name))
        fields: dict[str, Any] = {}
        for part in text.split(_SEPARATOR)[1:]:
            fields.update(get_types_from_idl(part.partition("\n")[2]))
        return fields
    except TypesysError as error:
        raise CodecError(f"{type_name}: its definition cannot be read: {error}") from error


def _with_event(type_name: str, text: str) -> str:
    """The definition of a service's events, for a text that begins with the request and the response of its `.srv`."""
    own, *others = text.split(_SEPARATOR)
    request, divider, response = f"\n{own}".partition("\n---\n")
    if not type_name.endswith("_Event"):
        return text
    if not text.strip():
        raise CodecError(f"{type_name}: its definition is empty")
    if not divider:
        return text
    name = type_name.removesuffix("_Event")
    parts = [EVENT.format(name=name), *others]
    parts += [
        f"MSG: {name}_{part}\n{fields.lstrip()}" for part, fields in (("Request", request), ("Response", response))
    ]
    if not any(each.startswith("MSG: service_msgs/") for each in others):
        parts.append(f"MSG: {_EVENT_INFO}\n{_EVENT_TEXT}")
    return _SEPARATOR.join(part if part.endswith("\n") else f"{part}\n" for part in parts)


def _of_services(types: dict[str, Any]) -> dict[str, Any]:
    """The types; rosbags takes every type for that of a message, so services get their names of ROS here."""
    return {
        name.replace("/srv/msg/", "/srv/"): (constants, [(field, renamed(desc)) for field, desc in fields])
        for name, (constants, fields) in types.items()
    }


def renamed(desc: Any) -> Any:
    """A field whose type is named as in ROS."""
    kind, inner = desc
    if kind == Nodetype.NAME:
        return kind, inner.replace("/srv/msg/", "/srv/")
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return kind, (renamed(inner[0]), inner[1])
    return desc


def make_typestore() -> Typestore:
    """A new store of the types of ROS 2 Jazzy and `ibrobot_msgs`."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for file in (files(__package__) / "msg").iterdir():
        name = f"{_PACKAGE}/msg/{file.name.removesuffix('.msg')}"
        define(store, name, file.read_text(encoding="utf-8"))
    return store


def define(store: Typestore, type_name: str, text: str) -> None:
    """Add a type and the types that its text defines to a store; they replace types of the same names.

    Thread-safe: other threads see a type as it was before or as it is afterwards, and never miss it.

    Raises:
        CodecError: for a definition that cannot be used.
    """
    types = parse_definition(type_name, text)
    with DEFINING:
        for name in types.keys() & store.fielddefs.keys():
            if types[name][1] == store.fielddefs[name][1]:
                del types[name]
        try:
            register(store, types)
        except (TypesysError, SyntaxError) as error:
            raise CodecError(f"{type_name}: its definition cannot be used: {error}") from error


def register(store: Typestore, types: dict[str, Any]) -> None:
    """Add parsed types to a store, or replace them. Thread-safe, as `define`.

    Raises:
        TypesysError: for types that rosbags cannot use.
        SyntaxError: for names that Python cannot use.
    """
    made = Typestore()
    with DEFINING:  # also of other stores: rosbags makes classes under one name for all
        made.register(types)
        store.types.update(made.types)
        store.fielddefs.update(made.fielddefs)  # last: a type counts as known from here on
        for name in types:
            store.cache.pop(name, None)


def standard_types() -> Typestore:
    """The types of ROS 2 Jazzy and `ibrobot_msgs`. Thread-safe."""
    if not _standard:
        with DEFINING:
            if not _standard:
                store = make_typestore()
                define(store, _EVENT_INFO, _EVENT_TEXT)
                _standard.append(store)
    return _standard[0]


def definition(type_name: str) -> str:
    """The `ros2msg` text of a type: its fields, then those of each type that it needs.

    Raises:
        CodecError: for a type that is not known.
    """
    return known(type_name, standard_types()).generate_msgdef(type_name, ros_version=2)[0]


def type_hash(type_name: str, types: Typestore | None = None) -> str:
    """The type's hash as ROS 2 makes it, `RIHS01_…`; of a standard type where `types` is None.

    Raises:
        CodecError: for a type that is not known.
    """
    types = standard_types() if types is None else types
    try:
        return known(type_name, types).hash_rihs01(type_name)
    except KeyError as error:
        raise CodecError(f"{type_name}: needs {error}, which is not defined") from None
    except RecursionError:
        raise CodecError(f"{type_name}: its definition contains itself") from None


def known(type_name: str, types: Typestore) -> Typestore:
    """The types, if a type is among them, or a plugin defines it.

    Raises:
        CodecError: if it is not.
    """
    if type_name not in types.fielddefs and type_name in MESSAGE_TYPES:
        _check(types, MESSAGE_TYPES[type_name])
        define(types, type_name, MESSAGE_TYPES[type_name].definition)
    if type_name not in types.fielddefs:
        raise CodecError(f"{type_name}: this message type is not defined")
    return types


def _check(store: Typestore, message: type[Message]) -> None:
    """Check the definition of a plugin's type: what it does not name would be lost from recordings.

    Raises:
        CodecError: if it is none, has other fields than the class, or changes a type that is defined already.
    """
    name, text = message.ros_type, message.definition
    if not isinstance(text, str) or not text.strip():
        raise CodecError(f"{name}: its class has no definition: give it the text of the .msg file, definition=…")
    types = parse_definition(name, text)
    for other, (_, described) in types.items():
        if other in store.fielddefs and store.fielddefs[other][1] != described:
            raise CodecError(f"{name}: its definition has other fields of {other} than those that are known")
    described = {core_name(field, desc) for field, desc in types[name][1]}
    has = {field.name for field in attrs.fields(message)}
    if described != has:
        more = [f"the class lacks {', '.join(sorted(described - has))}"] * bool(described - has)
        more += [f"the definition lacks {', '.join(sorted(has - described))}"] * bool(has - described)
        raise CodecError(f"{name}: its class and its definition have different fields: {'; '.join(more)}")


def core_name(name: str, desc: Any) -> str:
    """The name of a field in core's class of a message: times are `…_ns`."""
    kind, inner = desc
    named = inner[0] if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else desc
    return f"{name}_ns" if named[0] == Nodetype.NAME and named[1] in TIMES else normalize_fieldname(name)
