"""Servers of one model and robots on one network."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_serve import pacing
from ibrobot_serve.remote import RemoteEngine
from ibrobot_serve.service import InferenceService, ServiceOptions
from ibrobot_serve.wire import offer_name, server_name
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy, FakeTransport

from ibrobot_core.api import Handler, Tensors

PATIENCE_S = 30.0
Fault = Callable[[Tensors], Tensors]


class Network(FakeTransport):
    """Lets several servers have one name, as networks do."""

    @override
    def serve(self, name: str, handler: Handler, *, workers: int = 16) -> Callable[[], None]:
        if name in self._servers:
            return lambda: None
        return super().serve(name, handler, workers=workers)


class Doubles(FakePolicy):
    """Doubles `x`, and says which server it is on; `gate` keeps it at work."""

    def __init__(self, number: int = 0, weights: str = "", *, stateful: bool = False) -> None:
        super().__init__(host_context())
        self.spec = attrs.evolve(self.spec, stateful=stateful)
        self._number, self._weights = number, weights
        self.gate, self.entered = threading.Event(), threading.Semaphore(0)
        self.gate.set()
        self.resets = 0
        self.fault: Fault = lambda tensors: {}
        """Called for each request; may raise, or return outputs in place of the right ones."""

    @override
    def weights(self) -> str:
        return self._weights

    @override
    def reset(self, seed: int) -> None:
        self.resets += 1

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        self.entered.release()
        assert self.gate.wait(PATIENCE_S)
        if wrong := self.fault(tensors):
            return wrong
        return {"twice": tensors["x"] * 2, "server": np.array([self._number]), "resets": np.array([self.resets])}


class Fleet:
    """Servers and robots on one network."""

    def __init__(self) -> None:
        self.network = Network()
        self.servers: list[InferenceService] = []
        self.policies: list[Doubles] = []
        self.pool = ThreadPoolExecutor(4)

    def server(
        self, weights: str = "", *, canary: float = 0.0, stateful: bool = False, fault: Fault | None = None
    ) -> InferenceService:
        policy = Doubles(len(self.servers), weights, stateful=stateful)
        policy.fault = fault or policy.fault
        service = InferenceService(policy, self.network, "net", ServiceOptions(canary=canary))
        service.id = f"server{len(self.servers)}"  # no random names: robots choose by them
        service.start()
        self.servers.append(service)
        self.policies.append(policy)
        return service

    def robot(self, name: str = "robot", *, stateful: bool = False, **options: Any) -> Robot:
        return Robot(self, name, stateful, options)

    def robots(self, count: int) -> list[Robot]:
        return [self.robot(f"robot{i}") for i in range(count)]

    def kill(self, number: int) -> None:
        service = self.servers[number]
        self.network.kill(offer_name("net", service.id), server_name("net", service.id))

    def close(self) -> None:
        for policy in self.policies:
            policy.gate.set()
        for service in self.servers:
            service.close()
        self.pool.shutdown()
        self.network.close()


class Robot:
    """A robot that knows what its answers must be."""

    _x = 0

    def __init__(self, fleet: Fleet, name: str, stateful: bool, options: dict[str, Any]) -> None:
        self.engine = RemoteEngine(
            Doubles(stateful=stateful), fleet.network, "net", name, start_timeout_s=PATIENCE_S, **options
        )
        # Names without chance, so that each robot draws the same in every run.
        self.engine._robot = self.engine._choice.robot = name

    def ask(self) -> int:
        """The number of the server that answered."""
        return self.asked()[0]

    def asked(self) -> tuple[int, int]:
        """The number of the server that answered, and how often its model was reset."""
        self._x += 1
        deadline_ns = time.monotonic_ns() + round(PATIENCE_S * 1e9)
        outputs = self.engine.infer({"x": np.array([self._x])}, self._x, deadline_ns)
        assert outputs["twice"].tolist() == [2 * self._x], "the answer to another request"
        return int(outputs["server"][0]), int(outputs["resets"][0])


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> Iterator[Fleet]:
    monkeypatch.setattr(pacing, "_WINDOW_NS", 3_600_000_000_000)  # a slow machine forgets no robot
    made = Fleet()
    yield made
    made.close()
