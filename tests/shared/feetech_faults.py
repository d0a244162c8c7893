"""Teleoperation over two emulated servo buses on which everything fails in turn, for ten minutes.

    python tests/shared/feetech_faults.py

A person moves the leader; the real leader device, control core, safety layer and driver work in stepped time at 100 Hz
on real pseudo-terminals. On both buses one byte in a hundred is damaged, and replies are lost and late, all the time.
Into this come, in random order, a blocked joint, overload of an arm joint and of the gripper, brown-out of a servo and
of all, a servo without its cable, and either arm unplugged. After a fault an operator removes its cause, resets,
waits, and presses space. Prints what happened, and exits with 1 when

- a setpoint was beyond the limits, or further from the measured position than `max_lead`;
- a fault was not named with its joint or port, or the gripper's overload ended the run;
- a reset left a servo without torque, or a joint moved between a fault and the operator's next press of space.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import queue
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_feetech import bus
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import Emulator
from numpy.typing import NDArray

from ibrobot_core.clock import SteppedClock
from ibrobot_core.config import RobotConfig, from_document
from ibrobot_core.control.commands import ClearFaults, RaiseFault
from ibrobot_core.control.core import ControlCore
from ibrobot_core.errors import TeleopError
from ibrobot_core.interfaces import Context, JointReading, Teleop
from ibrobot_core.interfaces.run_state import PlanRecord
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.units import NS_PER_S

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
GRIPPER = 6
RADIAN = 4096 / (2 * math.pi)
"""Ticks."""
LIMIT, SPEED = 1.5, 3.0
"""Of every joint [rad, rad/s]."""
RANGE = 1000, 3100
"""Calibrated, of every servo [ticks]."""
NAMED_S = 15.0
"""In which a fault must be named: a slow hand takes 10 s to go to and fro, servos and control 2 s to see a block."""
SETTLE_S = 0.5
"""After a fault, until the joints stand."""
STILL_RAD = 0.02
"""How far a joint that stands may move."""
_SWITCH_S = 2e-4
"""For how long one thread may keep the others from answering [s]."""
_START_PATIENCE_S = 0.5
"""With replies while lines are good, in addition to their time on the wire [s]."""
_WRITTEN_S = 1e-3
"""Real time for the emulator to take a goal in, while no tick waits for replies [s]."""
UNSEEN_S = 0.06
"""For which a joint may have moved on since its last good reply: the driver rides out three lost ones."""


@attrs.frozen
class Incident:
    """What goes wrong, and what must then be said."""

    kind: str
    said: str
    """Pattern of a message that names it."""
    servo: int = 0
    stops: bool = True
    """Whether it is a fault, or only a warning."""


@attrs.define
class Tally:
    """What was seen."""

    incidents: Counter[str] = attrs.field(factory=Counter)
    unnamed: list[str] = attrs.field(factory=list)
    faults: list[str] = attrs.field(factory=list)
    resets: Counter[str] = attrs.field(factory=Counter)
    violations: Counter[str] = attrs.field(factory=Counter)
    examples: list[str] = attrs.field(factory=list)
    worst_lead: float = 0.0
    worst_still: float = 0.0

    def violated(self, what: str, example: str) -> None:
        """Count a violation, and keep the first ones."""
        self.violations[what] += 1
        if self.violations[what] <= 3:
            self.examples.append(f"{what}: {example}")


class Said(logging.Handler):
    """Keeps what is logged."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    @override
    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def document(folder: Path) -> dict[str, Any]:
    """The robot's YAML."""
    limits = {"lower": -LIMIT, "upper": LIMIT, "max_velocity": SPEED, "max_acceleration": 40.0}
    return {
        "robot": {
            "name": "faults",
            "joints": [{"name": name, **limits} for name in JOINTS],
            "groups": {"all": list(JOINTS), "gripper": ["gripper"]},
        },
        "hardware": {
            "type": "feetech_so101",
            "port": str(folder / "follower"),
            "calibration": str(folder / "follower.json"),
            "anchored": [],
        },
        "teleoperation": {
            "leader": {
                "type": "so101_leader",
                "port": str(folder / "leader"),
                "calibration": str(folder / "leader.json"),
                "scaled": [],
                "deadman": "toggle",
            }
        },
        "executors": {"position": {"type": "position", "group": "all"}},
        "control_modes": {"teleop": {"executors": ["position"], "teleop": "leader"}},
        "default_control_mode": "teleop",
    }


def arm(folder: Path, name: str, clock: SteppedClock, seed: int) -> Emulator:
    """An emulated arm in the middle of its range, on a bad line."""
    save_calibration(
        Calibration({joint: JointCalibration(i, 0, 0, *RANGE) for i, joint in enumerate(JOINTS, 1)}),
        folder / f"{name}.json",
    )
    emulator = Emulator(6, clock=clock, seed=seed, link=folder / name)
    for servo in emulator.servos.values():
        servo.set("min_position_limit", RANGE[0])
        servo.set("max_position_limit", RANGE[1])
    return emulator


class Bench:
    """Leader, control and follower, the person who moves the leader, and the operator."""

    def __init__(
        self, config: RobotConfig, leader: Emulator, follower: Emulator, clock: SteppedClock, seed: int
    ) -> None:
        self.leader, self.follower, self.clock = leader, follower, clock
        self.tally = Tally()
        self.keys: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.chance = np.random.default_rng(seed)
        self.said = Said()
        self.core = ControlCore.of(config, installed_plugins(), clock, seed)
        self._max_lead = config.robot.max_lead
        component = config.teleoperation["leader"]
        ctx = Context("leader", clock, logging.getLogger("ibrobot.leader"), config.robot, keys=lambda: self.keys)
        self.device: Teleop = installed_plugins().find("teleop", component.type).make(component.options, ctx)
        self._lost = False
        self._before: NDArray[np.float64] | None = None
        self._still: NDArray[np.float64] | None = None
        self._released: set[int] = set()
        self._quiet_s = 0.0
        self._asked = False
        self._swing = self.chance.uniform(0.1, 0.35, 6), self.chance.uniform(0, 2 * np.pi, 6)
        self.ticks = self._moved = 0

    def start(self, patience_s: float, corrupt: float, drop: float, late: float) -> None:
        """Connect both arms; from then on the lines are bad.

        Args:
            patience_s: with replies on bad lines, in addition to their time on the wire [s].
            corrupt: probability of each byte.
            drop: probability of each reply.
            late: probability of each reply.
        """
        # The emulators, threads of this process on a machine that may be busy, answer later than servos.
        bus._ADAPTER_S = _START_PATIENCE_S
        logging.getLogger("ibrobot").addHandler(self.said)
        self.device.connect()
        self.core.start("teleop")
        self.tick()
        self._activate()
        bus._ADAPTER_S = patience_s
        for emulator in (self.leader, self.follower):
            emulator.faults.corrupt, emulator.faults.drop, emulator.faults.late = corrupt, drop, late

    def stop(self) -> None:
        """Disconnect both."""
        logging.getLogger("ibrobot").removeHandler(self.said)
        self.device.disconnect()
        self.core.close()

    def tick(self) -> None:
        """One control period: the person, the leader device, control, and what is checked of it."""
        self.clock.advance(self.core.period_ns)
        self.ticks += 1
        self._move_leader()
        if self.core.state is not None and not self.core.fault and not self._lost:
            self._teleoperate()
        self.core.tick()
        if self.core.fault:
            time.sleep(_WRITTEN_S)
        self.follower.settle()
        while self.core.events:
            event = self.core.events.popleft()
            if event["event"] == "fault":
                self.tally.faults.append(str(event["fault"]))
                self.said.lines.append(str(event["fault"]))
        self._check()

    def run(self, duration_s: float) -> None:
        """Let time pass [s]."""
        for _ in range(round(duration_s * NS_PER_S / self.core.period_ns)):
            self.tick()

    def press_space(self) -> None:
        """The operator asks for motion, or for a pause."""
        self._asked, self._still, self._quiet_s = True, None, 0.0
        self._released.clear()
        self.keys.put("space")

    def recover(self) -> None:
        """The operator resets, again where that is refused, waits, and presses space."""
        for _ in range(30):
            self.run(float(self.chance.uniform(0.3, 0.8)))
            if self._reset():
                break
        else:
            self.tally.violated("no reset", self.core.fault)
            raise SystemExit(f"no reset in 30 attempts: {self.core.fault}")
        self.run(float(self.chance.uniform(SETTLE_S, 2 * SETTLE_S)))
        if not self.core.fault:
            self.press_space()

    def happen(self, incident: Incident) -> None:
        """Let something go wrong until it was named, and end it; another fault may come first."""
        tally = self.tally
        tally.incidents[incident.kind] += 1
        begun = len(self.said.lines)
        _begin(incident, self.leader, self.follower)
        named = False
        for _ in range(round(NAMED_S * 100)):
            self.tick()
            # A warning that still lasts from an earlier incident is not logged again, but shown.
            lasting = [str(each["message"]) for each in self.core.counters()["conditions"]]
            named = any(re.search(incident.said, line) for line in (*self.said.lines[begun:], *lasting))
            if named or self.core.fault:
                break
        else:
            tally.unnamed.append(incident.kind)
        if named and not incident.stops:
            self.run(1.0)
            if re.search(incident.said, self.core.fault):
                tally.violated("a warning ended the run", self.core.fault)
        if self.core.fault and not named:
            tally.incidents["another fault came first"] += 1
        if self.core.fault:
            self._asked = False
            self.run(float(self.chance.uniform(0.3, 1.0)))
        if incident.kind == "blocked joint":
            self._released.add(incident.servo)
        _end(self.leader, self.follower)

    def _activate(self) -> None:
        self.device.activate(self._reading())

    def _reading(self) -> JointReading:
        state = self.core.state
        assert state is not None
        return JointReading(state.stamp_ns, state.position, state.velocity, state.effort, state.stale)

    def _move_leader(self) -> None:
        """The person swings every joint; who needs both hands for a cable keeps still."""
        if self.core.fault:
            return
        frequency, phase = self._swing
        self._moved += 1
        angles = 0.6 * np.sin(2 * np.pi * frequency * self._moved / 100 + phase)
        with self.leader.lock:
            for servo, angle in zip(self.leader.servos.values(), angles, strict=True):
                servo.turn(2048 + angle * RADIAN)

    def _teleoperate(self) -> None:
        """As the host does with every joint state."""
        try:
            command = self.device.read(self._reading())
        except TeleopError as error:
            self._lost = True
            self.core.handle(RaiseFault(str(error)))
            return
        if command.positions:
            plan = np.array([[command.positions[joint] for joint in JOINTS]])
            self.core.set_plan(PlanRecord(self.core.generation, self.clock.now_ns(), 1, np.ones(6, dtype=bool), plan))

    def _reset(self) -> bool:
        """As the host does: the device first, if it was lost, then control; False where either is refused."""
        try:
            if self._lost:
                self.device.disconnect()
                self.device.connect()
                self._lost = False
        except TeleopError:
            self.tally.resets["refused by the leader"] += 1
            return False
        if error := self.core.handle(ClearFaults()).get("error"):
            self.tally.resets["refused by control"] += 1
            self.said.lines.append(str(error))
            return False
        self.tally.resets["done"] += 1
        self._activate()
        with self.follower.lock:
            slack = [number for number, servo in self.follower.servos.items() if not servo.torque]
        if slack:
            self.tally.violated("a reset left servos without torque", f"{slack}")
        return True

    def _check(self) -> None:
        state, tally = self.core.state, self.tally
        assert state is not None
        if (np.abs(state.command) > LIMIT + 1e-9).any():
            tally.violated("a setpoint beyond the limits", f"{state.command}")
        lead = np.abs(state.command - state.position)
        if (lead > self._max_lead + 1e-9).any():
            tally.violated("a lead beyond max_lead", f"{lead}")
        with self.follower.lock:
            servos = list(self.follower.servos.values())
            reached = np.array([(servo.encoder - 2048) / RADIAN for servo in servos])
            goals = np.array([(servo.goal - 2048) / RADIAN for servo in servos])
            torque = np.array([servo.torque for servo in servos])
        true_lead = np.where(torque, np.abs(goals - reached), 0.0)
        tally.worst_lead = max(tally.worst_lead, float(true_lead.max()))
        if (true_lead > self._max_lead + SPEED * UNSEEN_S).any():
            tally.violated("a servo's goal too far from its joint", f"{true_lead}")
        if self._before is not None and not self.core.fault:
            step = np.abs(state.command - self._before)
            free = lead < self._max_lead - 1e-9
            if (step[free] > SPEED * self.core.period_ns * 1e-9 + 1e-9).any() and self._still is None:
                tally.violated("a setpoint too fast", f"{step}")
        self._before = state.command
        if self.core.fault:
            self._asked = False
        self._check_still(reached)

    def _check_still(self, reached: NDArray[np.float64]) -> None:
        """Between a fault and the next press of space nothing moves, but a joint that was blocked and let go."""
        if self._asked:
            return
        self._quiet_s += self.core.period_ns * 1e-9
        if self._quiet_s < SETTLE_S:
            return
        if self._still is None:
            self._still = reached
        moved = np.abs(reached - self._still)
        moved[[servo - 1 for servo in self._released]] -= self._max_lead[[servo - 1 for servo in self._released]]
        self.tally.worst_still = max(self.tally.worst_still, float(moved.max()))
        if (moved > STILL_RAD).any():
            self.tally.violated("motion that nobody asked for", f"{moved} rad in {self.core.fault or 'a pause'}")


def incidents(chance: np.random.Generator) -> Iterator[Incident]:
    """All kinds, each at a random joint, in one random order after another."""
    while True:
        n = int(chance.integers(1, 6))
        name = JOINTS[n - 1]
        heavy = rf"servo {n} \({name}\).*(reports overload|above max_load)"
        deck = [
            Incident("blocked joint", rf"joint {name} does not follow|{heavy}", n),
            Incident("overload", heavy, n),
            Incident("overload of the gripper", r"servo 6 \(gripper\).*in overload and holds on", GRIPPER, stops=False),
            Incident("brown-out", rf"servo {n} \({name}\): its torque went off|joint {name} does not follow", n),
            Incident("brown-out of all", r": its torque went off|does not follow"),
            Incident("servo without its cable", rf"servo {n} \({name}\).*no valid reply", n),
            Incident("follower unplugged", r"/follower: the port is gone"),
            Incident("leader unplugged", r"leader: .*/leader: the port is gone"),
        ]
        for index in chance.permutation(len(deck)):
            yield deck[index]


def _begin(incident: Incident, leader: Emulator, follower: Emulator) -> None:
    faults = follower.faults
    match incident.kind:
        case "blocked joint":
            faults.blocked.add(incident.servo)
        case "overload" | "overload of the gripper":
            faults.overloaded.add(incident.servo)
        case "brown-out":
            faults.brown_out.add(incident.servo)
        case "brown-out of all":
            faults.brown_out |= set(follower.servos)
        case "servo without its cable":
            faults.disconnected.add(incident.servo)
        case "follower unplugged":
            follower.unplug()
        case "leader unplugged":
            leader.unplug()


def _end(leader: Emulator, follower: Emulator) -> None:
    """Remove every cause."""
    for cause in (follower.faults.blocked, follower.faults.overloaded, follower.faults.disconnected):
        cause.clear()
    for emulator in (leader, follower):
        emulator.replug()


def main() -> int:
    """Run and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0, help="of stepped time")
    parser.add_argument("--pause", type=float, default=2.0, help="mean time between two incidents [s]")
    parser.add_argument("--corrupt", type=float, default=0.01, help="probability of each byte")
    parser.add_argument("--drop", type=float, default=0.005, help="probability of each reply")
    parser.add_argument("--late", type=float, default=0.001, help="probability of each reply")
    parser.add_argument("--patience", type=float, default=0.02, help="with replies, beside their time on the wire [s]")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    sys.setswitchinterval(_SWITCH_S)
    clock = SteppedClock(1_700_000_000 * NS_PER_S)
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        leader, follower = (
            stack.enter_context(arm(folder, side, clock, arguments.seed + i))
            for i, side in enumerate(("leader", "follower"))
        )
        config = from_document(document(folder), source=Path("faults.yaml"), sim=False)
        bench = Bench(config, leader, follower, clock, arguments.seed)
        bench.start(arguments.patience, arguments.corrupt, arguments.drop, arguments.late)
        stack.callback(bench.stop)
        bench.press_space()
        drawn = incidents(bench.chance)
        while bench.ticks < 100 * arguments.seconds:
            bench.run(float(bench.chance.uniform(0.5, 1.5)) * arguments.pause)
            if not bench.core.fault:
                bench.happen(next(drawn))
            if bench.core.fault:
                bench.recover()
        counters = bench.core.counters()
    tally = bench.tally
    print(
        json.dumps(
            {
                "simulated_s": bench.ticks / 100,
                "took_s": round(time.monotonic() - begun, 1),
                "incidents": tally.incidents,
                "unnamed": tally.unnamed,
                "faults": Counter(kind_of(fault) for fault in tally.faults),
                "resets": tally.resets,
                "worst_lead_rad": round(tally.worst_lead, 3),
                "max_lead_rad": config.robot.max_lead.round(3).tolist(),
                "worst_motion_at_rest_rad": round(tally.worst_still, 4),
                "violations": tally.violations,
                "examples": tally.examples,
                "safety": counters["safety"],
                "bus": counters["hardware"]["hardware"],
            },
            indent=2,
        )
    )
    return 1 if tally.unnamed or tally.violations else 0


def kind_of(fault: str) -> str:
    """A fault's message without what differs from one to the next of its kind."""
    return re.sub(r"[\d.]+", "N", re.sub(r"/\S*/", "", fault.partition(";")[0]))


if __name__ == "__main__":
    sys.exit(main())
