"""`ibrobot feetech emulate`: emulates a servo bus on a pseudo-terminal, for tests without an arm."""

from __future__ import annotations

import datetime
import math
import os
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import attrs
from ibrobot_calibration import Calibration, JointCalibration, calibration_path, load_calibration
from ibrobot_terminal.plural import counted

from ibrobot_core.api import option
from ibrobot_core.app import RequestError, echo, on_signals
from ibrobot_feetech.arm import Arm, calibrated_registers
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.commands.joints import SO101
from ibrobot_feetech.ticks import MIDDLE_TICK, TICKS_PER_RADIAN, TICKS_PER_TURN

if TYPE_CHECKING:
    from ibrobot_core.api import Robot
    from ibrobot_core.app import RobotConfig
    from ibrobot_feetech.emulator import Emulator
    from ibrobot_feetech.emulator.physics import PhysicsArm

_JOINTS = tuple(SO101)
_GRIPPER = _JOINTS[-1]

_CHANCES = ("drop", "corrupt", "duplicate", "late", "late_s", "delay_s")
"""The options that are attributes of the emulator's faults."""
_PRIORITY = 70
"""Real-time priority, above that of a control process, which waits for the servos."""
_STEP_S = 0.02
"""Period of looking at the emulated arm, and of moving it by hand [s]."""
_SWING_S, _HAND = 8.0, 1.0
"""Time of a swing to and fro [s], and the highest speed of a hand [rad/s]."""
_SWITCH_S = 2e-4
"""Longest time for which the physics may delay the servos' answers [s]."""


@attrs.frozen(kw_only=True)
class Emulate:
    """Emulate a bus of STS3215 servos on a pseudo-terminal.

    The first line of the output is the path of the port. With --physics the simulation of a robot YAML moves the
    joints, and the run that uses the port can read the simulation's scene. Ctrl-C ends it.
    """

    servos: int = option(6, ge=1, le=253, help="how many servos, ids from 1")
    baud: int = option(1_000_000, help="initial baud rate of the servos")
    throttle: bool = option(False, help="delay bytes by their time on a real wire")
    link: Path | None = option(None, help="path of a symbolic link to the port")
    calibration: str | None = option(
        None, typed="--calibration NAME", help="calibration of the servos; created if it does not exist"
    )
    prefix: str = option("", help="prefix of the joints' names, e.g. left_ for one of two arms")
    physics: str | None = option(
        None, typed="--physics CONFIG", help="move the joints with the simulation of this robot YAML"
    )
    seed: int = option(0, help="seed of random faults and of the scene")
    drop: float = option(0.0, ge=0, le=1, help="probability that a reply is lost")
    corrupt: float = option(0.0, ge=0, le=1, help="probability that a reply's byte is damaged")
    duplicate: float = option(0.0, ge=0, le=1, help="probability that a reply is sent twice")
    late: float = option(0.0, ge=0, le=1, help="probability that a reply is late")
    late_s: float = option(0.05, ge=0, unit="s", help="how late")
    delay_s: float = option(0.0, ge=0, unit="s", help="additional delay of every reply")
    silent: tuple[int, ...] = option((), typed="--silent ID", help="a servo that ignores requests")
    blocked: tuple[int, ...] = option((), typed="--blocked ID", help="a servo whose joint does not move")
    overloaded: tuple[int, ...] = option((), typed="--overloaded ID", help="a servo under its maximum load")
    disconnected: tuple[int, ...] = option((), typed="--disconnected ID", help="a servo without its cable")
    mechanics: bool = option(False, help="give the joints the stops, friction and weight of an SO-101's")
    cables: tuple[tuple[int, int], ...] = option(
        (), typed="--cable ID TICKS", help="with --mechanics, a cable that pulls a joint back from so many ticks on"
    )
    swing: float = option(
        0.0, ge=0, le=0.5, unit="rad", help="how far joints without torque swing to each side, as if by hand"
    )
    errors: tuple[tuple[int, int], ...] = option((), typed="--error ID BITS", help="error bits of a servo")

    def __call__(self) -> None:
        from ibrobot_feetech.emulator import Emulator

        if self.link is not None and self.link.exists() and not self.link.is_symlink():
            raise RequestError(f"--link: {self.link} exists already and is not a link: choose another path")
        if self.link is not None and not os.access(self.link.parent, os.W_OK | os.X_OK):
            raise RequestError(f"--link: {self.link}: {self.link.parent} is not a folder that you can write into")
        if self.cables and not self.mechanics:
            raise RequestError(
                "--cable needs --mechanics: without it joints follow their goals, whatever is in the way"
            )
        if self.mechanics and self.physics is not None:
            raise RequestError("--mechanics and --physics exclude each other: either moves the joints")
        if self.swing and (self.physics is not None or self.mechanics):
            raise RequestError("--swing excludes --physics and --mechanics: something else moves the joints there")
        cables, errors = _by_servo("--cable", self.cables), _by_servo("--error", self.errors)
        ended = threading.Event()
        on_signals(ended.set)
        config = _config(self.physics) if self.physics is not None else None
        joints = (
            config.robot.joint_names
            if config is not None
            else [f"{self.prefix}{joint}" for joint in _JOINTS[: self.servos]]
        )
        count = len(joints) if config is not None else self.servos
        with ExitStack() as stack:
            emulator = stack.enter_context(
                Emulator(count, baud_rate=self.baud, throttle=self.throttle, seed=self.seed, link=self.link)
            )
            for name in _CHANCES:
                setattr(emulator.faults, name, getattr(self, name))
            faults = emulator.faults
            faults.silent, faults.blocked = set(self.silent), set(self.blocked)
            faults.overloaded, faults.disconnected = set(self.overloaded), set(self.disconnected)
            faults.errors = errors
            if self.mechanics:
                _add_mechanics(emulator, joints, cables)
            calibrated = _calibrate(emulator, self.calibration, joints, config.robot if config is not None else None)
            echo(str(self.link) if self.link is not None else emulator.port)
            arm = None
            if config is not None:
                assert calibrated is not None
                arm = _physics(config, calibrated, emulator, self.seed)
                arm.start()
                stack.callback(arm.stop)
            _hurry()
            echo(f"{counted(count, 'servo')} at {self.baud} baud; Ctrl-C ends it", err=True)
            hand = Hand(emulator, self.swing) if self.swing else None
            _wait(ended, arm, hand)


def _by_servo(typed: str, pairs: Sequence[tuple[int, int]]) -> dict[int, int]:
    """The values of an option by servo; raises RequestError if it names one twice."""
    values: dict[int, int] = {}
    for servo, value in pairs:
        if servo in values:
            raise RequestError(
                f"{typed}: servo {servo} is given twice, with {values[servo]} and with {value}; give it once"
            )
        values[servo] = value
    return values


def _add_mechanics(emulator: Emulator, joints: Sequence[str], cables: Mapping[int, int]) -> None:
    from ibrobot_feetech.emulator.mechanics import mechanics_of

    for cable in cables:
        if not 1 <= cable <= len(joints):
            raise RequestError(f"--cable: servo {cable} has no joint of an SO-101; ids are 1 to {len(joints)}")
    for (servo, emulated), joint in zip(emulator.servos.items(), joints, strict=False):
        lower, upper = next(ends for name, ends in SO101.items() if joint.endswith(name))
        emulated.mechanics = mechanics_of(joint, lower, upper, MIDDLE_TICK)
        emulated.mechanics.cable = cables.get(servo)


def _hurry() -> None:
    """Raise the priority, so that the servos answer in time on a busy machine, as real ones do."""
    from ibrobot_core.app import go_real_time

    sys.setswitchinterval(_SWITCH_S)
    for refused in go_real_time(_PRIORITY):
        echo(refused, err=True)


class Hand:
    """A hand that swings the joints of an emulated arm to and fro about their middle, those without torque.

    Args:
        emulator: the arm.
        amplitude: how far to each side [rad].
    """

    def __init__(self, emulator: Emulator, amplitude: float) -> None:
        self._emulator = emulator
        self._amplitude = amplitude * TICKS_PER_RADIAN
        self._angle = 0.0

    def move(self, elapsed_s: float) -> None:
        """Move each joint towards where the hand wants it after `elapsed_s` [s], no faster than a hand."""
        self._angle += 2 * math.pi * elapsed_s / _SWING_S
        farthest = _HAND * TICKS_PER_RADIAN * elapsed_s
        with self._emulator.lock:
            for number, servo in self._emulator.servos.items():
                wanted = MIDDLE_TICK + self._amplitude * math.sin(self._angle - number)  # one joint after the other
                if not servo.torque:
                    servo.turn(servo.encoder + max(-farthest, min(farthest, wanted - servo.encoder)))


def _wait(ended: threading.Event, arm: PhysicsArm | None, hand: Hand | None) -> None:
    announced = False
    while not ended.wait(_STEP_S):
        if hand is not None:
            hand.move(_STEP_S)
        if arm is not None:
            if arm.error is not None:
                return
            if arm.success and not announced:
                announced = True
                echo("success: the task of the scene is done")


def _config(name: str) -> RobotConfig:
    from ibrobot_core.app import find_config, installed_plugins, load_config

    registry = installed_plugins()
    return load_config(find_config(name, registry), sim=True, registry=registry)


def _physics(config: RobotConfig, calibration: Calibration, emulator: Emulator, seed: int) -> PhysicsArm:
    from ibrobot_core.app import installed_plugins
    from ibrobot_feetech.emulator.physics import PhysicsArm

    robot = config.robot
    closed = {joint.name: joint.lower for joint in robot.joints if joint.name == _GRIPPER}
    socket = Path(f"{emulator.link or emulator.port.replace('/dev/pts/', '/tmp/ibrobot-emulator-')}.signals")
    try:
        arm = PhysicsArm(
            config, installed_plugins(), Arm(robot.joint_names, calibration, closed), emulator, socket, seed
        )
    except OSError as error:
        raise RequestError(f"--link: cannot create a socket at {socket}: {error}") from None
    echo(f"signals on {socket}")
    return arm


def _calibrate(emulator: Emulator, name: str | None, joints: Sequence[str], robot: Robot | None) -> Calibration | None:
    """Write a calibration to the servos; returns None if no name is given."""
    if name is None and robot is None:
        return None
    if name is not None and calibration_path(name).exists():
        calibration = load_calibration(name, joints)
    else:
        date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        calibration = Calibration(_ranges(joints, robot), robot=name or "emulated", date=date)
        if name is not None:
            echo(f"calibration saved in {save_calibration(calibration, name)}", err=True)
    with emulator.lock:
        for joint in calibration.joints.values():
            for register, value in calibrated_registers(joint).items():
                emulator.servos[joint.id].set(register, value)
    return calibration


def _ranges(joints: Sequence[str], robot: Robot | None) -> dict[str, JointCalibration]:
    """Ranges that match the joints' limits, centred on the turn; those of an SO-101 if no robot is given."""
    limits = {joint.name: (joint.lower, joint.upper) for joint in robot.joints} if robot is not None else {}
    ranges = {}
    for number, joint in enumerate(joints, 1):
        lower, upper = limits.get(joint) or next(ends for name, ends in SO101.items() if joint.endswith(name))
        if joint.endswith(_GRIPPER):  # anchored at its closed end, but centred on the turn as well
            half = (upper - lower) / 2
            lower, upper = -half, half
        low = math.floor(MIDDLE_TICK + lower * TICKS_PER_RADIAN)
        high = math.ceil(MIDDLE_TICK + upper * TICKS_PER_RADIAN)
        ranges[joint] = JointCalibration(number, 0, 0, max(0, low), min(TICKS_PER_TURN - 1, high))
    return ranges
