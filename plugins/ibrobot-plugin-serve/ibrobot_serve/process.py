"""Execution mode `process`: run `infer` in a child process, which can neither starve nor crash the host."""

from __future__ import annotations

import logging
import mmap
import os
import threading
import time
from collections.abc import Mapping
from typing import Any, Self, override

from ibrobot_core.api import NS_PER_S, Context, Engine, PolicyError, Tensors
from ibrobot_core.app import Child, ComponentFailed, RobotConfig, create_memory
from ibrobot_serve.options import ProcessOptions
from ibrobot_serve.weights import check_weights
from ibrobot_serve.wire import WIRE_LIMITS, WireDecoder, WireEncoder, WireKind, WireMessage

_START_TIMEOUT_S = 600.0
_END_TIMEOUT_S = 2.0
_LONGEST_PAUSE_S = 30.0
_GLANCE_S = 0.1
"""How often a wait checks whether the run has ended [s]."""


class ProcessEngine(Engine):
    """The model in a process of its own, which loads the weights; tensors pass through shared memory.

    A process that dies or hangs is restarted: at once the first time, then after pauses that double until it answers.
    Meanwhile requests fail, and the arm holds.

    Args:
        config: the robot YAML.
        model: the model's name there.
        fingerprint: fingerprint of the host's policy.
        seed: seed of the run.
        given_up: set when the run ends, e.g. while the model loads.
        hang_timeout_s: a process that works longer on one request counts as hanging [s].
        accept_new_weights: continue, with a warning, if the process restarts with other weights.
    """

    def __init__(
        self, config: RobotConfig, model: str, fingerprint: str, seed: int = 0,
        given_up: threading.Event | None = None, hang_timeout_s: float = 30.0, *, accept_new_weights: bool = False,
    ) -> None:  # fmt: skip
        super().__init__("process", seed)
        self._order = {
            "document": config.complete,
            "source": str(config.source),
            "sim": config.simulated,
            "model": model,
            "seed": seed,
        }
        self._fingerprint = fingerprint
        self._accept_new_weights = accept_new_weights
        self._log = logging.getLogger("ibrobot.inference")
        self._robot = config.robot.name
        self._lock = threading.Lock()
        self._encoder, self._decoder = WireEncoder(), WireDecoder()
        self._closed = threading.Event()
        self._given_up = given_up or self._closed
        self._child: Child | None = None
        self._hang_timeout_s = hang_timeout_s
        self._sent = 0
        """Id of the newest request."""
        self._at_work_s: float | None = None
        """When the process began its current request [s]; None between requests."""
        self._deaths = 0
        self._start_again_s = 0.0

    @classmethod
    def from_context(cls, options: ProcessOptions, ctx: Context) -> Self:
        """The engine that a robot YAML describes."""
        assert ctx.model is not None
        return cls(
            ctx.model.config, ctx.name, ctx.model.policy.fingerprint(), ctx.seed, ctx.model.ending,
            options.hang_timeout, accept_new_weights=options.accept_new_weights,
        )  # fmt: skip

    @property
    def pid(self) -> int | None:
        """The id of the model's process; None before `start`."""
        return self._child.pid if self._child is not None else None

    @override
    def start(self) -> None:
        with self._lock:
            try:
                self._await("ready", self._spawn(), time.monotonic() + _START_TIMEOUT_S)
            except PolicyError:
                self._reap()
                raise

    @override
    def run(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        with self._lock:
            deadline_s = deadline_ns / NS_PER_S
            child = self._revived(deadline_s)
            message = WireMessage(
                WireKind.REQUEST, request_id, tensors, self._robot, episode=self._episode, seed=self._seed,
                deadline_ns=max(0, deadline_ns - time.monotonic_ns()),
            )  # fmt: skip
            frame = self._encoder.encode(message, lambda size: self._request[:size])
            child.channel.send({"id": request_id, "size": len(frame)})
            self._sent = request_id
            self._at_work_s = self._at_work_s or time.monotonic()
            while (event := self._await("answer", child, deadline_s))["id"] != request_id:
                pass  # the answer to an abandoned request
            # The memory belongs to the next answer; this one is kept.
            answer = self._decoder.decode(bytes(self._answer[: event["size"]]))
        self._deaths = 0
        self.stats.server = event["identity"]
        self.stats.model_ms = answer.latency_ms
        if answer.kind is WireKind.FAILURE:
            raise PolicyError(answer.text)
        return answer.tensors

    @override
    def close(self) -> None:
        self._closed.set()
        child = self._child  # a request in another thread may reap it meanwhile
        if child is not None:
            child.kill()
        with self._lock:
            self._reap()

    def _spawn(self) -> Child:
        self._reap()
        if self._closed.is_set():
            raise PolicyError("the model was closed")
        memories = [create_memory() for _ in range(2)]
        try:
            for memory in memories:
                os.ftruncate(memory, WIRE_LIMITS.size)  # pages are allocated at their first use
            self._request, self._answer = (memoryview(mmap.mmap(memory, WIRE_LIMITS.size)) for memory in memories)
            self._child = Child("ibrobot_serve.model_process", self._order, *memories, end_s=_END_TIMEOUT_S)
        finally:
            for memory in memories:
                os.close(memory)
        return self._child

    def _await(self, wanted: str, child: Child, deadline_s: float) -> Mapping[str, Any]:
        """The next event of this name."""
        while True:
            try:
                event = child.wait(min(_GLANCE_S, max(0.0, deadline_s - time.monotonic())))
            except ComponentFailed as death:
                raise self._died(child, str(death)) from None
            if event is not None:
                if event["event"] == "ready":
                    self._check(event["fingerprint"], event["weights"])
                    self.stats.server = event["identity"]
                elif event["event"] == "answer":
                    self._at_work_s = None if event["id"] == self._sent else time.monotonic()
                if event["event"] == wanted:
                    return event
                continue
            if self._closed.is_set() or self._given_up.is_set():
                raise PolicyError("the model was closed")
            if self._at_work_s is not None and time.monotonic() - self._at_work_s > self._hang_timeout_s:
                child.kill()
                raise self._died(child, f"it hung, working on one request for more than {self._hang_timeout_s:g} s")
            if time.monotonic() >= deadline_s:
                state = "did not answer" if self.stats.alive else "is still loading"
                raise PolicyError(f"the model's process {child.pid} {state} in time")

    def _check(self, fingerprint: str, weights: str) -> None:
        """Accept a process that is ready, unless its model differs: files may have changed since the start."""
        try:
            if fingerprint != self._fingerprint:
                raise PolicyError(
                    f"the model's process has another policy, {fingerprint!r}, than the host, {self._fingerprint!r}; "
                    "start the run again"
                )
            check_weights(self.stats.weights, weights, "the model's process", accept=self._accept_new_weights)
        except PolicyError:
            self._reap()
            self._start_again_s = time.monotonic() + _LONGEST_PAUSE_S
            raise
        self.stats.weights = weights
        self.stats.alive = True

    def _revived(self, deadline_s: float) -> Child:
        """The process, restarted if it died, once it has loaded the model."""
        child = self._child
        if child is None:
            if (left := self._start_again_s - time.monotonic()) > 0:
                raise PolicyError(f"the model's process died; it restarts in {left:.1f} s")
            self.stats.restarts += 1
            child = self._spawn()
        if not self.stats.alive:
            self._await("ready", child, deadline_s)
        return child

    def _died(self, child: Child, how: str) -> PolicyError:
        """An error with the cause of the process's death; schedules the restart."""
        self._reap()
        pause_s = min(_LONGEST_PAUSE_S, 2.0 ** (self._deaths - 1)) if self._deaths else 0.0
        self._deaths += 1
        self._start_again_s = time.monotonic() + pause_s
        if self.stats.requests and not self._closed.is_set():
            self._log.error("the model's process %d died: %s; it restarts in %g s", child.pid, how, pause_s)
        return PolicyError(f"the model's process {child.pid} died: {how}")

    def _reap(self) -> None:
        """End and forget the process."""
        self.stats.alive = False
        self._at_work_s = None
        if self._child is not None:
            child, self._child = self._child, None
            child.channel.close()  # a healthy process then ends
            child.end_s = 0.0 if self._closed.is_set() else _END_TIMEOUT_S
            child.end()
            self._request = self._answer = memoryview(b"")
