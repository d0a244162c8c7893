"""What the sections with a `type` say beside their plugin's options, and the sections of the file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import attrs

from ibrobot_core.config.schema import (
    ContractConfig,
    Control,
    Dispatch,
    Inference,
    MetricsConfig,
    ObservationSpec,
    Share,
)
from ibrobot_core.options import option
from ibrobot_core.robot import Robot
from ibrobot_core.units import NORM_MODES


@attrs.frozen
class ComponentKeys:
    """A section with a type and no keys of core's own."""

    type: str = option(help="which plugin; `ibrobot plugins` lists them")


@attrs.frozen
class HardwareKeys:
    """Keys of a hardware component."""

    type: str = option(help="which plugin; `ibrobot plugins` lists them")
    joints: tuple[str, ...] = option(
        (), help="the joints that it owns; the only component may leave them out and owns all"
    )


@attrs.frozen
class SimulationKeys:
    """Keys of the simulation."""

    type: str = option(help="which plugin; `ibrobot plugins` lists them")
    default_control_mode: str | None = option(None, help="with --sim, in place of the file's default_control_mode")


@attrs.frozen
class PeripheralKeys:
    """Keys of a sensor."""

    name: str = option(help="what the contract calls it")
    kind: str = option(help="camera, imu, …")
    type: str = option(help="which plugin; `ibrobot plugins` lists them")
    sim: Mapping[str, Any] = option(factory=dict, help="further options for the simulated sensor that stands for it")


@attrs.frozen
class ExecutorKeys:
    """Keys of an executor."""

    type: str = option(help="which plugin; `ibrobot plugins` lists them")
    group: str = option(help="the joint group that it owns")


@attrs.frozen
class ModelKeys:
    """Keys of a policy."""

    type: str = option(help="which plugin; `ibrobot plugins` lists them")
    norm_mode: str = option("radians", choices=NORM_MODES, help="unit of the joints in its vectors")
    calibration: str | None = option(None, help="in place of the hardware's, for norm_mode: a name, or a path to one")
    extra_observations: tuple[ObservationSpec, ...] = option((), help="what it sees beyond the contract")


@attrs.frozen
class ModeKeys:
    """Keys of a control mode."""

    executors: tuple[str, ...] = option(help="the executors that are active in it")
    teleop: str | None = option(None, help="the device under teleoperation that drives it")
    inference: Inference | None = option(None, help="the model that drives it")
    dispatch: Dispatch | None = option(None, help="how a model's plan is kept filled")
    planner: Mapping[str, Any] | None = option(None, help="the planner that drives it, with its options")


@attrs.frozen
class RecordingKeys:
    """Keys of the recorder."""

    type: str = option(help="which plugin; `ibrobot plugins` lists them")
    root: str = option("episodes", help="where episodes go; relative to the working directory")
    dataset: str = option("default", help="folder of one task's episodes, below root")
    topics: str | tuple[str, ...] = option("contract", help="contract, all, or a list of topics")


@attrs.frozen
class TransportKeys:
    """Keys of the transport."""

    type: str = option(help="which plugin; `ibrobot plugins` lists them")
    share: Share = option(factory=Share, help="topics shared with other machines")


@attrs.frozen
class Sections:
    """The sections of a robot YAML. Those with a `type` are structured further, by their plugin."""

    robot: Robot = option(help="joints, groups, models and poses")
    executors: Mapping[str, Mapping[str, Any]] = option(help="who moves the joints: name -> type, group, options")
    control_modes: Mapping[str, ModeKeys] = option(help="name -> the executors active in it, and what feeds them")
    default_control_mode: str = option(help="the mode to start in")
    hardware: Mapping[str, Any] = option(factory=dict, help="one component, or several by name, each with its joints")
    simulation: Mapping[str, Any] = option(None, help="stands for the hardware with --sim, or where there is none")
    peripherals: tuple[Mapping[str, Any], ...] = option((), help="cameras and other sensors")
    models: Mapping[str, Mapping[str, Any]] = option(factory=dict, help="policies by name")
    teleoperation: Mapping[str, Mapping[str, Any]] = option(factory=dict, help="devices by name")
    contract: ContractConfig = option(factory=ContractConfig, help="how topics become observations and actions")
    recording: Mapping[str, Any] = option(None, help="how episodes are recorded")
    transport: Mapping[str, Any] = option(None, help="how processes and machines talk")
    viewer: Mapping[str, Any] = option(None, help="what shows the robot to a person")
    control: Control = option(factory=Control, help="the control loop")
    metrics: MetricsConfig | None = option(None, help="counts in Prometheus' text format, over HTTP on this machine")
