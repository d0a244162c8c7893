"""Units of the models of a robot YAML, and whether its calibrations are there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ibrobot_calibration.calibration import load_calibration
from ibrobot_calibration.joint_units import JointUnits, calibrated_units, calibrations, with_closed_ends
from ibrobot_core.api import CalibrationError, Contract, Options
from ibrobot_core.app import ModelConfig, Problem, RobotConfig


def model_units(config: RobotConfig, model: ModelConfig, contract: Contract) -> JointUnits:
    """The conversion between the vectors of a robot and those of a model, by its calibration or that of the hardware.

    Raises:
        CalibrationError: if the unit needs a calibration that is missing.
    """
    name = model.calibration
    each = {} if model.norm_mode == "radians" else calibrations(config) if name is None else {
        "model": with_closed_ends(load_calibration(name).numbers(), config)
    }  # fmt: skip
    joined = {joint: numbers for joints in each.values() for joint, numbers in joints.items()}
    return calibrated_units(model.norm_mode, contract, joined, config.document)


def uncalibrated(config: RobotConfig) -> Iterator[Problem]:
    """What is wrong with the calibrations that a run needs at its start; this machine may not be the robot's."""
    mode = config.control_modes[config.default_control_mode]
    used = {*mode.devices.values(), *(mode.inference.devices.values() if mode.inference is not None else ())}
    for name, arm in config.hardware.items():
        path = "hardware" if name == "hardware" else f"hardware.{name}"
        yield from _faults(config, path, arm.options, arm.joints)
    for name in (each for each in config.teleoperation if each in used):
        device = config.teleoperation[name]
        yield from _faults(config, f"teleoperation.{name}", device.options, None)


def _faults(config: RobotConfig, path: str, options: Options, joints: Sequence[str] | None) -> Iterator[Problem]:
    if options.calibration is None:
        return
    limits = {joint.name: (joint.lower, joint.upper) for joint in config.robot.joints}
    try:
        device = next(iter(options.devices().values()), "")
        calibration = load_calibration(options.calibration, joints, tool=options.calibrated_by, device=device)
        calibration.check_ranges(limits, config.closed_ends)
    except CalibrationError as error:
        yield Problem(config.source, 0, path, str(error))
