"""Converts between core's messages and the objects of a type store; the differences are computed once per type.

Core has a stamp or duration `x` as `x_ns`, leaves some fields out, and has the two parts of a transform without
the transform; all else has equal names.
"""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import Any

import attrs
import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

from ibrobot_core import api as core
from ibrobot_core.api import MESSAGE_TYPES, NS_PER_S, Message
from ibrobot_ros2.definitions import TIMES, core_name

Convert = Callable[[Any], Any]

_TRANSFORM = "geometry_msgs/msg/Transform"
_PARTS: dict[str, type[Any]] = {
    "std_msgs/msg/Header": core.Header,
    "std_msgs/msg/MultiArrayDimension": core.MultiArrayDimension,
    "std_msgs/msg/MultiArrayLayout": core.MultiArrayLayout,
    "geometry_msgs/msg/Point": core.Vector3,
    "geometry_msgs/msg/Vector3": core.Vector3,
    "geometry_msgs/msg/Quaternion": core.Quaternion,
    "sensor_msgs/msg/PointField": core.PointField,
    "trajectory_msgs/msg/JointTrajectoryPoint": core.JointTrajectoryPoint,
    "diagnostic_msgs/msg/KeyValue": core.KeyValue,
    "diagnostic_msgs/msg/DiagnosticStatus": core.DiagnosticStatus,
}
"""Core's classes that are only parts of messages."""
_LEFT_OUT: dict[str, dict[str, Any]] = {
    "sensor_msgs/msg/CameraInfo": {"binning_x": 0, "binning_y": 0, "roi": "sensor_msgs/msg/RegionOfInterest"},
}
"""Fields that core does not have: their value, or the type whose zeros they are."""


def core_class(type_name: str) -> type[Any] | None:
    """Core's class of a type; None where it has none."""
    return MESSAGE_TYPES.get(type_name) or _PARTS.get(type_name)


def make_class(type_name: str, types: Typestore) -> type[Any]:
    """A frozen class for a type that core does not have, named and shaped as core would."""
    fields: dict[str, Any] = {}
    for name, desc in types.fielddefs[type_name][1]:
        array = desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) and dtype_of(desc[1][0]) is not None
        fields[core_name(name, desc)] = attrs.field(eq=attrs.cmp_using(eq=np.array_equal) if array else True)
    body = {"ros_type": type_name}
    return attrs.make_class(type_name.rpartition("/")[2], fields, bases=(Message,), class_body=body, frozen=True)


def encoder(type_name: str, types: Typestore) -> Convert:
    """Make the function that converts an object of core to the store's."""
    ros_class = types.types[type_name]
    left_out = _LEFT_OUT.get(type_name, {})
    parts = [
        _constant(left_out[name], types) if name in left_out else _encode_field(name, desc, types)
        for name, desc in types.fielddefs[type_name][1]
    ]
    return lambda message: ros_class(*[part(message) for part in parts])


def _constant(value: Any, types: Typestore) -> Convert:
    if isinstance(value, str):
        made = types.types[value](*[0] * len(types.fielddefs[value][1]))
        return lambda message: made
    return lambda message: value


def _encode_field(name: str, desc: Any, types: Typestore) -> Convert:
    get = attrgetter(core_name(name, desc))
    kind, inner = desc
    if kind == Nodetype.BASE:
        return get
    if kind == Nodetype.NAME:
        part = _encode_part(inner, types)
        # A transform's parts are the message's own.
        return part if inner == _TRANSFORM else lambda message: part(get(message))
    item, size = inner
    dtype = dtype_of(item)
    if dtype is not None:
        return _encode_array(get, dtype, size if kind == Nodetype.ARRAY else 0)
    if item[0] == Nodetype.BASE:
        return get
    part = _encode_part(item[1], types)
    return lambda message: [part(each) for each in get(message)]


def _encode_part(type_name: str, types: Typestore) -> Convert:
    if type_name not in TIMES:
        return encoder(type_name, types)
    time: Any = types.types[type_name]
    return lambda stamp_ns: time(*divmod(stamp_ns, NS_PER_S))


def _encode_array(get: Convert, dtype: np.dtype[Any], size: int) -> Convert:
    """A flat contiguous array. One of fixed size that core leaves empty is zeros: so ROS 2 says `unknown`."""
    zeros = np.zeros(size, dtype)

    def convert(message: Any) -> Any:
        value = np.asarray(get(message), dtype).ravel()
        return zeros if size and not len(value) else value

    return convert


def decoder(type_name: str, cls: type[Any], types: Typestore, class_of: Callable[[str], type[Any]]) -> Convert:
    """Make the function that converts an object of the store to a `cls`; `class_of` gives the classes of its parts."""
    parts: list[tuple[str, Convert]] = []
    for name, desc in types.fielddefs[type_name][1]:
        if name in _LEFT_OUT.get(type_name, {}) and cls is core_class(type_name):
            continue
        if desc[1] == _TRANSFORM and cls is core.TransformStamped:
            for part, part_desc in types.fielddefs[_TRANSFORM][1]:
                parts.append((part, _chain(attrgetter(name), _decode_field(part, part_desc, types, class_of))))
            continue
        part_of = _decode_field(name, desc, types, class_of)
        parts.append((core_name(name, desc), part_of))
    return lambda ros: cls(**{name: part(ros) for name, part in parts})


def _decode_field(name: str, desc: Any, types: Typestore, class_of: Callable[[str], type[Any]]) -> Convert:
    get = attrgetter(normalize_fieldname(name))
    kind, inner = desc
    if kind == Nodetype.BASE:
        return get
    if kind == Nodetype.NAME:
        return _chain(get, _decode_part(inner, types, class_of))
    item = inner[0]
    if item[0] == Nodetype.BASE:
        return get if dtype_of(item) is not None else lambda ros: tuple(get(ros))
    convert = _decode_part(item[1], types, class_of)
    return lambda ros: tuple(map(convert, get(ros)))


def _chain(first: Convert, second: Convert) -> Convert:
    return lambda value: second(first(value))


def _decode_part(type_name: str, types: Typestore, class_of: Callable[[str], type[Any]]) -> Convert:
    if type_name in TIMES:
        return lambda time: time.sec * NS_PER_S + time.nanosec
    return decoder(type_name, class_of(type_name), types, class_of)


def dtype_of(item: Any) -> np.dtype[Any] | None:
    """The NumPy type of an array's items; None where they are strings or messages."""
    kind, base = item
    if kind != Nodetype.BASE or base[0] == "string":
        return None
    name: str = {"byte": "uint8", "char": "uint8", "octet": "uint8"}.get(base[0], base[0])
    return np.dtype(name)
