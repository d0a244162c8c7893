"""Selection: dotted paths into a message -> a float32 vector; joints by name, array elements by number."""

from __future__ import annotations

import typing
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import cache, lru_cache
from itertools import groupby
from operator import attrgetter
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.errors import ContractError
from ibrobot_core.messages import MESSAGE_TYPES, JointState, Message
from ibrobot_core.options import did_you_mean

_LEROBOT_SUFFIX = {"position": "pos", "velocity": "vel", "effort": "eff"}

_NONE: Mapping[str, Any] = {}

type _Read = Callable[[Any], NDArray[np.generic]]


@attrs.frozen(eq=False)
class JointFeature:
    """Numbers computed from positions of joints, e.g. the position of the tool."""

    joints: tuple[str, ...]
    names: tuple[str, ...]
    """One for each number, as in datasets."""
    values: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Positions of `joints`, shape (J,) -> the numbers, shape (N,); None if they are these positions."""


@attrs.frozen
class Leaf:
    """A resolved path: a number, an element of an array, a joint's element, or a whole array."""

    field: str
    kind: str
    """`number`, `element`, `joint`, `array`, `foreign` or `feature`."""
    part: str = ""
    """Element number or joint name."""
    name: str = ""
    """Name of the number, if a `JointFeature` has given one."""

    @property
    def label(self) -> str:
        """LeRobot's name if it has one, e.g. `shoulder_pan.pos`; else the path."""
        if self.name:
            return self.name
        if self.kind == "joint":
            return f"{self.part}.{_LEROBOT_SUFFIX[self.field]}"
        return f"{self.field}.{self.part}" if self.part else self.field


class Selection:
    """Extracts numbers from messages; the constructor checks the paths against the message's class.

    `position.shoulder_pan` is looked up in the message's `name`, once for each order of names.
    `data.0` is an element, `data` the whole array, `orientation` all of its numbers. Without paths, the selection has
    the numbers of the whole message, or for a JointState the positions of the robot's joints in robot order.

    Foreign bags define types that core does not know. For these, every path, e.g. `wrench.force.x` or `tags.0.id`, is
    looked up in the messages and must lead to one number. The same applies to a path into a list of parts of a known
    type, e.g. `points.0.positions.2`.

    Args:
        type_name: the ROS 2 message type, e.g. `sensor_msgs/msg/JointState`.
        select: the paths, in the order of the vector.
        joints: the robot's joints.
        features: the paths into a JointState that name computed numbers.

    Raises:
        ContractError: for an unknown type without paths, or a path that leads to no number of a known type.
    """

    def __init__(
        self, type_name: str, select: Sequence[str] = (), joints: Sequence[str] = (),
        features: Mapping[str, JointFeature] = _NONE,
    ) -> None:  # fmt: skip
        message_type = MESSAGE_TYPES.get(type_name)
        if message_type is None and select:
            self.paths = tuple(select)
            leaves = [Leaf(path, "foreign") for path in select]
        elif message_type is None:
            hint = did_you_mean(type_name, list(MESSAGE_TYPES), "available")
            raise ContractError(f"unknown message type {type_name!r}{hint}")
        else:
            self.paths = tuple(select) or _default(message_type, joints)
            leaves = [
                leaf
                for path in self.paths
                for leaf in (_computed(path, features[path]) if path in features else _resolve(message_type, path))
            ]
        self.leaves = tuple(leaves)
        """One leaf per number of the vector, in order; one for a whole array."""
        unknown = any(leaf.kind == "array" for leaf in leaves)
        self.size = -1 if unknown else len(leaves)
        """Length of the vector; -1 with a whole array, whose length only the messages determine."""
        self.names: tuple[str, ...] = () if unknown else tuple(leaf.label for leaf in leaves)
        """One name per element; empty if the length is unknown."""
        runs = groupby(leaves, lambda leaf: (leaf.kind, leaf.field if leaf.kind not in ("number", "foreign") else ""))
        self._reads = [
            _feature_reader(features[field]) if kind == "feature" else _reader(kind, list(run))
            for (kind, field), run in runs
        ]

    def __call__(self, message: Message) -> NDArray[np.float32]:
        """The vector, float32, shape (size,).

        Raises:
            ContractError: if the message lacks a joint or an element.
        """
        if len(self._reads) == 1:
            return self._reads[0](message).astype(np.float32)
        return np.concatenate([read(message) for read in self._reads], dtype=np.float32, casting="same_kind")


def _default(message_type: type[Message], joints: Sequence[str]) -> tuple[str, ...]:
    if message_type is JointState:
        return tuple(f"position.{joint}" for joint in joints)
    if not message_type.whole:
        first = attrs.fields(message_type)[0].name
        raise ContractError(f"{message_type.ros_type} needs a select: paths to its numbers, e.g. {first}")
    return message_type.whole


def _resolve(message_type: type[Any], path: str) -> list[Leaf]:
    """The leaves of `path`."""
    owner: type[Any] = message_type
    tokens = path.split(".")
    for depth, token in enumerate(tokens):
        kinds = _kinds(owner)  # type: ignore[arg-type]  # a class has a hash
        if token not in kinds:
            hint = did_you_mean(token, list(kinds), "available")
            raise ContractError(f"{path!r}: {owner.__name__} has no field {token!r}{hint}")
        kind, field, rest = kinds[token], ".".join(tokens[: depth + 1]), ".".join(tokens[depth + 1 :])
        if attrs.has(kind):
            owner = kind
        elif kind in (int, float, bool) and not rest:
            return [Leaf(field, "number")]
        elif "ndarray" in str(kind).lower():
            return [_array_leaf(message_type, path, field, rest)]
        elif typing.get_origin(kind) is tuple and attrs.has(typing.get_args(kind)[0]) and rest:
            return _part_leaves(typing.get_args(kind)[0], path, field, rest)
        else:
            raise ContractError(f"{path!r} leads to no number of {message_type.__name__}")
    return [leaf for name in attrs.fields_dict(owner) for leaf in _resolve(message_type, f"{path}.{name}")]


@cache
def _kinds(owner: Hashable) -> Mapping[str, Any]:
    """Field -> type; resolving them takes as long as the rest of a selection."""
    hints = typing.get_type_hints(owner)
    return {name: kind for name, kind in hints.items() if typing.get_origin(kind) is not typing.ClassVar}


def _part_leaves(part: type[Any], path: str, field: str, rest: str) -> list[Leaf]:
    """The leaves below an element of a list of parts, whose length only the messages determine."""
    number, _, inner = rest.partition(".")
    if not (number.isascii() and number.isdigit()):
        raise ContractError(f"{path!r}: {field} is a list; select an element by number, e.g. {field}.0")
    if not inner:
        raise ContractError(f"{path!r} leads to no number, but to a {part.__name__}")
    leaves = _resolve(part, inner)
    if any(leaf.kind == "array" for leaf in leaves):
        raise ContractError(f"{path!r} is an array; select an element by number, e.g. {path}.0")
    return [Leaf(f"{field}.{number}.{leaf.label}", "foreign") for leaf in leaves]


def _array_leaf(message_type: type[Any], path: str, field: str, rest: str) -> Leaf:
    if message_type is JointState:
        if not rest:
            raise ContractError(f"{path!r} has the joints in the sender's order; name them, e.g. {path}.shoulder_pan")
        return Leaf(field, "joint", rest)
    if not rest:
        return Leaf(field, "array")
    if not (rest.isascii() and rest.isdigit()):
        raise ContractError(f"{path!r}: {field} is an array; select an element by number, e.g. {field}.0")
    return Leaf(field, "element", rest)


def _computed(path: str, feature: JointFeature) -> list[Leaf]:
    if feature.values is None:
        return [Leaf("position", "joint", *each) for each in zip(feature.joints, feature.names, strict=True)]
    return [Leaf(path, "feature", name=name) for name in feature.names]


def _feature_reader(feature: JointFeature) -> _Read:
    assert feature.values is not None
    read, compute = _joint_reader("position", list(feature.joints)), feature.values
    return lambda message: compute(np.asarray(read(message), dtype=np.float64))


def _reader(kind: str, leaves: list[Leaf]) -> _Read:
    """A reader for consecutive leaves of one kind and, for arrays, of one array."""
    field = leaves[0].field
    if kind == "foreign":
        paths = [leaf.field.split(".") for leaf in leaves]
        return lambda message: np.array([_number_at(message, path) for path in paths], dtype=np.float64)
    if kind == "number":
        reads = [attrgetter(leaf.field) for leaf in leaves]
        return lambda message: np.array([read(message) for read in reads], dtype=np.float64)
    if kind == "joint":
        return _joint_reader(field, [leaf.part for leaf in leaves])
    if kind == "array":
        read = attrgetter(field)
        return lambda message: np.concatenate([read(message)] * len(leaves))
    return _element_reader(field, [int(leaf.part) for leaf in leaves])


def _joint_reader(field: str, joints: list[str]) -> _Read:
    read = attrgetter(field)

    @lru_cache(maxsize=16)
    def indices(order: tuple[str, ...]) -> NDArray[np.intp]:
        missing = [joint for joint in joints if joint not in order]
        if missing:
            raise ContractError(f"the message has no joint {missing[0]!r}; it has: {', '.join(order) or 'none'}")
        return np.array([order.index(joint) for joint in joints], dtype=np.intp)

    def values(message: Any) -> NDArray[np.generic]:
        array: NDArray[np.generic] = read(message)
        if len(array) != len(message.name):
            raise ContractError(f"the message has {len(message.name)} names of joints, but {len(array)} in {field}")
        return array[indices(message.name)]

    return values


def _element_reader(field: str, elements: list[int]) -> _Read:
    read, indices, most = attrgetter(field), np.array(elements, dtype=np.intp), max(elements)

    def values(message: Any) -> NDArray[np.generic]:
        array: NDArray[np.generic] = read(message)
        if most >= len(array):
            raise ContractError(f"the message has {len(array)} elements in {field}, element {most} is asked for")
        return array[indices]

    return values


def _number_at(message: Any, path: Sequence[str]) -> float:
    """The number at a path in a message of a type that only bags define."""
    value = value_at(message, path)
    if isinstance(value, int | float | np.number | np.bool_):
        return float(value)
    if isinstance(value, tuple | list | np.ndarray):
        raise ContractError(f"{'.'.join(path)!r} leads to {len(value)} elements; select one by number, e.g. .0")
    fields = f"; available: {', '.join(attrs.fields_dict(type(value)))}" if attrs.has(type(value)) else ""
    raise ContractError(f"{'.'.join(path)!r} leads to no number{fields}")


def value_at(message: Any, path: Sequence[str]) -> Any:
    """The value at a path in a message; None if the path continues beyond a number or text.

    Args:
        message: any message, including types that only bags define.
        path: names of fields and numbers of elements.

    Raises:
        ContractError: for a missing field or element.
    """
    value: Any = message
    for depth, token in enumerate(path):
        before = ".".join(path[:depth]) or "the message"
        if attrs.has(type(value)):
            if token not in attrs.fields_dict(type(value)):
                fields = ", ".join(attrs.fields_dict(type(value)))
                raise ContractError(f"{'.'.join(path)!r}: {before} has no field {token!r}; available: {fields}")
            value = getattr(value, token)
        elif isinstance(value, tuple | list | np.ndarray) and token.isascii() and token.isdigit():
            if int(token) >= len(value):
                raise ContractError(f"{before} has {len(value)} elements, element {token} is asked for")
            value = value[int(token)]
        else:
            return value if isinstance(value, tuple | list | np.ndarray) else None
    return value
