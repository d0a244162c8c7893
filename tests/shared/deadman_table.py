"""Devices times events: how long the arm moves after an event, and whether it moves again by the same press.

Each cell is a run of the simulated arm in lockstep, with the device emulated at its reports: HID reports, replies of
servos, a serial port, bytes of a terminal, messages of pages, twists. A person presses the deadman and moves the arm;
the event happens, and the person keeps the deadman pressed for 3 s. A cell shows the time from the last report until
the command rests [ms], and how far the command moved afterwards [mrad]. At the end a new press must move the arm.
A cell is good if no motion lasts longer than 0.3 s, and the arm does not move again without a new press.
"""

from __future__ import annotations

import json
import queue
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import override

import attrs
import numpy as np
import pytest
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_feetech.calibration import save_calibration
from ibrobot_terminal.key_reader import decode as keys_of
from ibrobot_web import commands as page_commands
from ibrobot_web.messages import Sent, from_page, from_server, to_run
from ibrobot_webxr.messages import Hands, decode
from ibrobot_webxr.options import WebxrOptions
from ibrobot_webxr.shared import close_page, open_page
from plugin_tests import of_tests
from takeovers import CONFIG, JOINTS

from ibrobot_core.api import Context, Header, Twist, TwistStamped, Vector3
from ibrobot_core.config import load_config
from ibrobot_core.control.commands import EmergencyStop, RaiseFault
from ibrobot_core.errors import IbrobotError
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.plugins import installed_plugins

LIMIT_S = 0.3
_STILL = 2e-5
"""Change of a command per tick that counts as rest [rad]."""


class Person(ABC):
    """A person with a device. `hold` and `rest` are one tick with the deadman pressed, and released."""

    device: str
    """The device in the YAML."""
    faults = False
    """Whether the loss of the device is a fault, which needs a reset."""
    absent: tuple[str, ...] = ()
    """Events that the device cannot have."""
    presses = 1
    """Presses of which the last one moves the arm; two if the first one only tells the state of the buttons."""

    def __init__(self) -> None:
        self.typed: list[queue.SimpleQueue[str]] = []
        self._down: dict[int, str] = {}

    def subscribe(self) -> queue.SimpleQueue[str]:
        """A new queue of the keys of the terminal."""
        self.typed.append(queue.SimpleQueue())
        return self.typed[-1]

    def type(self, typed: bytes) -> None:
        """Have the terminal send bytes."""
        for key in keys_of(typed, final=True, down=self._down)[0]:
            for each in self.typed:
                each.put(key)

    def meet(self, runtime: Runtime) -> None:
        """Take up the device once the run has started."""

    def press(self) -> None:
        """Begin a new press of the deadman."""

    def release(self) -> None:
        """End the press."""

    @abstractmethod
    def hold(self, *, arrives: bool = True) -> None:
        """One tick with the deadman pressed; the robot should move. `arrives`: whether the device's report does."""

    @abstractmethod
    def rest(self) -> None:
        """One tick with the deadman released."""

    def freeze(self) -> None:
        """Have the device send nothing more; by default that takes nothing."""

    def unplug(self) -> None:
        """Remove the device."""

    def replug(self) -> None:
        """Bring it back."""

    def close(self) -> None:
        """Put the device away."""


class _Hid(Person):
    """A device of hidapi, replaced by a fake."""

    ids: tuple[int, int]
    usage = 0x05

    def __init__(self) -> None:
        super().__init__()
        self.fake = of_tests("ibrobot-plugin-gamepad", "fake_hid")
        self._bus = self.fake.FakeHidapi()
        self._patches = pytest.MonkeyPatch()
        for name in ("hidraw", "hid"):
            self._patches.setitem(sys.modules, name, self._bus)
        self.pad = self._bus.plug(self.fake.Plugged(*self.ids, usage=self.usage))

    @abstractmethod
    def reports(self, held: bool) -> tuple[bytes, ...]:
        """The reports of one tick."""

    @override
    def hold(self, *, arrives: bool = True) -> None:
        if arrives and self.pad.present:
            self.pad.send(*self.reports(True))

    @override
    def rest(self) -> None:
        if self.pad.present:
            self.pad.send(*self.reports(False))

    @override
    def unplug(self) -> None:
        self._bus.unplug(self.pad)

    @override
    def replug(self) -> None:
        self._bus.plug(self.pad)

    @override
    def close(self) -> None:
        self._patches.undo()


class DualSense(_Hid):
    """A pad that sends all the time."""

    device = "{type: gamepad, via: hid, cartesian: false}"
    ids = (0x054C, 0x0CE6)
    absent: tuple[str, ...] = ("key repeat", "network cut")

    @override
    def reports(self, held: bool) -> tuple[bytes, ...]:
        return (self.fake.dualsense(*["left_shoulder"] * held, left=(0.8 * held, 0)),)


class Xbox(_Hid):
    """A pad on Bluetooth, which sends only changes; here the stick trembles."""

    device = "{type: gamepad, via: hid, cartesian: false}"
    ids = (0x045E, 0x0B13)
    absent: tuple[str, ...] = ("key repeat", "network cut")

    @override
    def reports(self, held: bool) -> tuple[bytes, ...]:
        left_x = (32768 + 26000 * held).to_bytes(2, "little")
        rest = bytes.fromhex("0080" * 3 + "0000" * 2 + "00")
        return (b"\x01" + left_x + rest + bytes([0x40 * held, 0, 0]),)


class SpaceMouse(_Hid):
    """A cap with a button: reports of the cap while it is deflected, of the button when it changes."""

    device = "{type: spacemouse, cartesian: false, start: joints}"
    ids = (0x256F, 0xC635)
    usage = 0x08
    presses = 2
    absent: tuple[str, ...] = ("key repeat", "network cut")

    def __init__(self) -> None:
        super().__init__()
        self._was: bool | None = None

    @override
    def reports(self, held: bool) -> tuple[bytes, ...]:
        button = (self.fake.mouse_buttons(*[0] * held),) if held != self._was else ()
        self._was = held
        return (*button, self.fake.spacemouse(yaw=0.8)) if held else button

    @override
    def replug(self) -> None:
        super().replug()
        self._was = False  # the first report has the button


class Keyboard(Person):
    """Keys of a terminal that reports no releases: a held key repeats after 0.4 s, every 30 ms."""

    device = "{type: keyboard, cartesian: false}"
    key = b"w"
    absent: tuple[str, ...] = ("key repeat",)

    def __init__(self) -> None:
        super().__init__()
        self._ticks = 0

    @override
    def press(self) -> None:
        self._ticks = 0

    @override
    def hold(self, *, arrives: bool = True) -> None:
        if arrives and (self._ticks == 0 or (self._ticks >= 40 and self._ticks % 3 == 1)):
            self.type(self.key)
        self._ticks += 1

    @override
    def rest(self) -> None:
        pass


class KittyKeyboard(Keyboard):
    """Keys of a terminal with kitty's protocol, which reports repeats and releases."""

    @override
    def hold(self, *, arrives: bool = True) -> None:
        if arrives and (self._ticks == 0 or (self._ticks >= 40 and self._ticks % 3 == 1)):
            self.type(b"\x1b[119;1:%d;119u" % (1 if self._ticks == 0 else 2))
        self._ticks += 1

    @override
    def release(self) -> None:
        self.type(b"\x1b[119;1:3u")


class _Leader(Keyboard):
    """An emulated leader arm; space is its deadman."""

    key = b" "
    faults = True
    absent: tuple[str, ...] = ("network cut",)
    deadman = ""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        joints = {joint: JointCalibration(i + 1, 0, 0, 700, 3400) for i, joint in enumerate(JOINTS)}
        line = of_tests("ibrobot-plugin-feetech", "line")
        self._patches = pytest.MonkeyPatch()
        line.lay(self._patches)
        self._line, self._emulator = line.Line, line.Line(6)
        for servo in self._emulator.servos.values():
            servo.set("min_position_limit", 700)
            servo.set("max_position_limit", 3400)
        self._emulator.start()
        path = save_calibration(Calibration(joints), folder / "leader.json")
        self.device = (
            f"{{type: so101_leader, port: {self._emulator.port}, calibration: {path}, deadman: {self.deadman}}}"
        )
        self._way = 4.0

    @override
    def hold(self, *, arrives: bool = True) -> None:
        super().hold()  # the keyboard works, whatever the leader does
        self._turn()
        self._silence(not arrives)

    @override
    def rest(self) -> None:
        self._turn()

    def tick(self) -> None:
        """Time passes."""
        self._line.now_s += 0.01

    def place(self, value: float) -> None:
        """Have the first servo say that it is far away, on the side of a number's sign."""
        with self._emulator.lock:
            self._emulator.servos[1].turn(3300 if value > 0 else 800)

    def _turn(self) -> None:
        """The hand moves the leader on, to and fro."""
        self.tick()
        with self._emulator.lock:
            servo = self._emulator.servos[1]
            if not 1500 < servo.encoder + self._way < 2600:
                self._way = -self._way
            servo.turn(servo.encoder + self._way)

    def _silence(self, silent: bool) -> None:
        self._emulator.faults.silent.clear()
        if silent:
            self._emulator.faults.silent.update(self._emulator.servos)

    @override
    def freeze(self) -> None:
        self._silence(True)

    unplug = freeze

    @override
    def replug(self) -> None:
        self._silence(False)

    @override
    def close(self) -> None:
        self._emulator.stop()
        self._patches.undo()


class LeaderHold(_Leader):
    """`deadman: hold`."""

    deadman = "hold"
    absent: tuple[str, ...] = ("key repeat", "network cut")


class LeaderToggle(_Leader):
    """`deadman: toggle`: one press starts, the next one pauses."""

    deadman = "toggle"

    @override
    def meet(self, runtime: Runtime) -> None:
        self._source = runtime.session.command_source

    @override
    def hold(self, *, arrives: bool = True) -> None:
        if self._ticks == 0:
            self.type(self.key)
        self._ticks += 1
        self._turn()
        self._silence(not arrives)

    @override
    def release(self) -> None:
        if self._source.help().startswith("following"):
            self.type(self.key)


class Imu(Keyboard):
    """A sensor at a serial port, and a held key."""

    key = b" "
    faults = True
    absent: tuple[str, ...] = ("unplug", "replug", "key repeat", "network cut")

    def __init__(self) -> None:
        super().__init__()
        self._sensor = of_tests("ibrobot-plugin-imu", "sensor").Sensor("bno08x").__enter__()
        self.device = f"{{type: imu, model: bno08x, port: {self._sensor.port}}}"

    @override
    def hold(self, *, arrives: bool = True) -> None:
        super().hold()
        if arrives:
            self._sensor.turn(pitch=0.4 * (self._ticks > 45))

    @override
    def rest(self) -> None:
        self._sensor.turn()

    @override
    def close(self) -> None:
        self._sensor.unplug()


class Headset(Person):
    """A controller of a headset, whose poses arrive at the page's server."""

    device = "{type: webxr, port: 0}"
    absent: tuple[str, ...] = ("key repeat",)

    def __init__(self) -> None:
        super().__init__()
        self._sent, self._at, self._way = 0, 0.0, 0.002

    @override
    def meet(self, runtime: Runtime) -> None:
        session = runtime.session
        self._ctx = Context("hand", session.clock, session.log, session.config.robot, bus=session.bus)
        self._exchange = open_page(WebxrOptions(port=0), self._ctx).exchange

    def _send(self, clutch: bool) -> None:
        if abs(self._at + self._way) > 0.1:
            self._way = -self._way
        self._at += self._way
        hand = {"orientation": [0, 0, 0, 1], "clutch": clutch, "gripper": None, "open": 0, **self._pose()}
        message = {"type": "hands", "n": self._sent, "t": 0.01 * self._sent, "heading": 0, "hands": {"right": hand}}
        hands = decode(json.dumps(message))
        assert isinstance(hands, Hands)
        self._exchange.put(hands, 0.0)

    def _pose(self) -> dict[str, object]:
        return {"position": [0, 1.0 + self._at, 0], "move": [0, 0, 0]}

    @override
    def hold(self, *, arrives: bool = True) -> None:
        self._sent += 1
        if arrives:
            self._send(True)

    @override
    def rest(self) -> None:
        self._sent += 1
        self._send(False)

    @override
    def close(self) -> None:
        if self._sent:
            close_page(WebxrOptions(port=0), self._ctx)


class Phone(Headset):
    """A phone without positions of its own, whose sticks move the tool."""

    @override
    def _pose(self) -> dict[str, object]:
        return {"position": None, "move": [0, 0.5 if self._way > 0 else -0.5, 0]}


class Page(Person):
    """A page in a browser, whose messages pass through the checks of its server and of the run."""

    device = "{type: web}"
    absent: tuple[str, ...] = ("key repeat",)
    """Browsers say which key events are repeats, and the page passes over these; its own tests have that."""

    def __init__(self) -> None:
        super().__init__()
        self._ticks, self._press_ms = 0, 0
        self._patches = pytest.MonkeyPatch()
        self._commands: page_commands.Commands | None = None

    @override
    def meet(self, runtime: Runtime) -> None:
        session = runtime.session
        self._now_ns = session.clock.now_ns
        self._patches.setattr(page_commands, "clock_ns", session.clock.now_ns)
        failed: list[Exception] = []
        self._commands = page_commands.Commands(session, session.finish, lambda reply: None, failed.append)

    def _send(self, do: str, **facts: object) -> None:
        sent = to_run(from_page(json.dumps({"do": do, **facts})))  # type: ignore[arg-type]
        command = from_server(json.loads(json.dumps(sent)))
        assert isinstance(command, Sent)
        assert self._commands is not None
        self._commands.take(command)

    @override
    def press(self) -> None:
        self._press_ms = self._now_ns() // 1_000_000

    @override
    def hold(self, *, arrives: bool = True) -> None:
        self._ticks += 1
        if arrives and self._ticks % 4 == 0:
            speed = 0.5 if self._ticks // 60 % 2 else -0.5
            at = self._now_ns() // 1_000_000
            self._send("jog", at=at, press=self._press_ms, joints={"shoulder_pan": speed})

    @override
    def release(self) -> None:
        self._send("release", at=self._now_ns() // 1_000_000)

    @override
    def rest(self) -> None:
        pass

    @override
    def unplug(self) -> None:
        self._send("release")  # its server does, when the connection is gone

    @override
    def close(self) -> None:
        self._patches.undo()
        if self._commands is not None:
            self._commands.close(1.0)


class Twists(Person):
    """A program that sends twists with the time in their headers."""

    device = "{type: twist}"
    absent: tuple[str, ...] = ("key repeat", "unplug", "replug", "thaw")
    """A pause of 0.5 s counts as the release: whoever sends again after a gap asks for motion anew."""

    @override
    def meet(self, runtime: Runtime) -> None:
        self._session, self._ticks = runtime.session, 0

    def _send(self, speed: float) -> None:
        stamp_ns = self._session.clock.now_ns()
        sent = TwistStamped(Header(stamp_ns), Twist(Vector3(0.0, 0.0, speed), Vector3(0.0, 0.0, 0.0)))
        self._session.bus.publish("/servo_node/delta_twist_cmds", sent)

    @override
    def hold(self, *, arrives: bool = True) -> None:
        self._ticks += 1
        if arrives:
            self._send(0.1 if self._ticks // 60 % 2 else -0.1)

    @override
    def rest(self) -> None:
        self._send(0.0)


PERSONS: dict[str, Callable[[Path], Person]] = {
    "DualSense": lambda folder: DualSense(),
    "Xbox on Bluetooth": lambda folder: Xbox(),
    "SpaceMouse": lambda folder: SpaceMouse(),
    "keyboard": lambda folder: Keyboard(),
    "keyboard, kitty": lambda folder: KittyKeyboard(),
    "leader, hold": LeaderHold,
    "leader, toggle": LeaderToggle,
    "IMU": lambda folder: Imu(),
    "page": lambda folder: Page(),
    "headset": lambda folder: Headset(),
    "phone": lambda folder: Phone(),
    "twists": lambda folder: Twists(),
}


@attrs.define
class Trial:
    """A run, a person, and the commands at each tick."""

    runtime: Runtime
    person: Person
    commands: list[np.ndarray] = attrs.field(factory=list)

    def ticks(self, count: int, act: Callable[[], None] = lambda: None) -> None:
        """Let time pass, with an act of the person before each tick."""
        for _ in range(count):
            act()
            if self.runtime.step():
                self.runtime.raise_failure()
                raise SystemExit("the run ended early")
            state = self.runtime.session.state
            assert state is not None
            self.commands.append(state.command.copy())

    def hold(self, count: int, *, arrives: bool = True) -> None:
        """The person keeps the deadman pressed."""
        self.ticks(count, lambda: self.person.hold(arrives=arrives))

    def release(self) -> None:
        """The person lets go of the deadman for a while."""
        self.person.release()
        self.ticks(60, self.person.rest)

    def moves(self) -> bool:
        """Whether a release ends all motion, and a new press of the deadman moves the arm."""
        self.release()
        if np.ptp(self.commands[-10:], axis=0).max() > 1e-3:
            return False
        for _ in range(self.person.presses - 1):
            self.person.press()
            self.hold(5)
            self.release()
        before = len(self.commands)
        self.person.press()
        self.hold(120)
        return bool(np.ptp(self.commands[before:], axis=0).max() > 0.02)

    def reset(self) -> None:
        """Reset until it succeeds."""
        for _ in range(50):
            try:
                self.runtime.reset()
            except IbrobotError:
                self.hold(5)
                continue
            return


def unplug(trial: Trial) -> None:
    """The device goes, and does not come back while the person holds on."""
    trial.person.unplug()
    trial.hold(100, arrives=False)
    trial.person.replug()
    if trial.person.faults:
        trial.reset()


def replug(trial: Trial) -> None:
    """The device goes for a second."""
    unplug(trial)
    trial.hold(200)


def freeze(trial: Trial) -> None:
    """The device sends nothing for 3 s."""
    trial.hold(300, arrives=False)
    if trial.person.faults:
        trial.person.replug()
        trial.reset()


def thaw(trial: Trial) -> None:
    """The device sends nothing for 2 s, and then everything at once and goes on."""
    trial.hold(200, arrives=False)
    for _ in range(60):
        trial.person.hold()
    trial.hold(200)
    if trial.person.faults:
        trial.reset()
        trial.hold(100)


def stop(trial: Trial) -> None:
    """An emergency stop, and a reset."""
    trial.runtime.session.control.call(EmergencyStop())
    trial.hold(50)
    trial.reset()
    trial.hold(250)


def fault(trial: Trial) -> None:
    """A fault of another part, and a reset."""
    trial.runtime.session.control.call(RaiseFault(fault="a joint does not answer"))
    trial.hold(50)
    trial.reset()
    trial.hold(250)


def switch(trial: Trial) -> None:
    """To another mode and back."""
    trial.runtime.switch_mode("moveit_planning")
    trial.hold(20)
    trial.runtime.switch_mode("teleop")
    trial.hold(280)


def repeat(trial: Trial) -> None:
    """The key of the deadman stays pressed and repeats; for `toggle`, it would start and pause again and again."""
    trial.ticks(300, lambda: Keyboard.hold(trial.person))  # type: ignore[arg-type]


def pause(trial: Trial) -> None:
    """The host stands still for 2 s; reports wait, and the person holds on."""
    source = trial.runtime.plan.mode.source
    work = source.work  # type: ignore[attr-defined]
    source.work = lambda timeout_s: None  # type: ignore[attr-defined]
    trial.hold(200)
    source.work = work  # type: ignore[attr-defined]
    trial.hold(200)


def cut(trial: Trial) -> None:
    """The network is gone for 0.4 s."""
    trial.hold(40, arrives=False)
    trial.hold(260)


EVENTS: dict[str, Callable[[Trial], None]] = {
    "unplug": unplug,
    "replug": replug,
    "freeze": freeze,
    "thaw": thaw,
    "stop": stop,
    "fault": fault,
    "mode switch": switch,
    "key repeat": repeat,
    "host paused": pause,
    "network cut": cut,
}


@attrs.frozen
class Cell:
    """What happened after an event."""

    hold_s: float
    """Time from the event until the command rests [s]."""
    after_rad: float
    """The way of the command after that, by the same press [rad]."""
    new_press: bool
    """Whether a release of the deadman left the arm still, and a new press moved it."""

    @property
    def good(self) -> bool:
        """Whether nothing moved without a new press, and the arm held in time."""
        return self.hold_s <= LIMIT_S and self.after_rad < 2e-3 and self.new_press

    def __str__(self) -> str:
        return f"{1e3 * self.hold_s:.0f} ms, {1e3 * self.after_rad:.1f} mrad" + ("" if self.new_press else ", dead")


def measure(device: str, event: str, folder: Path) -> Cell | None:
    """A cell of the table; None for an event that the device cannot have."""
    person = PERSONS[device](folder)
    try:
        if event in person.absent:
            return None
        return _measure(person, event)
    finally:
        person.close()


def _measure(person: Person, event: str) -> Cell:
    overrides = [f"teleoperation.it={person.device}", "control_modes.teleop.teleop=it"]
    registry = installed_plugins()
    config = load_config(CONFIG, sim=True, mode="teleop", overrides=overrides, registry=registry)
    runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, keys=person.subscribe)))
    runtime.start()
    try:
        person.meet(runtime)
        trial = Trial(runtime, person)
        trial.ticks(80, person.rest)
        assert trial.moves(), "the device does not move the arm"
        begun = len(trial.commands)
        assert np.ptp(trial.commands[-20:], axis=0).max() > 0.01, "the arm does not move when the event happens"
        EVENTS[event](trial)
        steps = np.abs(np.diff(trial.commands[begun - 1 :], axis=0)).max(axis=1)
        period_s = 1.0 / config.control.rate_hz
        quiet = [i for i in range(len(steps)) if not (steps[i : i + 10] > _STILL).any()]
        held = quiet[0] if quiet else len(steps)
        after = np.array(trial.commands[begun + held :])
        way = float(np.ptp(after, axis=0).max()) if len(after) else 0.0
        return Cell(held * period_s, way, trial.moves())
    finally:
        runtime.stop()
