"""The protocol of openpi: a websocket, one msgpack message each way; metadata first, errors as text."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, override
from urllib.parse import urlsplit

from ibrobot_policy_wire import pack, unpack

from ibrobot_core.api import PolicyError
from ibrobot_policy_servers.connection import one_line
from ibrobot_policy_servers.options import OpenpiOptions
from ibrobot_policy_servers.websocket import WebsocketConnection

_LOOPBACK = ("localhost", "127.0.0.1", "::1")


class OpenpiConnection(WebsocketConnection):
    """A connection to an openpi server.

    Args:
        options: address, certificate authority and key.
        log: receives a warning if the key would be sent in the clear.
    """

    project = "openpi"

    def __init__(self, options: OpenpiOptions, log: logging.Logger) -> None:
        super().__init__(
            options.url, options.ca, {"Authorization": f"Api-Key {options.api_key}"} if options.api_key else {}
        )
        where = urlsplit(options.url)
        if options.api_key and where.scheme == "ws" and where.hostname not in _LOOPBACK:
            log.warning("%s: the API key is sent without encryption; use wss://", options.url)

    @override
    def greet(self, timeout_s: float) -> Mapping[str, Any]:
        return self._answer(timeout_s)

    @override
    def ask(self, request: Mapping[str, Any], timeout_s: float) -> Mapping[str, Any]:
        self.send(pack(request))
        return self._answer(timeout_s)

    @override
    def reset(self, timeout_s: float) -> None:
        """Do nothing: openpi has no such message."""

    def _answer(self, timeout_s: float) -> Mapping[str, Any]:
        message = self.receive(timeout_s)
        if isinstance(message, str):
            raise PolicyError(f"the server's error: {one_line(message)}")
        content = unpack(message)
        if not isinstance(content, dict):
            raise PolicyError(f"sent {type(content).__name__}, must be a dictionary")
        return content
