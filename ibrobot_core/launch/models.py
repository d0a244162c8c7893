"""Checks of models against the robot, before weights are loaded and torque is switched on."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from contextlib import closing

from ibrobot_core.config import RobotConfig
from ibrobot_core.contract.check import check_policy
from ibrobot_core.contract.specs import Contract
from ibrobot_core.dispatch.dispatcher import check_strategy
from ibrobot_core.errors import ConfigError, ContractError, IbrobotError, Problem
from ibrobot_core.interfaces import PolicySpec, PolicyVectors
from ibrobot_core.interfaces.run import Plugins
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.schema import ModelConfig


def check_model(
    config: RobotConfig, model: ModelConfig, spec: PolicySpec, log: logging.Logger, given: str = ""
) -> PolicyVectors:
    """Compare a policy with the contract, and with the modes that use it.

    Args:
        config: the robot.
        model: the policy's entry under `models`.
        spec: the policy's spec.
        log: receives warnings.
        given: prompt in place of those of the robot YAML.

    Returns:
        The conversion of vectors between the robot and the policy.

    Raises:
        ContractError: for a difference; shows both sides.
        CalibrationError: if the unit needs a calibration that is missing.
    """
    contract = Contract.from_config(config, model.extra_observations)
    units = _vectors(config, model, contract)
    try:
        check_policy(contract, spec, model.norm_mode)
        units.check(spec)
    except ContractError as error:
        raise ContractError(f"model {model.name!r} does not fit the contract of {config.source}\n{error}") from None
    for mode in config.control_modes.values():
        if mode.inference is None or mode.inference.model != model.name:
            continue
        where = f"{config.source}: control_modes.{mode.name}"
        try:
            check_strategy(mode.dispatch, spec)
        except ContractError as error:
            raise ContractError(f"{where}.{error}") from None
        prompt = given or mode.inference.prompt
        if spec.prompt and not prompt:
            example = "e.g. prompt: put the cube into the bin"
            raise ContractError(f"{where}.inference.prompt: is missing; model {model.name!r} needs a prompt, {example}")
        if prompt and not spec.prompt:
            log.warning("%s.inference.prompt: model %r takes no prompt", where, model.name)
    return units


def check_models(config: RobotConfig, registry: Plugins, modes: Iterable[str], given: str = "") -> list[str]:
    """Compare the models of some modes with the robot, without loading any; `given` is as for `check_model`.

    Returns:
        A line for each model.

    Raises:
        ConfigError: with a problem for each model that does not fit or cannot be read.
    """
    used = [mode.inference for name in modes if (mode := config.control_modes[name]).inference is not None]
    loaded_here = {inference.model for inference in used if inference.weights_here}
    lines, problems = [], []
    for name in dict.fromkeys(inference.model for inference in used):
        try:
            with closing(registry.build_policy(config, name)) as policy:
                check_model(config, config.models[name], policy.spec, logging.getLogger("ibrobot"), given)
                if name in loaded_here:
                    policy.check_weights()
                lines.append(_line(name, policy.spec))
        except IbrobotError as error:
            problems.append(Problem(config.source, 0, f"models.{name}", str(error)))
    if problems:
        raise ConfigError(problems)
    return lines


def _line(name: str, spec: PolicySpec) -> str:
    rate = f" at {spec.rate_hz:g} Hz" if spec.rate_hz is not None else ""
    trained = "" if spec.contract is not None else "; what it was trained on is not known"
    return (
        f"model {name} fits the contract: {', '.join(spec.observations) or 'no observations'} -> "
        f"{spec.action_size} numbers in chunks of {spec.chunk_size}{rate}{trained}"
    )


def _vectors(config: RobotConfig, model: ModelConfig, contract: Contract) -> PolicyVectors:
    has_features = any(part.features for part in contract.action_parts)
    if model.norm_mode == "radians" and model.units is None and not has_features:
        return PolicyVectors()
    registry, kind = installed_plugins(), "units"
    made: PolicyVectors = registry.create(kind, model.units or registry.default(kind), config, model, contract)
    return made
