"""A robot of a fleet without an arm: a dispatcher on its ticks, whose model is on a server over Zenoh."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from ibrobot_serve.remote import RemoteEngine
from ibrobot_testing import host_context, make_robot

from ibrobot_core.bus import Bus
from ibrobot_core.clock import RealClock
from ibrobot_core.contract.specs import Contract
from ibrobot_core.descriptors import Options
from ibrobot_core.dispatch.dispatcher import Dispatcher
from ibrobot_core.inference.client import Chunk, EngineClient
from ibrobot_core.interfaces import Policy, Transport
from ibrobot_core.messages import Header, JointState
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.robot import Vector
from ibrobot_core.schema import (
    ActionSpec,
    ContractConfig,
    ControlMode,
    DispatchConfig,
    ExecutorConfig,
    ObservationSpec,
    RobotConfig,
)

RATE_HZ = 30.0


def transport(**options: Any) -> Transport:
    """One of type zenoh."""
    descriptor = installed_plugins().find("transport", "zenoh")
    made: Transport = descriptor.make(descriptor.options(**options), host_context())
    return made


class Robot:
    """A dispatcher on its ticks, in a thread."""

    def __init__(
        self,
        number: int,
        network: Transport,
        watermark: Any,
        policy: Policy,
        send: Callable[[int, int, Vector], None],
    ) -> None:
        robot = self.robot = make_robot()
        joints = robot.joint_names
        config = RobotConfig(
            robot=robot,
            executors={"all": ExecutorConfig("position", Options(), "all", "all", joints)},
            control_modes={"idle": ControlMode(())},
            default_control_mode="idle",
            contract=ContractConfig(
                RATE_HZ,
                observations=(ObservationSpec("observation.state", topic="/joint_states"),),
                actions=(ActionSpec("all", "/commands"),),
            ),
        )
        self._clock, self._joints = RealClock(), joints
        self._bus = Bus(self._clock)
        self.policy = policy
        self.engine = RemoteEngine(policy, network, "model", f"robot{number}", start_timeout_s=60.0)
        self._client = EngineClient(policy, self.engine, 5.0)
        contract = Contract.from_config(config)
        self._step_ns = contract.step_ns
        self.dispatcher = Dispatcher(
            contract, policy.spec, DispatchConfig(watermark), robot, self._bus, self._client, send, 5.0
        )
        self.chunks: list[tuple[float, float]] = []
        """When each came [s], and its latency [ms]."""
        self.holds: list[float] = []
        """When the plan ran dry [s]."""

    def start(self) -> None:
        """Wait for the server."""
        self.engine.start()

    def after_tick(self, now_ns: int) -> None:
        """What else to do in each tick."""

    def after_chunk(self, chunk: Chunk) -> None:
        """What else to do with each answer or error."""

    def run(self, until_s: float) -> None:
        """Go on until a time, which may be changed meanwhile."""
        self.until_s = until_s
        self.dispatcher.begin(0)
        next_ns, stats = self._clock.now_ns(), self.dispatcher.stats
        while time.monotonic() < self.until_s:
            chunk = self._client.poll(max(0.0, (next_ns - self._clock.now_ns()) / 1e9))
            if chunk is not None:
                self.after_chunk(chunk)
                before = stats.chunks
                self.dispatcher.accept(chunk, self._clock.now_ns())
                if stats.chunks > before:
                    self.chunks.append((time.monotonic(), stats.latency_ms))
            if (now_ns := self._clock.now_ns()) >= next_ns:
                holds = stats.holds
                self._bus.publish(
                    "/joint_states", JointState(Header(now_ns), self._joints, np.zeros(len(self._joints)))
                )
                self.dispatcher.tick(now_ns)
                self.holds += [time.monotonic()] * (stats.holds - holds)
                self.after_tick(now_ns)
                next_ns += self._step_ns
        self._client.close()
        self.engine.close()
