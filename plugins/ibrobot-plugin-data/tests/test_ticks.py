"""Frames from recorded messages: in the order of receipt, at any number of ticks."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from ibrobot_data.config_metadata import load_contract
from ibrobot_data.ticks import frames

from ibrobot_core.api import Contract, ContractError, Header, JointState
from ibrobot_core.app import FrameAssembler

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
