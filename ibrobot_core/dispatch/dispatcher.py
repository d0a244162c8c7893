"""The dispatcher: asks for a chunk when the plan runs low, and joins what comes to the plan by time."""

from __future__ import annotations

import logging
from collections.abc import Callable

import attrs

from ibrobot_core.bus import Bus
from ibrobot_core.config.schema import Dispatch
from ibrobot_core.contract.frames import FrameSampler
from ibrobot_core.contract.specs import Contract
from ibrobot_core.dispatch.smoother import TemporalSmoother
from ibrobot_core.inference.client import Chunk, DispatchInfer, InferenceClient
from ibrobot_core.interfaces import Frame, PolicySpec
from ibrobot_core.robot import Vector
from ibrobot_core.units import ns

_RETRY_NS = 500_000_000
"""Pause after a failed request."""
_SILENCE_NS = 2_000_000_000
"""After which missing observations are told."""

SendPlan = Callable[[int, int, Vector], None]


@attrs.define
class DispatchStats:
    """What happened, for diagnostics."""

    requests: int = 0
    chunks: int = 0
    late_chunks: int = 0
    """Chunks wholly in the past when they came."""
    dropped_answers: int = 0
    """Answers to requests that had timed out or were from before a reset."""
    failures: int = 0
    timeouts: int = 0
    holds: int = 0
    """Times the plan ran dry."""
    plan_length: int = 0
    latency_ms: float = 0.0
    """From the observation to its chunk, of the last one."""
    smoothing: bool = True


class Dispatcher:
    """Pull: one request in flight, sent when no more than the watermark remains of the plan.

    Args:
        contract: the robot's contract, with the model's extra observations.
        spec: what the policy reads; only that is sampled.
        options: watermark and smoothing.
        bus: where observations are.
        client: where the model is.
        send: takes the plan: time of the first action [ns], step [ns], actions (N, A).
        request_timeout_s: after which a request has failed.
        prompt: the task, for policies that want one.
    """

    def __init__(
        self, contract: Contract, spec: PolicySpec, options: Dispatch, bus: Bus, client: InferenceClient,
        send: SendPlan, request_timeout_s: float, prompt: str = "",
    ) -> None:  # fmt: skip
        self._contract = contract
        self._keys = tuple(spec.observations)
        self._bus = bus
        self._client = client
        self._send = send
        self._timeout_ns = ns(request_timeout_s)
        self._watermark = options.watermark
        self._prompt = prompt
        step_ns = round(1e9 / (spec.rate_hz or contract.rate_hz))
        smoothing = options.smoothing
        self._smoother = TemporalSmoother(
            step_ns, len(contract.action_joints), coeff=smoothing.temporal_ensemble_coeff, enabled=smoothing.enabled
        )
        self.stats = DispatchStats(smoothing=smoothing.enabled)
        self._log = logging.getLogger("ibrobot.dispatch")
        self._request_id = 0
        self._sampler: FrameSampler | None = None

    def begin(self, seed: int) -> None:
        """A new episode, or a mode entered: forget plan, request and observations, and start asking."""
        if self._sampler is not None:
            self._sampler.close()
        self._sampler = FrameSampler(self._contract, self._bus, self._keys)
        self._smoother.reset()
        self._client.reset(seed)
        self._in_flight: DispatchInfer | None = None
        self._ask_after_ns = 0
        self._waiting_since_ns: int | None = None
        self._dry = True
        self.stats.plan_length = 0

    def end(self) -> None:
        """Stop asking; answers still to come are dropped."""
        if self._sampler is not None:
            self._sampler.close()
            self._sampler = None
        self._in_flight = None

    def toggle_smoothing(self, enabled: bool) -> None:
        """Switch blending on or off for the chunks to come."""
        self._smoother.toggle(enabled)
        self.stats.smoothing = enabled

    def tick(self, t_ns: int) -> None:
        """One tick of the contract, at its time `t_ns` [ns]."""
        if self._sampler is None:
            return
        self._smoother.trim(t_ns)
        self._sampler.advance(t_ns)
        remaining = self.stats.plan_length = self._smoother.remaining(t_ns)
        if not remaining and not self._dry:
            self.stats.holds += 1
        self._dry = not remaining
        if self._in_flight is not None:
            if t_ns - self._in_flight.frame.stamp_ns > self._timeout_ns:
                self.stats.timeouts += 1
                self._fail(t_ns, f"no chunk within {self._timeout_ns / 1e9:g} s")
        elif remaining <= self._watermark and t_ns >= self._ask_after_ns:
            self._ask(t_ns)

    def accept(self, chunk: Chunk, now_ns: int) -> None:
        """Join an answer to the plan, and send the plan; one that nobody waits for any more is dropped."""
        request = self._in_flight
        if self._sampler is None or request is None or chunk.id != request.id:
            self.stats.dropped_answers += 1
            return
        if chunk.actions is None:
            self._fail(now_ns, chunk.error)
            return
        self._smoother.trim(now_ns)
        try:
            joined = self._smoother.update(chunk.actions, chunk.start_ns)
        except ValueError as error:
            self._fail(now_ns, str(error))
            return
        self._in_flight = None
        self.stats.chunks += 1
        self.stats.latency_ms = (now_ns - chunk.start_ns) / 1e6
        if not joined:
            self.stats.late_chunks += 1
            return
        start_ns, positions = self._smoother.plan()
        self._send(start_ns, self._smoother.step_ns, positions)
        self.stats.plan_length = self._smoother.remaining(now_ns)
        self._dry = False

    def _ask(self, t_ns: int) -> None:
        assert self._sampler is not None
        frame = self._sampler.sample(t_ns)
        if frame.missing:
            self._wait_for(frame)
            return
        self._waiting_since_ns = None
        self._request_id += 1
        self.stats.requests += 1
        self._in_flight = DispatchInfer(self._request_id, attrs.evolve(frame, prompt=self._prompt))
        self._client.submit(self._in_flight)

    def _wait_for(self, frame: Frame) -> None:
        """Nothing is asked, and the arm holds, while an observation is missing."""
        if self._waiting_since_ns is None:
            self._waiting_since_ns = frame.stamp_ns
        elif frame.stamp_ns - self._waiting_since_ns >= _SILENCE_NS:
            topics = {part.topic for key in frame.missing for part in self._contract.parts(key)}
            self._log.warning("holding: nothing new on %s", ", ".join(sorted(topics)))
            self._waiting_since_ns = frame.stamp_ns

    def _fail(self, now_ns: int, why: str) -> None:
        self.stats.failures += 1
        self._in_flight = None
        self._ask_after_ns = now_ns + _RETRY_NS
        self._log.warning("inference failed, the arm holds when its plan ends: %s", why)
