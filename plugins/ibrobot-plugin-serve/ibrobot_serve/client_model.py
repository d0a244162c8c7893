"""A model for clients of other projects: checks their requests, and computes the answers."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import Frame, Policy, PolicyError

_WORDS = {"actions": "joints", "rate_hz": "rate"}
"""Key that a model may leave unknown -> word for it in messages."""


class ClientModel:
    """Checks the requests of clients, and computes them one after the other.

    Args:
        policy: loaded; its owner closes it.
        name: name of the model.
        protocol: the clients' protocol, for messages.

    Raises:
        PolicyError: for a policy that needs more than one request at a time.
    """

    def __init__(self, policy: Policy, name: str, protocol: str) -> None:
        if policy.spec.history or policy.spec.stateful:
            raise PolicyError(
                f"model {name!r} uses earlier observations, which do not fit into requests of {protocol}; serve it "
                "to robots of ibrobot, without --protocol"
            )
        self.policy, self.name, self.spec = policy, name, policy.spec
        self.answered = self.failed = 0
        self._turn = threading.Lock()
        self._log = logging.getLogger("ibrobot.serve")
        if unstated := [word for key, word in _WORDS.items() if key not in self.trained]:
            self._log.warning(
                "model %r does not state the %s of its actions: clients get only their size, %d numbers",
                name, " and ".join(unstated), self.spec.action_size,
            )  # fmt: skip

    @property
    def trained(self) -> dict[str, Any]:
        """The joints of its actions and their rate, as far as its training data say them."""
        known = {"actions": list(self.spec.actions or ()), "rate_hz": self.spec.rate_hz}
        return {name: value for name, value in known.items() if value}

    @contextmanager
    def contained(self) -> Iterator[None]:
        """Count a request that fails, and let only `PolicyError` pass.

        Raises:
            PolicyError: for an error of any kind.
        """
        try:
            yield
        except PolicyError:
            self.failed += 1
            raise
        except Exception as error:  # noqa: BLE001 - contained: the client gets the error
            self._log.exception("the policy failed")
            self.failed += 1
            raise PolicyError(f"{type(error).__name__}: {error}") from None

    def chunk(self, values: Mapping[str, Any], prompt: Any) -> tuple[NDArray[np.float32], float]:
        """Compute the actions for observations, shape (N, A). Also returns the time that it took [ms].

        Args:
            values: the policy's observations: images (H, W, 3) uint8, vectors of numbers.
            prompt: the task.

        Raises:
            PolicyError: if an observation is missing, unknown, or has a wrong dtype or shape, or if a number is not
                finite, from the request to the actions; names the stage.
        """
        begun_s = time.perf_counter()
        frame = _frame(values, prompt, self.policy)
        Policy.check_finite("the request", frame.values)
        with self._turn:
            tensors = self.policy.preprocess(frame)
            Policy.check_finite("the policy's preprocess", tensors)
            outputs = self.policy.infer(tensors)
            Policy.check_finite("the policy's infer", outputs)
            with np.errstate(over="ignore"):  # the check names it
                actions = self.policy.postprocess(outputs).astype(np.float32)
        Policy.check_finite("the policy's postprocess", {"actions": actions})
        self.answered += 1
        return actions, (time.perf_counter() - begun_s) * 1e3


def as_dictionary(request: object) -> dict[str, Any]:
    """A request after decoding.

    Raises:
        PolicyError: if it is no dictionary.
    """
    if not isinstance(request, dict):
        raise PolicyError(f"a request must be a dictionary, got {type(request).__name__}")
    return request


def _frame(request: Mapping[str, Any], prompt: Any, policy: Policy) -> Frame:
    wrong = [f"{str(name)[:80]!r} is unknown" for name in request if name not in policy.spec.observations]
    values: dict[str, NDArray[np.generic]] = {}
    for key, shape in policy.spec.observations.items():
        given = request.get(key)
        value = given if isinstance(given, np.ndarray) else None
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
    if not isinstance(prompt, str):
        wrong.append("the prompt must be text")
    if wrong:
        raise PolicyError(f"the request: {'; '.join(wrong)}")
    return Frame(time.time_ns(), values, prompt=prompt)
