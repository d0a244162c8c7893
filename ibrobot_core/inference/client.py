"""Inference clients: turn a frame into a chunk of actions, wherever the model runs; and the engine in this process."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from abc import ABC, abstractmethod
from typing import override

import attrs
import numpy as np

from ibrobot_core.errors import PolicyError
from ibrobot_core.interfaces import Engine, Frame, Policy, Tensors
from ibrobot_core.robot import Vector
from ibrobot_core.units import ns

_CLOSE_TIMEOUT_S = 1.0
_ALONE = contextlib.nullcontext()
_PATIENCE_S = 600.0
"""Default timeout of a request."""


@attrs.frozen(eq=False)
class DispatchInfer:
    """A request for a chunk: stamped observations and an id, which the answer repeats."""

    id: int
    frame: Frame


@attrs.frozen(eq=False)
class Chunk:
    """The answer to a request: actions, shape (N, A), the first for `start_ns`; or the error."""

    id: int
    start_ns: int
    actions: Vector | None
    error: str = ""
    queued_ns: int = 0
    """Time that the request spent queued behind other robots [ns]."""
    pace_ns: int = 0
    """Minimum time between requests, set by the server [ns]; 0 for no minimum."""


class LocalEngine(Engine):
    """The engine `monolithic`: calls the policy in this process; the policy's owner resets and closes it."""

    def __init__(self, policy: Policy) -> None:
        super().__init__("monolithic")
        self._policy = policy

    @override
    def start(self) -> None:
        self._policy.load()
        self._identify()
        self.stats.alive = True

    @override
    def run(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        outputs = self._policy.infer(tensors)
        self._identify()  # a policy on a server may have connected to another one
        return outputs

    def _identify(self) -> None:
        self.stats.weights, self.stats.server = self._policy.weights(), self._policy.identity()


class InferenceClient(ABC):
    """Takes requests and answers them later, not necessarily in order."""

    @property
    def parallel(self) -> int:
        """The number of requests that may be in flight at once without slowing each other down."""
        return 1

    @property
    def returns(self) -> int:
        """How often an unreachable model has come back; a change means that a new request need not wait."""
        return 0

    @abstractmethod
    def submit(self, request: DispatchInfer) -> None:
        """Start a request; returns at once."""

    @abstractmethod
    def poll(self, timeout_s: float = 0.0) -> Chunk | None:
        """Return an answer, waiting up to `timeout_s` [s] for one.

        Raises:
            PolicyError: if the policy could not be reset, so that its answers cannot be trusted.
        """

    @abstractmethod
    def reset(self, seed: int) -> None:
        """Start a new episode: the policy is reset before it sees a later request."""

    @abstractmethod
    def close(self) -> None:
        """Close the client. Safe to call twice."""


def run_policy(
    policy: Policy,
    engine: Engine,
    request: DispatchInfer,
    deadline_ns: int,
    turn: contextlib.AbstractContextManager[object] = _ALONE,
) -> Chunk:
    """Preprocess, infer and postprocess. If the policy raises, the chunk carries the error and the arm holds.

    Args:
        policy: pre- and postprocesses.
        engine: runs `infer`.
        request: the request to answer.
        deadline_ns: time after which the answer is no longer needed, by `time.monotonic_ns()`.
        turn: entered while the policy itself runs.
    """
    stamp_ns = request.frame.stamp_ns
    try:
        with turn:
            tensors = policy.preprocess(request.frame)
        Policy.check_finite("the policy's preprocess", tensors)
        outputs = engine.infer(tensors, request.id, deadline_ns)
        Policy.check_finite("the policy's infer", outputs)
        with turn:
            actions = np.array(policy.postprocess(outputs), dtype=np.float64)  # a policy may reuse its array
        Policy.check_finite("the policy's postprocess", {"action": actions})
    except PolicyError as error:
        return Chunk(request.id, stamp_ns, None, str(error))
    except Exception as error:
        logging.getLogger("ibrobot.inference").exception("the policy failed")
        return Chunk(request.id, stamp_ns, None, f"{type(error).__name__}: {error}")
    stats = engine.stats
    return Chunk(
        request.id, stamp_ns, actions, queued_ns=round(stats.queue_ms * 1e6), pace_ns=round(stats.pace_ms * 1e6)
    )


class LockstepClient(InferenceClient):
    """Runs the policy inside `submit`, so that inference takes no simulated time; for lockstep.

    Args:
        policy: pre- and postprocesses.
        engine: runs `infer`; by default the policy itself, in this process.
    """

    def __init__(self, policy: Policy, engine: Engine | None = None) -> None:
        self._policy = policy
        self._engine = engine or LocalEngine(policy)
        self._chunk: Chunk | None = None

    @override
    def submit(self, request: DispatchInfer) -> None:
        self._chunk = run_policy(self._policy, self._engine, request, time.monotonic_ns() + ns(_PATIENCE_S))

    @override
    def poll(self, timeout_s: float = 0.0) -> Chunk | None:
        chunk, self._chunk = self._chunk, None
        return chunk

    @override
    def reset(self, seed: int) -> None:
        self._chunk = None
        self._policy.reset(seed)
        self._engine.reset(seed)

    @override
    def close(self) -> None:
        self._chunk = None


class EngineClient(InferenceClient):
    """Runs pre- and postprocessing in threads of this process, at most one per parallel request of the engine.

    A queued request is skipped when a newer request or a reset is queued behind it, because its answer is no longer
    needed. The policy itself is called by one thread at a time.

    Args:
        policy: pre- and postprocesses.
        engine: runs `infer`; by default the policy itself, in this process.
        timeout_s: time from submission after which the answer of a request is no longer needed [s].
    """

    def __init__(self, policy: Policy, engine: Engine | None = None, timeout_s: float = _PATIENCE_S) -> None:
        self._policy = policy
        self._engine = engine or LocalEngine(policy)
        self._timeout_ns = ns(timeout_s)
        self._work: queue.SimpleQueue[tuple[DispatchInfer, int] | int | None] = queue.SimpleQueue()
        self._chunks: queue.SimpleQueue[Chunk | PolicyError] = queue.SimpleQueue()
        self._taking, self._turn, self._idle = threading.Lock(), threading.Lock(), threading.Lock()
        self._idle.acquire()  # free while a thread waits for work
        self._threads: list[threading.Thread] = []

    @property
    @override
    def parallel(self) -> int:
        # If the model itself takes most of the time, further requests would only queue, with older observations.
        stats, most = self._engine.stats, self._engine.parallel
        there_ms = stats.model_ms + stats.queue_ms
        return min(most, max(1, round(stats.infer_ms / there_ms))) if there_ms else most

    @property
    @override
    def returns(self) -> int:
        return self._engine.stats.restarts

    @override
    def submit(self, request: DispatchInfer) -> None:
        self._put((request, time.monotonic_ns() + self._timeout_ns))

    @override
    def poll(self, timeout_s: float = 0.0) -> Chunk | None:
        try:
            answer = self._chunks.get(timeout_s > 0, timeout_s or None)
        except queue.Empty:
            return None
        if isinstance(answer, PolicyError):
            raise answer
        return answer

    @override
    def reset(self, seed: int) -> None:
        self._put(seed)

    @override
    def close(self) -> None:
        for _ in self._threads:
            self._work.put(None)
        # A model that hangs must not keep the robot from stopping; the threads are daemons.
        deadline_s = time.monotonic() + _CLOSE_TIMEOUT_S
        for thread in self._threads:
            thread.join(max(0.0, deadline_s - time.monotonic()))

    def _put(self, work: tuple[DispatchInfer, int] | int) -> None:
        self._work.put(work)
        # Prefer one thread: each has its own buffers for large messages, and unused ones fall out of the cache.
        if not self._idle.acquire(blocking=False) and len(self._threads) < self._engine.parallel:
            thread = threading.Thread(target=self._run, name="inference", daemon=True)
            self._threads.append(thread)
            thread.start()

    def _run(self) -> None:
        while True:
            with self._taking:  # keeps requests and resets in the order submitted
                if (work := self._next()) is None:
                    return
                if isinstance(work, int):
                    self._reset(work)
                    continue
                if not self._work.empty():
                    continue
            self._chunks.put(run_policy(self._policy, self._engine, *work, self._turn))

    def _next(self) -> tuple[DispatchInfer, int] | int | None:
        with contextlib.suppress(queue.Empty):
            return self._work.get_nowait()
        if self._idle.locked():
            self._idle.release()
        return self._work.get()

    def _reset(self, seed: int) -> None:
        try:
            with self._turn:
                self._policy.reset(seed)
            self._engine.reset(seed)
        except Exception as error:
            logging.getLogger("ibrobot.inference").exception("the policy failed")
            self._chunks.put(PolicyError(f"the policy's reset failed: {type(error).__name__}: {error}"))
