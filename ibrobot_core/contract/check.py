"""Whether a policy fits the contract, asked before anything moves."""

from __future__ import annotations

from collections.abc import Sequence

from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import ContractError
from ibrobot_core.interfaces.policy import PolicySpec


def check_policy(contract: Contract, spec: PolicySpec) -> None:
    """Compare what a policy reads and gives with what the robot has.

    Raises:
        ContractError: for an observation that the contract lacks or has in another shape, and for an action of another
            size or other joints, e.g. the same ones in another order; every difference with both sides.
    """
    faults = []
    for key, wanted in spec.observations.items():
        feature = contract.observations.get(key)
        if feature is None:
            has = ", ".join(contract.observations) or "none"
            faults.append(_fault(key, f"{tuple(wanted)}", f"has no such observation; it has: {has}"))
        elif not _fits(wanted, feature.shape):
            faults.append(_fault(key, f"{tuple(wanted)}", f"{feature.shape}"))
    joints = contract.action_joints
    if spec.actions is not None and tuple(spec.actions) != joints:
        faults.append(_fault("action", ", ".join(spec.actions), ", ".join(joints)))
    elif spec.action_size != len(joints):
        faults.append(_fault("action", f"{spec.action_size} numbers", f"{len(joints)}: {', '.join(joints)}"))
    if faults:
        raise ContractError("the policy does not fit the contract:\n" + "\n".join(faults))


def _fits(wanted: Sequence[int], given: Sequence[int]) -> bool:
    """Equal but for dimensions that either side leaves open."""
    return len(wanted) == len(given) and all(w == g or -1 in (w, g) for w, g in zip(wanted, given, strict=True))


def _fault(key: str, policy: str, contract: str) -> str:
    return f"  {key}\n      policy: {policy}\n    contract: {contract}"
