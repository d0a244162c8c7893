"""Encoding: the action vector -> one joint vector for each executor, and the messages that tell of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import ContractError
from ibrobot_core.messages import Float64MultiArray


def split_action(contract: Contract, action: NDArray[Any]) -> dict[str, NDArray[np.float64]]:
    """Split actions among the executors.

    Args:
        contract: says which joints each executor takes.
        action: one action, shape (A,), or a chunk, shape (N, A); in the order of `contract.action_joints`.

    Returns:
        Executor -> its joints' values, shape (J,) or (N, J), in the order of its joints.

    Raises:
        ContractError: for an action of another length.
    """
    joints = contract.action_joints
    action = np.asarray(action, dtype=np.float64)
    if action.ndim not in (1, 2) or action.shape[-1] != len(joints):
        raise ContractError(f"an action has {len(joints)} values ({', '.join(joints)}), got the shape {action.shape}")
    split, begin = {}, 0
    for part in contract.action_parts:
        split[part.executor] = action[..., begin : begin + len(part.joints)]
        begin += len(part.joints)
    return split


def action_messages(contract: Contract, action: NDArray[Any]) -> dict[str, Float64MultiArray]:
    """One action, shape (A,), as messages: topic -> message.

    Raises:
        ContractError: for an action of another length.
    """
    split = split_action(contract, np.ravel(action))
    return {part.topic: Float64MultiArray(split[part.executor].copy()) for part in contract.action_parts}


def decode_action(contract: Contract, messages: dict[str, Float64MultiArray]) -> NDArray[np.float64]:
    """The action vector of what `action_messages` gives, shape (A,).

    Raises:
        ContractError: for a topic that is missing, or a message of another length.
    """
    values = []
    for part in contract.action_parts:
        if part.topic not in messages:
            raise ContractError(f"the action lacks {part.topic}; there are: {', '.join(messages) or 'none'}")
        value = messages[part.topic].data
        if value.shape != (len(part.joints),):
            raise ContractError(f"{part.topic} has {len(part.joints)} joints, got {value.size} values")
        values.append(value)
    return np.concatenate(values) if values else np.empty(0)
