"""Teleop `keyboard`: jogs joints or the tool while keys are held down."""

from __future__ import annotations

import queue
from typing import override

import numpy as np
from ibrobot_kinematics import JogArm
from ibrobot_terminal import HeldKeys, KeyEvent

from ibrobot_core.api import (
    Context,
    JointReading,
    Teleop,
    TeleopCommand,
    TeleopError,
    Vector,
    ns,
    seconds,
)
from ibrobot_keyboard.keymap import CARTESIAN_AXES, Mode
from ibrobot_keyboard.options import KeyboardOptions

_SPEED_STEP = 1.25
_SLOWEST, _FASTEST = 0.1, 4.0
"""Bounds of the factor that the speed keys change."""

_GRIPPER, _HOME = "<gripper>", "<home>"
"""Axes in addition to the joints and those of the tool."""
_SETTINGS = ("toggle", "faster", "slower")
_MOTIONS = {"gripper_open": (_GRIPPER, 1), "gripper_close": (_GRIPPER, -1), "home": (_HOME, 1)}


class KeyboardTeleop(Teleop):
    """Moves while keys repeat, since most terminals report presses and repeats but no releases.

    Each press or repeat moves for `hold` seconds from the tick that counts it; see `HeldKeys`. Each key is a deadman.
    Time is that of the measurements.
    """

    def __init__(self, options: KeyboardOptions, ctx: Context) -> None:
        self._options = options
        self._ctx = ctx
        robot = ctx.robot
        self._arm = JogArm(robot, options.gripper)
        self._home = robot.pose("home") if "home" in robot.description.poses else None
        self._keymap = options.keymap(robot)
        self._keys: queue.SimpleQueue[str] | None = None
        self._pressed = HeldKeys(options.hold)
        self._mode: Mode = "joints"
        self._speed = 1.0
        self._setpoint: Vector | None = None
        self._held: dict[str, tuple[int, int]] = {}
        """Axis -> direction, and when its motion ends [ns]."""
        self._moved_ns: int | None = None
        """When the last motion was computed [ns]; None while at rest."""

    @override
    def connect(self) -> None:
        if self._ctx.keys is None:
            raise TeleopError(
                f"{self._ctx.name}: the keyboard needs a terminal: start ibrobot in one, without --headless "
                "and without redirecting its input, or choose another teleop"
            )
        if self._options.cartesian:
            self._arm.load_model("cartesian: false", self._ctx.bus)
        self._keys = self._ctx.keys()

    @override
    def activate(self, measured: JointReading) -> None:
        self._setpoint = measured.position.copy()
        self._held.clear()
        self._moved_ns = None
        self._arm.stop_tool()
        self._pressed.take(self._keys, measured.stamp_ns)
        self._pressed.forget()

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        if self._keys is None:
            raise TeleopError(f"{self._ctx.name}: the keyboard is not connected: connect comes before read")
        now_ns = measured.stamp_ns
        self._held = {axis: held for axis, held in self._held.items() if now_ns < held[1]}
        if not self._moves():
            # The motion begins now, so after a pause of the host the robot does not jump.
            self._moved_ns = None
        self._pressed.take(self._keys, now_ns)
        for event, key in self._pressed.events:
            if (action := self._keymap.action(self._mode, key)) is not None:
                self._take(event, action, now_ns)
        if not self._held:
            self.deadman.report(False, now_ns)
        if not self.deadman.allows(now_ns):
            self._held.clear()
            if not self.deadman.armed:  # by a silence or a pause of the host
                self._pressed.forget()
                self._setpoint = None
                self._arm.stop_tool()
        if not self._moves():
            return TeleopCommand(None)
        if self._setpoint is None:
            self._setpoint = measured.position.copy()
        if self._moved_ns is not None and now_ns > self._moved_ns:
            self._setpoint = self._move(self._setpoint, seconds(now_ns - self._moved_ns))
        self._moved_ns = now_ns
        return TeleopCommand(dict(zip(self._ctx.robot.joint_names, self._setpoint.tolist(), strict=True)))

    @override
    def disconnect(self) -> None:
        self._keys = self._setpoint = None

    @override
    def help(self) -> str:
        return self._keymap.help(self._mode)

    def _take(self, event: KeyEvent, action: str, now_ns: int) -> None:
        if action in _SETTINGS:
            if event == "press":
                self._set(action)
            return
        axis, direction = _MOTIONS.get(action) or (action[:-1], 1 if action[-1] == "+" else -1)
        if event == "release":
            self._held.pop(axis, None)
            return
        if event == "press" and not self._held:
            self.deadman.report(False, now_ns)  # it was released before
        self.deadman.report(True, now_ns)
        if axis == _HOME:
            self._held.clear()
        self._held.pop(_HOME, None)
        self._held[axis] = direction, now_ns + ns(self._options.hold)

    def _set(self, action: str) -> None:
        if action == "toggle":
            self._mode = "cartesian" if self._mode == "joints" else "joints"
            self._held.clear()
            self._ctx.log.info("%s: jogs %s", self._ctx.name, "joints" if self._mode == "joints" else "the tool")
            return
        factor = _SPEED_STEP if action == "faster" else 1 / _SPEED_STEP
        self._speed = min(max(self._speed * factor, _SLOWEST), _FASTEST)
        self._ctx.log.info("%s: speed %.0f %%", self._ctx.name, 100 * self._speed)

    def _move(self, before: Vector, dt: float) -> Vector:
        """The setpoint `dt` [s] after `before`, both [rad], shape (J,)."""
        robot, options, speed = self._ctx.robot, self._options, self._speed
        velocity = np.zeros(len(robot.joints))
        after = before
        jogs_tool = self._mode == "cartesian" and _HOME not in self._held
        if self._arm.tool_moves or (jogs_tool and any(axis in self._held for axis in CARTESIAN_AXES)):
            # Before any other motion the tool slows down to a stop.
            x, y, z, pitch, roll = (self._direction(axis) if jogs_tool else 0 for axis in CARTESIAN_AXES)
            linear = np.array([x, y, z]) * options.cartesian_speed * speed
            turn = np.array([0.0, pitch, roll]) * options.joint_speed * speed
            after = self._arm.move_tool(before, linear, turn, dt)
        elif _HOME in self._held and self._home is not None:
            after = self._arm.move_towards(before, self._home, options.joint_speed * speed, dt)
        elif self._mode == "joints":
            for i, name in zip(robot.indices(self._arm.arm), self._arm.arm, strict=True):
                velocity[i] = self._direction(name) * options.joint_speed * speed
        velocity[robot.indices(self._arm.gripper)] = self._direction(_GRIPPER) * options.gripper_speed * speed
        return self._arm.move_joints(after, velocity, dt)

    def _moves(self) -> bool:
        return bool(self._held) or self._arm.tool_moves

    def _direction(self, axis: str) -> int:
        return self._held[axis][0] if axis in self._held else 0
