"""A websocket to a server, for the protocols that use one."""

from __future__ import annotations

import ssl
from abc import abstractmethod
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, override

from ibrobot_policy_wire import MAX_MESSAGE
from websockets.exceptions import InvalidHandshake, InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect

from ibrobot_core.api import PolicyError
from ibrobot_policy_servers.connection import Connection

_CLOSE_S = 0.5


class WebsocketConnection(Connection):
    """Base of connections over a websocket.

    Args:
        url: ws:// or wss:// address.
        authority: file with the certificate authority for wss://; empty: the system's.
        headers: additional headers of the opening request.
    """

    project: str
    """Whose protocol it is, for messages."""

    def __init__(self, url: str, authority: str, headers: Mapping[str, str]) -> None:
        self.address = url
        self._authority, self._headers = authority, headers
        self._stack = ExitStack()
        self._socket: ClientConnection | None = None

    @abstractmethod
    def greet(self, timeout_s: float) -> Mapping[str, Any]:
        """Exchange the first messages; returns what the server states."""

    @override
    def open(self, timeout_s: float) -> Mapping[str, Any]:
        try:
            # A server computes in the thread that would answer pings.
            opening = connect(
                self.address, ssl=self._tls(), additional_headers=self._headers, compression=None,
                max_size=MAX_MESSAGE, open_timeout=timeout_s, close_timeout=_CLOSE_S, ping_interval=None, proxy=None,
            )  # fmt: skip
            self._socket = self._stack.enter_context(opening)
            return self.greet(timeout_s)
        except InvalidStatus as error:
            raise PolicyError(f"refused the connection with status {error.response.status_code}") from None
        except (OSError, TimeoutError, InvalidHandshake, WebSocketException, EOFError) as error:
            raise PolicyError(f"no {self.project} server: {error or type(error).__name__}") from None

    @override
    def interrupt(self) -> None:
        socket = self._socket
        if socket is not None:
            socket.close()

    @override
    def close(self) -> None:
        self._socket = None
        self._stack.close()

    def send(self, message: bytes) -> None:
        """Send a message.

        Raises:
            PolicyError: if the connection has ended.
        """
        try:
            self._connected().send(message)
        except (OSError, WebSocketException, EOFError) as error:
            raise self._ended(error) from None

    def receive(self, timeout_s: float) -> bytes | str:
        """Receive a message.

        Raises:
            PolicyError: if there is none in time, or the connection has ended.
        """
        try:
            return self._connected().recv(timeout_s)
        except TimeoutError:
            raise PolicyError(f"no answer within {timeout_s:g} s") from None
        except (OSError, WebSocketException, EOFError) as error:
            raise self._ended(error) from None

    def _connected(self) -> ClientConnection:
        if self._socket is None:
            raise PolicyError("is not connected")
        return self._socket

    def _ended(self, error: Exception) -> PolicyError:
        return PolicyError(f"the connection ended: {error or type(error).__name__}")

    def _tls(self) -> ssl.SSLContext | None:
        if not self.address.startswith("wss:"):
            return None
        try:
            file = str(Path(self._authority).expanduser()) if self._authority else None
            return ssl.create_default_context(cafile=file)
        except (OSError, ssl.SSLError) as error:
            raise PolicyError(f"{self._authority}: cannot be used as a certificate authority: {error}") from None
