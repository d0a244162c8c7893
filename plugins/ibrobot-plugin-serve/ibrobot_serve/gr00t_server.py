"""`ibrobot serve --protocol gr00t`: a model for GR00T's clients, over ZeroMQ."""

from __future__ import annotations

import hmac
import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import zmq
from ibrobot_policy_wire import MAX_MESSAGE, pack_npy, unpack_npy

from ibrobot_core.api import PolicyError
from ibrobot_serve.client_model import ClientModel, as_dictionary

TASK = "annotation.human.task_description"
_GLANCE_MS = 100
"""How often the server checks whether it was closed [ms]."""
_UNREAD = 10
"""Answers kept for a client that does not read."""
_PREFIX, _PICTURES = "observation.", "observation.images."
_ACTION = "action"


class Gr00tServer:
    """Answers clients of Isaac GR00T 1.6 and 1.5 with a loaded policy.

    An observation `observation.images.NAME` is a video NAME, shape (1, 1, H, W, 3) uint8; `observation.NAME` is a state
    NAME, shape (1, 1, D). The answer has one vector `action`, shape (1, N, A), in the contract's units and order; the
    information beside it has the joints and the rate. Clients of 1.5 have one dimension less, and flat keys, e.g.
    `video.top`. ZeroMQ takes the requests of all clients in turns, and refuses messages over 64 MiB unread.

    Args:
        model: the model.
        host: address to listen on.
        port: port; 0: any free one.
        key: what clients must send as `api_token`; None: nothing.

    Raises:
        OSError: if the address cannot be used.
    """

    def __init__(self, model: ClientModel, host: str, port: int, key: str | None = None) -> None:
        self._model, self._key = model, key
        self._places = {_place(observation): observation for observation in model.spec.observations}
        """Modality and name -> observation."""
        self._context = zmq.Context()
        # A socket of kind REP stops answering everybody after bytes of another protocol (libzmq 4.3.5).
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, _UNREAD)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE)
        self._socket.setsockopt(zmq.IPV6, ":" in host)
        try:
            self._socket.bind(f"tcp://{f'[{host}]' if ':' in host else host}:{port or '*'}")
        except zmq.ZMQError as error:
            self._socket.close()
            self._context.term()
            raise OSError(error.errno, str(error)) from None
        self.port = int(self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="gr00t")
        self._thread.start()

    def close(self) -> None:
        """Stop answering. Safe to call twice."""
        self._closed.set()
        self._thread.join()
        self._socket.close()
        self._context.term()

    def _serve(self) -> None:
        while not self._closed.is_set():
            if not self._socket.poll(_GLANCE_MS):
                continue
            with suppress(zmq.Again):  # no complete message
                sender, *frames = self._socket.recv_multipart(zmq.NOBLOCK)
                if len(frames) == 2 and not frames[0]:  # from a socket of kind REQ
                    self._socket.send_multipart([sender, b"", pack_npy(self._answer(frames[1]))], zmq.NOBLOCK)

    def _answer(self, message: bytes) -> Any:
        try:
            with self._model.contained():
                request = as_dictionary(unpack_npy(message))
                if self._key is not None:
                    token = request.get("api_token")
                    if not isinstance(token, str) or not hmac.compare_digest(token.encode(), self._key.encode()):
                        raise PolicyError("Unauthorized: the API token is missing or wrong")
                return self._called(request.get("endpoint", "get_action"), request.get("data"))
        except PolicyError as error:
            return {"error": str(error)}

    def _called(self, endpoint: Any, data: Any) -> Any:
        if endpoint == "ping":
            return {"status": "ok", "message": f"serving {self._model.name}"}
        if endpoint == "reset":
            return {}
        if endpoint == "get_modality_config":
            return self._described()
        if endpoint != "get_action":
            raise PolicyError(
                f"no endpoint {str(endpoint)[:40]!r}; there are ping, reset, get_modality_config, get_action"
            )
        if not isinstance(data, dict):
            raise PolicyError("a request must have data, a dictionary")
        nested = "observation" in data
        values, prompt = _nested(data["observation"]) if nested else _flat(data)
        unknown = [place for place in values if place not in self._places]
        if unknown:
            raise PolicyError(f"the request: {', '.join(unknown)[:200]} unknown; there are {', '.join(self._places)}")
        actions, took_ms = self._model.chunk({self._places[place]: value for place, value in values.items()}, prompt)
        if not nested:
            return {f"action.{_ACTION}": actions}
        trained = self._model.trained
        told = {"joints" if name == "actions" else name: value for name, value in trained.items()}
        told["infer_ms"] = took_ms
        return [{_ACTION: actions[None]}, told]

    def _described(self) -> dict[str, Any]:
        """The modalities, as GR00T 1.6 describes them."""
        keys: dict[str, list[str]] = {"video": [], "state": []}
        for place in self._places:
            modality, _, name = place.partition(".")
            keys[modality].append(name)
        steps = {modality: [0] for modality in keys}
        keys["action"], steps["action"] = [_ACTION], list(range(self._model.spec.chunk_size))
        keys["language"], steps["language"] = [TASK], [0]
        return {
            modality: {
                "__ModalityConfig_class__": True,
                "as_json": {"delta_indices": steps[modality], "modality_keys": names},
            }
            for modality, names in keys.items()
        }


def _place(observation: str) -> str:
    """The modality and the name of an observation, e.g. `video.top`."""
    if observation.startswith(_PICTURES):
        return f"video.{observation.removeprefix(_PICTURES)}"
    return f"state.{observation.removeprefix(_PREFIX)}"


def _nested(given: Any) -> tuple[dict[str, Any], str]:
    """The arrays of a request of GR00T 1.6 by modality and name, and the prompt.

    Raises:
        PolicyError: if it has another structure.
    """
    if not isinstance(given, dict) or not all(isinstance(each, dict) for each in given.values()):
        raise PolicyError("the request: an observation must be a dictionary of dictionaries")
    values = {
        f"{modality}.{name}": _last(value, 2)
        for modality, each in given.items()
        if modality != "language"
        for name, value in each.items()
    }
    return values, _text(given.get("language", {}).get(TASK, ""))


def _flat(given: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """The same for GR00T 1.5."""
    values = {str(name): _last(value, 1) for name, value in given.items() if name != TASK}
    return values, _text(given.get(TASK, ""))


def _last(value: Any, count: int) -> Any:
    """An array without the dimensions of a batch and of time, which must be 1."""
    if not isinstance(value, np.ndarray) or value.shape[:count] != (1,) * count:
        shape = value.shape if isinstance(value, np.ndarray) else type(value).__name__
        raise PolicyError(f"the request: an array is {shape}; it must have one batch and one time step")
    return value.reshape(value.shape[count:])


def _text(value: Any) -> str:
    """A prompt, out of lists of one element."""
    while isinstance(value, list | tuple) and len(value) == 1:
        value = value[0]
    if not isinstance(value, str):
        raise PolicyError("the request: the prompt must be one text")
    return value
