"""Messages to and from CDR, the serialisation of ROS 2."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import cached_property
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from ibrobot_core.api import Message
from ibrobot_ros2.convert import Convert, core_class, decoder, encoder, make_class
from ibrobot_ros2.definitions import DEFINING, CodecError, define, make_typestore, standard_types, type_hash

_ENCAPSULATIONS = {b"\x00\x00": False, b"\x00\x01": True}
"""First bytes of plain CDR -> whether it is little-endian."""


class Codec:
    """Encodes and decodes messages of the standard types, of `ibrobot_msgs`, and of those that are defined here.

    Thread-safe.

    Args:
        definitions: type -> its `ros2msg` or `ros2idl` text, e.g. as a bag brings them; they come before the standard
            ones. A text is read when its type is first needed.
    """

    def __init__(self, definitions: Mapping[str, str] | None = None) -> None:
        self._definitions = dict(definitions or {})
        self._classes: dict[str, type[Any]] = {}
        self._encoders: dict[str, Convert] = {}
        self._decoders: dict[str, Convert] = {}

    @cached_property
    def _types(self) -> Typestore:
        """The types; a store takes too long to make where only the summary of a bag is read."""
        # First needed with `DEFINING` held, so that it is made once.
        return make_typestore() if self._definitions else standard_types()

    def encode(self, message: Message) -> memoryview:
        """CDR of a message, little-endian, with its encapsulation header; arrays are copied once.

        Raises:
            CodecError: e.g. for a number that its field cannot hold.
        """
        type_name = message.ros_type
        convert = self._encoders.get(type_name)
        if convert is None:
            with DEFINING:
                self._define(type_name)
                convert = self._encoders[type_name] = encoder(type_name, self._types)
        try:
            return self._types.serialize_cdr(convert(message), type_name, little_endian=True)
        except (SerdeError, struct.error, ValueError, OverflowError, TypeError, AttributeError) as error:
            raise CodecError(f"{type_name}: cannot be encoded: {error}") from error

    def decode(self, type_name: str, data: bytes | memoryview) -> Message:
        """The message in `data`. Arrays are views of it; bytes after the message are ignored.

        A type that core does not have becomes a class made from its definition, with stamps as `…_ns` [ns].

        Raises:
            CodecError: for a type that nobody defined, or data that is not such a message.
        """
        convert = self._decoders.get(type_name)
        if convert is None:
            with DEFINING:  # so that each type has one class
                self._define(type_name)
                convert = decoder(type_name, self._class_of(type_name), self._types, self._class_of)
                self._decoders[type_name] = convert
        little_endian = _ENCAPSULATIONS.get(bytes(data[:2]))
        if little_endian is None or len(data) < 4:
            raise CodecError(f"{type_name}: not plain CDR: begins with {bytes(data[:4]).hex(' ') or 'nothing'}")
        entry = self._types.get_msgdef(type_name)
        deserialize = entry.deserialize_cdr_le if little_endian else entry.deserialize_cdr_be
        try:
            ros, _ = deserialize(memoryview(data)[4:], 0, entry.cls, self._types)
        except (SerdeError, struct.error, ValueError) as error:
            raise CodecError(f"{type_name}: {len(data)} bytes cannot be decoded: {error}") from error
        message: Message = convert(ros)
        return message

    def type_hash(self, type_name: str) -> str:
        """The type's hash, `RIHS01_…`, as it is defined here.

        Raises:
            CodecError: for a type that nobody defined, or whose definition cannot be read.
        """
        with DEFINING:
            self._define(type_name)
            return type_hash(type_name, self._types)

    def _class_of(self, type_name: str) -> type[Any]:
        """Core's class where the type is as core knows it; else one made from the definition."""
        if type_name not in self._classes:
            known = core_class(type_name)
            same = known is not None and type_hash(type_name, self._types) == type_hash(type_name)
            self._classes[type_name] = known if known and same else make_class(type_name, self._types)
        return self._classes[type_name]

    def _define(self, type_name: str) -> None:
        if type_name in self._definitions:
            define(self._types, type_name, self._definitions.pop(type_name))
        type_hash(type_name, self._types)  # raises for undefined types, also nested ones


_standard = Codec()


def encode(message: Message) -> memoryview:
    """CDR of a message of a standard type; see `Codec.encode`."""
    return _standard.encode(message)


def decode(type_name: str, data: bytes | memoryview) -> Message:
    """A message of a standard type; see `Codec.decode`."""
    return _standard.decode(type_name, data)
