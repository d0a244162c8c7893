"""Inference: what takes a frame and gives back a chunk, wherever the model runs."""

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
from ibrobot_core.inference.engine import LocalEngine
from ibrobot_core.interfaces import Engine, Frame, Policy
from ibrobot_core.robot import Vector
from ibrobot_core.units import ns

_CLOSE_TIMEOUT_S = 1.0
_ALONE = contextlib.nullcontext()
_PATIENCE_S = 600.0
"""How long a request is waited for where nothing else says so."""


@attrs.frozen(eq=False)
class DispatchInfer:
    """A request for a chunk: the observations, stamped, and an id that its answer carries."""

    id: int
    frame: Frame


@attrs.frozen(eq=False)
class Chunk:
    """The answer to a request: actions, shape (N, A), the first for `start_ns`; or why there are none."""

    id: int
    start_ns: int
    actions: Vector | None
    error: str = ""
    queued_ns: int = 0
    """For how long the request waited for those of other robots [ns]."""
    pace_ns: int = 0
    """Time to leave from one request to the next, as the server asks [ns]; 0: any."""


class InferenceClient(ABC):
    """Takes requests, and answers them some time later, not always in order."""

    @property
    def parallel(self) -> int:
        """How many requests may be on their way at a time so that each is answered as soon as if it were alone."""
        return 1

    @property
    def returns(self) -> int:
        """How often a model that was away has come back: requests that wait for it need not wait any more."""
        return 0

    @abstractmethod
    def submit(self, request: DispatchInfer) -> None:
        """Begin; returns at once."""

    @abstractmethod
    def poll(self, timeout_s: float = 0.0) -> Chunk | None:
        """An answer that came, waiting for one up to `timeout_s` [s].

        Raises:
            PolicyError: when the policy could not be reset, so that nothing it says can be trusted.
        """

    @abstractmethod
    def reset(self, seed: int) -> None:
        """A new episode begins: the policy forgets the last before it sees a later request."""

    @abstractmethod
    def close(self) -> None:
        """End; safe to call twice."""


def run_policy(
    policy: Policy, engine: Engine, request: DispatchInfer, deadline_ns: int,
    turn: contextlib.AbstractContextManager[object] = _ALONE,
) -> Chunk:  # fmt: skip
    """The three steps, one after the other. A policy that raises gives a chunk with its error: the arm holds.

    Args:
        policy: pre- and postprocesses.
        engine: runs `infer`.
        request: what to answer.
        deadline_ns: when nobody waits any more, by `time.monotonic_ns()`.
        turn: entered for what the policy does here.
    """
    stamp_ns = request.frame.stamp_ns
    try:
        with turn:
            tensors = policy.preprocess(request.frame)
        outputs = engine.infer(tensors, request.id, deadline_ns)
        with turn:
            actions = np.array(policy.postprocess(outputs), dtype=np.float64)  # a policy may reuse its own
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
    """Runs the policy in `submit`, so that a chunk costs no simulated time: for lockstep.

    Args:
        policy: pre- and postprocesses.
        engine: where `infer` runs; here where left out.
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
    """Runs the policy in threads of this process, up to as many as its engine takes requests; `infer` where that is.

    A request that waits behind slow ones is not run at all when a newer one, or a reset, waits behind it: nobody
    waits for its answer any more. The policy itself is called by one thread at a time.

    Args:
        policy: pre- and postprocesses.
        engine: where `infer` runs; here where left out.
        timeout_s: for how long the answer of a request is waited for, from its submission on.
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
        # A model that takes most of the time itself would only let them wait, and look at older observations.
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
        # One thread for as long as one will do: each has memory of its own for large messages, which grows cold.
        if not self._idle.acquire(blocking=False) and len(self._threads) < self._engine.parallel:
            thread = threading.Thread(target=self._run, name="inference", daemon=True)
            self._threads.append(thread)
            thread.start()

    def _run(self) -> None:
        while True:
            with self._taking:  # what was submitted before a reset begins before it, and what follows after it
                work = self._next()
                if work is None:
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
