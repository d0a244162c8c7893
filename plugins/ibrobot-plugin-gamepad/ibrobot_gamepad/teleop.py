"""Teleops `gamepad` and `spacemouse`: jog joints or the tool while a deadman is held."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

import numpy as np
from ibrobot_kinematics import JogArm, JogMotion, VelocityJog

from ibrobot_core.api import (
    Context,
    JointReading,
    OperatorEvent,
    Teleop,
    TeleopCommand,
    TeleopError,
    ns,
)
from ibrobot_gamepad.controls import Controls
from ibrobot_gamepad.devices import Device, DeviceGone
from ibrobot_gamepad.finder import Finder, open_first
from ibrobot_gamepad.mapping import EVENTS, GRIPPER, control_map
from ibrobot_gamepad.options import GamepadOptions, SpaceMouseOptions
from ibrobot_gamepad.reports import Kind

_LOOK_NS = ns(0.5)
"""Period of the search while no device is connected."""
_REST_NS = ns(2.0)
"""Time for which the deadman of a device that reports only changes may be held at rest [ns]."""
_POSE = "pose "
"""Prefix of the function of a button that drives to a pose."""


class JogTeleop(Teleop):
    """Jogs with the first device of its kind, connected before or after the launch. Time is that of the measurements.

    Without a device the robot holds. Buttons held when a device connects, or when the mode begins, count as released:
    the operator must press the deadman again before anything moves.

    A device that reports only changes is silent while its controls are still. Its deadman then counts as held for as
    long as nothing should move, up to two seconds; a motion ends as with any other silent device.
    """

    def __init__(self, options: GamepadOptions | SpaceMouseOptions, ctx: Context) -> None:
        robot = ctx.robot
        self._options = options
        self._ctx = ctx
        self._kind: Kind = "gamepad" if isinstance(options, GamepadOptions) else "spacemouse"
        self._via = options.via if isinstance(options, GamepadOptions) else "hid"
        self._trusts = isinstance(options, GamepadOptions) and options.trust_link
        self._map = control_map(options, robot)
        self._buttons = {**self._map.buttons, **{_POSE + name: button for name, button in self._map.poses.items()}}
        """Function -> button."""
        self._arm = JogArm(robot, options.gripper)
        self._jog = VelocityJog(self._arm, options.follow)
        self._mode = options.start
        self._finder: Finder | None = None
        """Exists from `connect` to `disconnect`."""
        self._device: Device | None = None
        self._name = ""
        self._looked_ns: int | None = None
        self._complaint = ""
        self._estop = False
        """Whether the emergency stop was pressed and is not yet reported."""
        self._opens = False
        """Whether the next press of the button `gripper` opens the gripper."""
        self._forget()

    def _forget(self) -> None:
        """Reset the state for a new device."""
        self._controls: Controls | None = None
        self._pressed: frozenset[str] = frozenset(self._buttons)
        """Functions whose buttons are pressed; all of them until the device has sent a state."""
        self._rest: dict[str, float] = {}
        """Gripper control -> its first value, for those that have not moved yet."""
        self._heard_ns = 0
        """When its last state came [ns]."""
        self._release()

    def _release(self) -> None:
        self._toggle_ns: int | None = None
        """When the toggle button was pressed [ns]; None after the toggle, or while it is released."""
        self._jog.rest()

    @override
    def connect(self) -> None:
        if self._options.cartesian:
            self._arm.load_model("cartesian: false", self._ctx.bus)
        self._finder = Finder(self._kind, self._via)
        self._look(self._finder)
        if self._device is None:
            self._ctx.log.warning("%s: no %s is plugged in; the robot holds until one is", self._ctx.name, self._kind)

    @override
    def activate(self, measured: JointReading) -> None:
        # Discards buttons pressed before, except for the emergency stop.
        self._take(self._poll(measured.stamp_ns), measured.stamp_ns)
        self._release()

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        if self._finder is None:
            raise TeleopError(f"{self._ctx.name}: the {self._kind} is not connected: call connect before read")
        now_ns = measured.stamp_ns
        events = self._take(self._poll(now_ns), now_ns)
        if self._estop:
            self._estop = False
            self._release()
            return TeleopCommand(None, estop=True, events=events)
        self._toggle_after_long_press(measured)
        if not self.deadman.allows(now_ns) or self._controls is None:
            self._jog.rest()
            return TeleopCommand(None, events=events)
        dt = self._jog.step(measured)
        setpoint = self._jog.move(measured.position, self._motion(self._controls), dt)
        return TeleopCommand(dict(zip(self._ctx.robot.joint_names, setpoint.tolist(), strict=True)), events=events)

    @override
    def disconnect(self) -> None:
        self._lose()
        if self._finder is not None:
            self._finder.close()
        self._finder = None
        self._looked_ns = None

    @override
    def help(self) -> str:
        moves = "the tool" if self._mode == "tool" else "joints"
        stuck = self._controls is not None and "deadman" in self._pressed and not self.deadman.armed
        then = "; RELEASE the deadman and press it again" if stuck else ""
        return f"{self._name or f'no {self._kind} yet'}: moves {moves}{then}\n{self._map.help()}"

    def _poll(self, now_ns: int) -> Sequence[Controls]:
        """The new states of the device, if one is connected."""
        if self._finder is not None and self._device is None and self._is_due(now_ns):
            self._looked_ns = now_ns
            try:
                self._look(self._finder)
            except TeleopError as error:  # e.g. udev has not yet set the permissions of a new device
                if str(error) != self._complaint:
                    self._complaint = str(error)
                    self._ctx.log.warning("%s: %s", self._ctx.name, error)
        if self._device is None:
            return ()
        try:
            return self._device.poll(now_ns)
        except DeviceGone as error:
            self._ctx.log.warning("%s: lost %s (%s); the robot holds", self._ctx.name, self._name, error)
            self._lose()
            self.deadman.disarm(now_ns)
            return ()

    def _is_due(self, now_ns: int) -> bool:
        return self._looked_ns is None or now_ns - self._looked_ns >= _LOOK_NS

    def _look(self, finder: Finder) -> None:
        opened = open_first(finder.find(), self._options.device)
        if opened is not None:
            listed, self._device = opened
            self._name = f"{listed.name} ({listed.id}, {listed.model})"
            self._complaint = ""

    def _lose(self) -> None:
        if self._device is not None:
            self._device.close()
        self._device = None
        self._name = ""
        self._forget()

    def _take(self, states: Sequence[Controls], now_ns: int) -> tuple[OperatorEvent, ...]:
        """Process the new states; returns the operator's events."""
        events: list[OperatorEvent] = []
        if states and self._controls is None:
            self._greet()
        for controls in states:
            self._controls, self._heard_ns = controls, now_ns
            if not controls.complete:
                continue
            before, self._pressed = self._pressed, self._functions(controls)
            self.deadman.report("deadman" in self._pressed, now_ns)
            for function in sorted(self._pressed - before):
                if function == "toggle":
                    self._toggle_ns = now_ns
                elif function == "gripper":
                    self._opens = not self._opens
                elif function == "estop":
                    self._estop = True
                elif function in EVENTS:
                    events.append(function)
            if "toggle" not in self._pressed:
                self._toggle_ns = None
        if not states:
            self._vouch(now_ns)
        return tuple(events)

    def _greet(self) -> None:
        self._ctx.log.info("%s: %s", self._ctx.name, self._name)
        if self._device is not None and not self._device.streams:
            silence = "its open connection counts as a report" if self._trusts else "a motion ends when it is silent"
            self._ctx.log.info("%s: it reports only changes, so %s", self._ctx.name, silence)

    def _vouch(self, now_ns: int) -> None:
        """Report the deadman of a silent device that reports only changes, where this moves nothing."""
        controls = self._controls
        if self._device is None or self._device.streams or controls is None or not controls.complete:
            return
        held = "deadman" in self._pressed
        if not held or self._trusts or (now_ns - self._heard_ns <= _REST_NS and self._motion(controls).is_rest):
            self.deadman.report(held, now_ns)

    def _functions(self, controls: Controls) -> frozenset[str]:
        """Functions whose buttons are pressed; those of the gripper only after their controls have moved."""
        for function in GRIPPER:
            if (control := self._buttons.get(function)) is not None:
                value = controls.value(control)
                if abs(value - self._rest.setdefault(control, value)) > self._options.dead_zone:
                    self._rest[control] = np.inf
        return frozenset(name for name, button in self._buttons.items() if controls.pressed(button))

    def _toggle_after_long_press(self, measured: JointReading) -> None:
        if self._toggle_ns is None or measured.stamp_ns - self._toggle_ns < ns(self._options.long_press):
            return
        self._toggle_ns = None
        self._mode = "joints" if self._mode == "tool" else "tool"
        self._jog.restart(measured.position)
        self._ctx.log.info("%s: moves %s", self._ctx.name, "the tool" if self._mode == "tool" else "joints")

    def _motion(self, controls: Controls) -> JogMotion:
        options, robot = self._options, self._ctx.robot
        velocity = np.zeros(len(robot.joints))
        velocity[robot.indices(self._arm.gripper)] = self._gripper(controls) * options.gripper_speed
        for function in self._pressed:
            if function.startswith(_POSE):
                pose = robot.pose(function.removeprefix(_POSE)).copy()
                return JogMotion(np.zeros(len(robot.joints)), pose=pose, pose_speed=options.joint_speed)
        if self._mode == "joints":
            for joint, axis in self._map.joints.items():
                velocity[robot.indices((joint,))] = axis.value(controls, options.dead_zone) * options.joint_speed
            return JogMotion(velocity)
        x, y, z, roll, pitch, yaw = (self._tool(controls, axis) for axis in ("x", "y", "z", "roll", "pitch", "yaw"))
        linear, turn = np.array([x, y, z]), np.array([yaw, pitch, roll])
        return JogMotion(velocity, linear * options.tool_speed, turn * options.turn_speed)

    def _tool(self, controls: Controls, name: str) -> float:
        axis = self._map.tool.get(name)
        return axis.value(controls, self._options.dead_zone) if axis is not None else 0.0

    def _gripper(self, controls: Controls) -> float:
        """Speed of the gripper as a fraction of its maximum; negative for closing."""
        opens, closes, turns = (self._moved(controls, function) for function in GRIPPER)
        return opens - closes + (turns if self._opens else -turns)

    def _moved(self, controls: Controls, function: str) -> float:
        """Deflection of a gripper control, 0 to 1; 0 until it has moved since the device connected."""
        control = self._buttons.get(function)
        if control is None or np.isfinite(self._rest.get(control, 0.0)):
            return 0.0
        return max(0.0, controls.value(control) - self._options.dead_zone) / (1.0 - self._options.dead_zone)
