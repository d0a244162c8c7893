"""Check that a policy fits the contract, before anything moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import ContractError
from ibrobot_core.interfaces.policy import PolicySpec


def check_policy(contract: Contract, spec: PolicySpec, norm_mode: str = "radians") -> None:
    """Compare a policy's observations and actions to the robot's.

    Args:
        contract: the contract of the robot, with the model's extra observations.
        spec: the spec of the policy.
        norm_mode: unit of the joints in the policy's vectors, from the robot YAML.

    Raises:
        ContractError: for an observation that is missing in the contract or has another shape, and for an action of
            another size, other joints or another order of joints. If the policy states its training contract, also
            for another unit, rate, topic, selection or alignment. Shows both sides of every difference.
    """
    faults = []
    for key, wanted in spec.observations.items():
        if (feature := contract.observations.get(key)) is None:
            has = ", ".join(contract.observations) or "none"
            faults.append(_fault(key, f"{tuple(wanted)}", f"has no such observation; it has: {has}"))
        elif not _fits(wanted, feature.shape):
            faults.append(_fault(key, f"{tuple(wanted)}", f"{feature.shape}"))
    names = contract.action_names
    if spec.actions is not None and tuple(spec.actions) != names:
        faults.append(_fault("action", ", ".join(spec.actions), ", ".join(names)))
    elif spec.action_size != len(names):
        faults.append(_fault("action", f"{spec.action_size} numbers", f"{len(names)}: {', '.join(names)}"))
    if spec.norm_mode not in (None, norm_mode):
        faults.append(_fault("norm_mode", f"trained in {spec.norm_mode}", f"the model's norm_mode is {norm_mode}"))
    if spec.contract is not None and not faults:
        trained = Contract.from_canonical(_restricted(spec.contract, spec))
        present = Contract.from_canonical(_restricted(contract.canonical(), spec))
        faults += [trained.difference(present, names=("policy", "contract"))] if trained != present else []
    if faults:
        raise ContractError("the policy does not fit the contract:\n" + "\n".join(faults))


def _restricted(canonical: Mapping[str, Any], spec: PolicySpec) -> dict[str, Any]:
    """A contract reduced to the observations that the policy reads; a rectified image may be of any lens."""
    any_lens: dict[str, Any] = {"model": {"rectify": {}}}
    seen = {
        key: [part | any_lens if "rectify" in part.get("model", ()) else part for part in parts]
        for key, parts in canonical["observations"].items()
        if key in spec.observations
    }
    return {**canonical, "observations": seen}


def _fits(wanted: Sequence[int], given: Sequence[int]) -> bool:
    """Whether two shapes are equal, except for dimensions that either side leaves open."""
    return len(wanted) == len(given) and all(w == g or -1 in (w, g) for w, g in zip(wanted, given, strict=True))


def _fault(key: str, policy: str, contract: str) -> str:
    return f"  {key}\n      policy: {policy}\n    contract: {contract}"
