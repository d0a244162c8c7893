"""Composes messages from the values of a tick: the inverse of `select` and `image`."""

from __future__ import annotations

import typing
from collections.abc import Collection, Mapping
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import (
    ACTION,
    MESSAGE_TYPES,
    Contract,
    ContractError,
    Float64MultiArray,
    Header,
    Image,
    JointState,
    Message,
    ObservationPart,
)

_DEPTH: Mapping[str, type[np.generic]] = {"16UC1": np.uint16, "32FC1": np.float32}
"""Encoding -> element type, for encodings that are not uint8."""


class Composer:
    """Makes messages from the values of a tick, such that the contract extracts the same values from them.

    Numbers that no path selects are unknown and become NaN.

    Args:
        contract: defines which values are in which messages.

    Raises:
        ContractError: if the position of values in a message is ambiguous, e.g. with two whole arrays in one vector.
    """

    def __init__(self, contract: Contract) -> None:
        self._contract = contract
        if computed := [part for part in contract.action_parts if part.features]:
            raise ContractError(
                f"{ACTION}: cannot make commands from {', '.join(computed[0].features)}: the dataset lacks the "
                "positions of the joints"
            )
        if foreign := [part for part in contract.action_parts if part.select]:
            raise ContractError(
                f"{ACTION}: cannot make a {foreign[0].type} for {foreign[0].topic}, because the action is foreign"
            )
        self._topics: dict[str, list[ObservationPart]] = {}
        for part in contract.observation_parts:
            self._topics.setdefault(part.topic, []).append(part)
        self._places = {id(part): _places(part) for part in contract.observation_parts if part.image is None}
        for key in contract.observations:
            unknown = [part for part in contract.parts(key) if part.image is None and part.feature.shape == (-1,)]
            if len(unknown) > 1:
                raise ContractError(f"{key}: the lengths of {len(unknown)} whole arrays cannot be distinguished")

    def keys(self, topics: Collection[str]) -> set[str]:
        """The keys whose values are needed for the messages of `topics`."""
        keys = {part.key for part in self._contract.observation_parts if part.topic in topics}
        return keys | ({ACTION} if any(part.topic in topics for part in self._contract.action_parts) else set())

    def __call__(self, values: Mapping[str, NDArray[Any]], stamp_ns: int) -> dict[str, Message]:
        """Make the messages of all topics whose keys are in `values`; returns topic -> message.

        Args:
            values: key -> value; vectors in SI units, images in the contract's encoding.
            stamp_ns: stamp of the headers [ns].

        Raises:
            ContractError: if a value does not fit the contract.
        """
        messages: dict[str, Message] = {}
        header = Header(stamp_ns)
        for topic, parts in self._topics.items():
            if all(part.key in values for part in parts):
                messages[topic] = self._message(parts, values, header)
        if ACTION in values:
            messages |= self._action(values[ACTION])
        return messages

    def _message(self, parts: list[ObservationPart], values: Mapping[str, NDArray[Any]], header: Header) -> Message:
        first = parts[0]
        if first.image is not None:
            return _image(first, values[first.key], header)
        placed: list[tuple[str, str, Any]] = []
        for part in parts:
            places, vector = self._places[id(part)], self._slice(part, values[part.key])
            given = [vector] if part.selection.size < 0 else vector.tolist()
            placed += [(*place, value) for place, value in zip(places, given, strict=True)]
        message_type = MESSAGE_TYPES[first.type]
        if message_type is JointState:
            return _joint_state(placed, header)
        message: Message = _build(message_type, "", _fields(placed), header)
        return message

    def _action(self, vector: NDArray[Any]) -> dict[str, Message]:
        joints = self._contract.action_joints
        if vector.shape != (len(joints),):
            raise ContractError(
                f"an action has {len(joints)} values ({', '.join(joints)}), got the shape {vector.shape}"
            )
        messages: dict[str, Message] = {}
        begin = 0
        for part in self._contract.action_parts:
            end = begin + len(part.joints)
            messages[part.topic] = Float64MultiArray(vector[begin:end].astype(np.float64))
            begin = end
        return messages

    def _slice(self, part: ObservationPart, vector: NDArray[Any]) -> NDArray[Any]:
        """The slice of a key's vector that belongs to the part."""
        sizes = {id(each): each.feature.shape[0] for each in self._contract.parts(part.key)}
        known = sum(size for size in sizes.values() if size >= 0)
        rest = len(vector) - known
        if rest < 0 or (rest and -1 not in sizes.values()):
            raise ContractError(f"{part.key} has {known} values by the contract, got {len(vector)}")
        begin = 0
        for each, size in sizes.items():
            length = rest if size < 0 else size
            if each == id(part):
                return vector[begin : begin + length]
            begin += length
        raise AssertionError(part)


def _places(part: ObservationPart) -> list[tuple[str, str]]:
    """Field of each number of a part, and its element or joint; empty for a number or a whole array."""
    if part.type not in MESSAGE_TYPES:
        raise ContractError(f"{part.key}: cannot make a {part.type}, because only the original bags define this type")
    leaves = part.selection.leaves
    if parts := [leaf.label for leaf in leaves if leaf.kind in ("foreign", "feature")]:
        raise ContractError(
            f"{part.key}: cannot make a {part.type} from {', '.join(parts)}: its other fields are unknown"
        )
    if len(leaves) > 1 and any(leaf.kind == "array" for leaf in leaves):
        raise ContractError(f"{part.key}: the position of {', '.join(part.select)} in the vector is unknown")
    return [(leaf.field, leaf.part) for leaf in leaves]


def _image(part: ObservationPart, array: NDArray[Any], header: Header) -> Image:
    assert part.image is not None
    encoding, channels = part.image.encoding, part.feature.shape[-1]
    element = np.dtype(_DEPTH.get(encoding, np.uint8))
    if array.dtype != element or array.ndim != 3 or array.shape[2] != channels:
        wanted = f"{element.name} of shape (H, W, {channels})"
        raise ContractError(f"{part.key}: {encoding} is {wanted}, got {array.dtype.name} of shape {array.shape}")
    height, width, _ = array.shape
    rows = np.ascontiguousarray(array, dtype=element.newbyteorder("<")).view(np.uint8).reshape(height, -1)
    return Image(header, height, width, encoding, rows.shape[1], rows.reshape(-1))


def _joint_state(placed: list[tuple[str, str, Any]], header: Header) -> JointState:
    names = tuple(dict.fromkeys(joint for _, joint, _ in placed))
    arrays: dict[str, NDArray[np.float64]] = {}
    for field, joint, value in placed:
        array = arrays.setdefault(field, np.full(len(names), np.nan))
        array[names.index(joint)] = value
    return JointState(header, names, **arrays)


def _fields(placed: list[tuple[str, str, Any]]) -> dict[str, Any]:
    """Path -> value, with elements combined into arrays."""
    known: dict[str, Any] = {}
    for field, element, value in placed:
        if not element:
            known[field] = value
            continue
        index = int(element)
        array = known.get(field, np.empty(0))
        known[field] = np.pad(array, (0, max(0, index + 1 - len(array))), constant_values=np.nan)
        known[field][index] = value
    return known


def _build(owner: type[Any], prefix: str, known: Mapping[str, Any], header: Header) -> Any:
    """An object of class `owner` with the values whose paths begin with `prefix`."""
    fields: dict[str, Any] = {}
    for name, kind in _hints(owner).items():
        path = prefix + name
        if kind is Header:
            fields[name] = header
        elif path in known:
            fields[name] = _cast(path, known[path], kind)
        elif attrs.has(kind) and (_is_numeric(kind) or any(each.startswith(f"{path}.") for each in known)):
            fields[name] = _build(kind, f"{path}.", known, header)
        elif kind in (float, str):
            fields[name] = np.nan if kind is float else ""
        elif attrs.fields_dict(owner)[name].default is attrs.NOTHING:
            raise ContractError(f"cannot make a {owner.__name__} from {', '.join(known)}: {path} is unknown")
    return owner(**fields)


def _cast(path: str, value: Any, kind: Any) -> Any:
    if kind in (int, float, bool):
        return kind(value)
    whole = "int" in str(kind)
    if whole and not np.isfinite(value).all():
        raise ContractError(f"{path}: elements that no path selects are unknown, and integers have no NaN")
    return value


def _hints(owner: type[Any]) -> dict[str, Any]:
    hints = typing.get_type_hints(owner)
    return {name: kind for name, kind in hints.items() if typing.get_origin(kind) is not typing.ClassVar}


def _is_numeric(kind: type[Any]) -> bool:
    """Whether all fields of a class are floats, e.g. of Vector3."""
    return all(each is float or (attrs.has(each) and _is_numeric(each)) for each in _hints(kind).values())
