"""Descriptors: what a plugin says about each thing it offers, without importing anything heavy."""

from __future__ import annotations

import builtins
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import attrs

from ibrobot_core.options import NoOptions, OptionFault

if TYPE_CHECKING:
    import click

    from ibrobot_core import interfaces
    from ibrobot_core.component import Component
    from ibrobot_core.config.schema import RobotConfig
    from ibrobot_core.launch.session import Session
    from ibrobot_core.launch.transport import TransportLink
    from ibrobot_core.messages import CompressedImage, Image
    from ibrobot_core.robot import Robot


@attrs.frozen
class Descriptor[T]:
    """One implementation of one kind.

    `make(options, ctx)` imports what it needs when it is called, and opens no device: that is for the object's own
    `connect`, `open` or `load`.
    """

    type: str
    """What the YAML gives as `type`."""
    make: Callable[[Any, interfaces.Context], T]
    summary: str
    options: builtins.type[Any] = NoOptions
    """A frozen attrs class made with `ibrobot_core.options.option`."""
    check: Callable[[], None] = attrs.field(default=lambda: None, kw_only=True)
    """Whether this machine has what the type needs beyond the plugin's own packages; imports nothing heavy.

    Raises:
        MissingDependency: e.g. for a system library. A run goes on without a sensor that nothing in it needs.
    """
    check_options: Callable[[Any, Robot, tuple[str, ...]], Iterable[OptionFault]] = attrs.field(
        default=lambda options, robot, joints: (), kw_only=True
    )
    """What is wrong with the options for a robot, e.g. a joint that it does not have; the third argument has the joints
    that the component owns, or all where its kind owns none. Opens no device, and imports nothing heavy."""
    devices: Callable[[Any], Mapping[str, str]] = attrs.field(default=lambda options: {}, kw_only=True)
    """Option -> the device that it names and that one component at a time can open, always written in the same way."""
    default: bool = attrs.field(default=False, kw_only=True)
    """Whether commands take this type where none of its kind is named; one type of a kind at most."""


@attrs.frozen
class HardwareDescriptor(Descriptor["interfaces.Hardware"]):
    """Hardware; `simulated` ones are `SimulatedHardware` and may stand in the `simulation:` section."""

    simulated: bool = False
    sensors: Mapping[str, str] = attrs.field(factory=dict)
    """For simulated hardware, sensor kind, e.g. `camera` -> the sensor type that stands for it."""
    torque_off: str = ""
    """For joints that hold on when no process commands them any more: the command that takes their torque off."""
    calibration: Callable[[Any], str | None] = attrs.field(default=lambda options: None, kw_only=True)
    """Name or path of the calibration that the options name, as `load_calibration` takes it; recordings keep it. None
    where it works without one."""
    anchored: Callable[[Any], tuple[str, ...]] = attrs.field(default=lambda options: (), kw_only=True)
    """The joints whose calibrated closed end is their lower limit, as a gripper's may be. In LeRobot's units these are
    0 to 100."""


@attrs.frozen
class SensorDescriptor(Descriptor["interfaces.Sensor"]):
    """A sensor of a kind, e.g. `camera` or `imu`."""

    kind: str = "camera"
    picture: Callable[[Any], tuple[int, int] | None] = attrs.field(default=lambda options: None, kw_only=True)
    """Height and width of the pictures [px], as far as the options say them."""


@attrs.frozen
class TeleopDescriptor(Descriptor["interfaces.Teleop"]):
    """A teleoperation device."""


@attrs.frozen
class PolicyDescriptor(Descriptor["interfaces.Policy"]):
    """A policy."""


@attrs.frozen
class EngineDescriptor(Descriptor["interfaces.Engine"]):
    """A place where the model of a policy runs, and `Context.model` is that model.

    In the YAML `inference.execution_mode` names the type, and its options stand beside it.
    """

    uses_transport: bool = False
    """Whether it reaches the model over the transport of the YAML, which must then lead to other machines."""
    weights_here: bool = True
    """Whether this machine has the model's weights, so that `ibrobot config check --deep` looks at them."""


@attrs.frozen
class ExecutorDescriptor(Descriptor["interfaces.Executor"]):
    """An executor; `streams` says that it follows setpoints (from policies and teleop) rather than goals.

    The options of one that streams derive from `ibrobot_core.executor_options.StreamOptions`.
    """

    streams: bool = False
    goals: Literal["trajectory", "position"] = "trajectory"
    """What a planner sends to one that does not stream: a timed path, as `trajectory_goal` gives it, or
    `{"position": q}`, where the first of its joints goes [rad]."""


@attrs.frozen
class PlannerDescriptor(Descriptor["interfaces.Planner"]):
    """A motion planner."""


@attrs.frozen
class TransportDescriptor(Descriptor["interfaces.Transport"]):
    """A transport."""

    listen: Callable[[Sequence[str]], Mapping[str, Any]] | None = None
    """Endpoints -> the options with which a server listens there and connects to nobody; at an endpoint of this machine
    alone where none is given. None where servers cannot use this transport."""
    used: Callable[[Any], bool] = attrs.field(default=lambda options: False, kw_only=True)
    """Whether a run with these options uses the transport even if no mode needs it."""
    components: Callable[[Any, Session, TransportLink], Sequence[Component]] = attrs.field(
        default=lambda options, session, link: (), kw_only=True
    )
    """Options, run and its transport -> what the options add to a run that uses the transport, e.g. components that
    send topics to other machines. Each needs `link.name`; from its start on, `link.transport` is open."""


@attrs.frozen
class RecorderDescriptor(Descriptor["interfaces.Recorder"]):
    """An episode recorder."""


@attrs.frozen
class Flag:
    """A flag of the command line that sets an option of a type."""

    name: str
    """E.g. `--codec`."""
    option: str
    help: str
    value: str | None = None
    """What the flag sets the option to; None where the value follows the flag."""


@attrs.frozen
class DatasetDescriptor(Descriptor["interfaces.DatasetWriter"]):
    """A dataset writer."""

    flags: tuple[Flag, ...] = ()
    """Short ways, in the command that converts, to set options of this type."""


@attrs.frozen
class ViewerDescriptor(Descriptor["interfaces.Viewer"]):
    """A viewer."""


@attrs.frozen
class SectionDescriptor(Descriptor["Component"]):
    """A section that a plugin adds to the robot YAML, e.g. `counter: {topic: /count}`, and what serves it in a run.

    `type` is the section's key at the top level of the file, one that core does not have. `options` are its keys.
    """

    make: Callable[[Any, Session], Component] = attrs.field(kw_only=True)  # type: ignore[assignment]
    """Options and run -> the component that starts and stops with the run. The options are None where the component
    runs without its section. Imports what it needs when it is called, and opens nothing."""
    without_section: Callable[[RobotConfig], bool] = attrs.field(default=lambda config: False, kw_only=True)
    """Whether the component also runs with a robot whose file lacks the section."""
    check_config: Callable[[RobotConfig], Iterable[OptionFault]] = attrs.field(default=lambda config: (), kw_only=True)
    """What is wrong with a robot that it runs with, in any section; opens no device. The `option` of a fault begins at
    the top of the file: `("peripherals", 0, "transform")`."""


@attrs.frozen
class ReaderDescriptor:
    """A format of recorded episodes that can be read; the first installed one that knows a path reads it."""

    type: str
    summary: str
    reads: Callable[[Path], bool]
    """Whether what lies at a path is of this format; looks at names and first bytes only."""
    make: Callable[[interfaces.EpisodeAddress], interfaces.EpisodeReader]
    """Opens an episode.

    Raises:
        RecorderError: when it cannot be read.
    """
    numbered: bool = False
    """Whether many episodes lie at a path, which go by their numbers, from 0."""


@attrs.frozen
class DecoderDescriptor:
    """A decoder of compressed pictures, registered by plugins that send them; the first that knows a format counts."""

    formats: tuple[str, ...]
    """E.g. `jpeg`; for messages to the user."""
    make: Callable[[], Callable[[CompressedImage], Image | None]]
    """Imports the decoder, which gives the pixels, or None for a format that it does not know.

    Equal bytes give equal pixels, in a run and in a conversion. The decoder raises:
        ContractError: for a damaged picture.
    """


@attrs.frozen
class ConfigFile:
    """A robot YAML that a plugin ships; `ibrobot launch NAME` finds it."""

    name: str
    path: Path
    summary: str = ""


@attrs.frozen
class Command:
    """A command that a plugin adds: `ibrobot NAME …`; `load` imports it when it is called."""

    name: str
    summary: str
    load: Callable[[], click.Command]


@attrs.frozen
class Check:
    """One line of `ibrobot doctor`."""

    name: str
    ok: bool
    found: str
    remedy: str = ""
    """What to do about it, where `ok` is False."""
    matters: bool = True
    """Whether `ibrobot doctor` fails where `ok` is False; otherwise it is a note."""
