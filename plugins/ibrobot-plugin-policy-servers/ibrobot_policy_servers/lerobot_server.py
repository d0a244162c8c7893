"""The protocol of LeRobot's policy server: gRPC, with pickles that are written and read here without running them."""

from __future__ import annotations

import io
import pickle
import re
import time
from collections.abc import Iterator, Mapping
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import MissingDependency, PolicyError, how_to_install
from ibrobot_policy_servers.connection import Connection, one_line
from ibrobot_policy_servers.options import LerobotServerOptions
from ibrobot_policy_servers.pickles import Made, Named, PickleReader, Reference

try:
    import grpc
except ModuleNotFoundError:
    raise MissingDependency(
        "policy lerobot_server needs the Python package grpcio",
        remedy=how_to_install("ibrobot-plugin-policy-servers[grpc]"),
    ) from None

_SERVICE = "/transport.AsyncInference/"
_PIECE = 2 << 20
"""Size of a piece of an observation [bytes]: the server takes messages of 4 MiB."""
_MAX_ANSWER = 16 << 20
"""Maximum size of an answer [bytes]; LeRobot's own client takes 4 MiB."""
_MAX_NUMBERS = _MAX_ANSWER // 2
"""Of all actions of an answer: more can be in it only if its actions overlap, and these could fill the memory."""
_BEGIN, _MIDDLE, _END = 1, 2, 3
_CHANNEL = (
    ("grpc.max_receive_message_length", _MAX_ANSWER),
    ("grpc.enable_http_proxy", 0),
    ("grpc.enable_retries", 0),  # a repeated request could be answered by the answer to the first
    ("grpc.use_local_subchannel_pool", 1),  # else a new channel waits as the last one did before connecting again
)
_STATE, _CAMERA = "observation.state", re.compile(r"observation\.images\.(?!task$)([\w-]+)", re.ASCII)
_CLASSES = "lerobot.async_inference.helpers"
_ACTION, _TENSOR, _STORAGE = (
    f"{_CLASSES}.TimedAction",
    "torch._utils._rebuild_tensor_v2",
    "torch.storage._load_from_bytes",
)
_HOOKS = "collections.OrderedDict"
_DTYPES = {"FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "BFloat16Storage": "<u2"}
_NAMES = frozenset({_ACTION, _TENSOR, _STORAGE, _HOOKS, *(f"torch.{name}" for name in _DTYPES)})
_MAGIC, _VERSION = 0x1950A86A20F9469CFC6C, 1001
"""Of torch's files, as a storage is pickled."""


class LerobotConnection(Connection):
    """A connection to LeRobot's policy server, which loads the checkpoint for it.

    The server has one model and one observation for all its clients. So an answer must repeat the time and the number
    of the request; another client's answer is an error.

    Args:
        options: address, checkpoint and mapping.

    Raises:
        PolicyError: if the mapping has a key that LeRobot's server does not know.
    """

    def __init__(self, options: LerobotServerOptions) -> None:
        self.address = options.address
        self._channel: grpc.Channel | None = None
        self._load_s = options.start_timeout
        self._features = _features(options)
        self._loaded = {
            "policy_type": options.policy_type,
            "pretrained_name_or_path": options.pretrained_name_or_path,
            "policy_device": options.policy_device,
        }
        self._horizon = options.horizon
        self._number = 0
        """Of the last request."""

    @override
    def open(self, timeout_s: float) -> Mapping[str, Any]:
        self._channel = grpc.insecure_channel(self.address, _CHANNEL)
        self._call("Ready", b"", timeout_s)
        instructions = {
            "policy_type": self._loaded["policy_type"],
            "pretrained_name_or_path": self._loaded["pretrained_name_or_path"],
            "lerobot_features": self._features,
            "actions_per_chunk": self._horizon,
            "device": self._loaded["policy_device"],
            "rename_map": {},
        }
        message = _field(1, _pickled("RemotePolicyConfig", instructions))
        self._call("SendPolicyInstructions", message, max(timeout_s, self._load_s))
        return self._loaded

    @override
    def ask(self, request: Mapping[str, Any], timeout_s: float) -> Mapping[str, Any]:
        deadline_s, stamp = time.monotonic() + timeout_s, time.time()
        self._number += 1
        # `must_go`: otherwise the server ignores an observation that resembles the last one.
        observation = {
            "timestamp": stamp, "timestep": self._number, "observation": _raw(request), "must_go": True,
        }  # fmt: skip
        self._call("SendObservations", _pieces(_pickled("TimedObservation", observation)), timeout_s, streamed=True)
        answer = self._call("GetActions", b"", max(0.0, deadline_s - time.monotonic()), limit_s=timeout_s)
        if not (content := _content(answer)):
            raise PolicyError("the server has no actions for the observation; its log has the reason")
        return {"actions": read_actions(content, stamp, self._number)}

    @override
    def reset(self, timeout_s: float) -> None:
        """The protocol has no message for it."""

    @override
    def interrupt(self) -> None:
        channel = self._channel
        if channel is not None:
            channel.close()

    @override
    def close(self) -> None:
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()

    def _call(
        self, method: str, request: Any, timeout_s: float, *, streamed: bool = False, limit_s: float | None = None
    ) -> bytes:
        channel = self._channel
        if channel is None:
            raise PolicyError("is not connected")
        try:
            make = channel.stream_unary if streamed else channel.unary_unary
            answer = make(_SERVICE + method)(request, timeout=timeout_s)
        except ValueError:  # of a closed channel
            raise PolicyError("was closed") from None
        except grpc.RpcError as error:
            raise PolicyError(_problem(error, timeout_s if limit_s is None else limit_s)) from None
        if answer is None:
            raise PolicyError(f"the server ended {method} without an answer")
        return bytes(answer)


def read_actions(content: bytes, stamp: float, number: int) -> NDArray[Any]:
    """The actions of an answer, shape (N, A): a pickled list of `TimedAction`, of which nothing is run.

    Args:
        content: the pickle.
        stamp: time of the request.
        number: of the request.

    Raises:
        PolicyError: if it is something else, or the answer to another request.
    """
    reader, storages, numbers = PickleReader(_NAMES), {}, 0
    stream = io.BytesIO(content)
    timed = reader.read(stream)
    if not isinstance(timed, list) or not timed or stream.read(1):
        raise PolicyError("the answer is not a list of actions")
    actions = []
    for i, each in enumerate(timed):
        state = each.state if isinstance(each, Made) and each.name == _ACTION and not each.arguments else None
        if state is None or state.keys() != {"timestamp", "timestep", "action"}:
            raise PolicyError(f"action {i} of the answer is not a TimedAction with a time, a number and an action")
        if state["timestep"] != number + i or (i == 0 and state["timestamp"] != stamp):
            raise PolicyError(
                f"action {i} of the answer is not the one of request {number}: another client uses the server, too"
            )
        storage, *place = _tensor(state["action"])
        if storage not in storages:
            storages[storage] = _values(reader, storage)
        actions.append(_view(storages[storage], *place))
        numbers += len(actions[-1])
        if numbers > _MAX_NUMBERS:
            raise PolicyError(f"the actions of the answer have more than {_MAX_NUMBERS} numbers")
    if len({each.shape for each in actions}) > 1:
        raise PolicyError("the actions of the answer have different sizes")
    return np.stack(actions)


def _tensor(value: Any) -> tuple[bytes, int, int, int]:
    """A tensor of one dimension: its storage, and its first element, size and stride in it."""
    match value:
        case Made(name=name, arguments=(Made() as file, int() as first, (int() as size,), (int() as stride,), *rest)):
            match file.arguments, rest:
                case (bytes() as storage,), [bool(), Made(name=hooks, arguments=())] if (name, file.name, hooks) == (
                    _TENSOR,
                    _STORAGE,
                    _HOOKS,
                ):
                    return storage, first, size, stride
    raise PolicyError("an action of the answer is not a tensor of one dimension")


def _values(reader: PickleReader, storage: bytes) -> NDArray[Any]:
    """The elements of a tensor's storage, in the format of torch's files before 1.6."""
    stream = io.BytesIO(storage)
    head = reader.read(stream), reader.read(stream)
    about, reference, keys = reader.read(stream), reader.read(stream), reader.read(stream)
    match about, reference:
        case {"little_endian": True}, Reference(
            key=("storage", Named(name=kind), str() as key, "cpu", int() as size, None)
        ):
            dtype = _DTYPES.get(kind.removeprefix("torch."))
        case _:
            dtype = None
    if head != (_MAGIC, _VERSION) or dtype is None or keys != [key]:
        raise PolicyError("a tensor of the answer is not a dense one of floats on the CPU, as torch pickles it")
    data = stream.read()
    if int.from_bytes(data[:8], "little") != size or len(data) != 8 + size * np.dtype(dtype).itemsize:
        raise PolicyError(f"a tensor of the answer has {len(data) - 8} bytes, not those of its {size} elements")
    values = np.frombuffer(data, dtype, offset=8)
    return (values.astype(np.uint32) << 16).view(np.float32) if dtype == "<u2" else values


def _view(values: NDArray[Any], first: int, size: int, stride: int) -> NDArray[Any]:
    if min(first, size, stride) < 0 or size > len(values) or first + max(0, size - 1) * stride >= len(values):
        raise PolicyError(
            f"a tensor of the answer has {size} elements from {first} at stride {stride}, outside its {len(values)}"
        )
    # Not copied: many actions may have the same values.
    return values[first : first + size * stride : stride] if stride else np.broadcast_to(values[first], size)


def _features(options: LerobotServerOptions) -> dict[str, Any]:
    """LeRobot's description of the observations.

    Raises:
        PolicyError: if the server does not know a key, or needs one that is missing.
    """
    features: dict[str, Any] = {}
    for each in options.observations:
        key = ".".join(each.key)
        if len(each.key) == 1 and key == _STATE and len(each.shape) == 1:
            names = _state_names(each.shape[0])
            features[key] = {"dtype": "float32", "shape": each.shape, "names": names}
        elif len(each.key) == 1 and _CAMERA.fullmatch(key) and len(each.shape) == 3 and each.layout == "hwc":
            features[key] = {"dtype": "image", "shape": each.shape, "names": ["height", "width", "channels"]}
        else:
            raise PolicyError(
                f"{each.observation}: key {list(each.key)} is not one of LeRobot's server: [{_STATE}] for a vector, "
                "[observation.images.NAME] for an image in layout hwc"
            )
    if _STATE not in features:
        raise PolicyError(f"observations: LeRobot's server needs one with the key [{_STATE}]")
    if options.prompt not in ((), ("task",)):
        raise PolicyError(f"prompt: LeRobot's server expects it in [task], not in {list(options.prompt)}")
    return features


def _state_names(size: int) -> list[str]:
    """Names of the state's elements, the same in the description and in each observation."""
    return [f"{_STATE}.{i}" for i in range(size)]


def _raw(request: Mapping[str, Any]) -> dict[str, Any]:
    """An observation as one of LeRobot's robots would return it: a number for each joint, and an image each camera."""
    raw: dict[str, Any] = {}
    for key, value in request.items():
        if key == _STATE:
            raw |= zip(_state_names(len(value)), value.tolist(), strict=True)
        else:
            raw[key.removeprefix("observation.images.")] = value
    return raw


def _pickled(name: str, state: Mapping[str, Any]) -> bytes:
    """The pickle of an instance of one of LeRobot's classes, which is not needed for it."""
    plain = pickle.dumps(dict(state), protocol=4)  # protocol 4: two bytes, the dictionary, and a stop
    return plain[:2] + f"c{_CLASSES}\n{name}\n".encode() + b")\x81" + plain[2:-1] + b"b."


def _pieces(content: bytes) -> Iterator[bytes]:
    """Messages `Observation`: a state of the transfer, and a piece."""
    for start in range(0, len(content), _PIECE):
        last = start + _PIECE >= len(content)
        state = _END if last else _MIDDLE if start else _BEGIN
        yield bytes((1 << 3, state)) + _field(2, content[start : start + _PIECE])


def _field(number: int, content: bytes) -> bytes:
    """A field of bytes of a protobuf message."""
    size, length = len(content), bytearray()
    while size > 0x7F:
        length.append(size & 0x7F | 0x80)
        size >>= 7
    return bytes((number << 3 | 2, *length, size)) + content


def _content(message: bytes) -> bytes:
    """The one field of a message `Actions`; empty if it is not there.

    Raises:
        PolicyError: if the message is another one.
    """
    if not message:
        return b""
    size = at = 0
    for at, byte in enumerate(message[1:6], 1):
        size |= (byte & 0x7F) << 7 * (at - 1)
        if byte < 0x80:
            break
    content = message[at + 1 :]
    if message[0] != 1 << 3 | 2 or len(content) != size:
        raise PolicyError("answered with a message that is not one of LeRobot's server")
    return content


def _problem(error: Any, timeout_s: float) -> str:
    """A failed call, in words."""
    code, details = error.code(), one_line(error.details() or "")
    if code is grpc.StatusCode.DEADLINE_EXCEEDED:
        return f"no answer within {timeout_s:g} s"
    if code is grpc.StatusCode.CANCELLED:
        return "was closed"
    if code is grpc.StatusCode.UNAVAILABLE:
        return f"no LeRobot policy server, or it closed the connection: {details}"
    if code is grpc.StatusCode.UNKNOWN:
        return f"the server's error: {details}"
    return f"the connection failed: {code.name}: {details}"
