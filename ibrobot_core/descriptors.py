"""Descriptors of what a plugin offers; they import nothing heavy."""

from __future__ import annotations

import builtins
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal

import attrs

from ibrobot_core.errors import PluginError
from ibrobot_core.options import OptionFault, OptionName, documented, mistakes, option

if TYPE_CHECKING:
    from ibrobot_core import interfaces
    from ibrobot_core.component import Component, SourceWorker, TransportLink
    from ibrobot_core.component_config import ComponentConfig
    from ibrobot_core.errors import Problem
    from ibrobot_core.events import Event
    from ibrobot_core.interfaces.run import RunAccess, RunView
    from ibrobot_core.messages import CompressedImage, Image, Message
    from ibrobot_core.robot import Robot
    from ibrobot_core.schema import ModelConfig, RobotConfig
    from ibrobot_core.selection import JointFeature


@attrs.frozen
class Late:
    """A function or class of a module that is imported when it is first needed, not with the descriptor.

    HardwareDescriptor("my_arm", make=Late("my_package.arm:MyArm"), summary="...")
    """

    place: str
    """`MODULE:NAME`."""

    def load(self) -> Any:
        """Import it, and return it."""
        return resolve_name(self.place)

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Import it, and call it."""
        return self.load()(*arguments, **options)


def _answer(default: object) -> Any:
    """A field for a function that is asked, e.g. about options; by default it answers this."""
    return attrs.field(default=lambda *asked: default, kw_only=True)


@attrs.frozen
class Options:
    """Options of an implementation: a frozen attrs class that derives from this one, with a field for each key.

    Its methods and properties say what core must know before it makes an object; by default, nothing. They open no
    device, and import nothing heavy.
    """

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Yields faults of the options for a robot, e.g. an unknown joint.

        Args:
            robot: the robot, or the part of it that a device moves.
            joints: the joints that the component owns, or all joints if its kind owns none.
        """
        return ()

    def devices(self) -> Mapping[str, str]:
        """Maps options to devices that only one component can open at a time, in a canonical form."""
        return {}

    def peripherals(self) -> Iterable[OptionName]:
        """The peripherals of the robot YAML that options name."""
        return ()

    def publishes(self) -> Iterable[OptionName]:
        """The topics that options name and the component publishes, which nothing else may publish."""
        return ()

    def offers(self, service: str) -> bool:
        """Whether other programs can call a service of the run, by its name, through the component."""
        return False

    @property
    def calibration(self) -> str | None:
        """Of hardware and teleop: name or path of the calibration; recordings contain that of hardware."""
        return None

    @property
    def calibrated_by(self) -> str | None:
        """Of hardware and teleop: the command that has `calibrate` and `import` for its calibrations, for messages."""
        return None

    @property
    def anchored(self) -> tuple[str, ...]:
        """Of hardware: the joints whose calibrated closed end is at their lower limit, such as a gripper.

        In LeRobot's units they range from 0 to 100.
        """
        return ()

    def scene_objects(self, robot: Robot) -> Sequence[interfaces.SceneObject]:
        """Of simulated hardware: the objects around the robot, for planners."""
        return ()

    @property
    def picture(self) -> tuple[int, int] | None:
        """Of sensors: height and width of the images [px], if the options define them."""
        return None

    @property
    def lens(self) -> Mapping[str, Any] | None:
        """Of cameras: the intrinsics, as fields of `CameraInfo` without the header in plain values; None if unknown.

        Raises:
            SensorError: if the options could have them and do not; says what to set.
        """
        return None

    def find_device(self) -> None:
        """Of sensors: looks for the device that the options name, without opening it.

        Raises:
            MissingDependency: if it is not there. A run continues without a sensor that it does not need.
        """

    def events(self) -> Collection[interfaces.OperatorEvent]:
        """Of teleop: the events for which the device has a button, e.g. `start` to begin an episode."""
        return ()

    def terminal_keys(self, robot: Robot) -> Mapping[str, str]:
        """Maps the keys that the component reads from the terminal to what they do, e.g. `space` to `deadman`.

        A device with keys needs a terminal. Devices of one mode share a key only if it does the same for all of them.

        Args:
            robot: what a device moves, or the whole robot.
        """
        return {}

    @property
    def used(self) -> bool:
        """Of transports: whether a run uses the transport even if no mode needs it."""
        return False

    def components(self, run: RunAccess, link: TransportLink) -> Sequence[Component]:
        """Of transports: components that the options add to a run, e.g. to send topics to other machines.

        Each needs `link.name`; when it starts, `link.transport` is open.
        """
        return ()


@attrs.frozen
class Descriptor[T]:
    """An implementation of one kind.

    `make(options, ctx)` imports what it needs when it is called, and opens no device; the object's `connect`, `open` or
    `load` does.
    """

    type: str
    """The value of `type` in the YAML."""
    make: Callable[[Any, interfaces.Context], T]
    summary: str
    label: str = attrs.field(default="", kw_only=True)
    """What it does, in the words of an operator who chooses it, e.g. `follow the leader arm`; empty: its summary."""
    options: builtins.type[Any] = Options
    """The class of its options, which derives from `Options`."""
    check: Callable[[], None] = _answer(None)
    """Checks dependencies other than Python packages; imports nothing heavy.

    Raises:
        MissingDependency: e.g. if a system library is missing. A run continues without a sensor that it does not need.
    """
    unsaid: Callable[[Mapping[str, Any]], Mapping[str, Any] | None] = _answer(None)
    """Of a guard: the section `control.guard` for the plain values of a robot YAML without one; None for no guard."""
    default: bool = attrs.field(default=False, kw_only=True)
    """Whether commands use this type by default; at most one type of each kind."""

    def mistakes(self) -> Iterator[str]:
        """What is wrong with it, in words for its author."""
        if not re.fullmatch(r"[A-Za-z0-9][\w.-]*", self.type):
            yield f"type {self.type!r} is not a name: use letters, digits and _, e.g. my_arm"
        if not callable(self.make):
            yield f"make is {self.make!r}: give a class, or a function that makes the object"
        if lacking := sorted(getattr(self.make, "__abstractmethods__", ())):
            yield f"make is an abstract class: it lacks {', '.join(lacking)}"
        yield from (f"options: {mistake}" for mistake in mistakes(self.options, Options))

    def fits(self, section: builtins.type[ComponentConfig]) -> bool:
        """Whether it may be used in a section of its kind."""
        return True

    def kept(self) -> Mapping[str, Any]:
        """Fields of its section that are no keys, by name; a section without such a field leaves it out."""
        return {}


@attrs.frozen
class HardwareDescriptor(Descriptor["interfaces.Hardware"]):
    """Hardware. If `simulated`, it is a `SimulatedHardware` and can be used in the `simulation:` section."""

    simulated: bool = False
    sensors: Mapping[str, str] = attrs.field(factory=dict)
    """For simulated hardware: sensor kind, e.g. `camera` -> sensor type that replaces it."""
    torque_off: str = ""
    """For joints that hold even without a process that commands them: the command that switches their torque off."""
    film: Mapping[str, Any] = attrs.field(factory=dict, kw_only=True)
    """For simulated hardware: the keys of a peripheral of kind `camera` that films the robot and all of its scene."""

    def fits(self, section: builtins.type[ComponentConfig]) -> bool:
        """Whether the section is for simulated hardware, as it is or is not."""
        return self.simulated == section.simulates


@attrs.frozen
class SensorDescriptor(Descriptor["interfaces.Sensor"]):
    """A sensor of a kind, e.g. `camera` or `imu`."""

    kind: str = "camera"
    topic: str = ""
    """Topic of its messages, with `{name}` for the peripheral's; empty for a camera, and if only its options say it."""
    message: str = ""
    """ROS type of its messages, with `topic`."""

    def kept(self) -> Mapping[str, Any]:
        """Its topic."""
        return {"topic": self.topic, "message": self.message} if self.topic else {}


@attrs.frozen
class MessageDescriptor:
    """A message type that a plugin defines, so that contracts, codecs, bags and networks know it."""

    type: str
    """Its ROS name, `PACKAGE/msg/NAME`."""
    message: Late
    """Its class: a frozen attrs class derived from `Message`."""

    def mistakes(self) -> Iterator[str]:
        """What is wrong with it, in words for its author."""
        if not re.fullmatch(r"[a-z]\w*/msg/[A-Z]\w*", self.type):
            yield f"type {self.type!r} is no name of a message: use PACKAGE/msg/NAME, e.g. my_msgs/msg/Force"

    def load(self) -> builtins.type[Message]:
        """Import its class.

        Raises:
            PluginError: if it is no message of this type.
        """
        from ibrobot_core.messages import Message

        kind = self.message.load()
        if not (isinstance(kind, type) and issubclass(kind, Message) and kind.ros_type == self.type):
            raise PluginError(f"{self.message.place} is no message of type {self.type}: {kind!r}")
        return kind


@attrs.frozen
class TeleopDescriptor(Descriptor["interfaces.Teleop"]):
    """A teleoperation device."""


@attrs.frozen
class PolicyDescriptor(Descriptor["interfaces.Policy"]):
    """A policy."""

    reads: Callable[[Path], bool] = _answer(False)
    """Whether a folder has a trained policy of this type, the option `path`; checks only names."""


@attrs.frozen
class EngineDescriptor(Descriptor["interfaces.Engine"]):
    """An engine, which runs the model of a policy, `Context.model`.

    In the YAML, `inference.execution_mode` selects the type, and its options are keys of `inference`.
    """

    uses_transport: bool = False
    """Whether it reaches the model over the transport of the YAML, which must then connect to other machines."""
    weights_here: bool = True
    """Whether this machine has the model's weights, so that `ibrobot config check --deep` checks them."""

    def kept(self) -> Mapping[str, Any]:
        """Its needs."""
        return {"uses_transport": self.uses_transport, "weights_here": self.weights_here}


@documented
@attrs.frozen
class StreamOptions(Options):
    """Options of any executor that follows a stream of setpoints."""

    stale_timeout: float = option(0.25, unit="s", gt=0, help="age at which the last setpoint becomes stale")
    safety_behavior: str = option(
        "hold", choices=("hold", "relax"), help="behaviour for stale setpoints, here or in the contract's action"
    )


@attrs.frozen
class ExecutorDescriptor(Descriptor["interfaces.Executor"]):
    """An executor. If `streams`, it follows setpoints (from policies and teleop) rather than goals.

    The options of a streaming executor derive from `StreamOptions`.
    """

    streams: bool = False
    goals: Literal["trajectory", "position"] = "trajectory"
    """The goals of an executor that does not stream: `trajectory` (`FollowTrajectory`) or `position` (`MoveJoint`).
    The result of an aborted trajectory has the key `exceeded` if a tolerance was: `path` or `goal`."""

    def kept(self) -> Mapping[str, Any]:
        """The kind of goals that it takes."""
        return {"goals": "" if self.streams else self.goals}


@attrs.frozen
class SourceDescriptor(Descriptor["SourceWorker"]):
    """The command source of the control modes that have a key, its `type`: `planner`, or `intervene` of `inference`."""

    make: Callable[..., SourceWorker] = attrs.field(kw_only=True)
    """Session and mode -> the source; for `intervene` with a third argument, the `PolicySource` that runs the policy.
    Called before anything starts: what it raises stops a wrong run, e.g. for goals that make no sense. Imports what it
    needs when it is called, and opens nothing."""


@attrs.frozen
class TransportDescriptor(Descriptor["interfaces.Transport"]):
    """A transport."""

    listen: Callable[[Sequence[str]], Mapping[str, Any]] | None = None
    """Maps endpoints to the options of a server that listens there and does not connect; without endpoints, it listens
    on this machine only. None if servers cannot use this transport."""


@attrs.frozen
class RecorderDescriptor(Descriptor["interfaces.Recorder"]):
    """An episode recorder."""


@attrs.frozen
class ViewerDescriptor(Descriptor["interfaces.Viewer"]):
    """A viewer."""

    flag: str = ""
    """Flag of the command line that runs the robot with this viewer, e.g. `--window`."""
    begins_episodes: bool = False
    """Whether an operator can begin and end episodes in it."""


@attrs.frozen
class UnitsDescriptor(Descriptor[Any]):
    """Units of policies other than radians, `norm_mode` of a model, and features of their actions."""

    make: Callable[[RobotConfig, ModelConfig, Any], Any] = attrs.field(kw_only=True)  # type: ignore[assignment]
    """Robot, model and `Contract` -> the `PolicyVectors`, which convert. Raises CalibrationError."""
    uncalibrated: Callable[[RobotConfig], Iterable[Problem]] = _answer(())
    """Yields what is wrong with the calibrations that a run needs at its start."""
    of_recording: Callable[[str, Any, Mapping[str, Any], Mapping[str, Any]], Any] = _answer(None)
    """Unit, `Contract`, calibrations of joints, and robot YAML of a recording -> the `PolicyVectors` of its dataset;
    None if it converts runs only."""


@attrs.frozen
class SectionDescriptor(Descriptor["Component"]):
    """A section that a plugin adds to the robot YAML, e.g. `counter: {topic: /count}`, and its component.

    `type` is the section's key at the top level of the file, which core must not have. `options` are its keys.
    """

    make: Callable[[Any, RunAccess], Component] = attrs.field(kw_only=True)  # type: ignore[assignment]
    """Makes the component, from options and session. The options are None if the component runs without its section.
    Imports what it needs when it is called, and opens nothing."""
    without_section: Callable[[RobotConfig], bool] = _answer(False)
    """Whether the component also runs if the YAML lacks the section."""
    records_episodes: bool = attrs.field(default=False, kw_only=True)
    """Whether its component is the `EpisodeRecorder` of runs with a section `recording`."""
    check_config: Callable[[RobotConfig], Iterable[OptionFault]] = _answer(())
    """Yields faults of a robot config in any section, also if the component does not run; opens no device. The `option`
    of a fault is a path from the top of the file: `("peripherals", 0, "transform")`."""


@attrs.frozen
class Kind:
    """A kind that a plugin defines. Its types can be named in the robot YAML, as those of core's kinds.

    A plugin that offers types of it, but does not need the package that defines it, marks the hook with
    `@hookimpl(optionalhook=True)`.
    """

    name: str
    hook: str
    """Name of the hook, e.g. `ibrobot_planners`."""
    descriptor: builtins.type[Descriptor[Any]]
    """The class of what the hook yields."""


@attrs.frozen
class ReaderDescriptor:
    """A readable format of recorded episodes; the first installed one that recognises a path reads it."""

    type: str
    summary: str
    reads: Callable[[Path], bool]
    """Whether a path has this format; checks only names and first bytes."""
    make: Callable[[interfaces.EpisodeAddress], interfaces.EpisodeReader]
    """Opens an episode.

    Raises:
        RecorderError: when it cannot be read.
    """
    numbered: bool = False
    """Whether a path contains many episodes, numbered from 0."""


@attrs.frozen
class DecoderDescriptor:
    """A decoder of compressed images; the first one that supports a format is used."""

    formats: tuple[str, ...]
    """Names of formats for messages, e.g. `jpeg`."""
    make: Callable[[], Callable[[CompressedImage], Image | None]]
    """Imports the decoder, which returns pixels, or None for an unknown format.

    Equal bytes give equal pixels, in a run and in a conversion. The decoder raises `ContractError` if an image is
    damaged.
    """
    rectifier: Callable[[Mapping[str, Any]], Callable[[Any], Any]] | None = None
    """Intrinsics as `Options.lens` has them -> what removes the distortion from images.

    That maps arrays of shape (H, W, C) to arrays of the same shape and type, in a run and in a conversion with the same
    bits. `ContractError` is raised for intrinsics that are not those of a camera, and for images of another size.
    """


@attrs.frozen
class FeatureDescriptor:
    """Numbers that are computed from positions of joints; `select` in the contract names them `NAME.PART`."""

    name: str
    """The first word of the paths, e.g. `tool`."""
    model: Callable[[Robot, Sequence[str]], Mapping[str, Any]]
    """Robot and paths -> all that the numbers depend on beside the joints, as plain values. The contract has it in its
    fingerprint, and recordings have it. Raises ContractError."""
    make: Callable[[Mapping[str, Any], Sequence[str], Sequence[str]], JointFeature]
    """Model, paths, and for an action the joints that it moves -> the numbers. Raises ContractError."""
    vectors: Callable[..., Any]
    """The class that converts vectors of contracts whose actions have such paths, for what offers `ibrobot_units`."""
    check_config: Callable[[RobotConfig], Iterable[OptionFault]] = _answer(())
    """As `SectionDescriptor.check_config`."""


@attrs.frozen
class ConfigFile:
    """A robot YAML that a plugin ships; `ibrobot launch NAME` finds it."""

    name: str
    path: Path
    summary: str = ""


@attrs.frozen
class Command:
    """A command `ibrobot NAME …`, e.g. `port list`: a name of one or more words, and a class.

    The class is a frozen attrs class: its fields are the options, its docstring is the help, and an object of it does
    the work when it is called. What the call returns is the result: if the class has a method `show`, that prints it,
    and `--json` prints it as JSON instead. Command line, shell completion, forms, checks and reference derive from it.

        Command("port list", Late("my_package.ports:ListPorts"))

    A command without a class describes those whose names begin with its own.
    """

    name: str
    does: builtins.type[Any] | Late | None = None
    """The class, or the place of it, which is imported when the command is called."""
    _summary: str = attrs.field(default="", alias="summary")
    events: tuple[builtins.type[Event], ...] = ()
    """The classes of what it prints with `--events`. The call then gets a function that prints one, or without the flag
    None. Pages can run a command with events, and show its progress."""
    about: str = attrs.field(default="", kw_only=True)
    """Without a class: the help below the summary."""
    hidden: bool = attrs.field(default=False, kw_only=True)
    """Whether lists of commands leave it out."""
    check: Callable[[], None] = _answer(None)
    """As `Descriptor.check`."""
    takes: Callable[[Mapping[str, Any]], str] = _answer("")
    """Returns what a file with these plain values is, e.g. `a contract of Rosetta`, if it is no robot YAML but the
    command takes it; errors then name the command. Otherwise empty."""

    @property
    def options(self) -> builtins.type[Any]:
        """The class."""
        return self.does.load() if isinstance(self.does, Late) else self.does or Options

    @property
    def summary(self) -> str:
        """The line for lists of commands; by default the first one of the class's docstring."""
        return self._summary or (self.options.__doc__ or "").partition("\n")[0]


@attrs.frozen
class Check:
    """One line of `ibrobot doctor`."""

    name: str
    ok: bool
    found: str
    remedy: str = ""
    """The remedy if `ok` is False."""
    matters: bool = True
    """Whether `ibrobot doctor` fails if `ok` is False; otherwise it is only a note."""
