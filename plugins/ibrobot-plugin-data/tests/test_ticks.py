"""Frames from recorded messages: in the order of receipt, at any number of ticks."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ibrobot_data.config_metadata import load_contract
from ibrobot_data.ticks import Ticks, frames

from ibrobot_core.api import (
    Contract,
    ContractError,
    Feature,
    Header,
    JointState,
    ObservationPart,
    Recorded,
    TopicSummary,
)
from ibrobot_core.app import Align, FrameAssembler

CONTRACT = """\
contract:
  observations:
    - {key: observation.state, topic: /joint_states, select: [position.pan]}
"""


@pytest.fixture
def contract(tmp_path: Path) -> Contract:
    (tmp_path / "contract.yaml").write_text(CONTRACT)
    return Contract.from_config(load_contract(tmp_path / "contract.yaml"))


def message(received_ns: int) -> tuple[str, JointState, int]:
    return "/joint_states", JointState(Header(0), ("pan",), np.zeros(1)), received_ns


def test_messages_must_be_in_the_order_of_receipt(contract: Contract) -> None:
    with pytest.raises(ContractError, match="in the order of receipt; /joint_states at 4 ns came after 5 ns"):
        list(frames(FrameAssembler(contract), [message(5), message(4)], [10]))


def test_ticks_may_be_endless(contract: Contract) -> None:
    endless = frames(FrameAssembler(contract), [message(0)], itertools.count(0, contract.step_ns))
    assert [len(frame.values) for frame in itertools.islice(endless, 3)] == [1, 1, 1]


def test_observations_that_go_missing_together_are_counted_in_one_order() -> None:
    """In that of sets, equal episodes would give different bytes."""
    names = [f"o{i}" for i in range(8)]
    kind, feature = JointState.ros_type, Feature("float32", (1,), ("pan.pos",))
    parts = [
        ObservationPart(name, f"/{name}", kind, ("position.pan",), None, Align("asof", tol_ms=10.0), feature)
        for name in names
    ]
    times = [ms * 1_000_000 for ms in (*range(0, 300, 5), *range(600, 900, 5))]
    messages = [
        Recorded(f"/{name}", JointState(Header(t), ("pan",), np.zeros(1)), t, t) for t in times for name in names
    ]
    summary = SimpleNamespace(
        topics={f"/{name}": TopicSummary(kind, len(times)) for name in names}, start_ns=0, end_ns=times[-1]
    )
    reader: Any = SimpleNamespace(summary=lambda: summary, messages=lambda topics=None: iter(messages))
    ticks = Ticks(reader, Contract(30.0, tuple(parts), ()), "skip")
    assert sum(1 for _ in ticks) > 10
    assert list(ticks.gaps.items()) == [(name, 1) for name in names]
