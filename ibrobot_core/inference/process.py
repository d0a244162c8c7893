"""Execution mode `process`: `infer` in a child process, so that a model can neither starve nor crash the host."""

from __future__ import annotations

import contextlib
import json
import logging
import mmap
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from multiprocessing.connection import Pipe
from typing import Any, override

from ibrobot_core.config import RobotConfig
from ibrobot_core.errors import PolicyError
from ibrobot_core.inference.engine import Engine, check_weights
from ibrobot_core.inference.wire import WIRE_LIMITS, WireDecoder, WireEncoder, WireKind, WireMessage
from ibrobot_core.interfaces import Tensors
from ibrobot_core.memory import create_memory
from ibrobot_core.units import NS_PER_S

_START_TIMEOUT_S = 600.0
_END_TIMEOUT_S = 2.0
_LONGEST_PAUSE_S = 30.0
_GLANCE_S = 0.1
"""How often a wait looks whether it was given up."""


class ProcessEngine(Engine):
    """The model in a process of its own, which loads the weights; tensors go through shared memory.

    One that dies is started again: at once the first time, then after pauses that double until it answers. Requests
    meanwhile fail, and the arm holds. One that hangs is killed, and so dies.

    Args:
        config: the robot YAML.
        model: the model's name there.
        fingerprint: of the policy on this side.
        seed: the run's.
        given_up: set when nobody waits for it any more, e.g. while it loads.
        hang_timeout_s: how long it may be at work on one request before it is taken to hang [s].
        accept_new_weights: go on, with a warning, when the process starts again with other weights.
    """

    def __init__(
        self, config: RobotConfig, model: str, fingerprint: str, seed: int = 0,
        given_up: threading.Event | None = None, hang_timeout_s: float = 30.0, *, accept_new_weights: bool = False,
    ) -> None:  # fmt: skip
        super().__init__("process")
        self._order = {
            "document": config.complete, "source": str(config.source), "sim": config.simulated, "model": model,
            "seed": seed, "host": os.getpid(),
        }  # fmt: skip
        self._fingerprint = fingerprint
        self._accept_new_weights = accept_new_weights
        self._log = logging.getLogger("ibrobot.inference")
        self._robot = config.robot.name
        self._lock = threading.Lock()
        self._encoder, self._decoder = WireEncoder(), WireDecoder()
        self._closed = threading.Event()
        self._given_up = given_up or self._closed
        self._process: subprocess.Popen[bytes] | None = None
        self._failure = ""
        self._hang_timeout_s = hang_timeout_s
        self._sent = 0
        """The id of the newest request."""
        self._at_work_s: float | None = None
        """Since when the process is at work on one request [s]; None while it has none."""
        self._deaths = 0
        self._start_again_s = 0.0
        self._episode, self._seed = 0, seed

    @property
    def pid(self) -> int | None:
        """The id of the model's process; None before `start`."""
        return self._process.pid if self._process is not None else None

    @override
    def start(self) -> None:
        with self._lock:
            try:
                self._spawn()
                self._await("ready", time.monotonic() + _START_TIMEOUT_S)
            except PolicyError:
                self._bury()
                raise

    @override
    def run(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        with self._lock:
            deadline_s = deadline_ns / NS_PER_S
            self._revive(deadline_s)
            message = WireMessage(
                WireKind.REQUEST, request_id, tensors, self._robot, episode=self._episode, seed=self._seed,
                deadline_ns=max(0, deadline_ns - time.monotonic_ns()),
            )  # fmt: skip
            frame = self._encoder.encode(message, lambda size: self._request[:size])
            try:
                self._pipe.send_bytes(json.dumps({"id": request_id, "size": len(frame)}).encode())
            except OSError:
                raise self._died() from None
            self._sent = request_id
            self._at_work_s = self._at_work_s or time.monotonic()
            while (event := self._await("answer", deadline_s))["id"] != request_id:
                pass  # of a request that nobody waits for any more
            # The memory belongs to the next answer; this one is kept.
            answer = self._decoder.decode(bytes(self._answer[: event["size"]]))
        self._deaths = 0
        self.stats.model_ms = answer.latency_ms
        if answer.kind is WireKind.FAILURE:
            raise PolicyError(answer.text)
        return answer.tensors

    @override
    def reset(self, seed: int) -> None:
        self._episode += 1
        self._seed = seed

    @override
    def close(self) -> None:
        self._closed.set()
        process = self._process  # a request that goes on may bury it meanwhile
        if process is not None:
            process.kill()
        with self._lock:
            self._bury()

    def _spawn(self) -> None:
        self._bury()
        if self._closed.is_set():
            raise PolicyError("the model was closed")
        self._failure = ""
        self._pipe, theirs = Pipe()
        memories = [create_memory() for _ in range(2)]
        try:
            for memory in memories:
                os.ftruncate(memory, WIRE_LIMITS.size)  # pages are there from their first use on
            self._request, self._answer = (memoryview(mmap.mmap(memory, WIRE_LIMITS.size)) for memory in memories)
            descriptors = (theirs.fileno(), *memories)
            command = [sys.executable, "-m", "ibrobot_core.inference.model_process", *map(str, descriptors)]
            # A session of its own: Ctrl-C in the terminal is for the host, which then ends the model in order.
            self._process = subprocess.Popen(
                command, pass_fds=descriptors, stdin=subprocess.DEVNULL, start_new_session=True
            )
        finally:
            theirs.close()
            for memory in memories:
                os.close(memory)
        with contextlib.suppress(OSError):  # where it died at once, reading shows it
            self._pipe.send_bytes(json.dumps(self._order).encode())

    def _await(self, wanted: str, deadline_s: float) -> Mapping[str, Any]:
        """The next event of this name."""
        while True:
            try:
                if self._pipe.poll(min(_GLANCE_S, max(0.0, deadline_s - time.monotonic()))):
                    event = json.loads(self._pipe.recv_bytes())
                    if event["event"] == "log":
                        logging.getLogger(event["logger"]).log(event["level"], "%s", event["message"])
                    elif event["event"] == "failed":
                        self._failure = event["error"]
                    elif event["event"] == "ready":
                        self._check(event["fingerprint"], event["weights"])
                    elif event["event"] == "answer":
                        self._at_work_s = None if event["id"] == self._sent else time.monotonic()
                    if event["event"] == wanted:
                        return dict(event)
                    continue
            except (EOFError, OSError):
                raise self._died() from None
            if self._closed.is_set() or self._given_up.is_set():
                raise PolicyError("the model was closed")
            if self._at_work_s is not None and time.monotonic() - self._at_work_s > self._hang_timeout_s:
                raise self._hung()
            if time.monotonic() >= deadline_s:
                state = "did not answer" if self.stats.alive else "is still loading"
                raise PolicyError(f"the model's process {self.pid} {state} in time")

    def _check(self, fingerprint: str, weights: str) -> None:
        """Take a process that is ready, unless its model is another: the files may have changed since the start."""
        try:
            if fingerprint != self._fingerprint:
                raise PolicyError(
                    f"the model's process has another policy, {fingerprint!r}, than the host, {self._fingerprint!r}; "
                    "start the run again"
                )
            check_weights(self.stats.weights, weights, "the model's process", accept=self._accept_new_weights)
        except PolicyError:
            self._bury()
            self._start_again_s = time.monotonic() + _LONGEST_PAUSE_S
            raise
        self.stats.weights = weights
        self.stats.alive = True

    def _revive(self, deadline_s: float) -> None:
        """See to it that there is a process, and that it has loaded."""
        if self._process is None:
            if (left := self._start_again_s - time.monotonic()) > 0:
                raise PolicyError(f"the model's process died; it starts again in {left:.1f} s")
            self.stats.restarts += 1
            self._spawn()
        if not self.stats.alive:
            self._await("ready", deadline_s)

    def _hung(self) -> PolicyError:
        assert self._process is not None
        self._failure = f"it hung, at work on one request for more than {self._hang_timeout_s:g} s"
        self._process.kill()
        return self._died()

    def _died(self) -> PolicyError:
        """What is known of the death of the process, which is set to start again."""
        assert self._process is not None
        pid, failure = self._process.pid, self._failure
        status = self._bury()
        how = failure or (f"killed by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}")
        pause_s = min(_LONGEST_PAUSE_S, 2.0 ** (self._deaths - 1)) if self._deaths else 0.0
        self._deaths += 1
        self._start_again_s = time.monotonic() + pause_s
        if self.stats.requests and not self._closed.is_set():
            self._log.error("the model's process %d died: %s; it starts again in %g s", pid, how, pause_s)
        return PolicyError(f"the model's process {pid} died: {how}")

    def _bury(self) -> int:
        """End and forget the process; returns its exit status."""
        self.stats.alive = False
        self._at_work_s = None
        if self._process is None:
            return 0
        process, self._process = self._process, None
        self._pipe.close()  # for one that is well, the end
        try:
            process.wait(0.0 if self._closed.is_set() else _END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
        status = process.wait()
        self._request = self._answer = memoryview(b"")
        return status
