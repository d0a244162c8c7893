"""The action vector, split among the executors and back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ibrobot_core.contract.encode import action_messages, decode_action, split_action
from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import ContractError
from ibrobot_core.messages import Float64MultiArray


@pytest.fixture(scope="module")
def contract(make_config: Callable[..., Any]) -> Contract:
    return Contract.from_config(make_config())


def test_a_chunk_is_split_in_file_order(contract: Contract) -> None:
    chunk = np.arange(18.0).reshape(3, 6)
    split = split_action(contract, chunk)
    assert list(split) == ["arm_position", "gripper_position"]
    np.testing.assert_array_equal(split["arm_position"], chunk[:, :5])
    np.testing.assert_array_equal(split["gripper_position"], chunk[:, 5:])


@settings(deadline=None)
@given(values=st.lists(st.floats(-4, 4), min_size=6, max_size=6))
def test_messages_and_back(contract: Contract, values: list[float]) -> None:
    messages = action_messages(contract, np.array(values))
    assert list(messages) == ["/arm/commands", "/gripper/commands"]
    assert messages["/gripper/commands"].data.shape == (1,)
    np.testing.assert_array_equal(decode_action(contract, messages), values)


def test_other_lengths_are_refused(contract: Contract) -> None:
    with pytest.raises(ContractError, match=r"an action has 6 values \(shoulder_pan, .*, got the shape \(5,\)"):
        split_action(contract, np.zeros(5))
    with pytest.raises(ContractError, match="an action has 6 values"):
        action_messages(contract, np.zeros((2, 6)))
    arm = {"/arm/commands": Float64MultiArray(np.zeros(5))}
    with pytest.raises(ContractError, match="the action lacks /gripper/commands; there are: /arm/commands"):
        decode_action(contract, arm)
    with pytest.raises(ContractError, match="/gripper/commands has 1 joints, got 2 values"):
        decode_action(contract, {**arm, "/gripper/commands": Float64MultiArray(np.zeros(2))})
