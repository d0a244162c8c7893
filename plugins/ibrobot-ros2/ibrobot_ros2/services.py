"""Service calls as JSON, as rosbridge encodes them.

Source: https://github.com/RobotWebTools/rosbridge_suite/blob/ros2/ROSBRIDGE_PROTOCOL.md
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from enum import Enum
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from ibrobot_ros2.definitions import CodecError

SERVICES = "/rosapi/services"
"""Service that answers with the names of the services that can be called; rosapi's name."""

DETAILS = "/rosapi/service_request_details"
"""Service that answers with the declaration of a service, given its name; rosapi's name."""


def endpoint(namespace: str = "") -> str:
    """Name under which a transport serves the services of a robot with a namespace."""
    return f"{namespace.strip('/')}/services".lstrip("/")


@attrs.frozen
class Call:
    """A call of a service."""

    service: str
    request: Any = None
    """Plain data: None, text, numbers, lists and mappings."""


@attrs.frozen
class Answer:
    """The answer to a call, or why it failed."""

    values: Any = None
    """Plain data, or the error's message."""
    result: bool = True
    """Whether the call succeeded."""


def encode_call(call: Call) -> bytes:
    """A call as bytes.

    Raises:
        CodecError: if the request has objects without a counterpart in JSON.
    """
    return _bytes({"op": "call_service", "service": call.service, "args": plain(call.request)})


def decode_call(data: bytes | bytearray | memoryview) -> Call:
    """A call from bytes.

    Raises:
        CodecError: if the bytes are not a call.
    """
    value = _value(data)
    if value.get("op") != "call_service" or not isinstance(value.get("service"), str):
        raise CodecError("not a service call: it needs op: call_service and the name of a service")
    return Call(value["service"], value.get("args"))


def encode_answer(answer: Answer) -> bytes:
    """An answer as bytes.

    Raises:
        CodecError: if the answer has objects without a counterpart in JSON.
    """
    return _bytes({"op": "service_response", "values": plain(answer.values), "result": answer.result})


def decode_answer(data: bytes | bytearray | memoryview) -> Answer:
    """An answer from bytes.

    Raises:
        CodecError: if the bytes are not an answer.
    """
    value = _value(data)
    if value.get("op") != "service_response" or not isinstance(value.get("result"), bool):
        raise CodecError("not an answer to a service call: it needs op: service_response and result")
    return Answer(value.get("values"), value["result"])


def plain(value: Any) -> Any:
    """A value as plain data: objects of attrs classes become mappings, arrays lists, members of an enum their names.

    Raises:
        CodecError: for other objects.
    """
    match value:
        case Enum():
            plain_value: Any = value.name
        case None | bool() | int() | float() | str():
            plain_value = value
        case np.ndarray() | np.generic():
            plain_value = value.tolist()
        case Path():
            plain_value = str(value)
        case Mapping():
            plain_value = {str(key): plain(each) for key, each in value.items()}
        case list() | tuple():
            plain_value = [plain(each) for each in value]
        case AbstractSet():
            plain_value = sorted(plain(each) for each in value)
        case _ if attrs.has(type(value)):
            plain_value = {name: plain(each) for name, each in attrs.asdict(value, recurse=False).items()}
        case _:
            raise CodecError(f"a {type(value).__name__} cannot be sent to another process")
    return plain_value


def _bytes(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()


def _value(data: bytes | bytearray | memoryview) -> Mapping[str, Any]:
    try:
        value = json.loads(bytes(data))
    except (ValueError, RecursionError) as error:
        raise CodecError(f"not JSON: {error}") from None
    if not isinstance(value, dict):
        raise CodecError(f"expected a JSON object, got {type(value).__name__}")
    return value
