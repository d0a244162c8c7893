"""Random takeovers and handbacks by a gamepad, a leader arm and the keyboard: steps, lost frames, labels, parity.

The simulated SO-101 follows a policy that moves all joints, in lockstep. At random times a scripted person takes it
with the device, moves it, lets go of the deadman now and then, and gives it back. The gamepad is a DualSense whose
reports come from a fake of hidapi, the leader consists of emulated servos, which its motors drive before each
takeover, and the keyboard is a queue of keys. The run is recorded, and converted to a dataset.

`is_good` holds if every velocity and acceleration of the commands is within the limits, nothing is lost, who commands
is labelled at every state as the person acted, the frames from the recording equal those of the run bit by bit, the
column `intervention` is true in exactly the rows that the person commanded, and `--only interventions` gives each
takeover as an episode.
"""

from __future__ import annotations

import math
import queue
import random
import sys
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_data.commanders import Commanders
from ibrobot_data.episode import DATASET, Job, convert_episode
from ibrobot_data.request import ConversionRequest
from ibrobot_data.ticks import Ticks, frames
from ibrobot_feetech.calibration import save_calibration
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_provenance.recorded_names import HANDOVER, OPERATOR, POLICY
from ibrobot_webxr.messages import HandPose, Hands
from ibrobot_webxr.options import WebxrOptions
from ibrobot_webxr.shared import close_page, open_page
from plugin_tests import ROOT, of_tests

from ibrobot_core.api import Context
from ibrobot_core.config import load_config
from ibrobot_core.contract.frames import FrameAssembler, FrameSampler
from ibrobot_core.contract.specs import Contract
from ibrobot_core.interfaces import Frame
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.plugins import installed_plugins

CONFIG = ROOT / "configs" / "so101_blind.yaml"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
RADIAN = 4096 / (2 * math.pi)
"""Ticks."""
SLACK = 1.001
_KEYS = "wsedrftgyhoc"
"""Pairs of keys that jog a joint up and down."""
_AWAY_RAD, _AWAY_TICKS, _ACTS = 0.2, 100, 25
"""A joint that is away from its setpoint for that long is blocked, and the person acts on it again and again [ticks].
After twice as long it would be a fault."""
_FIRST = 5
"""Ticks before the first compared frame: the recording begins during the first one."""
WANDER = """
import numpy as np
from ibrobot_core.api import Policy, PolicyDescriptor, PolicySpec, hookimpl

class Wander(Policy):
    def __init__(self, options, ctx):
        names = ctx.robot.joint_names
        self.spec = PolicySpec({"observation.state": (len(names),)}, names, len(names), chunk_size=30)
        self._middle = np.array([0.0, -0.3, 0.3, 0.2, 0.0, 0.6])

    def preprocess(self, frame):
        return {"t": np.array([frame.stamp_ns])}

    def infer(self, tensors):
        return tensors

    def postprocess(self, tensors):
        times = tensors["t"][0] * 1e-9 + np.arange(30) / 30
        return self._middle + 0.3 * np.sin(times[:, None] * np.linspace(1.0, 2.0, len(self._middle)))

@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor("wander", Wander, "moves all joints to and fro")
"""


class Person(ABC):
    """A person with a device. Each act counts at the next tick."""

    device: str
    """The device in the YAML."""

    @abstractmethod
    def toggle(self) -> None:
        """Take the robot, or give it back."""

    @abstractmethod
    def engage(self) -> None:
        """Press the deadman."""

    @abstractmethod
    def release(self) -> None:
        """Let go of the deadman."""

    def tick(self, rng: random.Random) -> None:
        """Move the robot, while the deadman is pressed."""

    def turn_back(self, joint: int, ahead: bool) -> None:
        """Move a blocked joint back, whose setpoint is `ahead` of it, or behind it."""

    def waits(self) -> bool:
        """Whether the device is not ready after a takeover."""
        return False

    def meet(self, runtime: Runtime) -> None:
        """Take up the device once the run has started."""

    def close(self) -> None:
        """Put the device away."""


class WithPad(Person):
    """A DualSense."""

    device = "{type: gamepad, via: hid, cartesian: false}"

    def __init__(self) -> None:
        self._hid = of_tests("ibrobot-plugin-gamepad", "fake_hid")
        self._bus = self._hid.FakeHidapi()
        self._patches = pytest.MonkeyPatch()
        for name in ("hidraw", "hid"):
            self._patches.setitem(sys.modules, name, self._bus)
        self._pad = self._bus.plug(self._hid.Plugged(*self._hid.DUALSENSE))
        self._held: tuple[str, ...] = ()
        self._stick = (0.0, 0.0)
        self.trigger = 0.0
        """How far the left trigger is pulled, 0 to 1; it opens the gripper."""

    @override
    def toggle(self) -> None:
        self._held = ()
        self._pad.send(self._hid.dualsense("left_stick"), self._hid.dualsense())

    @override
    def engage(self) -> None:
        self._held = ("left_shoulder",)

    @override
    def release(self) -> None:
        self._held = ()

    @override
    def tick(self, rng: random.Random) -> None:
        if rng.random() < 0.05:
            self._stick = rng.uniform(-1, 1), rng.uniform(-1, 1)
        self.send(self._held, self._stick)

    def send(self, held: tuple[str, ...], left: tuple[float, float], right: tuple[float, float] = (0.0, 0.0)) -> None:
        """Send a report."""
        triggers = self.trigger, 0.0
        self._pad.send(self._hid.dualsense(*held, left=left, right=right, triggers=triggers))

    @override
    def close(self) -> None:
        self._patches.undo()


class WithKeys(Person):
    """The keyboard."""

    device = "{type: keyboard, cartesian: false}"

    def __init__(self) -> None:
        self.queues: list[queue.SimpleQueue[str]] = []
        self._key = ""

    def subscribe(self) -> queue.SimpleQueue[str]:
        """A new queue of the keys typed from now on."""
        self.queues.append(queue.SimpleQueue())
        return self.queues[-1]

    def type(self, *keys: str) -> None:
        """Type keys, in a terminal that reports releases."""
        for each in self.queues:
            for key in keys:
                each.put(key)

    @override
    def toggle(self) -> None:
        self._key = ""
        self.type("enter")

    @override
    def engage(self) -> None:
        self._key = "w"
        self.type("release:w", "w")

    @override
    def release(self) -> None:
        self.type(f"release:{self._key}")
        self._key = ""

    @override
    def tick(self, rng: random.Random) -> None:
        if self._key:
            if rng.random() < 0.05:
                self._change(rng.choice(_KEYS))
            self.type(f"repeat:{self._key}")

    def _change(self, key: str) -> None:
        self.type(key)
        self._key = key

    @override
    def turn_back(self, joint: int, ahead: bool) -> None:
        if self._key:
            self._change(_KEYS[2 * joint + ahead])


class WithLeader(WithKeys):
    """An emulated leader arm; space is its deadman."""

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
        self.device = f"{{type: so101_leader, port: {self._emulator.port}, calibration: {path}}}"
        self._speeds = np.zeros(6)

    @override
    def engage(self) -> None:
        self._key = "-"
        self.type("release:space", "space")

    @override
    def release(self) -> None:
        self._key = ""
        self.type("space")

    @override
    def tick(self, rng: random.Random) -> None:
        self._line.now_s += 0.01
        if not self._key:
            return
        if rng.random() < 0.05:
            self._speeds = np.array([rng.uniform(-1.0, 1.0) for _ in JOINTS])
        with self._emulator.lock:
            for servo, speed in zip(self._emulator.servos.values(), self._speeds, strict=True):
                if not servo.torque:
                    servo.turn(min(3300.0, max(800.0, servo.encoder + speed * RADIAN * 0.01)))

    @override
    def turn_back(self, joint: int, ahead: bool) -> None:
        self._speeds = -self._speeds

    @override
    def waits(self) -> bool:
        with self._emulator.lock:
            return any(servo.torque for servo in self._emulator.servos.values())

    @override
    def close(self) -> None:
        self._emulator.stop()
        self._patches.undo()


class WithSensor(WithKeys):
    """An orientation sensor in a hand, at a pseudo-terminal; space is its deadman, which a terminal repeats."""

    def __init__(self) -> None:
        super().__init__()
        self._sensor = of_tests("ibrobot-plugin-imu", "sensor").Sensor("bno08x").__enter__()
        self.device = f"{{type: imu, model: bno08x, port: {self._sensor.port}}}"
        self._tilt = {"pitch": 0.0, "yaw": 0.0}

    @override
    def engage(self) -> None:
        self._key = "space"
        self.type("release:space", "space")

    @override
    def tick(self, rng: random.Random) -> None:
        if self._key:
            self.type(f"repeat:{self._key}")
            if rng.random() < 0.05:
                self._tilt = {"pitch": rng.uniform(-0.6, 0.6), "yaw": rng.uniform(-0.6, 0.6)}
        self._sensor.turn(**self._tilt)

    @override
    def turn_back(self, joint: int, ahead: bool) -> None:
        self._tilt = {axis: -tilt for axis, tilt in self._tilt.items()}

    @override
    def close(self) -> None:
        self._sensor.unplug()


class WithHand(Person):
    """A controller of a headset, whose poses arrive at the page's server as those of a browser do."""

    device = "{type: webxr, port: 0}"

    def __init__(self) -> None:
        self._clutch = False
        self._at, self._velocity = np.array([0.0, 1.0, 0.0]), np.zeros(3)
        self._sent = 0

    @override
    def meet(self, runtime: Runtime) -> None:
        session = runtime.session
        self._ctx = Context("hand", session.clock, session.log, session.config.robot, bus=session.bus)
        self._exchange = open_page(self._options, self._ctx).exchange

    @override
    def toggle(self) -> None:
        self._clutch = False
        self._exchange.press("intervention")

    @override
    def engage(self) -> None:
        self._clutch = True

    @override
    def release(self) -> None:
        self._clutch = False

    @override
    def tick(self, rng: random.Random) -> None:
        if rng.random() < 0.05:
            self._velocity = np.array([rng.uniform(-0.3, 0.3) for _ in range(3)])
        self._at = np.clip(self._at + 0.01 * self._velocity, (-0.2, 0.8, -0.2), (0.2, 1.2, 0.2))
        self.send(HandPose((0.0, 0.0, 0.0, 1.0), tuple(self._at.tolist()), self._clutch))

    @override
    def turn_back(self, joint: int, ahead: bool) -> None:
        self._velocity = -self._velocity

    def send(self, pose: HandPose) -> None:
        """Send a pose, 10 ms after the last one by the page's clock."""
        self._sent += 1
        self._exchange.put(Hands(self._sent, 0.01 * self._sent, 0.0, {"right": pose}), 0.0)

    @override
    def close(self) -> None:
        close_page(self._options, self._ctx)

    _options = WebxrOptions(port=0)


PERSONS: dict[str, Callable[[Path], Person]] = {
    "gamepad": lambda folder: WithPad(),
    "leader": WithLeader,
    "keyboard": lambda folder: WithKeys(),
    "webxr": lambda folder: WithHand(),
    "imu": lambda folder: WithSensor(),
}


@attrs.define(slots=False)
class Trial:
    """A run, and what happened in it at each tick."""

    runtime: Runtime
    person: Person
    rng: random.Random
    commands: list[Any] = attrs.field(factory=list)
    stamps: list[int] = attrs.field(factory=list)
    labels: list[str] = attrs.field(factory=list)
    expected: list[str] = attrs.field(factory=list)
    seen: list[Frame] = attrs.field(factory=list)
    who: str = POLICY
    """Who should command from the next tick on."""
    away: int = 0
    """For how many ticks a joint has been away from its setpoint."""

    def __attrs_post_init__(self) -> None:
        session = self.runtime.session
        self._words = session.bus.subscribe("/commander", 1000)
        self._words.drain()  # that of the start
        contract = Contract.from_config(session.config)
        self._sampler = FrameSampler(contract, session.bus)
        self._step_ns, self._next_ns = contract.step_ns, 0

    def tick(self, then: str | None = None) -> str:
        """One tick; from the next one on, `then` should command. Returns who commanded."""
        self.person.tick(self.rng)
        if self.runtime.step():
            self.runtime.raise_failure()
            raise SystemExit("the run ended early")
        session = self.runtime.session
        state = session.state
        assert state is not None
        if session.faults:
            raise SystemExit(f"fault: {'; '.join(session.faults)}")
        (word,) = (str(item.message.data) for item in self._words.drain())  # type: ignore[attr-defined]
        self.commands.append(state.command)
        self.stamps.append(state.stamp_ns)
        self.labels.append(word)
        self.expected.append(self.who)
        self.who = then or self.who
        now_ns = session.clock.now_ns()
        if len(self.commands) >= _FIRST and now_ns >= self._next_ns:
            self.seen.append(self._sampler.sample(now_ns))
            self._next_ns = now_ns + self._step_ns
        self.look()
        return word

    def look(self) -> None:
        """Let the person see whether something blocks the robot."""
        state = self.runtime.session.state
        assert state is not None
        lead = state.command - state.position
        joint = int(np.abs(lead).argmax())
        self.away = self.away + 1 if abs(lead[joint]) > _AWAY_RAD else 0
        if self.away >= _AWAY_TICKS and self.away % _ACTS == 0:
            self.person.turn_back(joint, bool(lead[joint] > 0))

    def wait(self, least_s: float, most_s: float) -> None:
        """Let a random time pass."""
        for _ in range(round(100 * self.rng.uniform(least_s, most_s))):
            self.tick()

    def until(self, condition: Callable[[], bool]) -> None:
        """Let time pass until something has happened, for at most ten seconds."""
        for _ in range(1000):
            if condition():
                return
            self.tick()
        raise SystemExit("it did not happen within 10 s")

    def takeover(self) -> None:
        """Take the robot, move it, and give it back."""
        self.wait(0.2, 1.5)
        self.person.toggle()
        self.tick(HANDOVER)
        self.wait(0.6, 0.8)  # the arm brakes
        self.until(lambda: not self.person.waits())
        self.wait(0.05, 0.3)
        self.person.engage()
        self.tick(OPERATOR)
        self.wait(0.2, 1.5)
        while self.rng.random() < 0.3:
            self.person.release()
            self.wait(0.1, 0.5)
            self.person.engage()
            self.wait(0.2, 1.0)
        self.person.toggle()
        self.tick(HANDOVER)
        self.until_given_back()

    def until_given_back(self) -> None:
        """Let time pass until the policy commands."""
        while self.tick() == HANDOVER:
            pass
        self.who = POLICY
        self.expected[-1] = POLICY

    def commanders(self) -> list[tuple[int, str]]:
        """Who should have commanded, from which time on [ns]."""
        return list(zip(self.stamps, self.expected, strict=True))

    def wrong_labels(self) -> int:
        """How many states have another commander than they should."""
        return sum(a != b for a, b in zip(self.labels, self.expected, strict=True))


def measure(name: str, takeovers: int, seed: int) -> dict[str, Any]:
    """All of one device."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        person = PERSONS[name](folder)
        overrides = [
            "models={wander: {type: wander}}",
            "control_modes.model_inference.inference={model: wander, intervene: it}",
            "control_modes.teleop.teleop=it",
            f"teleoperation={{web: {{type: web}}, it: {person.device}}}",
            f"recording={{type: mcap, root: {folder}}}",
            "contract.max_duration_s=100000",
        ]
        keys = person.subscribe if isinstance(person, WithKeys) else None
        config = load_config(CONFIG, overrides=overrides, sim=True)
        runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(lockstep=True, seed=seed, keys=keys)))
        runtime.start()
        try:
            person.meet(runtime)
            trial = Trial(runtime, person, random.Random(seed))
            for _ in range(takeovers):
                trial.takeover()
            trial.wait(0.5, 0.5)
        finally:
            runtime.stop()
            person.close()
        runtime.raise_failure()
        return {"device": name, "takeovers": takeovers, **figures(trial), **converted(trial, folder)}


def figures(trial: Trial) -> dict[str, Any]:
    """Steps, losses and labels of a run."""
    session = trial.runtime.session
    robot = session.config.robot
    velocity = np.diff(trial.commands, axis=0) * 100
    acceleration = np.diff(velocity, axis=0) * 100
    summary = trial.runtime.summary()
    return {
        "ticks": len(trial.commands),
        "velocity_share": round(float((np.abs(velocity) / robot.max_velocity).max()), 3),
        "acceleration_share": round(float((np.abs(acceleration) / robot.max_acceleration).max()), 3),
        "faults": summary["faults"],
        "drops": sum(summary["drops"].values()),
        "wrong_labels": trial.wrong_labels(),
    }


def converted(trial: Trial, folder: Path) -> dict[str, Any]:
    """The recording against the run, and the dataset against both."""
    import pyarrow.parquet as pq

    (episode,) = (folder / "default" / "episodes").iterdir()
    reader = installed_plugins().open_episode(episode)
    contract = Contract.from_config(trial.runtime.session.config)
    messages = [(item.topic, item.message, item.received_ns) for item in reader.messages(set(contract.topics))]
    again = list(frames(FrameAssembler(contract), messages, [frame.stamp_ns for frame in trial.seen]))
    unequal = sum(
        old.missing != new.missing or any(old.values[key].tobytes() != new.values[key].tobytes() for key in old.values)
        for old, new in zip(trial.seen, again, strict=True)
    )
    ticks, wanted = Ticks(reader, contract, "refuse"), []
    commanders = Commanders(reader, reader.summary())
    times, words = zip(*trial.commanders(), strict=True)
    for _ in ticks:
        newest = max(0, int(np.searchsorted(times, ticks.stamp_ns, "right")) - 1)
        wanted.append(words[newest] == OPERATOR)
        assert commanders.at(ticks.stamp_ns) in (POLICY, OPERATOR, HANDOVER)
    lost = sum(each.dropped for each in reader.summary().topics.values())
    reader.close()
    request = ConversionRequest(folder / "dataset", LeRobotOptions(), "lerobot", labels=True)
    report = convert_episode(Job(request, episode, "run", folder / "unit"), lambda frames: None)
    assert not report.error, report.error
    parts = attrs.evolve(request, only="interventions", context=0.0)
    corrections = convert_episode(Job(parts, episode, "run", folder / "parts"), lambda frames: None)
    (table,) = (folder / "unit" / DATASET / "data").rglob("*.parquet")
    got, done = (
        [bool(each[0] if isinstance(each, list) else each) for each in column.to_pylist()]
        for column in pq.read_table(table, columns=["intervention", "next.done"]).columns
    )
    return {
        "lost_messages": lost,
        "frames": len(trial.seen),
        "unequal_frames": unequal,
        "rows": len(got),
        "skipped_rows": report.skipped,
        "intervention_rows": sum(got),
        "corrections": len(corrections.stretches),
        "correction_rows": corrections.frames,
        "wrong_dones": sum(done[:-1]) + (not done[-1]),
        "wrong_interventions": sum(a != b for a, b in zip(got, wanted, strict=True)),
    }


def is_good(found: dict[str, Any]) -> bool:
    """Whether all demands are met."""
    none = (
        "drops",
        "wrong_labels",
        "lost_messages",
        "unequal_frames",
        "skipped_rows",
        "wrong_interventions",
        "wrong_dones",
    )
    whole = (found["corrections"], found["correction_rows"]) == (found["takeovers"], found["intervention_rows"])
    steps = max(found["velocity_share"], found["acceleration_share"])
    return whole and not found["faults"] and steps <= SLACK and all(found[name] == 0 for name in none)
