"""`ibrobot serve --protocol openpi`: a model for openpi's clients, over a websocket."""

from __future__ import annotations

import hmac
import logging
import threading
import time
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

import numpy as np
from ibrobot_policy_wire import MAX_MESSAGE, pack, unpack
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from ibrobot_core.api import Frame, Policy, PolicyError

_CLOSE_S = 0.5
_PROMPT = "prompt"


class OpenpiServer:
    """Answers openpi's clients with a loaded policy.

    A request is a dictionary of the policy's observations, under their keys in the contract: images (H, W, 3) uint8,
    vectors of floats, and `prompt`. The answer has `actions`, shape (N, A), in the contract's units and order, and
    `server_timing`. Requests of all clients are computed one after the other.

    Args:
        policy: loaded; its owner closes it.
        name: name of the model, for the metadata.
        host: address to listen on.
        port: port; 0: any free one.
        key: what clients must send as `Authorization: Api-Key KEY`; None: nothing.

    Raises:
        PolicyError: for a policy that needs more than one request at a time.
        OSError: if the address cannot be used.
    """

    def __init__(self, policy: Policy, name: str, host: str, port: int, key: str | None = None) -> None:
        spec = policy.spec
        if spec.history or spec.stateful:
            raise PolicyError(
                f"model {name!r} uses earlier observations, for which openpi's protocol has no place; serve it to "
                "robots of ibrobot, without --protocol"
            )
        self._policy, self._key = policy, key
        self._turn = threading.Lock()
        self._log = logging.getLogger("ibrobot.serve")
        self._metadata = {
            "model": name,
            "fingerprint": policy.fingerprint(),
            "weights": policy.weights(),
            "observations": {each: list(shape) for each, shape in spec.observations.items()},
            "actions": list(spec.actions or ()),
            "horizon": spec.chunk_size,
            "rate_hz": spec.rate_hz,
            "prompt": spec.prompt,
        }
        self.answered = self.failed = 0
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
        begun_s = time.perf_counter()
        try:
            if isinstance(message, str):
                raise PolicyError("a request must be binary")
            frame = _frame(unpack(message), self._policy)
            with self._turn:
                tensors = self._policy.preprocess(frame)
                actions = self._policy.postprocess(self._policy.infer(tensors)).copy()
        except PolicyError as error:
            self.failed += 1
            return str(error)
        except Exception as error:  # noqa: BLE001 - contained: the client gets the error
            self._log.exception("the policy failed")
            self.failed += 1
            return f"{type(error).__name__}: {error}"
        self.answered += 1
        timing = {"infer_ms": (time.perf_counter() - begun_s) * 1e3}
        return pack({"actions": actions.astype(np.float32), "server_timing": timing})


def _frame(request: Any, policy: Policy) -> Frame:
    """The observations of a request.

    Raises:
        PolicyError: if one is missing, unknown, or has a wrong dtype or shape.
    """
    if not isinstance(request, dict):
        raise PolicyError(f"a request must be a dictionary, got {type(request).__name__}")
    wrong = [f"{name!r} is unknown" for name in request if name not in (*policy.spec.observations, _PROMPT)]
    values: dict[str, NDArray[np.generic]] = {}
    for key, shape in policy.spec.observations.items():
        value = _array(request, key)
        kind = "u" if len(shape) == 3 else "iuf"
        fits = (
            value is not None
            and len(value.shape) == len(shape)
            and all(n in (-1, m) for n, m in zip(shape, value.shape, strict=True))
        )
        if value is None or not fits or value.dtype.kind not in kind:
            got = "is missing" if value is None else f"is {value.dtype} {value.shape}"
            wrong.append(f"{key!r} {got}, must be {'uint8' if kind == 'u' else 'numbers'} {tuple(shape)}")
        else:
            values[key] = value if kind == "u" else value.astype(np.float32)
    prompt = request.get(_PROMPT, "")
    if not isinstance(prompt, str):
        wrong.append(f"{_PROMPT!r} must be text")
    if wrong:
        raise PolicyError(f"the request: {'; '.join(wrong)}")
    return Frame(time.time_ns(), values, prompt=prompt)


def _array(request: Mapping[str, Any], key: str) -> NDArray[Any] | None:
    value = request.get(key)
    return value if isinstance(value, np.ndarray) else None
