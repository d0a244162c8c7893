"""Engines: where a policy's `infer` runs, e.g. in this process, in another, or on a server."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod

import attrs

from ibrobot_core.interfaces.policy import Tensors


@attrs.define
class EngineStats:
    """What happened, for diagnostics."""

    mode: str
    """The engine's type, as `execution_mode` gives it."""
    alive: bool = False
    """Whether the model answers."""
    weights: str = ""
    """Hash of the weights that act, as `Policy.weights`."""
    requests: int = 0
    failures: int = 0
    """Requests without outputs; those that were on their way when one failed count as one with it."""
    restarts: int = 0
    """Times that the model came back after it was away."""
    infer_ms: float = 0.0
    """From the tensors to the outputs, of the last request."""
    model_ms: float = 0.0
    """The model's part of it, where it runs elsewhere."""
    queue_ms: float = 0.0
    """The part of it for which the request waited for other robots' requests."""
    pace_ms: float = 0.0
    """Time to leave from one request to the next, as the server asks; 0: any."""


class Engine(ABC):
    """Runs `infer` for one robot: up to `parallel` requests at a time, each from a thread of its own.

    The constructor opens nothing; `start` does. The run resets and closes the policy of `Context.model`. An engine that
    runs `infer` elsewhere never loads it.

    Args:
        mode: the engine's type.
        seed: the run's, until the first `reset`.
    """

    parallel = 1

    def __init__(self, mode: str, seed: int = 0) -> None:
        self.stats = EngineStats(mode)
        self._episode, self._seed = 0, seed
        """For models elsewhere, which may have restarted since the last request: send both with each request."""
        self._counting = threading.Lock()
        self._failed_ns = 0

    def start(self) -> None:
        """Return when the model is ready.

        Raises:
            PolicyError: e.g. no such checkpoint, or no server has it.
            ContractError: when the model is not the one that the robot expects, with both sides.
        """

    def infer(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        """Inputs -> raw outputs.

        Args:
            tensors: what `preprocess` made.
            request_id: unique in a run, so that no request gets the answer to another one.
            deadline_ns: when the answer is of no use any more, by `time.monotonic_ns()`.

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
        """A new episode begins: a policy that remembers forgets the last one before the next request."""
        self._episode += 1
        self._seed = seed

    def close(self) -> None:
        """Release all resources; a request that is under way fails soon. Safe to call twice."""
