"""Command source of an environment: samples frames at the contract's ticks, and sends the environment's actions."""

from __future__ import annotations

from typing import override

from ibrobot_core.api import Contract, Frame, Vector
from ibrobot_core.app import ControlMode, FrameSampler, RunAccess, SourceWorker


class EnvironmentSource(SourceWorker):
    """Takes the place of a policy: `frame` is the newest observation, `act` commands from its tick on."""

    autonomous = True

    def __init__(self, session: RunAccess, mode: ControlMode) -> None:
        super().__init__(session, mode, "actions of an environment")
        self._contract = Contract.from_config(session.config)
        self._sampler: FrameSampler | None = None
        self.frame: Frame | None = None
        """The frame of the last tick; None before the first complete one of an episode."""

    @override
    def begin_mode(self, seed: int) -> None:
        self.frame = None
        self._next_ns = self.session.bus.snapshot_ns() + self._contract.step_ns
        self._sampler = FrameSampler(self._contract, self.session.bus)

    @override
    def end_mode(self) -> None:
        if self._sampler is not None:
            self._sampler.close()
            self._sampler = None

    @override
    def work(self, timeout_s: float) -> None:
        with self.lock:
            now_ns = self.session.bus.snapshot_ns()
            if self._sampler is None or now_ns < self._next_ns:
                return
            frame = self._sampler.sample(self._next_ns)
            self._next_ns += self._contract.step_ns
            if not frame.missing:
                self.frame = frame

    def act(self, action: Vector) -> None:
        """Command joint positions [rad], shape (A,), from the tick of the last frame on."""
        assert self.frame is not None
        self.session.send_plan(self.frame.stamp_ns, self._contract.step_ns, self._contract.action_joints, action[None])
