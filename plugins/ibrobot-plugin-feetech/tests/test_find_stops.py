"""`feetech calibrate --auto` on emulated joints with stops, friction, weight, and what is odd about an arm."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_calibration import JointCalibration
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.commands.calibrate import measure_by_motor
from ibrobot_feetech.commands.find_stops import StopFinder
from ibrobot_feetech.commands.joints import SO101, by_servo, joints_of
from ibrobot_feetech.commands.measure import Answers
from ibrobot_feetech.emulator.mechanics import Mechanics, mechanics_of
from ibrobot_feetech.ticks import TICKS_PER_RADIAN
from ibrobot_terminal.fakes import FakeGuide
from ibrobot_terminal.guide import Cells
from ibrobot_terminal.questions import Declined

from ibrobot_core.api import CalibrationError, HardwareError, IbrobotError

from .line import Line

TORQUE = 0.4
MIDDLE = 2048
CYCLE_S = 0.04
SAVED = (
    "homing_offset", "min_position_limit", "max_position_limit", "torque_limit", "goal_velocity", "acceleration",
    "torque_enable", "lock", "operating_mode", "max_torque", "p_coefficient",
)  # fmt: skip


def siblings(every: Iterable[int], step: int) -> list[Any]:
    """Parameters of a test, of which one in `step` is in the short run."""
    return [pytest.param(each, marks=[pytest.mark.long] * (i % step > 0)) for i, each in enumerate(every)]


class Operator(FakeGuide):
    """An operator who watches the table, and may end a wait at a reading."""

    def __init__(self) -> None:
        super().__init__()
        self.readings = 0
        self.at: dict[int, Callable[[], None]] = {}
        """Reading -> what happens then."""
        self.ends_at: int | None = None
        self.answers: dict[str, bool] = {}
        """Beginning of a question -> the answer, if it is not yes."""

    @override
    def show(self, columns: Sequence[str], rows: Cells) -> None:
        raise AssertionError

    @override
    def confirm(self, question: str, *, flag: str = "", default: bool = False) -> bool:
        super().confirm(question)
        return next((answer for begin, answer in self.answers.items() if question.startswith(begin)), True)

    @override
    def wait(
        self, request: str, *, flag: str = "", columns: Sequence[str] = (),
        rows: Callable[[], Cells] | None = None, sight: Callable[[], bytes | None] | None = None,
        seconds: float | None = None,
    ) -> None:  # fmt: skip
        self.said.append(request)
        until_s = Line.now_s + (seconds if seconds is not None else 300.0)
        while rows is not None and Line.now_s < until_s:
            assert len(columns) == len(rows()[0])
            Line.now_s += CYCLE_S
            self.readings += 1
            self.at.get(self.readings, lambda: None)()
            if self.readings == self.ends_at:
                return


class Rig:
    """Emulated servos, whose torque is watched at every request."""

    def __init__(self, emulator: Line, only: tuple[int, ...] = (1, 3)) -> None:
        self.emulator, self.only = emulator, only
        self.guide = Operator()
        self.torques: list[int] = []
        self.requests = 0
        for joint in self.joints:
            servo = emulator.servos[joint.servo]
            servo.mechanics = mechanics_of(joint.name, *SO101[joint.name], MIDDLE)
            servo.set("homing_offset", 40 * joint.servo - 100)
            servo.set("min_position_limit", 500)
            servo.set("max_position_limit", 3600)
            servo.turn(MIDDLE)
        emulator.on_request = self._watch

    @property
    def joints(self):
        return [joint for joint in joints_of() if joint.servo in self.only]

    def mechanics(self, servo: int) -> Mechanics:
        made = self.emulator.servos[servo].mechanics
        assert made is not None
        return made

    def _watch(self) -> None:
        self.requests += 1
        for servo in self.emulator.servos.values():
            if servo.torque:
                self.torques.append(min(servo.get("max_torque"), servo.get("torque_limit")))
                self.torques.append(abs(servo.get("present_load")))

    def registers(self) -> dict[int, dict[str, int]]:
        return {number: {name: each.get(name) for name in SAVED} for number, each in self.emulator.servos.items()}

    def calibrate(self, *, yes: bool = True, signs: bool = False) -> dict[str, JointCalibration]:
        bus = FeetechBus(self.emulator.port, joints=by_servo(self.joints), retries=2)
        bus.open()
        try:
            return measure_by_motor(
                bus, self.guide, self.joints, full_turn=["wrist_roll"], compared=list(SO101), zero_at="pose",
                torque=TORQUE, yes=yes, answers=Answers(middle_now=True, check_signs=signs), clock=Line.clock_s,
            )  # fmt: skip
        finally:
            bus.close()

    def refuses(self, message: str | None, kind: type[IbrobotError] = CalibrationError, **answers: bool) -> None:
        """It refuses, says why, exceeds no torque, and leaves the servos as they were."""
        before = self.registers()
        with pytest.raises(kind, match=message):
            self.calibrate(**answers)
        assert self.registers() == before
        self.stays_gentle()

    def succeeds(self, **answers: bool) -> dict[str, JointCalibration]:
        before = self.registers()
        found = self.calibrate(**answers)
        assert self.registers() == before
        self.stays_gentle()
        for joint in self.joints:
            numbers, mechanics = found[joint.name], self.mechanics(joint.servo)
            if joint.name == "wrist_roll":
                assert (numbers.range_min, numbers.range_max) == (0, 4095)
                continue
            encoders = numbers.range_min + numbers.homing_offset, numbers.range_max + numbers.homing_offset
            assert encoders == pytest.approx((mechanics.low, mechanics.high), abs=12)
        return found

    def stays_gentle(self) -> None:
        assert max(self.torques, default=0) <= 1000 * TORQUE


@pytest.fixture
def emulator(lines: None) -> Iterator[Line]:
    with Line(6) as emulator:
        yield emulator


@pytest.fixture
def rig(emulator: Line) -> Rig:
    return Rig(emulator)


def test_whole_arm_finds_its_stops_joint_by_joint(emulator):
    rig = Rig(emulator, (1, 2, 3, 4, 5, 6))
    found = rig.succeeds()
    assert list(found) == list(SO101)
    assert max(rig.torques) == 1000 * TORQUE
    moved = [text.split()[0] for text in rig.guide.said if "finds its stops" in text]
    assert moved == ["gripper", "wrist_flex", "elbow_flex", "shoulder_lift", "shoulder_pan"]
    assert "never on real servos" in rig.guide.said[0]
    for joint in rig.joints:
        numbers = found[joint.name]
        assert numbers.homing_offset == 0, "0 rad is the pose in which it began"
        assert rig.emulator.servos[joint.servo].encoder == pytest.approx(MIDDLE, abs=170)


@pytest.mark.parametrize("middle", siblings((30, 700, 3400, 4090), 3))
def test_range_that_crosses_the_end_of_the_encoder_is_found(rig, middle):
    for joint in rig.joints:
        emulated = rig.emulator.servos[joint.servo]
        emulated.mechanics = mechanics_of(joint.name, *SO101[joint.name], middle)
        emulated.turn(middle)
    found = rig.succeeds()
    assert {each.homing_offset for each in found.values()} == {middle - MIDDLE}


def test_missing_stop_is_refused(rig):
    rig.mechanics(3).high = float("inf")
    rig.refuses("elbow_flex: it turned by [0-9]+ deg and met no stop")


@pytest.mark.parametrize("end", ["low", "high"])
def test_stop_inside_the_range_is_refused(rig, end):
    mechanics = rig.mechanics(1)
    setattr(mechanics, end, getattr(mechanics, end) + (400 if end == "low" else -400))
    rig.refuses("shoulder_pan: between both places where it stops are 19[0-9] deg, its limits are 220 deg apart")


@pytest.mark.parametrize("off", [-500, 300])
def test_start_in_another_than_the_middle_pose_is_refused(rig, off):
    """Its stops are right, but 0 rad is where the arm stood."""
    rig.emulator.servos[3].mechanics = mechanics_of("elbow_flex", *SO101["elbow_flex"], MIDDLE + off)
    rig.refuses("elbow_flex: the middle of its range is (26|44) deg from the middle pose, which is its 0 deg")


def test_cable_that_pulls_is_no_stop(rig):
    mechanics = rig.mechanics(1)
    mechanics.cable = mechanics.high - 220
    rig.refuses("shoulder_pan: with 40 % of the torque it stops at [0-9]+, with 28 % at .* that is no stop but a cable")


def test_cable_that_yields_is_harmless(rig):
    mechanics = rig.mechanics(1)
    mechanics.cable, mechanics.cable_stiffness = mechanics.low + 150, 0.0004
    rig.succeeds()


def test_joint_that_is_mounted_the_other_way_is_known_by_its_weight(rig):
    rig.mechanics(3).gravity *= -1
    rig.refuses("elbow_flex: holding it takes 1[0-9].* it is reversed, or the arm does not stand upright")


def test_person_says_which_way_joints_turn(rig):
    rig.mechanics(3).gravity *= -1
    rig.guide.answers["Did elbow_flex move first in its positive"] = False
    found = rig.succeeds(yes=False, signs=True)
    assert [found["shoulder_pan"].drive_mode, found["elbow_flex"].drive_mode] == [0, 1]


def test_friction_that_holds_the_joint_is_refused(rig):
    rig.mechanics(1).sticky = (2400, 2700, 0.45)
    rig.refuses("shoulder_pan: (between both places where it stops are [0-9]+ deg|on its way to)")


def test_friction_that_yields_to_the_whole_torque_is_no_stop(rig):
    high = rig.mechanics(1).high
    rig.mechanics(1).sticky = (high - 90, high - 30, 0.32)
    rig.refuses("that is no stop but a cable, a hand, stiff gears")


def test_supply_that_gives_way_is_refused(rig):
    watch = rig.emulator.on_request

    def sag() -> None:
        watch()
        ampere = sum(abs(each.get("present_current")) for each in rig.emulator.servos.values()) * 0.0065
        for servo in rig.emulator.servos.values():
            servo.set("present_voltage", round(121 - 35 * ampere))

    rig.emulator.on_request = sag
    rig.refuses("its supply fell from 12.1 to [0-9.]+ V, below 85 %", HardwareError)


def test_servo_that_gets_hot_is_refused(rig):
    rig.guide.at[90] = lambda: rig.emulator.servos[3].set("present_temperature", 56)
    rig.refuses("servo 3 .elbow_flex.: it is at 56 deg C, above 55; let it cool", HardwareError)


def test_servo_in_overload_is_refused(rig):
    rig.guide.at[90] = lambda: rig.emulator.faults.errors.update({1: 0x20})
    with pytest.raises(HardwareError, match=r"servo 1 .shoulder_pan.: the servo reports overload"):
        rig.calibrate()
    rig.stays_gentle()


def test_servo_that_falls_silent_stops_the_arm_and_the_others_are_restored(rig):
    before = rig.registers()
    rig.guide.at[90] = lambda: rig.emulator.faults.silent.add(1)
    with pytest.raises(HardwareError, match=r"servo 1 .shoulder_pan.*: (no valid reply for 6 readings|no reply)"):
        rig.calibrate()
    assert rig.registers()[3] == before[3]
    assert any(text.startswith("error: not restored: ") and "servo 1" in text for text in rig.guide.said)
    assert any("it had homing_offset -60, min_position_limit 500" in text for text in rig.guide.said)
    assert rig.guide.said[-1] == "Nothing was saved."
    rig.stays_gentle()


def test_servo_that_loses_power_for_a_moment_is_refused(rig):
    rig.guide.at[90] = lambda: rig.emulator.faults.brown_out.add(3)
    rig.refuses("elbow_flex.: its torque went off", HardwareError)


def test_servo_with_another_id_is_named(emulator):
    rig = Rig(emulator, (1, 2, 3, 4, 5, 6))
    rig.emulator.servos[3].set("id", 9)
    rig.refuses("servo 3 .elbow_flex.: it does not answer; servo 9 does, and no joint has that id", HardwareError)


def test_exchanged_servos_are_known_by_who_moves(rig):
    rig.guide.answers["Did elbow_flex move"] = False
    rig.refuses("elbow_flex: another joint moved: servo 3 is not its servo", yes=False)


def test_offset_that_no_servo_stores_is_refused_before_anything_moves(rig):
    rig.emulator.servos[3].turn(0)
    rig.refuses("elbow_flex: in the middle pose its encoder is at 0, which needs an offset of -2048")
    assert not rig.torques


def test_hand_that_holds_a_joint_is_refused(rig):
    def grip() -> None:
        rig.mechanics(3).hand = rig.emulator.servos[3].encoder

    rig.guide.at[60] = grip
    rig.refuses("elbow_flex: (between both places|on its way|it stands still)")


def test_hand_that_moves_another_joint_is_refused(rig):
    def pull() -> None:
        rig.mechanics(1).hand = MIDDLE + 400

    rig.guide.at[60] = pull
    rig.refuses("shoulder_pan.: it moved from [0-9]+ to [0-9]+ ticks, by more than 170", HardwareError)


def test_weight_that_the_torque_does_not_hold_is_refused(rig):
    rig.mechanics(3).gravity = 0.5
    rig.refuses("elbow_flex: it sagged by [0-9]+ deg|elbow_flex.: it moved", IbrobotError)


def test_motor_that_draws_more_than_its_torque_needs_is_refused(rig, monkeypatch):
    plain = Mechanics.current_a
    monkeypatch.setattr(Mechanics, "current_a", lambda self, speed, duty: 2 * plain(self, speed, duty))
    rig.refuses("its current is [0-9.]+ A, above 1.62", HardwareError)


def test_current_of_a_standing_joint_ends_the_motion_of_another_one(rig, monkeypatch):
    plain, standing = Mechanics.current_a, rig.mechanics(1)

    def current(self: Mechanics, speed: float, duty: float) -> float:
        return 2.0 if self is standing and rig.guide.readings >= 60 else plain(self, speed, duty)

    monkeypatch.setattr(Mechanics, "current_a", current)
    rig.refuses("shoulder_pan.*its current is 2.00 A, above 1.62", HardwareError)
    assert rig.guide.readings < 65


@pytest.mark.parametrize(("cable", "duty"), [(MIDDLE + 300, 0.3), (MIDDLE - 300, -0.3)])
def test_cable_of_a_joint_without_stops_is_in_its_way_on_its_own_side(cable, duty):
    wrist = mechanics_of("wrist_roll", *SO101["wrist_roll"], MIDDLE)
    wrist.cable = cable
    assert wrist.advance(MIDDLE, 0.0, 0.0, 1.0) == (MIDDLE, 0.0), "it is slack in the middle pose"
    pulled, _ = wrist.advance(MIDDLE, 0.0, duty, 5.0)
    free, _ = wrist.advance(MIDDLE, 0.0, -duty, 5.0)
    assert 300 < abs(pulled - MIDDLE) < 600
    assert abs(free - MIDDLE) > 2000


def test_arm_that_moves_by_itself_is_refused(rig):
    servo = rig.emulator.servos[1]
    watch = rig.emulator.on_request

    def drift() -> None:
        watch()
        servo.turn(servo.encoder + 9)

    rig.emulator.on_request = drift
    with pytest.raises(HardwareError, match="shoulder_pan: it moves while its torque is off"):
        rig.calibrate()


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("reading", siblings((*range(1, 40, 6), *range(60, 900, 105)), 3))
def test_operator_stops_it_at_any_time_and_the_servos_are_as_they_were(rig, reading, held):
    for servo in rig.emulator.servos.values():
        servo.set("torque_limit", 250 if held else 1000)
        servo.set("torque_enable", int(held))

    def interrupt() -> None:
        raise KeyboardInterrupt

    rig.guide.at[reading] = interrupt
    before = rig.registers()
    with pytest.raises(KeyboardInterrupt):
        rig.calibrate()
    assert rig.registers() == before
    assert rig.guide.said[-1] == "Nothing was saved. The servos have the registers and the torque that they had."
    rig.stays_gentle()


@pytest.mark.parametrize("reading", [2, 200])
def test_key_stops_it(rig, reading):
    rig.guide.ends_at = reading
    rig.refuses(None, Declined, yes=False)
    assert "stopped by the operator" in rig.guide.said


def test_second_interrupt_does_not_keep_servos_from_being_restored(rig, monkeypatch):
    before, restore = rig.registers(), StopFinder._restore_one
    calls: list[int] = []

    def interrupted(self: StopFinder, servo: int, values: dict[str, int]) -> None:
        calls.append(servo)
        if len(calls) == 1:
            raise KeyboardInterrupt
        restore(self, servo, values)

    monkeypatch.setattr(StopFinder, "_restore_one", interrupted)
    rig.guide.at[100] = lambda: rig.emulator.servos[3].set("present_temperature", 60)
    with pytest.raises(KeyboardInterrupt):
        rig.calibrate()
    assert calls == [1, 1, 3]
    assert rig.registers() == before


def test_operator_who_reads_that_it_was_never_tried_may_decline(rig):
    rig.guide.answers["No servo will exceed 40 % of its torque"] = False
    rig.refuses(None, Declined, yes=False)
    assert rig.requests == 0


def oddity(rng: np.random.Generator, rig: Rig) -> str:
    """Plant something odd, of a random size, and say what may follow: `right`, `refused`, or either."""
    servo = int(rng.choice(rig.only))
    mechanics = rig.mechanics(servo)
    low, high = mechanics.low, mechanics.high
    kind = rng.choice(["nothing", "friction", "stops", "cable", "sticky", "hand", "push", "weight", "wrap"])
    reading = int(rng.integers(1, 500))
    match kind:
        case "friction":
            mechanics.friction = float(rng.uniform(0.01, 0.5))
        case "stops":
            mechanics.low, mechanics.high = low + float(rng.uniform(-600, 600)), high + float(rng.uniform(-600, 600))
        case "cable":
            mechanics.cable = float(rng.uniform(low, high))
            mechanics.cable_stiffness = float(10 ** rng.uniform(-5, -1))
        case "sticky":
            begin = float(rng.uniform(low, high))
            mechanics.sticky = begin, begin + float(rng.uniform(5, 300)), float(rng.uniform(0.1, 0.9))
        case "hand":
            rig.guide.at[reading] = lambda: setattr(mechanics, "hand", rig.emulator.servos[servo].encoder)
        case "push":
            to = float(rng.uniform(low, high))
            rig.guide.at[reading] = lambda: setattr(mechanics, "hand", to)
        case "weight":
            mechanics.gravity = float(rng.uniform(-0.6, 0.6))
        case "wrap":
            middle = int(rng.integers(0, 4096))
            rig.emulator.servos[servo].mechanics = mechanics_of(
                by_servo(rig.joints)[servo], *SO101[by_servo(rig.joints)[servo]], middle
            )
            rig.emulator.servos[servo].turn(middle)
    return str(kind)


@pytest.mark.parametrize("seed", siblings(range(24), 4))
def test_odd_arm_is_measured_right_or_refused(rig, seed):
    """Siblings of the oddities above: whatever is odd, no range is wrong, and no torque above the stated one."""
    kind, before = oddity(np.random.default_rng(seed), rig), rig.registers()
    try:
        found = rig.calibrate()
    except IbrobotError:
        assert kind != "nothing"
        found = {}
    assert rig.registers() == before
    rig.stays_gentle()
    for joint in rig.joints if found else ():
        numbers, mechanics = found[joint.name], rig.mechanics(joint.servo)
        for end, stop in ((numbers.range_min, mechanics.low), (numbers.range_max, mechanics.high)):
            # What holds as hard as a stop, within a twentieth of the limits, is one.
            room = 0.09 * (joint.upper - joint.lower) * TICKS_PER_RADIAN
            assert abs(end + numbers.homing_offset - stop) <= (12 if kind in ("nothing", "wrap", "weight") else room), (
                kind
            )


def test_joints_know_their_mechanics():
    assert attrs.asdict(mechanics_of("left_wrist_roll", -2.7, 2.7, 2048))["high"] == float("inf")
