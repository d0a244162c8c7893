"""The websocket protocol of vla-eval, version 1: hello, then observations, each with its action."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, override

import numpy as np
from ibrobot_policy_wire import pack_named, unpack_named

from ibrobot_core.api import PolicyError
from ibrobot_policy_servers.connection import one_line
from ibrobot_policy_servers.options import VlaEvalOptions
from ibrobot_policy_servers.websocket import WebsocketConnection

VERSION = 1


class VlaEvalConnection(WebsocketConnection):
    """A connection to a model server of vla-eval.

    Args:
        options: address and certificate authority.
    """

    project = "vla-eval"

    def __init__(self, options: VlaEvalOptions) -> None:
        super().__init__(options.url, options.ca, {})
        self._number = 0
        """Of the last message; the answer repeats it."""

    @override
    def greet(self, timeout_s: float) -> Mapping[str, Any]:
        hello = self._call("hello", {"harness_version": "ibrobot", "protocol_version": VERSION}, "hello", timeout_s)
        if hello.get("protocol_version") != VERSION:
            raise PolicyError(
                f"the server speaks version {hello.get('protocol_version')!r} of the protocol, "
                f"the robot version {VERSION}"
            )
        self._begin()
        return hello

    @override
    def ask(self, request: Mapping[str, Any], timeout_s: float) -> Mapping[str, Any]:
        answer = dict(self._call("observation", request, "action", timeout_s))
        for name, value in answer.items():
            if isinstance(value, np.ndarray) and value.ndim == 1:
                answer[name] = value[None]  # one action, without the dimension of a chunk
        return answer

    @override
    def reset(self, timeout_s: float) -> None:
        self._send("episode_end", {})
        self._begin()

    def _begin(self) -> None:
        self._send("episode_start", {})

    def _send(self, kind: str, payload: Mapping[str, Any]) -> None:
        self._number += 1
        self.send(pack_named({"type": kind, "payload": payload, "seq": self._number, "timestamp": time.time()}))

    def _call(self, kind: str, payload: Mapping[str, Any], wanted: str, timeout_s: float) -> Mapping[str, Any]:
        self._send(kind, payload)
        message = self.receive(timeout_s)
        if isinstance(message, str):
            raise PolicyError(f"sent text, must be binary: {one_line(message)}")
        answer = unpack_named(message)
        content = answer.get("payload") if isinstance(answer, dict) else None
        if not isinstance(answer, dict) or not isinstance(content, dict):
            raise PolicyError("sent a message without a payload")
        if answer.get("type") == "error":
            raise PolicyError(f"the server's error: {one_line(str(content.get('error')))}")
        if answer.get("type") != wanted or answer.get("seq") != self._number:
            raise PolicyError(
                f"answered message {self._number} with {str(answer.get('type'))[:40]!r} to message "
                f"{str(answer.get('seq'))[:40]}; expected {wanted!r}"
            )
        return content
