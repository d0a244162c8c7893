"""An openpi server for tests: its metadata and its answers are what a test sets."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

import numpy as np
from ibrobot_policy_wire import pack, unpack
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

HORIZON = 5
SIZE = 6
type Answer = Callable[[dict[str, Any]], bytes | str | dict[str, Any] | None]
"""Request -> answer; None: no answer."""


def ramp(request: dict[str, Any]) -> dict[str, Any]:
    """Actions that begin at the state, in the server's joint order, and tell which request they answer."""
    state = request["observation/state"]
    shade = float(request["observation/image"][..., 0].mean())
    actions = state + np.arange(HORIZON, dtype=np.float32)[:, None] * 0.01 + shade * 1e-3
    return {"actions": actions.astype(np.float32), "server_timing": {"infer_ms": 1.0}}


class OpenpiServer:
    """Serves until the end of the context, on a port that stays the same across restarts."""

    def __init__(self, answer: Answer = ramp, metadata: dict[str, Any] | bytes | str | None = None) -> None:
        self.answer, self.metadata = answer, {"config": "pi05_test"} if metadata is None else metadata
        self.requests: list[dict[str, Any]] = []
        self.headers: list[str | None] = []
        self.port = 0
        self._connections: set[ServerConnection] = set()
        self.released = threading.Event()
        """Set when requests without an answer may end."""

    @property
    def url(self) -> str:
        """The address."""
        return f"ws://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.stop()

    def start(self) -> None:
        self._server = serve(self._handle, "127.0.0.1", self.port, compression=None, max_size=None, close_timeout=0.1)
        self.port = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def stop(self) -> None:
        """End like a killed process: connections break."""
        self.released.set()
        self._server.shutdown()
        for connection in list(self._connections):
            connection.close_socket()
        self._thread.join()
        while self._connections:
            threading.Event().wait(0.005)
        self.released.clear()

    def _handle(self, connection: ServerConnection) -> None:
        self._connections.add(connection)
        try:
            assert connection.request is not None
            self.headers.append(connection.request.headers.get("Authorization"))
            connection.send(self.metadata if isinstance(self.metadata, bytes | str) else pack(self.metadata))
            for message in connection:
                assert isinstance(message, bytes)
                request = unpack(message)
                self.requests.append(request)
                answer = self.answer(request)
                if answer is None:
                    self.released.wait()
                    continue
                connection.send(answer if isinstance(answer, bytes | str) else pack(answer))
        except ConnectionClosed:
            pass
        finally:
            self._connections.discard(connection)


def towards_a_goal(request: dict[str, Any]) -> dict[str, Any]:
    """Ten small steps from the state."""
    return {"actions": request["state"] + np.linspace(0.002, 0.02, 10, dtype=np.float32)[:, None]}
