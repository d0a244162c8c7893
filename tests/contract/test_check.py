"""Policies that fit a contract, and those that do not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs
import pytest

from ibrobot_core.contract.check import check_policy
from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import ContractError
from ibrobot_core.interfaces.policy import PolicySpec
from ibrobot_core.testing.contexts import ARM, GRIPPER

FITS = PolicySpec(
    observations={"observation.state": (6,), "observation.images.top": (2, 3, 3)},
    actions=ARM + GRIPPER,
    action_size=6,
    chunk_size=100,
)


@pytest.fixture(scope="module")
def contract(make_config: Callable[..., Any]) -> Contract:
    return Contract.from_config(make_config())


@pytest.mark.parametrize(
    "spec",
    [
        FITS,
        attrs.evolve(FITS, observations={"observation.state": (6,)}),
        attrs.evolve(FITS, observations={"observation.images.top": (-1, -1, 3)}),
        attrs.evolve(FITS, actions=None),
    ],
)
def test_fits(contract: Contract, spec: PolicySpec) -> None:
    check_policy(contract, spec)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"observations": {"observation.images.front": (2, 3, 3)}},
            "  observation.images.front\n      policy: (2, 3, 3)\n    contract: has no such observation; it has: "
            "observation.state, observation.images.top",
        ),
        (
            {"observations": {"observation.state": (7,), "observation.images.top": (3, 2, 3)}},
            "  observation.state\n      policy: (7,)\n    contract: (6,)\n"
            "  observation.images.top\n      policy: (3, 2, 3)\n    contract: (2, 3, 3)",
        ),
        (
            {"observations": {"observation.images.top": (2, 3)}},
            "  observation.images.top\n      policy: (2, 3)\n    contract: (2, 3, 3)",
        ),
        (
            {"actions": GRIPPER + ARM},
            "  action\n      policy: gripper, shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll\n"
            "    contract: shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll, gripper",
        ),
        (
            {"actions": None, "action_size": 7},
            "  action\n      policy: 7 numbers\n"
            "    contract: 6: shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll, gripper",
        ),
        (
            {"action_size": 7},
            "  action\n      policy: 7 numbers\n"
            "    contract: 6: shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll, gripper",
        ),
    ],
)
def test_every_difference_is_told_with_both_sides(contract: Contract, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ContractError) as caught:
        check_policy(contract, attrs.evolve(FITS, **changes))
    assert str(caught.value) == f"the policy does not fit the contract:\n{message}"
