"""A dispatcher on a stepped clock between a bus and a model, both in the test's hands."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from ibrobot_testing import make_robot
from ibrobot_testing.contexts import START_NS

from ibrobot_core.bus import Bus
from ibrobot_core.clock import SteppedClock
from ibrobot_core.contract.specs import Contract
from ibrobot_core.descriptors import Options
from ibrobot_core.dispatch.dispatcher import Dispatcher
from ibrobot_core.inference.client import Chunk, DispatchInfer, InferenceClient
from ibrobot_core.interfaces import PolicySpec
from ibrobot_core.messages import Header, JointState
from ibrobot_core.schema import (
    ActionSpec,
    Align,
    ContractConfig,
    ControlMode,
    DispatchConfig,
    ExecutorConfig,
    ObservationSpec,
    RobotConfig,
    Smoothing,
)

STEP = 100_000_000
"""The contract's tick at 10 Hz [ns]."""
ROBOT = make_robot()
SIZE = len(ROBOT.joints)


class ScriptedClient(InferenceClient):
    """Keeps what it is asked; the test answers."""

    parallel = 1
    returns = 0

    def __init__(self) -> None:
        self.requests: list[DispatchInfer] = []
        self.seeds: list[int] = []

    def submit(self, request: DispatchInfer) -> None:
        self.requests.append(request)

    def poll(self, timeout_s: float = 0.0) -> Chunk | None:
        return None

    def reset(self, seed: int) -> None:
        self.seeds.append(seed)

    def close(self) -> None:
        pass


def make_contract(safety_behavior: str) -> Contract:
    state = ObservationSpec("observation.state", topic="/joint_states", align=Align("asof", tol_ms=150.0))
    action = ActionSpec(executor="all", topic="/commands", safety_behavior=safety_behavior)
    config = RobotConfig(
        robot=ROBOT,
        executors={"all": ExecutorConfig("position", Options(), "all", "all", ROBOT.joint_names)},
        control_modes={"idle": ControlMode(())},
        default_control_mode="idle",
        contract=ContractConfig(rate_hz=10.0, observations=(state,), actions=(action,)),
    )
    return Contract.from_config(config)


class Rig:
    """A dispatcher between a bus and a client, with the plans that it sent."""

    def __init__(
        self, *, watermark: Any = 3, strategy: str | None = None, enabled: bool = False, coeff: float = 0.0,
        timeout_s: float = 1.0, rate_hz: float | None = None, chunk_size: int = 10, prefix: bool = True,
        safety_behavior: str = "hold", client: InferenceClient | None = None,
    ) -> None:  # fmt: skip
        self.clock = SteppedClock(START_NS)
        self.bus = Bus(self.clock)
        self.client: Any = client or ScriptedClient()
        self.plans: list[tuple[int, int, np.ndarray]] = []
        self.sent: list[tuple[int, tuple[int, int, np.ndarray]]] = []
        """Plans with the tick at which each was sent."""
        self.reports: list[tuple[int, str, str]] = []
        """Request, outcome and error of each answer."""
        names = ROBOT.joint_names
        spec = PolicySpec({"observation.state": (SIZE,)}, names, SIZE, chunk_size, rate_hz, prefix=prefix)
        self.dispatcher = Dispatcher(
            make_contract(safety_behavior),
            spec,
            DispatchConfig(watermark, strategy, Smoothing(enabled, coeff)),
            ROBOT,
            self.bus,
            self.client,
            self._take,
            timeout_s,
            "pick the cube",
            report=lambda chunk, now_ns, outcome: self.reports.append((chunk.id, outcome, chunk.error)),
        )
        self.dispatcher.begin(7)

    def _take(self, *plan: Any) -> None:
        self.plans.append(plan)
        self.sent.append(((self.clock.now_ns() - START_NS) // STEP, plan))

    @property
    def stats(self):
        return self.dispatcher.stats

    @property
    def requests(self) -> list[DispatchInfer]:
        assert isinstance(self.client, ScriptedClient)
        return self.client.requests

    def tick(self, count: int = 1, *, observed: bool = True) -> int:
        """Pass `count` ticks; the position observed is the number of the tick since the start."""
        for _ in range(count):
            now_ns = self.clock.advance(STEP)
            if observed:
                position = np.full(SIZE, (now_ns - START_NS) / STEP)
                self.bus.publish("/joint_states", JointState(Header(now_ns), ROBOT.joint_names, position))
            self.dispatcher.tick(now_ns)
        return self.clock.now_ns()

    def answer(
        self, actions, request: DispatchInfer | None = None, *, start_ns: int | None = None, **fields: Any
    ) -> None:
        asked = request or self.requests[-1]
        start = asked.frame.stamp_ns if start_ns is None else start_ns
        self.dispatcher.accept(Chunk(asked.id, start, actions, **fields), self.clock.now_ns())

    def tick_of(self, request: DispatchInfer) -> int:
        """At which tick it was sent."""
        return (request.frame.stamp_ns - START_NS) // STEP


@pytest.fixture(scope="session")
def make_rig() -> type[Rig]:
    """What makes a rig."""
    return Rig
