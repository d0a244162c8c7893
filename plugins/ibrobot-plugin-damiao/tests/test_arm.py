"""The arm on emulated motors: conformance, faults, and what they are called."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, override

import can
import numpy as np
import pytest
from ibrobot_damiao.arm import DamiaoArm
from ibrobot_damiao.emulator import EmulatedMotor
from ibrobot_damiao.options import DamiaoOptions, MotorOptions
from ibrobot_damiao.protocol import (
    ERRORS,
    MAX_POSITION,
    MAX_TORQUE,
    MAX_VELOCITY,
    MODE,
    OFF,
    ON,
    MitCommand,
    Ranges,
)
from ibrobot_testing import HardwareSuite
from ibrobot_testing.contexts import ARM, GRIPPER, control_context

from ibrobot_core.api import Context, Hardware, HardwareError, Severity, SteppedClock, Torque

from .memory import MemoryBus

JOINTS = (*ARM, *GRIPPER)


def options(**changes: Any) -> DamiaoOptions:
    """One joint is inverted, one counts from elsewhere."""
    motors = {joint: MotorOptions(id=i, kp=40.0, kd=1.5) for i, joint in enumerate(JOINTS, 1)}
    motors["elbow_flex"] = MotorOptions(id=3, kp=40.0, kd=1.5, inverted=True)
    motors["wrist_flex"] = MotorOptions(id=4, kp=40.0, kd=1.5, zero=-0.4)
    given: dict[str, Any] = {"channel": "arm", "interface": "memory", "motors": motors, **changes}
    return DamiaoOptions(**given)


class TestDamiaoArm(HardwareSuite):
    @pytest.fixture(autouse=True)
    def _arm(self, clock: SteppedClock) -> None:
        self.clock = clock

    @override
    def context(self) -> Context:
        return control_context(clock=self.clock)

    @override
    def make(self, ctx: Context) -> Hardware:
        return DamiaoArm(options(), ctx)

    @override
    def elapse(self, hardware: Hardware, ctx: Context, duration_s: float) -> None:
        super().elapse(hardware, ctx, duration_s)
        MemoryBus.wires["arm"].motors.settle()

    @override
    def has_torque(self, hardware: Hardware) -> bool:
        (torque,) = {motor.state != OFF for motor in MemoryBus.wires["arm"].motors.motors}
        return torque

    @override
    def lose_replies(self, hardware: Hardware) -> None:
        for motor in MemoryBus.wires["arm"].motors.motors:
            motor.silent = True

    @override
    def unplug(self, hardware: Hardware) -> None:
        MemoryBus.wires["arm"].gone = True

    @override
    def stall(self, hardware: Hardware, joint: int) -> None:
        MemoryBus.wires["arm"].motors.motors[joint].blocked = True


@contextmanager
def connected(clock: SteppedClock, **changes: Any) -> Iterator[DamiaoArm]:
    arm = DamiaoArm(options(**changes), control_context(clock=clock))
    arm.connect()
    try:
        yield arm
    finally:
        arm.disconnect()


def step(arm: DamiaoArm, clock: SteppedClock, ticks: int = 1) -> None:
    for _ in range(ticks):
        clock.advance(10_000_000)
        arm.read()


def test_positions_are_signed_and_count_from_the_zero(wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    wire.motors[1].angle, wire.motors[3].angle, wire.motors[4].angle = 0.3, 0.3, 0.3
    with connected(clock) as arm:
        position = arm.read().position
    np.testing.assert_allclose(position[[0, 2, 3]], [0.3, -0.3, -0.1], atol=2e-3)


def test_numbers_are_scaled_by_what_the_motor_says(wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    """As `PMAX` differs between motors, a driver with a table of models would be wrong by its ratio."""
    other = EmulatedMotor(2, ranges=Ranges(3.141593, 8.0, 28.0))
    wire.motors.motors[1] = other
    other.angle = 1.0
    with connected(clock) as arm:
        assert arm.read().position[1] == pytest.approx(1.0, abs=1e-3)
        arm.write(arm.read().position)
        step(arm, clock, 50)
        assert other.angle == pytest.approx(1.0, abs=2e-3)


def test_torque_comes_on_where_the_arm_is_though_motors_remember_another_command(
    wire: MemoryBus.Wire, clock: SteppedClock
) -> None:
    with connected(clock) as arm:
        arm.write(np.full(6, 0.3))
        step(arm, clock, 100)
        arm.relax()
        for motor in wire.motors.motors:
            motor.angle = -0.2
            motor.velocity = 0.0
        wire.frame_ns = 10_000_000
        arm.write(arm.read().position)
        far = []
        for _ in range(50):
            clock.advance(10_000_000)
            wire.motors.settle()
            far.append(max(abs(motor.angle + 0.2) for motor in wire.motors.motors))
    assert max(far) < 0.01


@pytest.mark.parametrize("lost", [1, 3])
def test_lost_replies_repeat_the_last_state_and_are_counted(
    lost: int, wire: MemoryBus.Wire, clock: SteppedClock
) -> None:
    with connected(clock) as arm:
        before = arm.read().position
        for _ in range(lost):
            wire.lose.add(2)
            clock.advance(10_000_000)
            reading = arm.read()
            assert reading.stale
            np.testing.assert_array_equal(reading.position, before)
        assert not arm.read().stale
        assert arm.counters()["lost_replies"] == lost


def test_a_motor_that_stays_silent_is_a_fault_that_names_it_and_a_reset_finds_it_again(
    wire: MemoryBus.Wire, clock: SteppedClock
) -> None:
    with connected(clock) as arm:
        wire.motors[5].silent = True
        with pytest.raises(HardwareError, match=r"arm, motor 5 \(wrist_roll\): does not answer for 4 ticks"):
            step(arm, clock, 4)
        with pytest.raises(HardwareError, match="motor 5"):
            arm.reset_faults()
        wire.motors[5].silent = False
        wire.motors[5].restart()
        arm.reset_faults()
        assert not arm.read().stale
        assert not arm.health()


def test_all_missing_motors_are_named_at_the_start_and_no_torque_stays(
    wire: MemoryBus.Wire, clock: SteppedClock
) -> None:
    wire.motors[2].silent = wire.motors[6].silent = True
    with (
        pytest.raises(HardwareError, match=r"no answer from motors 2 \(shoulder_lift\), 6 \(gripper\)"),
        connected(clock),
    ):
        pass
    assert not any(motor.state for motor in wire.motors.motors)


def test_a_motor_that_cannot_hold_ends_the_start_and_no_torque_stays(
    wire: MemoryBus.Wire, clock: SteppedClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wire.motors[4], "_obey", lambda data: None)
    with (
        pytest.raises(
            HardwareError, match=r"motor 4 \(wrist_flex\): cannot hold: its torque stays off; check the power"
        ),
        connected(clock),
    ):
        pass
    assert not any(motor.state for motor in wire.motors.motors)


def test_two_motors_with_one_id_are_refused(wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    wire.motors.motors.append(EmulatedMotor(3, feedback_id=0x33))
    with pytest.raises(HardwareError, match=r"motor 3 \(elbow_flex\): 2 motors have this id.*set-id"), connected(clock):
        pass


def test_motors_whose_answers_look_alike_are_refused(wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    """Motors 1 and 17 with feedback id 0, as motors come, differ in nothing that their feedback has."""
    wire.motors.motors[0] = EmulatedMotor(1, feedback_id=0)
    wire.motors.motors.append(EmulatedMotor(17, feedback_id=0))
    motors = {**options().motors, "gripper": MotorOptions(id=17)}
    with (
        pytest.raises(HardwareError, match=r"motor 17 .gripper.: answers like motor 1"),
        connected(clock, motors=motors),
    ):
        pass


@pytest.mark.parametrize(("state", "name"), ERRORS.items(), ids=ERRORS.values())
def test_each_error_of_a_motor_is_a_fault_with_its_name_and_a_remedy_until_a_reset(
    state: int, name: str, wire: MemoryBus.Wire, clock: SteppedClock
) -> None:
    with connected(clock) as arm:
        wire.motors[4].fail(state)
        step(arm, clock)
        (condition,) = arm.health()
        assert condition.joint == "wrist_flex"
        assert condition.severity is Severity.FAULT
        assert name in condition.message
        assert "; " in condition.message
        arm.reset_faults()
        step(arm, clock)
        assert not arm.health()
        assert wire.motors[4].state == 1


def test_a_motor_that_lost_its_power_is_a_fault(wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    with connected(clock) as arm:
        wire.motors[2].restart()
        step(arm, clock)
        (condition,) = arm.health()
    assert (condition.joint, condition.quantity) == ("shoulder_lift", "torque")
    assert "its torque went off by itself" in condition.message


def test_temperatures_warn_then_fail_and_end_below_their_level(wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    seen = []
    with connected(clock) as arm:
        for celsius in (69, 71, 69, 67, 91, 89, 87):
            wire.motors[1].coil = celsius
            step(arm, clock)
            seen.append([condition.severity for condition in arm.health()])
        values = np.empty(6)
        arm.read_signal(0, values)
    warning, fault = [Severity.WARNING], [Severity.FAULT]
    assert seen == [[], warning, warning, [], fault, fault, warning]
    assert values[0] == 87


def test_error_frames_are_counted_and_bus_off_is_a_fault_that_a_reset_clears(
    wire: MemoryBus.Wire, clock: SteppedClock
) -> None:
    with connected(clock) as arm:
        wire.pending.append(can.Message(arbitration_id=0x8, is_error_frame=True))
        step(arm, clock)
        assert arm.counters()["error_frames"] == 1
        wire.pending.append(can.Message(arbitration_id=0x40, is_error_frame=True))
        with pytest.raises(HardwareError, match=r"arm: bus-off.*120 ohm"):
            step(arm, clock)
        arm.reset_faults()
        step(arm, clock)


def test_a_cable_that_is_pulled_is_a_fault_until_it_is_back(wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    with connected(clock) as arm:
        wire.gone = True
        with pytest.raises(HardwareError, match=r"arm: .*Network is down; check the adapter's cable"):
            arm.read()
        assert arm.relax() is Torque.UNKNOWN
        assert arm.holding() is not None
        with pytest.raises(HardwareError, match="cannot be opened"):
            arm.reset_faults()
        wire.gone = False
        arm.reset_faults()
        assert not arm.read().stale


def test_torque_that_stays_on_is_an_error(
    wire: MemoryBus.Wire, clock: SteppedClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    with connected(clock) as arm:
        monkeypatch.setattr(wire.motors[6], "_obey", lambda data: None)
        with pytest.raises(HardwareError, match=r"motor 6 \(gripper\): its torque stays on; cut its power"):
            arm.relax()
        assert not any(motor.state for motor in wire.motors.motors[:5])
        assert arm.holding() is not None


def test_a_motor_in_another_mode_is_put_into_mit_mode(wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    wire.motors[1].registers[MODE] = 2
    with connected(clock):
        assert wire.motors[1].registers[MODE] == 1


def test_frames_are_can_fd_if_the_data_have_a_rate_of_their_own(wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    with connected(clock, data_bitrate=5_000_000) as arm:
        arm.read()
    assert all(frame.is_fd and frame.bitrate_switch for frame in wire.frames)


def test_frames_of_others_are_counted_and_change_nothing(wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    with connected(clock) as arm:
        before = arm.read().position
        send = MemoryBus.send

        def strange(bus: MemoryBus, msg: can.Message, timeout: float | None = None) -> None:
            for arbitration_id, data in ((0x12, b""), (0x12, b"\x02\xff"), (0x12, b"\x72" + bytes(7)), (0x5, bytes(8))):
                wire.pending.append(can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False))
            send(bus, msg, timeout)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(MemoryBus, "send", strange)
            reading = arm.read()
        assert not reading.stale
        np.testing.assert_array_equal(reading.position, before)
        assert arm.counters()["strange_frames"] >= 4


@pytest.mark.parametrize("angle", [12.6, 13.0, 20.0, -13.0, 100.0])
def test_torque_stays_off_where_a_motor_has_no_known_position(
    angle: float, wire: MemoryBus.Wire, clock: SteppedClock
) -> None:
    """Held at the end of its range, a motor that is beyond it would turn to there."""
    wire.motors[2].angle = angle
    with (
        pytest.raises(HardwareError, match=r"motor 2 .shoulder_lift.: is at or beyond the end of its range of 12.5"),
        connected(clock),
    ):
        pass
    assert wire.motors[2].angle == angle
    assert not any(motor.state for motor in wire.motors.motors)


def test_a_joint_that_leaves_the_range_of_its_motor_is_a_fault(wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    with connected(clock) as arm:
        wire.motors[2].angle = 12.7
        step(arm, clock)
        (condition,) = arm.health()
    assert (condition.joint, condition.quantity, condition.severity) == ("shoulder_lift", "position", Severity.FAULT)


@pytest.mark.parametrize("end", [0.5, 1.0, 1.69])
def test_limits_beyond_the_range_of_a_motor_are_refused(end: float, wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    """Commands beyond it would be cut to it in silence."""
    wire.motors[2].registers[MAX_POSITION] = end
    reason = rf"motor 2 .*-1.7 and 1.6 rad .*beyond its range of {end:g} rad"
    with pytest.raises(HardwareError, match=reason), connected(clock):
        pass
    assert not any(motor.state for motor in wire.motors.motors)


@pytest.mark.parametrize("register", [MAX_POSITION, MAX_VELOCITY, MAX_TORQUE])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf"), 1e-30, 1e-3, 9999.0, 1e5])
def test_ranges_that_cannot_be_are_refused(
    register: int, value: float, wire: MemoryBus.Wire, clock: SteppedClock
) -> None:
    wire.motors[2].registers[register] = value
    with pytest.raises(HardwareError, match=r"they must be 0\.1 to 200, 1000, 1000"), connected(clock):
        pass


@pytest.mark.parametrize("mode", [0, 2, 3, 4])
def test_a_motor_with_torque_in_another_mode_is_left_as_it_is(
    mode: int, wire: MemoryBus.Wire, clock: SteppedClock
) -> None:
    """In MIT mode it would go on with the last command that it had in it."""
    motor = wire.motors[2]
    motor.state, motor.registers[MODE], motor._command = ON, mode, MitCommand(1.0, 60.0, 1.0)
    with (
        pytest.raises(HardwareError, match=r"torque is on in another mode.*off arm --interface memory --id 2`"),
        connected(clock),
    ):
        pass
    assert (motor.registers[MODE], motor.state, motor.angle) == (mode, ON, 0.0)


@pytest.mark.parametrize("state", sorted({*range(16)} - {OFF, ON, *ERRORS}))
def test_a_state_that_is_unknown_is_named(state: int, wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    with connected(clock) as arm:
        wire.motors[5].state = state
        with pytest.raises(HardwareError, match=rf"motor 5 .wrist_roll.: answers .* for 4 ticks: {state} is no state"):
            step(arm, clock, 4)


def test_a_motor_that_would_hear_the_answers_of_another_is_refused(wire: MemoryBus.Wire, clock: SteppedClock) -> None:
    """A motor takes each frame with its id for a command, whoever has sent it."""
    wire.motors.motors.append(EmulatedMotor(0x11))
    motors = {**options().motors, "gripper": MotorOptions(id=0x11)}
    with (
        pytest.raises(HardwareError, match=r"motor 17 .gripper.: has the feedback id of motor 1, .*set-id arm "),
        connected(clock, motors=motors),
    ):
        pass
    assert not any(motor.state for motor in wire.motors.motors)


def test_a_flood_of_frames_ends_no_read(
    wire: MemoryBus.Wire, clock: SteppedClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    class EndlessError(Exception):
        pass

    left = iter(range(200_000))
    receive = MemoryBus._recv_internal

    def flooded(bus: MemoryBus, timeout: float | None) -> tuple[can.Message | None, bool]:
        message, filtered = receive(bus, timeout)
        if message is None and next(left, None) is None:
            raise EndlessError
        return message or can.Message(arbitration_id=0x500, data=bytes(8), is_extended_id=False), filtered

    with connected(clock) as arm:
        wire.motors[3].silent = True
        monkeypatch.setattr(MemoryBus, "_recv_internal", flooded)
        assert arm.read().stale


@pytest.mark.parametrize("first", range(6))
def test_a_full_queue_leaves_no_other_motor_with_torque(
    first: int, wire: MemoryBus.Wire, clock: SteppedClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    send, sent = MemoryBus.send, iter(range(100))

    def full(bus: MemoryBus, msg: can.Message, timeout: float | None = None) -> None:
        if first <= next(sent) < first + 3:
            raise can.CanOperationError("No buffer space available")
        send(bus, msg, timeout)

    with connected(clock) as arm:
        monkeypatch.setattr(MemoryBus, "send", full)
        arm.relax()
    assert not any(motor.state for motor in wire.motors.motors)


def test_a_joint_without_a_motor_and_a_motor_without_a_joint_are_refused(clock: SteppedClock) -> None:
    motors = dict(options().motors)
    del motors["gripper"]
    with pytest.raises(HardwareError, match="no motor for joint 'gripper'"):
        DamiaoArm(options(motors=motors), control_context(clock=clock))
    motors = {**options().motors, "griper": MotorOptions(id=9)}
    with pytest.raises(HardwareError, match="unknown joint 'griper', did you mean 'gripper'"):
        DamiaoArm(options(motors=motors), control_context(clock=clock))
    motors = {**options().motors, "gripper": MotorOptions(id=1)}
    with pytest.raises(HardwareError, match="motor 1 belongs to shoulder_pan already"):
        DamiaoArm(options(motors=motors), control_context(clock=clock))
