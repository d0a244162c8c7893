"""A teleoperation device of a robot YAML in a program of LeRobot's."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ibrobot_core.api import (
    Context,
    JointReading,
    Options,
    RealClock,
    Robot,
    Teleop,
    TeleopError,
    Vector,
    did_you_mean,
)
from ibrobot_core.app import (
    RobotConfig,
    RunTerminal,
    find_config,
    installed_plugins,
    load_config,
)
from ibrobot_lerobot_program.features import RobotFeatures
from ibrobot_lerobot_program.link import ProgramLink


class ProgramTeleop:
    """A device that commands joints in LeRobot's units, one command at a time.

    It starts where the robot is: that of `--robot.type=ibrobot` in the same program, else a pose of the YAML. While its
    deadman is released, the command stays.

    Args:
        config: robot YAML: a path, or the name of a shipped one.
        device: name of the device in its section `teleoperation`.
        pose: named pose at which a robot stands that is not one of ibrobot's.
        sim: whether the YAML is loaded for simulation.
        overrides: changes of it, as `--set` takes them.
        use_degrees: as for the robot.
        calibration: as for the robot.
    """

    def __init__(
        self, config: str, device: str, *, pose: str = "", sim: bool = False, overrides: Sequence[str] = (),
        use_degrees: bool = True, calibration: str = "",
    ) -> None:  # fmt: skip
        registry = installed_plugins()
        self._config: RobotConfig = load_config(find_config(config, registry), overrides=overrides, sim=sim)
        known = self._config.teleoperation
        if device not in known:
            raise TeleopError(f"{config}: teleoperation has no {device!r}{did_you_mean(device, list(known), 'it has')}")
        self._name, self._pose = device, pose
        self._units = use_degrees, calibration
        self._device: Teleop | None = None
        self._keys: RunTerminal | None = None
        self._clock = RealClock()
        self._command: Vector | None = None
        """The last command [rad], shape (J,); None before the first."""

    @property
    def robot(self) -> Robot:
        """The robot of the YAML."""
        return self._config.robot

    @cached_property
    def features(self) -> RobotFeatures:
        """The joints of the contract's action."""
        use_degrees, calibration = self._units
        return RobotFeatures.of_config(self._config, use_degrees=use_degrees, calibration=calibration)

    @property
    def is_connected(self) -> bool:
        """Whether the device is open."""
        return self._device is not None

    def connect(self) -> None:
        """Open the device.

        Raises:
            TeleopError: if it cannot be opened.
        """
        keys = self._terminal() if sys.stdin.isatty() else None
        context = Context.of(self._config, self._name, self._clock, keys=keys.subscribe if keys is not None else None)
        section = self._config.teleoperation[self._name]
        device: Teleop = installed_plugins().create("teleop", section.type, section.options, context)
        if keys is not None:
            keys.__enter__()
        try:
            device.connect()
        except BaseException:
            device.disconnect()
            if keys is not None:
                keys.close()
            raise
        self._device, self._keys, self._command = device, keys, None

    def _terminal(self) -> RunTerminal:
        """The keys of the terminal."""
        registry, name = installed_plugins(), "terminal"
        context = Context.of(self._config, name, self._clock)
        keys: RunTerminal = registry.create(name, registry.default(name), Options(), context)
        return keys

    def read(self) -> dict[str, float]:
        """The command in LeRobot's units.

        Raises:
            TeleopError: if the device has failed, or commands an emergency stop, or if the robot's position is not
                known.
        """
        if self._device is None:
            raise TeleopError(f"{self._name}: not connected")
        measured = self._measured()
        if self._command is None:  # LeRobot connects teleoperators before robots
            self._command = measured.copy()
            self._device.begin_operation(self._reading(measured))
        command = self._device.operate(self._reading(measured))
        if command.estop:
            raise TeleopError(f"{self._name}: emergency stop")
        for joint, position in (command.positions or {}).items():
            self._command[self.robot.joint_names.index(joint)] = position
        return self.features.values(self._command[self.robot.indices(self.features.joints)])

    def disconnect(self) -> None:
        """Release the device. Safe to call twice."""
        device, self._device = self._device, None
        keys, self._keys = self._keys, None
        if device is not None:
            device.disconnect()
        if keys is not None:
            keys.close()

    def _reading(self, position: Vector) -> JointReading:
        size = len(position)
        return JointReading(self._clock.now_ns(), position, np.zeros(size), np.full(size, np.nan))

    def _measured(self) -> Vector:
        """Where the robot is [rad], shape (J,)."""
        link = ProgramLink.newest
        if link is not None and link.is_running:
            return np.array([link.measured.get(joint, 0.0) for joint in self.robot.joint_names])
        if self._command is not None:
            return self._command.copy()
        poses = self.robot.description.poses
        if self._pose not in poses:
            raise TeleopError(
                f"{self._name}: the robot's position is not known: connect --robot.type=ibrobot first, or give the "
                f"--teleop.pose at which the robot stands; the YAML has: {', '.join(poses) or 'none'}"
            )
        return self.robot.pose(self._pose)
