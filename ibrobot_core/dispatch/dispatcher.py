"""The dispatcher: requests a chunk when the plan runs low and merges each answer into the plan by time."""

from __future__ import annotations

import logging
from collections.abc import Callable

import attrs
import numpy as np

from ibrobot_core.bus import Bus
from ibrobot_core.contract.frames import FrameSampler
from ibrobot_core.contract.specs import Contract
from ibrobot_core.dispatch.latency import LatencyEstimate
from ibrobot_core.dispatch.smoother import LeadIn, TemporalSmoother
from ibrobot_core.errors import ContractError
from ibrobot_core.inference.client import Chunk, DispatchInfer, InferenceClient
from ibrobot_core.interfaces import Frame, PolicySpec, PolicyVectors
from ibrobot_core.interfaces.run_state import DispatchStats
from ibrobot_core.robot import Robot, Vector
from ibrobot_core.schema import DispatchConfig
from ibrobot_core.units import ns, seconds

_FIRST_PAUSE_NS = 100_000_000
"""Pause after a failed request; doubles with each consecutive failure."""
_LONGEST_PAUSE_NS = 1_000_000_000
"""Longest pause, also between unanswered requests; bounds how long a recovered model stays unused."""
_UNKNOWN = 4
"""Requests per chunk duration before the first answer, while the round-trip time is still unknown."""
_SILENCE_NS = 2_000_000_000
"""Missing observations are reported after this time."""

SendPlan = Callable[[int, int, Vector], None]
Report = Callable[[Chunk, int, str], None]


def check_strategy(options: DispatchConfig, spec: PolicySpec) -> None:
    """Check that the policy supports the configured strategy.

    Raises:
        ContractError: for `strategy: rtc` with a policy that cannot continue a plan.
    """
    if options.joins_by == "rtc" and not spec.prefix:
        raise ContractError(
            "dispatch.strategy: rtc needs a policy that continues the plan it is given (flow matching or diffusion), "
            "and this one does not; use ensemble or replace"
        )


class Dispatcher:
    """Requests a chunk once the remaining plan is no longer than the watermark.

    Normally one request is in flight. When it is overdue, a second one is sent with newer observations, and the first
    answer wins. If the round trip is so long that the plan would run out, several requests are kept in flight. When
    other robots share the model, the dispatcher keeps to the pace set by the server as long as the plan lasts. After
    failures it retries with growing pauses. Without an answer the plan ends and the arm holds; the next chunk then
    starts with a smooth transition from the held position.

    Args:
        contract: the robot's contract, with the model's extra observations.
        spec: the policy's inputs; nothing else is sampled.
        options: watermark, strategy and smoothing.
        robot: for the limits of its joints.
        bus: the source of the observations.
        client: runs the model.
        send: called with the plan: time of the first action [ns], step [ns], actions (N, A).
        report: called with each answer, the time [ns], and what became of it: used, late, dropped or failed.
        request_timeout_s: time after which a request counts as failed.
        prompt: the task, for policies that take one.
        units: conversion of the policy's vectors; None for positions of joints in radians.
        position: returns the joints' measured positions [rad], shape (A,).

    Raises:
        ContractError: as `check_strategy`.
    """

    def __init__(
        self, contract: Contract, spec: PolicySpec, options: DispatchConfig, robot: Robot, bus: Bus,
        client: InferenceClient, send: SendPlan, request_timeout_s: float, prompt: str = "",
        units: PolicyVectors | None = None, report: Report = lambda *_: None,
        position: Callable[[], Vector] | None = None,
    ) -> None:  # fmt: skip
        check_strategy(options, spec)
        self._contract = contract
        self._spec = spec
        self._options = options
        self._bus = bus
        self._client = client
        self._send = send
        self._report = report
        self._timeout_ns = ns(request_timeout_s)
        self._prompt = prompt
        self._units = units or PolicyVectors()
        self._position = position or (lambda: np.zeros(len(contract.action_joints)))
        self.step_ns = step_ns = round(1e9 / (spec.rate_hz or contract.rate_hz))
        """Time from an action of a chunk to the next [ns]."""
        joints = contract.action_joints
        columns = robot.indices(joints)
        lead_in = LeadIn(seconds(step_ns), robot.max_velocity[columns], robot.max_acceleration[columns])
        holds = all(part.safety_behavior == "hold" for part in contract.action_parts)
        blends = options.joins_by == "ensemble"
        self._smoother = TemporalSmoother(
            step_ns, len(joints), coeff=options.smoothing.temporal_ensemble_coeff, enabled=blends,
            lead_in=lead_in if holds else None, continues=options.joins_by == "rtc",
        )  # fmt: skip
        self._latency = LatencyEstimate()
        """Total latency."""
        self._unqueued = LatencyEstimate()
        """Latency without queueing: requesting earlier because of a queue would only lengthen the queue."""
        self._chunk_length = spec.chunk_size
        self.stats = DispatchStats(options.joins_by, blends)
        self._log = logging.getLogger("ibrobot.dispatch")
        self._request_id = 0
        self._sampler: FrameSampler | None = None
        self._seen: dict[int, Frame] = {}
        """The observations of open requests."""
        self._open: dict[int, int] = {}
        """Requests that may still be answered, oldest first: id -> time of the observation [ns]."""
        self._pause_ns = self._overdue_ns = self._pace_ns = self._queued_ns = 0
        self._asked_ns = self._failed_ns = 0
        """Times of the last request and of the last failure [ns]."""
        self._returns = client.returns

    def begin(self, seed: int) -> None:
        """Start an episode or a mode: discard plan, requests and observations, and start requesting."""
        if self._sampler is not None:
            self._sampler.close()
        keys = dict.fromkeys((*self._spec.observations, *self._units.needs))
        self._sampler = FrameSampler(self._contract, self._bus, tuple(keys), self._spec.history)
        self._seed = seed
        self.resume()

    def suspend(self) -> None:
        """Discard plan and requests, and request none until `resume`; observations are still sampled."""
        self._suspended = True
        self._smoother.reset()
        self._open = {}
        self._dry = True
        self.stats.plan_length = 0

    def resume(self, held: Vector | None = None) -> None:
        """Request a new plan, which begins at `held` [rad], shape (A,), if the arm is held there."""
        self.suspend()
        self._smoother.reset(held)
        self._client.reset(self._seed)
        self._settle()
        self._ask_after_ns = 0
        self._waiting_since_ns: int | None = None
        self._suspended = False

    def end(self) -> None:
        """Stop requesting; later answers are dropped."""
        if self._sampler is not None:
            self._sampler.close()
            self._sampler = None

    def toggle_smoothing(self, enabled: bool) -> None:
        """Switch blending on or off for later chunks."""
        self._smoother.enabled = enabled
        self.stats.smoothing = enabled

    def tick(self, t_ns: int) -> None:
        """Run one tick of the contract, at time `t_ns` [ns]."""
        if self._sampler is None:
            return
        self._smoother.trim(t_ns)
        self._sampler.advance(t_ns)
        if self._suspended:
            return
        remaining = self.stats.plan_length = self._smoother.remaining(t_ns)
        if not remaining and not self._dry:
            self.stats.holds += 1
        self._dry = not remaining
        for number in [number for number, asked_ns in self._open.items() if t_ns - asked_ns > self._timeout_ns]:
            self.stats.timeouts += 1
            error = f"no chunk within {self._timeout_ns / 1e9:g} s"
            self._fail(Chunk(number, self._open[number], None, error), t_ns)
        self.stats.watermark = self._watermark()
        if self._client.returns != self._returns:
            self._returns = self._client.returns
            self._settle()
            self._ask_after_ns = t_ns
        if self._too_soon(t_ns, remaining):
            return
        if self._open:
            if self._overlaps(t_ns):
                self._ask(t_ns)
            elif t_ns - max(self._open.values()) > self._overdue_ns > 0:
                self._overdue_ns = max(self._overdue_ns, min(2 * self._overdue_ns, _LONGEST_PAUSE_NS))
                self.stats.retries += self._ask(t_ns)
        elif remaining <= self.stats.watermark and t_ns >= self._ask_after_ns:
            self._ask(t_ns)

    def accept(self, chunk: Chunk, now_ns: int) -> None:
        """Merge an answer into the plan and send the plan; drop the answer if its request is no longer open."""
        asked_ns = self._open.get(chunk.id) if self._sampler is not None else None
        if asked_ns is None:
            self.stats.dropped_answers += 1
            self._report(chunk, now_ns, "dropped")
            return
        if chunk.actions is None:
            if chunk.id == max(self._open):
                self._fail(chunk, now_ns)
            else:  # the newer request may still succeed
                del self._open[chunk.id]
                self._report(chunk, now_ns, "failed")
            return
        self._smoother.trim(now_ns)
        try:
            before = self._smoother.ahead(chunk.start_ns, 1)
            start = self._position() if before is None else before[0]
            actions, unreachable = self._units.commands(chunk.actions, self._seen[chunk.id].values, start)
            joined = self._smoother.update(actions, chunk.start_ns)
        except (ValueError, IndexError) as error:
            self._fail(attrs.evolve(chunk, error=str(error)), now_ns)
            return
        # Chunks for older observations are useless from here on.
        self._open = {number: stamp_ns for number, stamp_ns in self._open.items() if number > chunk.id}
        self._count(chunk, now_ns, now_ns - asked_ns)
        self._settle()
        self.stats.unreachable += unreachable if joined else 0
        self._report(chunk, now_ns, "used" if joined else "late")
        if not joined:
            self.stats.late_chunks += 1
            return
        start_ns, positions = self._smoother.plan()
        self._send(start_ns, self._smoother.step_ns, positions)
        self.stats.plan_length = self._smoother.remaining(now_ns)
        self._dry = False

    def _ask(self, t_ns: int) -> bool:
        """Send a request, unless an observation is missing."""
        assert self._sampler is not None
        frame = self._sampler.sample(t_ns)
        if frame.missing:
            self._wait_for(frame)
            return False
        self._waiting_since_ns = None
        self._asked_ns = t_ns
        self._request_id += 1
        self.stats.requests += 1
        self._seen = {number: self._seen[number] for number in self._open} | {self._request_id: frame}
        self._open[self._request_id] = t_ns
        prefix, delay_steps = self._continued(t_ns)
        frame = attrs.evolve(frame, prompt=self._prompt, prefix=prefix, delay_steps=delay_steps)
        self._client.submit(DispatchInfer(self._request_id, self._units.frame(frame)))
        return True

    def _continued(self, t_ns: int) -> tuple[Vector | None, int]:
        """For real-time chunking: the commands from `t_ns` on, and how many of them precede the next chunk."""
        if self._options.joins_by != "rtc":
            return None, 0
        size = self._spec.chunk_size
        delay = self._steps(self._latency.upper_ns)
        # While the arm holds, at least half of the chunk must be left to move it.
        if (prefix := self._smoother.ahead(t_ns, min(max(delay, 1), (size + 1) // 2))) is None:
            return None, 0
        return prefix[:size], min(delay, len(prefix), size)

    def _watermark(self) -> int:
        """The plan length at which the next chunk is requested."""
        if self._options.watermark != "auto":
            return int(self._options.watermark)
        # A request that was queued delays the next one by as much, which spreads a fleet's requests over time.
        spread = self._chunk_length // 2 - round(self._queued_ns / self._smoother.step_ns)
        # Time for one answer and, in case it is lost, for a second one.
        return max(spread, self._steps(2 * self._unqueued.upper_ns + self._slack_ns))

    def _too_soon(self, t_ns: int, remaining: int) -> bool:
        """Whether to wait because of the server's pace.

        If the plan would not last that long, the robot requests just in time. The exception is a latency above half a
        chunk: the model is then overloaded, and requesting early would make it worse for every robot.
        """
        if self._options.watermark != "auto" or t_ns - self._asked_ns >= self._pace_ns + self._queued_ns:
            return False
        usual_ns = self._latency.quantile_ns(0.5)
        in_time = 2 * usual_ns <= self._chunk_length * self._smoother.step_ns
        return not in_time or remaining > self._steps(usual_ns + self._slack_ns)

    def _overlaps(self, t_ns: int) -> bool:
        """Whether to send a further request while others are in flight.

        An answer that takes most of a chunk's duration leaves too little time for the next one. Requests are then sent
        often enough for the plan to survive the loss of one answer.
        """
        most, chunk_ns, upper_ns = self._client.parallel, self._chunk_length * self._smoother.step_ns, self._usual_ns()
        if most == 1 or self._options.watermark != "auto":
            return False
        expected = [asked_ns for asked_ns in self._open.values() if t_ns - asked_ns <= (self._overdue_ns or t_ns)]
        if not self.stats.chunks:
            most, spacing_ns = min(most, _UNKNOWN), chunk_ns // _UNKNOWN
        else:
            spacing_ns = max((chunk_ns - upper_ns) // 2, upper_ns // most)
        return len(expected) < most and t_ns - max(self._open.values()) >= spacing_ns

    def _steps(self, time_ns: int) -> int:
        """A duration as a number of actions, rounded up."""
        return -(-time_ns // self._smoother.step_ns)

    def _count(self, chunk: Chunk, now_ns: int, latency_ns: int) -> None:
        """Update the statistics with an answer."""
        assert chunk.actions is not None
        self._latency.add(now_ns, latency_ns)
        self._unqueued.add(now_ns, max(0, latency_ns - chunk.queued_ns))
        self._chunk_length = len(chunk.actions)
        self._pace_ns, self._queued_ns = chunk.pace_ns, chunk.queued_ns
        stats = self.stats
        stats.chunks += 1
        stats.latency_ms, stats.queue_ms, stats.pace_ms = latency_ns / 1e6, chunk.queued_ns / 1e6, chunk.pace_ns / 1e6
        stats.latency_p50_ms = self._latency.quantile_ns(0.5) / 1e6
        stats.latency_p99_ms = self._latency.quantile_ns(0.99) / 1e6

    def _settle(self) -> None:
        """After an answer: reset the pause, and expect the next answer in the usual time (0 if unknown)."""
        self._pause_ns = _FIRST_PAUSE_NS
        self._overdue_ns = self._usual_ns() if self.stats.chunks else 0

    def _usual_ns(self) -> int:
        """Time within which an answer is expected [ns]."""
        return self._latency.upper_ns + self._slack_ns

    @property
    def _slack_ns(self) -> int:
        """Margin of the deadline: a tick until the request is sent, and one for rounding [ns]."""
        return 2 * self._contract.step_ns

    def _wait_for(self, frame: Frame) -> None:
        """Note that an observation is missing; no request is sent, and the arm holds once the plan ends."""
        if self._waiting_since_ns is None:
            self._waiting_since_ns = frame.stamp_ns
        elif frame.stamp_ns - self._waiting_since_ns >= _SILENCE_NS:
            topics = {part.topic for key in frame.missing for part in self._contract.parts(key)}
            self._log.warning("holding: nothing new on %s", ", ".join(sorted(topics)))
            self._waiting_since_ns = frame.stamp_ns

    def _fail(self, chunk: Chunk, now_ns: int) -> None:
        asked_ns = self._open.pop(chunk.id)
        self._report(chunk, now_ns, "failed")
        if asked_ns < self._failed_ns:  # sent before this outage was noticed
            return
        self._failed_ns = now_ns
        self.stats.failures += 1
        self._ask_after_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, _LONGEST_PAUSE_NS)
        self._log.warning("inference failed, the arm holds when its plan ends: %s", chunk.error)
