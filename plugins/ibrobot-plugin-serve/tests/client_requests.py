"""A model for clients of other projects, and damaged requests."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from ibrobot_serve.client_model import ClientModel
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy

STATE = "observation.state"


@pytest.fixture
def model() -> ClientModel:
    policy = FakePolicy(host_context())
    policy.load()
    policy.reset(3)
    return ClientModel(policy, "net", "their protocol")


@pytest.fixture
def broken(model: ClientModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Has the policy raise an error."""

    def infer(tensors: object) -> object:
        raise ZeroDivisionError("not today")

    monkeypatch.setattr(model.policy, "infer", infer)


def damaged(good: bytes) -> Iterator[bytes]:
    """1,000 requests with flipped or cut bytes."""
    random = np.random.default_rng(0)
    for _ in range(1000):
        content = bytearray(good)
        for place in random.integers(0, len(good), random.integers(1, 6)):
            content[place] = random.integers(256)
        yield bytes(content[: random.integers(1, len(good) + 1)])
