"""The hooks. Registration hooks run once, at discovery, and yield descriptors; event hooks report events.

A plugin is a module (or object) named by an entry point of group `ibrobot`:

    [project.entry-points.ibrobot]
    wave = "ibrobot_wave"

with functions marked `@ibrobot_core.hookimpl`, each yielding descriptors:

    @hookimpl
    def ibrobot_teleop():
        yield TeleopDescriptor(type="wave", summary="waves with one joint", options=WaveOptions, make=_make_wave)

An implementation may omit arguments that it does not need.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import pluggy

if TYPE_CHECKING:
    from ibrobot_core import descriptors

hookspec = pluggy.HookspecMarker("ibrobot")
hookimpl = pluggy.HookimplMarker("ibrobot")
"""Decorator of a plugin's hook implementations."""


@hookspec
def ibrobot_hardware() -> Iterable[descriptors.HardwareDescriptor]:  # type: ignore[empty-body]
    """Hardware that this plugin drives or simulates."""


@hookspec
def ibrobot_sensors() -> Iterable[descriptors.SensorDescriptor]:  # type: ignore[empty-body]
    """Cameras and other sensors."""


@hookspec
def ibrobot_teleop() -> Iterable[descriptors.TeleopDescriptor]:  # type: ignore[empty-body]
    """Teleoperation devices."""


@hookspec
def ibrobot_policies() -> Iterable[descriptors.PolicyDescriptor]:  # type: ignore[empty-body]
    """Policies."""


@hookspec
def ibrobot_engines() -> Iterable[descriptors.EngineDescriptor]:  # type: ignore[empty-body]
    """Engines, which run the model of a policy."""


@hookspec
def ibrobot_executors() -> Iterable[descriptors.ExecutorDescriptor]:  # type: ignore[empty-body]
    """Executors, which run in the control process and send their setpoints to the safety layer."""


@hookspec
def ibrobot_sources() -> Iterable[descriptors.SourceDescriptor]:  # type: ignore[empty-body]
    """Command sources of control modes."""


@hookspec
def ibrobot_transports() -> Iterable[descriptors.TransportDescriptor]:  # type: ignore[empty-body]
    """Transports between processes and machines."""


@hookspec
def ibrobot_recorders() -> Iterable[descriptors.RecorderDescriptor]:  # type: ignore[empty-body]
    """Episode recorders."""


@hookspec
def ibrobot_readers() -> Iterable[descriptors.ReaderDescriptor]:  # type: ignore[empty-body]
    """Formats of recorded episodes that this plugin reads."""


@hookspec
def ibrobot_decoders() -> Iterable[descriptors.DecoderDescriptor]:  # type: ignore[empty-body]
    """Formats of compressed pictures that this plugin decodes."""


@hookspec
def ibrobot_features() -> Iterable[descriptors.FeatureDescriptor]:  # type: ignore[empty-body]
    """Numbers that this plugin computes from positions of joints, for the contract."""


@hookspec
def ibrobot_messages() -> Iterable[descriptors.MessageDescriptor]:  # type: ignore[empty-body]
    """Message types that this plugin defines."""


@hookspec
def ibrobot_viewers() -> Iterable[descriptors.ViewerDescriptor]:  # type: ignore[empty-body]
    """Viewers."""


@hookspec
def ibrobot_terminals() -> Iterable[descriptors.Descriptor]:  # type: ignore[empty-body, type-arg]
    """Terminals, which read keys and show runs: `make` gives a `RunTerminal`."""


@hookspec
def ibrobot_units() -> Iterable[descriptors.UnitsDescriptor]:  # type: ignore[empty-body]
    """Units of policies other than radians."""


@hookspec
def ibrobot_sections() -> Iterable[descriptors.SectionDescriptor]:  # type: ignore[empty-body]
    """Sections that this plugin adds to the robot YAML."""


@hookspec
def ibrobot_kinds() -> Iterable[descriptors.Kind]:  # type: ignore[empty-body]
    """Kinds that this plugin defines, each with a hook by which others offer theirs."""


@hookspec
def ibrobot_configs() -> Iterable[descriptors.ConfigFile]:  # type: ignore[empty-body]
    """Robot YAMLs that this plugin ships."""


@hookspec
def ibrobot_commands() -> Iterable[descriptors.Command]:  # type: ignore[empty-body]
    """Commands that this plugin adds to `ibrobot`."""


@hookspec
def ibrobot_doctor() -> Iterable[descriptors.Check]:  # type: ignore[empty-body]
    """Checks that `ibrobot doctor` runs."""


@hookspec
def ibrobot_episode_started(robot: str, episode: int, mode: str, stamp_ns: int) -> None:
    """Event: episode number `episode` (from 1) began."""


@hookspec
def ibrobot_episode_ended(robot: str, episode: int, outcome: str, stamp_ns: int) -> None:
    """Event: an episode ended as `success`, `failure` or `unknown`."""


@hookspec
def ibrobot_mode_changed(robot: str, mode: str, previous: str, stamp_ns: int) -> None:
    """Event: the control mode switched."""


@hookspec
def ibrobot_fault_raised(robot: str, fault: str, stamp_ns: int) -> None:
    """Event: a fault was raised, e.g. hardware that stopped answering."""
