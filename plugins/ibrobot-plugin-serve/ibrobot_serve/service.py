"""The server side of inference: one model, loaded once, answers many robots over a transport."""

from __future__ import annotations

import copy
import json
import logging
import queue
import threading
import time
import traceback
import uuid
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import attrs
import numpy as np
from ibrobot_terminal.plural import counted

from ibrobot_core.api import NS_PER_S, IbrobotError, Payload, PictureCodec, Policy, PolicyError, Tensors, Transport
from ibrobot_core.app import WireError
from ibrobot_serve.fair_queue import FairQueue
from ibrobot_serve.pacing import Pacing
from ibrobot_serve.results import Results
from ibrobot_serve.wire import (
    WIRE_LIMITS,
    WireDecoder,
    WireEncoder,
    WireKind,
    WireLimits,
    WireMessage,
    health_name,
    offer_name,
    server_name,
    service_name,
    whole_fingerprint,
)

_ROBOTS_KEPT = 256
"""Number of most recent robots whose counts are kept."""
_LATENCIES_KEPT = 1000
_LEASE_NS = 5 * NS_PER_S
"""Time for which a stateful model stays reserved for a silent robot while another asks [s]."""
_LONGEST_WAIT_S = 600.0
_GLANCE_S = 1.0
"""Maximum sleep of the watchdog."""


@attrs.frozen
class ServiceOptions:
    """How requests are queued and batched."""

    batch: int = 8
    """Maximum number of requests for one `infer_batch`."""
    queue: int = 64
    """Maximum number of waiting requests, one per robot."""
    patience_s: float = 0.0
    """How long an incomplete batch waits for more requests [s]; 0: it takes only requests already waiting."""
    hang_timeout_s: float = 30.0
    """A model that works on one batch for longer counts as hanging [s]."""
    canary: float = 0.0
    """Fraction of all robots that may use this server although its weights differ; 0: an ordinary server."""
    limits: WireLimits = WIRE_LIMITS


@attrs.define
class RobotCounts:
    """Requests of one robot, and the latencies of its answers."""

    requests: int = 0
    answered: int = 0
    failed: int = 0
    """Answered with an error; includes `expired` ones."""
    expired: int = 0
    """Not begun, because the deadline had passed."""
    latencies_ms: deque[float] = attrs.field(factory=lambda: deque(maxlen=_LATENCIES_KEPT))

    def summary(self) -> dict[str, Any]:
        """The counts and latencies, as JSON values."""
        p50, p99 = np.percentile(self.latencies_ms or [0.0], [50, 99])
        counts = {name: getattr(self, name) for name in ("requests", "answered", "failed", "expired")}
        return {**counts, "latency_p50_ms": round(float(p50), 2), "latency_p99_ms": round(float(p99), 2)}


@attrs.frozen(eq=False)
class _Outcome:
    """Result of a request: outputs, or an error."""

    outputs: Tensors | None
    error: str = ""
    expired: bool = False
    refused: bool = False
    """Whether another server may take the request."""
    model: bool = False
    """Whether the model failed, on a request that passes the policy's check."""
    queued_ns: int = 0


@attrs.frozen(eq=False)
class _Ticket:
    """A waiting request. Its first outcome counts."""

    message: WireMessage
    arrived_ns: int
    deadline_ns: int
    outcomes: queue.SimpleQueue[_Outcome] = attrs.field(factory=queue.SimpleQueue)

    def answer(self, outputs: Tensors, begun_ns: int) -> None:
        self.outcomes.put(_Outcome(outputs, queued_ns=begun_ns - self.arrived_ns))

    def fail(self, error: str, *, expired: bool = False, model: bool = False) -> None:
        self.outcomes.put(_Outcome(None, error, expired, model=model))

    def refuse(self, why: str) -> None:
        self.outcomes.put(_Outcome(None, why, refused=True))

    def like(self, other: _Ticket) -> bool:
        """Whether both can be in one batch."""
        theirs = other.message.tensors
        return self.message.tensors.keys() == theirs.keys() and all(
            array.dtype == theirs[name].dtype and array.shape == theirs[name].shape
            for name, array in self.message.tensors.items()
        )


class InferenceService:
    """Serves `infer` of a loaded policy under `service_name(model)`, and its statistics under `health_name(model)`.

    Several servers may have one model. Robots choose among their offers, and ask each by its own name.

    Args:
        policy: the loaded policy; the caller closes it, after the service.
        transport: the connection to the robots; the caller closes it, after the service.
        model: name of the model for robots.
        options: how requests are queued.
        codec: decodes images sent as JPEG.
        on_hang: called once when the model hangs. Nothing can stop its thread: replace the process.
    """

    def __init__(
        self, policy: Policy, transport: Transport, model: str, options: ServiceOptions | None = None,
        codec: PictureCodec | None = None, on_hang: Callable[[], object] = lambda: None,
    ) -> None:  # fmt: skip
        self._policy = policy
        self._transport = transport
        self._model = model
        self.id = uuid.uuid4().hex[:12]
        """Identifies this server among those of the model; new after each start."""
        self._options = options or ServiceOptions()
        self._decoder, self._encoder = WireDecoder(self._options.limits, codec), WireEncoder(self._options.limits)
        self._weights = policy.weights()
        self._fingerprint = whole_fingerprint(policy.fingerprint(), self._weights)
        self._queue: FairQueue[_Ticket] = FairQueue(self._options.queue)
        self._pacing = Pacing()
        self._results = Results()
        self._lock = threading.Lock()
        self._all = RobotCounts()
        self._robots: OrderedDict[str, RobotCounts] = OrderedDict()
        self._batches: Counter[int] = Counter()
        self._malformed = 0
        self._pending = 0
        self._idle = threading.Condition(self._lock)
        self._draining = False
        self._work: tuple[int, list[_Ticket]] | None = None
        """The start time [ns] and the tickets of the present batch."""
        self._on_hang = on_hang
        self._closed = threading.Event()
        self._owner: tuple[str, int] | None = None
        self._owner_heard_ns = 0
        self._begun_ns = time.monotonic_ns()
        self._log = logging.getLogger("ibrobot.inference")
        self._ends: list[Callable[[], None]] = []
        self._withdraw: Callable[[], None] = lambda: None
        """Ends the offer to robots."""
        self._thread = threading.Thread(target=self._infer_all, name=f"model {model}", daemon=True)
        self._watchdog = threading.Thread(target=self._watch, name=f"watchdog of {model}", daemon=True)

    def start(self) -> None:
        """Start answering requests.

        Raises:
            TransportError: if another server has this name.
        """
        options = self._options
        # Each waiting request occupies a worker; one more answers that the queue is full.
        workers = options.queue + options.batch + 1
        self._ends.append(self._transport.serve(health_name(self._model), self._health, workers=1))
        for name in (service_name(self._model), server_name(self._model, self.id)):
            self._ends.append(self._transport.serve(name, self._answer, workers=workers))
        self._withdraw = self._transport.serve(offer_name(self._model, self.id), self._offer, workers=1)
        self._thread.start()
        self._watchdog.start()

    def drain(self, timeout_s: float) -> bool:
        """Redirect robots to other servers, and wait until all pending requests are answered.

        Args:
            timeout_s: maximum waiting time [s].

        Returns:
            Whether all were answered in time.
        """
        self._withdraw()
        with self._idle:
            self._draining = True
            return self._idle.wait_for(lambda: self._pending == 0, timeout_s)

    def close(self) -> None:
        """Stop, and answer waiting requests with an error. Safe to call twice."""
        self._draining = True
        self._closed.set()
        self._queue.end()
        ends, self._ends = [self._withdraw, *self._ends], []
        for end in ends:
            end()
        for thread in (self._thread, self._watchdog):
            if thread.is_alive() and thread is not threading.current_thread():
                thread.join(1.0)

    @property
    def state(self) -> str:
        """The state in `…/health`: `ready`, `draining`, `hangs`, or `fails`."""
        work = self._work
        if work is not None and time.monotonic_ns() - work[0] > self._options.hang_timeout_s * NS_PER_S:
            return "hangs"
        if self._draining:
            return "draining"
        return "fails" if self.failing else "ready"

    @property
    def failing(self) -> str:
        """The newest error of a model that fails all its requests; empty for one that works."""
        return self._results.failing(time.monotonic_ns())

    def statistics(self) -> dict[str, Any]:
        """The answer of `…/health`."""
        pace_ms = self._pacing.pace_ns(time.monotonic_ns()) / 1e6
        with self._lock:
            robots = {name: counts.summary() for name, counts in self._robots.items()}
            batches = {str(size): count for size, count in sorted(self._batches.items())}
            return {
                "model": self._model, "server": self.id, "canary": self._options.canary, "state": self.state,
                "error": self.failing, "fingerprint": self._fingerprint, "weights": self._weights,
                "spec": attrs.asdict(self._policy.spec),
                "uptime_s": round((time.monotonic_ns() - self._begun_ns) / NS_PER_S, 1), "waiting": len(self._queue),
                "malformed": self._malformed, "pace_ms": round(pace_ms, 1), **self._all.summary(),
                "batches": batches, "robots": robots,
            }  # fmt: skip

    def _health(self, payload: Payload, sender: str | None) -> Payload:
        return json.dumps(self.statistics()).encode()

    def _offer(self, payload: Payload, sender: str | None) -> Payload:
        """Information for robots that choose among servers."""
        now_ns = time.monotonic_ns()
        owned = self._owner is not None and now_ns - self._owner_heard_ns < _LEASE_NS
        robots = int(owned) if self._policy.spec.stateful else self._pacing.robots(now_ns)
        offer = {
            "fingerprint": self._fingerprint, "weights": self._weights, "spec": attrs.asdict(self._policy.spec),
            "robots": robots, "canary": self._options.canary, "uptime_s": (now_ns - self._begun_ns) / NS_PER_S,
            "failing": self._results.offered_failing(now_ns), "latency_ms": self._results.latency_ns(now_ns) / 1e6,
            "identity": f"ibrobot-plugin-serve {version('ibrobot-plugin-serve')}, {self._policy.identity()[:1024]}",
        }  # fmt: skip
        return json.dumps(offer).encode()

    def _answer(self, payload: Payload, sender: str | None) -> Payload:
        """Called by the transport, once for every request, in several threads."""
        arrived_ns = time.monotonic_ns()
        try:
            message = self._decoder.decode(payload)
            if message.kind is not WireKind.REQUEST:
                raise WireError(f"a frame of kind {message.kind.name}; robots send requests")
        except WireError as error:
            with self._lock:
                self._malformed += 1
            return self._encoder.encode(WireMessage(WireKind.FAILURE, 0, text=str(error)))
        if sender is not None:  # regardless of the name in the request
            message = attrs.evolve(message, robot=sender)
        with self._idle:
            refused = self._refusal(message)
            self._pending += 1
        try:
            outcome = _Outcome(None, refused, refused=True) if refused else self._wait_for(message, arrived_ns)
            return self._reply(message, outcome, arrived_ns)
        finally:
            with self._idle:
                self._pending -= 1
                self._idle.notify_all()

    def _refusal(self, message: WireMessage) -> str:
        state = self.state
        if state == "hangs":
            return self._hang()
        if state == "draining":
            return "the server is stopping"
        if message.fingerprint != self._fingerprint:
            return (
                f"another policy, or other weights: the robot's is {message.fingerprint!r}, the server's "
                f"{self._fingerprint!r}; start the run again to see where they differ"
            )
        return ""

    def _wait_for(self, message: WireMessage, arrived_ns: int) -> _Outcome:
        try:
            Policy.check_finite("the request", message.tensors)
        except PolicyError as error:
            return _Outcome(None, str(error))
        patience_ns = min(message.deadline_ns, round(_LONGEST_WAIT_S * NS_PER_S))
        ticket = _Ticket(message, arrived_ns, arrived_ns + patience_ns)
        self._pacing.ask(message.robot, arrived_ns)
        replaced = self._queue.put(message.robot, ticket)
        if replaced is ticket:
            ticket.refuse(f"the server is full: {counted(self._options.queue, 'request')} waiting")
        elif replaced is not None:
            replaced.fail(f"dropped: replaced by the newer request {message.id} of this robot")
        try:
            return ticket.outcomes.get(timeout=max(0.0, (ticket.deadline_ns - time.monotonic_ns()) / NS_PER_S))
        except queue.Empty:
            return _Outcome(None, "no outputs within the deadline", expired=True)

    def _reply(self, message: WireMessage, outcome: _Outcome, arrived_ns: int) -> Payload:
        now_ns = time.monotonic_ns()
        latency_ms = (now_ns - arrived_ns) / 1e6

        def encoded(kind: WireKind, outputs: Tensors, text: str = "") -> Payload:
            answer = WireMessage(
                kind, message.id, outputs, message.robot, self._fingerprint, text, message.stamp_ns,
                latency_ms=latency_ms, queued_ns=outcome.queued_ns, pace_ns=self._pacing.pace_ns(now_ns),
            )  # fmt: skip
            return self._encoder.encode(answer)

        error, reply, broken = outcome.error, None, outcome.model
        if outcome.outputs is not None:
            try:
                Policy.check_finite("infer", outcome.outputs)
                reply = encoded(WireKind.ANSWER, outcome.outputs)
            except (PolicyError, WireError) as invalid:
                error, broken = f"the policy's outputs: {invalid}", True
        if reply is not None:
            self._results.answer(message.robot, now_ns)
        elif broken:
            self._results.fail(message.robot, now_ns, error)
        if reply is not None or outcome.expired:
            self._results.took(now_ns - arrived_ns, now_ns)
        with self._lock:
            for counts in (self._all, self._counts(message.robot)):
                counts.requests += 1
                counts.answered += reply is not None
                counts.failed += reply is None
                counts.expired += outcome.expired
                counts.latencies_ms.append(latency_ms)
        if reply is not None:
            return reply
        return encoded(WireKind.REFUSAL if outcome.refused else WireKind.FAILURE, {}, error)

    def _counts(self, robot: str) -> RobotCounts:
        counts = self._robots.setdefault(robot, RobotCounts())
        self._robots.move_to_end(robot)
        if len(self._robots) > _ROBOTS_KEPT:
            self._robots.popitem(last=False)
        return counts

    def _infer_all(self) -> None:
        """The model's one thread."""
        most = 1 if self._policy.spec.stateful else self._options.batch
        while batch := self._queue.take(most, _Ticket.like, self._options.patience_s):
            now_ns = time.monotonic_ns()
            live = [ticket for ticket in batch if ticket.deadline_ns > now_ns]
            for ticket in batch:
                if ticket not in live:
                    ticket.fail("expired while it waited for its turn", expired=True)
            if live:
                self._work = (now_ns, live)
                self._run(live, now_ns)
                self._work = None

    def _run(self, live: list[_Ticket], now_ns: int) -> None:
        if not self._policy.spec.stateful:
            self._infer(live)
        elif self._enter(live[0], now_ns) and self._infer(live):
            self._owner = (live[0].message.robot, live[0].message.episode)
            self._owner_heard_ns = now_ns

    def _watch(self) -> None:
        """Fail all waiting requests once the model hangs."""
        while not self._closed.wait(min(_GLANCE_S, self._options.hang_timeout_s / 4)):
            work = self._work
            if work is None or self.state != "hangs":
                continue
            self._log.error("%s", self._hang())
            self._withdraw()
            for ticket in (*work[1], *self._queue.clear()):
                ticket.refuse(self._hang())
            self._on_hang()
            return

    def _hang(self) -> str:
        return f"the model hangs: it has worked on one batch for more than {self._options.hang_timeout_s:g} s"

    def _infer(self, live: list[_Ticket]) -> bool:
        """Answer the tickets; returns whether the whole batch succeeded."""
        begun_ns = time.monotonic_ns()
        with self._lock:
            self._batches[len(live)] += 1
        try:
            # Other threads encode the answers, while the model may overwrite its outputs in the next batch.
            requests = [ticket.message.tensors for ticket in live]
            outputs = [copy.deepcopy(dict(each)) for each in self._policy.infer_batch(requests)]
            if len(outputs) != len(live):
                raise PolicyError(f"{counted(len(outputs), 'output')} for a batch of {len(live)}")
        except Exception as error:  # noqa: BLE001 - contained: the request is refused
            if len(live) == 1:
                live[0].fail(self._error_text(error), model=self._checked(live[0].message.tensors))
            else:  # one faulty request must not fail the others
                for ticket in live:
                    self._infer([ticket])
            return False
        self._pacing.work(len(live), time.monotonic_ns() - begun_ns)
        for ticket, output in zip(live, outputs, strict=True):
            ticket.answer(output, begun_ns)
        return True

    def _enter(self, ticket: _Ticket, now_ns: int) -> bool:
        """Whether a stateful model may answer this robot; resets the model for a new episode.

        The robot becomes the owner with the first answer, so that an invalid request neither blocks other robots nor
        ends the episode of the present owner.
        """
        message = ticket.message
        if self._owner is not None and self._owner[0] != message.robot and now_ns - self._owner_heard_ns < _LEASE_NS:
            ticket.refuse(f"this policy is stateful, so it serves one robot at a time, at present {self._owner[0]!r}")
            return False
        try:
            self._policy.check(message.tensors)
        except Exception as error:  # noqa: BLE001 - contained: the robot gets the error
            ticket.fail(self._error_text(error))
            return False
        if self._owner != (message.robot, message.episode):
            self._owner = None
            try:
                self._policy.reset(message.seed)
            except Exception as error:  # noqa: BLE001 - contained: the robot gets the error
                ticket.fail(f"the policy's reset failed: {self._error_text(error)}", model=True)
                return False
        return True

    def _checked(self, tensors: Tensors) -> bool:
        """Whether a request has the tensors that the policy needs: then a failure is the model's."""
        try:
            self._policy.check(tensors)
        except Exception:  # noqa: BLE001 - any error means that it has not
            return False
        return True

    def _error_text(self, error: Exception) -> str:
        if isinstance(error, IbrobotError):
            return str(error)
        self._log.error("%s", "".join(traceback.format_exception(error)))
        return f"{type(error).__name__}: {error}"
