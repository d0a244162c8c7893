"""A look at a live rig: the robot runs as `ibrobot launch` runs it, but nothing commands it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import override

import attrs

from ibrobot_core.api import HardwareError, IbrobotError, ns
from ibrobot_core.app import (
    ControlMode,
    LaunchRequest,
    RobotConfig,
    Runtime,
    RunView,
    Session,
    SourceWorker,
    echo,
    installed_plugins,
)
from ibrobot_diagnose.cause import DEVICE_POSE
from ibrobot_diagnose.options import SECTION
from ibrobot_diagnose.rig import Rig
from ibrobot_diagnose.watch import POLL_S, SETTLE_S, LiveWindow, Watch


def still(config: RobotConfig) -> RobotConfig:
    """The robot as it is looked at: without poses to move to, recording, preflight, viewer and transport."""
    control = config.control
    kept = attrs.evolve(control, startup="hold", stop="hold" if control.stop.startswith("pose") else control.stop)
    sections = {name: each for name, each in config.plugin_sections.items() if name != SECTION}
    return attrs.evolve(config, control=kept, recording=None, viewer=None, transport=None, plugin_sections=sections)


def look(
    config: RobotConfig, seconds: float, *, lockstep: bool = False, seed: int = 0,
    tell: Callable[[str], None] = lambda what: None,
) -> LiveWindow:  # fmt: skip
    """Look at a rig for some seconds; nothing moves. What holds torque in the end is on stderr, with its remedy.

    Args:
        config: the robot.
        seconds: length of the window [s].
        lockstep: whether to run in simulated time.
        seed: of a simulated scene.
        tell: called with what is done.

    Raises:
        IbrobotError: if a part of the robot does not start, or dies.
    """
    with looking(config, lockstep=lockstep, seed=seed, tell=tell) as (runtime, watch):
        watch.begin()
        _run(runtime, watch, seconds)
        seen = watch.window()
        seen = attrs.evolve(seen, window=attrs.evolve(seen.window, rig=_with_leaders(seen.rig, runtime.session)))
    runtime.raise_failure()
    return seen


@contextmanager
def looking(
    config: RobotConfig, *, lockstep: bool = False, seed: int = 0, tell: Callable[[str], None] = lambda what: None
) -> Iterator[tuple[Runtime, Watch]]:
    """A run in which nothing moves, after automatic exposures have settled, and what it shows; as `look`."""
    runtime = Runtime(Session(still(config), installed_plugins(), LaunchRequest(lockstep, seed, source=_Still)))
    watch = Watch(runtime.session)
    try:
        runtime.start(tell)
        tell("the window")
        _run(runtime, watch, SETTLE_S)
        yield runtime, watch
    finally:
        watch.close()
        runtime.stop()
        for line in runtime.session.outcome.holding:
            echo(line, err=True)


class _Still(SourceWorker):
    """Commands nothing."""

    def __init__(self, session: RunView, mode: ControlMode) -> None:
        super().__init__(session, mode, "nothing moves")

    @override
    def begin_mode(self, seed: int) -> None:
        """Begin nothing."""

    @override
    def work(self, timeout_s: float) -> None:
        if timeout_s > 0:
            self.pause(timeout_s)


def _run(runtime: Runtime, watch: Watch, seconds: float) -> None:
    """Let the run go on, in its own time.

    Raises:
        IbrobotError: if it ends.
    """
    session = runtime.session
    until_ns = session.clock.now_ns() + ns(seconds)
    while session.clock.now_ns() < until_ns:
        if runtime.step() if session.request.lockstep else runtime.wait(POLL_S):
            runtime.raise_failure()
            raise HardwareError(f"the run ended while the rig was looked at: {'; '.join(session.faults) or 'stopped'}")
        watch.take()


def _with_leaders(rig: Rig, session: RunView) -> Rig:
    """The rig with how far its leaders stand from it."""
    config, measured = session.config, session.measured()
    at = dict(zip(config.robot.joint_names, measured.position.tolist(), strict=True))
    known = {each.type for each in session.registry.of_kind(DEVICE_POSE)}
    groups = {name: group for mode in config.control_modes.values() for group, name in mode.devices.items()}
    leaders: dict[str, dict[str, float]] = {}
    notes: list[str] = []
    for name, group in () if config.simulated else groups.items():
        device = config.teleoperation[name]
        if device.type not in known:
            continue
        part = config.robot.part(group) if group else config.robot
        try:
            poses = session.make(DEVICE_POSE, device, name, robot=part)
        except IbrobotError as error:
            notes.append(f"{name} cannot be read: {error}")
            continue
        leaders[name] = {joint: position - at[joint] for joint, position in poses.items()}
    return attrs.evolve(rig, leaders=leaders, notes=tuple(notes))
