"""Checks of the features in a robot YAML."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import Contract, ContractError, OptionFault
from ibrobot_kinematics.delta_features import delta_feature
from ibrobot_kinematics.feature_vectors import measured_places, missing_reference
from ibrobot_kinematics.tool_features import tool_feature, tool_model

if TYPE_CHECKING:
    from ibrobot_core.app import RobotConfig


def _is_feature(path: str) -> bool:
    return path.partition(".")[0] in ("tool", "delta")


def _is_relative(path: str) -> bool:
    return path.startswith("delta.") or path.rpartition(".")[2].startswith("delta_")


def faults(config: RobotConfig) -> Iterator[OptionFault]:
    """Yield the faults of paths `tool.PART` and `delta.JOINT` in the contract, and in the models' own observations."""
    lists: list[tuple[tuple[str, ...], tuple[Any, ...]]] = [
        (("contract", "observations"), config.contract.observations)
    ]
    lists += [(("models", name, "extra_observations"), each.extra_observations) for name, each in config.models.items()]
    option_faults = [
        OptionFault((*place, i, "select", n), message)
        for place, specs in lists
        for i, spec in enumerate(specs)
        for n, path in enumerate(spec.select)
        if _is_feature(path) and (message := _fault(config, (path,), ()))
    ]
    for i, action in enumerate(config.contract.actions):
        if any(map(_is_feature, action.select)):
            joints = config.executors[action.executor].joints
            if message := _fault(config, action.select, joints):
                option_faults.append(OptionFault(("contract", "actions", i, "select"), message))
    yield from option_faults
    if not option_faults:
        yield from _references(config)


def _fault(config: RobotConfig, paths: tuple[str, ...], joints: tuple[str, ...]) -> str:
    first = paths[0].partition(".")[0]
    if any(path.partition(".")[0] != first for path in paths):
        return f"an action has features of one kind, got {', '.join(paths)}"
    try:
        if first == "delta":
            delta_feature({}, paths, joints)
        else:
            tool_feature(tool_model(config.robot, paths), paths, joints)
    except ContractError as error:
        return str(error)
    return ""


def _references(config: RobotConfig) -> Iterator[OptionFault]:
    """Check that what actions are relative to is among the observations."""
    relative = [(i, each) for i, each in enumerate(config.contract.actions) if any(map(_is_relative, each.select))]
    if not relative:
        return
    places = measured_places(Contract.from_config(config))
    for i, action in relative:
        wanted = config.executors[action.executor].joints
        if lacking := [joint for joint in wanted if joint not in places]:
            yield OptionFault(("contract", "actions", i, "select"), missing_reference(lacking[0]))
