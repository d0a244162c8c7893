"""Engines: where a policy's `infer` runs. In this process here; others are in `process` and `remote`."""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from typing import override

import attrs

from ibrobot_core.errors import PolicyError
from ibrobot_core.interfaces import Policy, Tensors


@attrs.define
class EngineStats:
    """What happened, for diagnostics."""

    mode: str
    alive: bool = False
    """Whether there is a model that answers."""
    weights: str = ""
    """Hash of the weights that act, as `Policy.weights`."""
    requests: int = 0
    failures: int = 0
    """Requests without outputs; those that were on their way when one failed count as one with it."""
    restarts: int = 0
    """Times that the model's process was started again, or its server came back."""
    infer_ms: float = 0.0
    """From the tensors to the outputs, of the last request."""
    model_ms: float = 0.0
    """As much of it as the model took, where it runs elsewhere."""
    queue_ms: float = 0.0
    """As much of it as the request waited for other robots' requests."""
    pace_ms: float = 0.0
    """Time to leave from one request to the next, as the server asks; 0: any."""


class Engine(ABC):
    """Runs `infer` for one robot: so many requests at a time as `parallel` says, each from a thread of its own."""

    parallel = 1

    def __init__(self, mode: str, seed: int = 0) -> None:
        self.stats = EngineStats(mode)
        self._episode, self._seed = 0, seed
        """What a model elsewhere must know with each request: it may have been started since the last."""
        self._counting = threading.Lock()
        self._failed_ns = 0

    def start(self) -> None:
        """Return when the model is ready.

        Raises:
            PolicyError: e.g. no such checkpoint, or nobody serves it.
            ContractError: when the model is not the one that the robot expects, with both sides.
        """

    def infer(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        """Inputs -> raw outputs.

        Args:
            tensors: what `preprocess` made.
            request_id: its answer is given to no other request.
            deadline_ns: when nobody waits any more, by `time.monotonic_ns()`.

        Raises:
            PolicyError: when there is no answer in time; a later request may well have one.
        """
        begun_ns = time.monotonic_ns()
        with self._counting:
            self.stats.requests += 1
        try:
            outputs = self.run(tensors, request_id, deadline_ns)
        except Exception:
            with self._counting:
                if begun_ns >= self._failed_ns:  # else it was on its way when the outage was noticed
                    self.stats.failures += 1
                    self._failed_ns = time.monotonic_ns()
            raise
        self.stats.infer_ms = (time.monotonic_ns() - begun_ns) / 1e6
        return outputs

    @abstractmethod
    def run(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        """As `infer`, which counts."""

    def reset(self, seed: int) -> None:
        """A new episode begins: a policy that remembers forgets the last before the next request."""
        self._episode += 1
        self._seed = seed

    def close(self) -> None:
        """Release what it took; a request that goes on fails soon. Safe to call twice."""


def check_weights(before: str, now: str, whose: str, *, accept: bool) -> None:
    """Compare the weights of a restarted model to the weights before.

    Args:
        before: hash of those that acted; empty at the first start.
        now: hash of those that would act.
        whose: which model, for the message.
        accept: whether others may act, with a warning.

    Raises:
        PolicyError: when they are others, and are not accepted.
    """
    if before in ("", now):
        return
    told = f"{whose} came back with other weights, {now or 'of no known hash'}; those that acted were {before}"
    if not accept:
        raise PolicyError(f"{told}; start the run again, or set inference.accept_new_weights: true")
    logging.getLogger("ibrobot.inference").warning("%s; they act from now on", told)


class LocalEngine(Engine):
    """The policy itself. Whoever owns it resets and closes it."""

    def __init__(self, policy: Policy) -> None:
        super().__init__("monolithic")
        self._policy = policy

    @override
    def start(self) -> None:
        self._policy.load()
        self.stats.weights = self._policy.weights()
        self.stats.alive = True

    @override
    def run(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        return self._policy.infer(tensors)
