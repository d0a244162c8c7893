"""A policy server of GR00T for tests: its description and its answers are what a test sets."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

import numpy as np
import zmq
from ibrobot_policy_wire import pack_npy, unpack_npy

from .served_requests import HORIZON

ARM_SIZE = 5
DESCRIPTION = {
    "action": {
        "__ModalityConfig_class__": True,
        "as_json": {"delta_indices": list(range(HORIZON)), "modality_keys": ["single_arm", "gripper"]},
    }
}
type Answer = Callable[[dict[str, Any]], Any]
"""Data of a request -> answer; bytes are sent as they are, and None sends nothing until the server is released."""


def ramp(data: dict[str, Any]) -> Any:
    """Actions that begin at the state and tell which request they answer, as version 1.6 sends them."""
    seen = data["observation"]
    state, shade = seen["state"]["joints"][0, 0], float(seen["video"]["front"].mean())
    actions = (state + np.arange(HORIZON)[:, None] * 0.01 + shade * 1e-3).astype(np.float32)[None]
    return [{"single_arm": actions[..., :ARM_SIZE], "gripper": actions[..., ARM_SIZE:]}, {}]


class Gr00tServer:
    """Serves until the end of the context, on a port that stays the same across restarts."""

    def __init__(self, answer: Answer = ramp) -> None:
        self.answer, self.description, self.token = answer, DESCRIPTION, ""
        self.requests: list[dict[str, Any]] = []
        self.port = 0
        self.released = threading.Event()

    @property
    def address(self) -> str:
        """The address."""
        return f"tcp://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.stop()

    def start(self) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        if self.port:
            self._socket.bind(self.address)
        else:
            self.port = self._socket.bind_to_random_port("tcp://127.0.0.1")
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def stop(self) -> None:
        """End like a killed process."""
        self._ending.set()
        self.released.set()
        self._thread.join()
        self._socket.close()
        self._context.term()
        self.released.clear()

    def _serve(self) -> None:
        while not self._ending.is_set():
            if not self._socket.poll(5):
                continue
            request = unpack_npy(self._socket.recv())
            self.requests.append(request)
            answer = self._answered(request)
            if answer is None:
                self.released.wait()
                if self._ending.is_set():
                    return
                answer = {"late": True}
            self._socket.send(answer if isinstance(answer, bytes) else pack_npy(answer))

    def _answered(self, request: dict[str, Any]) -> Any:
        if request.get("api_token", "") != self.token:
            return {"error": "Unauthorized: Invalid API token"}
        if request["endpoint"] == "get_modality_config":
            return self.description
        return self.answer(request["data"]) if request["endpoint"] == "get_action" else {}
