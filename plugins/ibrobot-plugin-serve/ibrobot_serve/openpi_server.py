"""`ibrobot serve --protocol openpi`: a model for openpi's clients, over a websocket."""

from __future__ import annotations

import hmac
import threading
from http import HTTPStatus

from ibrobot_policy_wire import MAX_MESSAGE, pack, unpack
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from ibrobot_core.api import PolicyError
from ibrobot_serve.client_model import ClientModel, as_dictionary

_CLOSE_S = 0.5
_PROMPT = "prompt"


class OpenpiServer:
    """Answers openpi's clients with a loaded policy.

    A request is a dictionary of the policy's observations, under their keys in the contract: images (H, W, 3) uint8,
    vectors of floats, and `prompt`. The answer has `actions`, shape (N, A), in the contract's units and order, and
    `server_timing`. Requests of all clients are computed one after the other.

    Args:
        model: the model.
        host: address to listen on.
        port: port; 0: any free one.
        key: what clients must send as `Authorization: Api-Key KEY`; None: nothing.

    Raises:
        OSError: if the address cannot be used.
    """

    def __init__(self, model: ClientModel, host: str, port: int, key: str | None = None) -> None:
        self._model, self._key = model, key
        policy, spec = model.policy, model.spec
        self._metadata = {
            "model": model.name,
            "fingerprint": policy.fingerprint(),
            "weights": policy.weights(),
            "observations": {each: list(shape) for each, shape in spec.observations.items()},
            "action_size": spec.action_size,
            "horizon": spec.chunk_size,
            "prompt": spec.prompt,
        } | model.trained
        self._connections: set[ServerConnection] = set()
        self._server = serve(
            self._handle, host, port, process_request=self._admit, compression=None, max_size=MAX_MESSAGE,
            close_timeout=_CLOSE_S, ping_interval=None,
        )  # fmt: skip
        self.port: int = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever, name="openpi")
        self._thread.start()

    def close(self) -> None:
        """End all connections. Safe to call twice."""
        self._server.shutdown()
        for connection in list(self._connections):
            connection.close()
        self._thread.join()

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        if request.path == "/healthz":
            return connection.respond(HTTPStatus.OK, "OK\n")
        given = request.headers.get("Authorization", "")
        if self._key is not None and not hmac.compare_digest(given.encode(), f"Api-Key {self._key}".encode()):
            return connection.respond(HTTPStatus.UNAUTHORIZED, "the API key is missing or wrong\n")
        return None

    def _handle(self, connection: ServerConnection) -> None:
        self._connections.add(connection)
        try:
            connection.send(pack(self._metadata))
            for message in connection:
                connection.send(self._answer(message))
        except ConnectionClosed:
            pass  # a client may leave at any time
        finally:
            self._connections.discard(connection)

    def _answer(self, message: bytes | str) -> bytes | str:
        """The answer to a message; text is an error."""
        try:
            with self._model.contained():
                if isinstance(message, str):
                    raise PolicyError("a request must be binary")
                request = as_dictionary(unpack(message))
                prompt = request.pop(_PROMPT, "")
                actions, took_ms = self._model.chunk(request, prompt)
        except PolicyError as error:
            return str(error)
        return pack({"actions": actions, "server_timing": {"infer_ms": took_ms}})
