"""The protocol of GR00T's policy server: ZeroMQ request and reply, msgpack with arrays as .npy files."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any, override

import numpy as np
import zmq
from ibrobot_policy_wire import MAX_MESSAGE, pack_npy, unpack_npy

from ibrobot_core.api import PolicyError
from ibrobot_policy_servers.connection import Connection, one_line
from ibrobot_policy_servers.options import Gr00tOptions

_ENDS = zmq.EVENT_CLOSED | zmq.EVENT_DISCONNECTED | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
"""Events after which no answer comes: nobody listens, the server died, or it speaks another protocol."""
_GONE = "no GR00T server, or it closed the connection"
_GLANCE_MS = 50
"""How often a wait checks whether it was interrupted [ms]."""


class Gr00tConnection(Connection):
    """A connection to a policy server of Isaac GR00T.

    Args:
        options: address, version and token.
    """

    def __init__(self, options: Gr00tOptions) -> None:
        self.address = options.address
        self._token = options.api_token
        self._flat = options.version == "1.5"
        """Whether requests and answers are flat dictionaries, without options and information."""
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._socket: zmq.Socket[bytes] | None = None
        self._interrupted = threading.Event()

    @override
    def open(self, timeout_s: float) -> Mapping[str, Any]:
        self._interrupted.clear()
        self._context = zmq.Context()
        self._socket = socket = self._context.socket(zmq.REQ)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE)
        # A server that restarts may have another model: a new connection asks for it.
        socket.setsockopt(zmq.RECONNECT_IVL, -1)
        self._monitor = socket.get_monitor_socket(_ENDS)
        try:
            socket.connect(self.address)
        except zmq.ZMQError as error:
            raise PolicyError(f"cannot be used: {error}") from None
        described = self._call("get_modality_config", None, timeout_s)
        if not isinstance(described, dict):
            raise PolicyError(f"described its model as {type(described).__name__}, not a dictionary")
        return described

    @override
    def ask(self, request: Mapping[str, Any], timeout_s: float) -> Mapping[str, Any]:
        batch = self._batch(request)
        answer = self._call("get_action", batch if self._flat else {"observation": batch, "options": None}, timeout_s)
        if not self._flat and isinstance(answer, list) and answer:
            answer = answer[0]  # the rest is information
        if not isinstance(answer, dict):
            raise PolicyError(f"answered with {type(answer).__name__}, must be a dictionary")
        return {name: self._alone(value) for name, value in answer.items()}

    @override
    def reset(self, timeout_s: float) -> None:
        if not self._flat:
            self._call("reset", {"options": None}, timeout_s)

    @override
    def interrupt(self) -> None:
        self._interrupted.set()

    @override
    def close(self) -> None:
        socket, self._socket = self._socket, None
        context, self._context = self._context, None
        if socket is not None:
            socket.disable_monitor()
            self._monitor.close(linger=0)
            socket.close(linger=0)
        if context is not None:
            context.term()

    def _call(self, endpoint: str, data: Mapping[str, Any] | None, timeout_s: float) -> Any:
        socket = self._socket
        if socket is None:
            raise PolicyError("is not connected")
        message: dict[str, Any] = {"endpoint": endpoint}
        if data is not None:
            message["data"] = data
        if self._token:
            message["api_token"] = self._token
        try:
            socket.send(pack_npy(message), zmq.NOBLOCK)
            self._wait(socket, timeout_s)
            answer = unpack_npy(socket.recv())
        except zmq.Again:
            raise PolicyError(_GONE) from None
        except zmq.ZMQError as error:
            raise PolicyError(f"the connection failed: {error}") from None
        if isinstance(answer, dict) and "error" in answer:
            raise PolicyError(f"the server's error: {one_line(str(answer['error']))}")
        return answer

    def _wait(self, socket: zmq.Socket[bytes], timeout_s: float) -> None:
        deadline_s, poller = time.monotonic() + timeout_s, zmq.Poller()
        for each in (socket, self._monitor):
            poller.register(each, zmq.POLLIN)
        while not (ready := dict(poller.poll(_GLANCE_MS))).get(socket):
            if ready:
                raise PolicyError(_GONE)
            if self._interrupted.is_set():
                raise PolicyError("was closed")
            if time.monotonic() >= deadline_s:
                raise PolicyError(f"no answer within {timeout_s:g} s")

    def _batch(self, values: Mapping[str, Any], *, nested: bool = False) -> dict[str, Any]:
        """A batch of one request, and of one tick if the version has this dimension: texts have it below a modality."""
        batch: dict[str, Any] = {}
        for name, value in values.items():
            if isinstance(value, dict):
                batch[name] = self._batch(value, nested=True)
            elif isinstance(value, str):
                batch[name] = [[value]] if nested and not self._flat else [value]
            else:
                batch[name] = value[None] if self._flat else value[None, None]
        return batch

    def _alone(self, value: Any) -> Any:
        """An answer without the dimension of the batch."""
        batched = not self._flat and isinstance(value, np.ndarray) and value.ndim == 3 and value.shape[0] == 1
        return value[0] if batched else value
