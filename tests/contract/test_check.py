"""Policies that fit a contract, and those that do not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs
import pytest
from ibrobot_testing.contexts import ARM, GRIPPER

from ibrobot_core.contract.check import check_policy
from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import ContractError
from ibrobot_core.interfaces.policy import PolicySpec

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
def test_every_difference_is_reported_with_both_sides(
    contract: Contract, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ContractError) as caught:
        check_policy(contract, attrs.evolve(FITS, **changes))
    assert str(caught.value) == f"the policy does not fit the contract:\n{message}"


def test_what_it_was_trained_on_is_compared(contract: Contract, make_config: Callable[..., Any]) -> None:
    trained = attrs.evolve(FITS, contract=contract.canonical(), norm_mode="degrees")
    check_policy(contract, trained, "degrees")
    with pytest.raises(ContractError, match=r"policy: trained in degrees\n    contract: the model's norm_mode is rad"):
        check_policy(contract, trained)
    faster = Contract.from_config(make_config(rate_hz=50.0))
    with pytest.raises(ContractError, match=r"rate_hz\n    policy: 30.0\n  contract: 50.0"):
        check_policy(faster, trained, "degrees")


def test_observations_that_it_does_not_read_are_not_compared(contract: Contract) -> None:
    canonical = contract.canonical()
    other = {**canonical, "observations": {**canonical["observations"]}}
    other["observations"]["observation.images.top"] = [{**canonical["observations"]["observation.images.top"][0]}]
    other["observations"]["observation.images.top"][0]["topic"] = "/camera/chest/image_raw"
    check_policy(contract, attrs.evolve(FITS, observations={"observation.state": (6,)}, contract=other))
    with pytest.raises(ContractError, match="/camera/chest/image_raw"):
        check_policy(contract, attrs.evolve(FITS, contract=other))
