"""A policy server that speaks LeRobot's protocol, without LeRobot and torch: its answers are what a test sets."""

from __future__ import annotations

import io
import pickle
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Any, Self

import grpc
import numpy as np
from numpy.typing import NDArray

from .served_requests import HORIZON

CLASSES = "lerobot.async_inference.helpers"
FPS = 30
type Answer = Callable[[Message], bytes | None]
"""Observation -> content of the answer; None: no answer until the server is released."""


class Message:
    """An instance of one of LeRobot's classes, as the server gets it."""

    timestamp: float
    timestep: int
    observation: dict[str, Any]
    must_go: bool
    lerobot_features: dict[str, Any]
    actions_per_chunk: int


class Unpickler(pickle.Unpickler):
    """Reads what a client sends: LeRobot's classes and arrays of NumPy."""

    def find_class(self, module: str, name: str) -> Any:
        if module == CLASSES and name in ("RemotePolicyConfig", "TimedObservation"):
            return type(name, (Message,), {})
        assert module.startswith("numpy"), f"{module}.{name}"
        return super().find_class(module, name)


def plain(value: Any) -> bytes:
    """Instructions that make a plain value, without a beginning and an end."""
    return pickle.dumps(value, 2)[2:-1]


def named(name: str) -> bytes:
    """A class or function."""
    module, _, last = name.rpartition(".")
    return f"c{module}\n{last}\n".encode()


def called(name: str, *arguments: bytes) -> bytes:
    """A call."""
    return named(name) + b"(" + b"".join(arguments) + b"tR"


def storage(values: NDArray[Any], kind: str = "FloatStorage", *, size: int | None = None, data: bytes = b"") -> bytes:
    """A file of torch with a storage."""
    size = values.size if size is None else size
    about = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"short": 2, "int": 4, "long": 4}}
    reference = b"(" + plain("storage") + named(f"torch.{kind}") + plain("94") + plain("cpu") + plain(size) + b"NtQ"
    head = [pickle.dumps(each, 2) for each in (0x1950A86A20F9469CFC6C, 1001, about)]
    keys = pickle.dumps(["94"], 2)
    data = data or values.tobytes()
    return b"".join([*head, b"\x80\x02", reference, b".", keys, size.to_bytes(8, "little", signed=True), data])


def tensor(file: bytes, first: Any, size: Any, stride: Any) -> bytes:
    """A tensor of one dimension."""
    # `plain` writes bytes of protocol 2 as a call of a codec.
    loaded = called("torch.storage._load_from_bytes", b"B" + len(file).to_bytes(4, "little") + file)
    hooks = called("collections.OrderedDict")
    parts = (loaded, plain(first), plain(size), plain(stride), b"\x89", hooks)
    return called("torch._utils._rebuild_tensor_v2", *parts)


def timed(stamp: Any, number: Any, action: bytes) -> bytes:
    """A `TimedAction`."""
    state = b"}(" + plain("timestamp") + plain(stamp) + plain("timestep") + plain(number) + plain("action") + action
    return named(f"{CLASSES}.TimedAction") + b")\x81" + state + b"ub"


def chunk_of(stamp: float, number: int, tensors: Sequence[bytes]) -> bytes:
    """An answer."""
    actions = [timed(stamp + i / FPS, number + i, each) for i, each in enumerate(tensors)]
    return b"\x80\x04](" + b"".join(actions) + b"e."


def answered(seen: Message, actions: NDArray[Any], kind: str = "FloatStorage") -> bytes:
    """The answer to an observation: actions of shape (N, A), views of one storage as LeRobot sends them."""
    file, size = storage(actions, kind), actions.shape[1]
    tensors = [tensor(file, i * size, (size,), (1,)) for i in range(len(actions))]
    return chunk_of(seen.timestamp, seen.timestep, tensors)


def state_of(seen: Message) -> NDArray[np.float32]:
    """The positions of an observation."""
    return np.array([value for value in seen.observation.values() if isinstance(value, float)], np.float32)


def ramp(seen: Message) -> bytes:
    """Actions that begin at the state and tell which request they answer."""
    images = [each for each in seen.observation.values() if isinstance(each, np.ndarray)]
    shade = float(images[0].mean()) if images else 0.0
    actions = state_of(seen) + np.arange(HORIZON, dtype=np.float32)[:, None] * 0.01 + shade * 1e-3
    return answered(seen, actions.astype(np.float32))


@contextmanager
def grpc_in_use() -> Iterator[None]:
    """Keeps gRPC from ending, and from opening its files again in another test: it has one for the whole process."""
    pool = ThreadPoolExecutor(1)
    server = grpc.server(pool)
    with grpc.insecure_channel(f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}") as channel:
        server.start()
        with suppress(grpc.RpcError):
            channel.unary_unary("/nothing")(b"")
        yield
    server.stop(0).wait()
    pool.shutdown()


class LerobotServer:
    """Serves until the end of the context, on a port that stays the same across restarts."""

    def __init__(self, answer: Answer = ramp) -> None:
        self.answer = answer
        self.observations: list[Message] = []
        self.instructions: list[Message] = []
        self.patience_s: list[float] = []
        """How long the client waits for each loading of the checkpoint [s]."""
        self.refusal = ""
        """Why the server does not load the checkpoint."""
        self.silent = ""
        """The method that ends well without an answer, from the next start on."""
        self.port = 0
        self.released = threading.Event()

    @property
    def address(self) -> str:
        """The address."""
        return f"127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.stop()

    def start(self) -> None:
        self._pool = ThreadPoolExecutor(4)
        self._server = grpc.server(self._pool, options=[("grpc.so_reuseport", 0)])
        unary, streamed = grpc.unary_unary_rpc_method_handler, grpc.stream_unary_rpc_method_handler
        handlers = {
            "Ready": unary(lambda request, context: b""),
            "SendPolicyInstructions": unary(self._instruct),
            "SendObservations": streamed(self._observe),
            "GetActions": unary(self._act),
        }
        if self.silent:
            handlers[self.silent] = grpc.stream_stream_rpc_method_handler(lambda requests, context: iter(()))
        service = grpc.method_handlers_generic_handler("transport.AsyncInference", handlers)
        self._server.add_generic_rpc_handlers((service,))
        self.port = self._server.add_insecure_port(self.address)
        self._server.start()

    def stop(self) -> None:
        """End like a killed process."""
        self.released.set()
        self._server.stop(0).wait()
        self._server.wait_for_termination()
        self._pool.shutdown()
        self.released.clear()

    def _instruct(self, request: bytes, context: Any) -> bytes:
        if self.refusal:
            raise ValueError(self.refusal)
        self.patience_s.append(context.time_remaining())
        self.instructions.append(Unpickler(io.BytesIO(_bytes(request)[1])).load())
        return b""

    def _observe(self, requests: Iterator[bytes], context: Any) -> bytes:
        pieces = [(each[1], _bytes(each[2:])) for each in requests]
        assert [each[0] for each in pieces] == [1, *[2] * (len(pieces) - 2), 3][-len(pieces) :]
        assert all(number == 2 for _, (number, _) in pieces)
        content = b"".join(each for _, (_, each) in pieces)
        self.observations.append(Unpickler(io.BytesIO(content)).load())
        return b""

    def _act(self, request: bytes, context: Any) -> bytes:
        content = self.answer(self.observations[-1])
        if content is None:
            self.released.wait()
            return b""
        return message(content)


def message(content: bytes) -> bytes:
    """The message `Actions`."""
    length, size = bytearray(), len(content)
    while size > 0x7F:
        length.append(size & 0x7F | 0x80)
        size >>= 7
    return b"\x0a" + bytes((*length, size)) + content if content else b""


def _bytes(field: bytes) -> tuple[int, bytes]:
    """The number and content of a protobuf field of bytes that fills its message."""
    size = at = 0
    for at, byte in enumerate(field[1:], 1):
        size |= (byte & 0x7F) << 7 * (at - 1)
        if byte < 0x80:
            break
    content = field[at + 1 :]
    assert len(content) == size
    assert field[0] & 7 == 2
    return field[0] >> 3, content
