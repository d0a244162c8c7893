"""Engines, which run a policy's `infer`, e.g. in this process, in another one, or on a server."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod

import attrs

from ibrobot_core.interfaces.policy import Tensors


@attrs.define
class EngineStats:
    """Statistics for diagnostics."""

    mode: str
    """The engine's type, from `execution_mode`."""
    alive: bool = False
    """Whether the model is reachable."""
    weights: str = ""
    """Hash of the weights in use, as in `Policy.weights`."""
    server: str = ""
    """Name and version of the program that computes the answers, as in `Policy.identity`."""
    requests: int = 0
    failures: int = 0
    """Number of failed requests; requests in flight at the time of a failure are counted with it as one."""
    restarts: int = 0
    """Number of times that the model returned after an outage."""
    infer_ms: float = 0.0
    """Duration of the last request, from tensors to outputs."""
    model_ms: float = 0.0
    """The model's part of it, if it runs elsewhere."""
    queue_ms: float = 0.0
    """The part of it spent waiting for requests of other robots."""
    pace_ms: float = 0.0
    """Time to leave between requests, set by the server; 0: any."""


class Engine(ABC):
    """Runs `infer` for one robot, with up to `parallel` concurrent requests, each in its own thread.

    The constructor opens nothing; `start` does. The run resets and closes the policy of `Context.model`. An engine that
    runs `infer` elsewhere never loads it.

    Args:
        mode: the engine's type.
        seed: seed of the run, used until the first `reset`.
    """

    parallel = 1

    def __init__(self, mode: str, seed: int = 0) -> None:
        self.stats = EngineStats(mode)
        self._episode, self._seed = 0, seed
        """For remote models, which may have restarted since the last request: send both with each request."""
        self._counting = threading.Lock()
        self._failed_ns = 0

    def start(self) -> None:
        """Start the model; returns when it is ready.

        Raises:
            PolicyError: e.g. if the checkpoint does not exist, or no server has it.
            ContractError: if the model is not the one that the robot expects; shows both sides.
        """

    def infer(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        """Compute raw outputs from inputs.

        Args:
            tensors: tensors from `preprocess`.
            request_id: unique in a run, so that answers are never assigned to another request.
            deadline_ns: time after which the answer is useless, by `time.monotonic_ns()`.

        Raises:
            PolicyError: if there is no answer in time; later requests may succeed.
        """
        begun_ns = time.monotonic_ns()
        with self._counting:
            self.stats.requests += 1
        try:
            outputs = self.run(tensors, request_id, deadline_ns)
        except Exception:
            with self._counting:
                if begun_ns >= self._failed_ns:  # otherwise it was in flight when the outage was detected
                    self.stats.failures += 1
                    self._failed_ns = time.monotonic_ns()
            raise
        self.stats.infer_ms = (time.monotonic_ns() - begun_ns) / 1e6
        return outputs

    @abstractmethod
    def run(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        """The implementation of `infer`, which adds statistics."""

    def reset(self, seed: int) -> None:
        """Begin a new episode: a stateful policy is reset before the next request."""
        self._episode += 1
        self._seed = seed

    def close(self) -> None:
        """Release all resources; a running request fails soon. Safe to call twice."""
