"""The follower against the emulated bus: the suite of hardware, set-up, faults and coming back from them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ibrobot_calibration import Calibration, load_calibration
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import EmulatedServo, Emulator
from ibrobot_feetech.errors import NoReply, PortError, ServoFault
from ibrobot_feetech.follower import FeetechFollower
from ibrobot_feetech.health import SteadyLoad
from ibrobot_feetech.options import FollowerOptions
from ibrobot_feetech.protocol import OVERLOAD
from ibrobot_testing.contexts import START_NS, control_context
from ibrobot_testing.hardware import HardwareSuite

from ibrobot_core.api import (
    CalibrationError,
    Context,
    Hardware,
    HardwareError,
    Holding,
    Severity,
    SteppedClock,
    Torque,
)

from .conftest import JOINTS, arm_calibration, prepare
from .line import Line

TICK = 2 * math.pi / 4096


@pytest.fixture(autouse=True)
def _in_memory(lines: None) -> None:
    pass


class TestFollower(HardwareSuite):
    @pytest.fixture(autouse=True)
    def _arm(self, calibration_file: Path) -> Iterator[None]:
        self.clock = SteppedClock(START_NS)
        self.file = calibration_file
        with Line(6, clock=self.clock) as self.emulator:
            prepare(self.emulator, arm_calibration())
            yield

    @override
    def context(self) -> Context:
        return control_context(clock=self.clock)

    @override
    def make(self, ctx: Context) -> Hardware:
        return FeetechFollower(FollowerOptions(port=self.emulator.port, calibration=str(self.file)), ctx)

    @override
    def elapse(self, hardware: Hardware, ctx: Context, duration_s: float) -> None:
        with suppress(HardwareError):
            hardware.read()  # once it is answered, the goals sent before it have arrived
        super().elapse(hardware, ctx, duration_s)

    @override
    def has_torque(self, hardware: Hardware) -> bool:
        with self.emulator.lock:
            (torque,) = {servo.torque for servo in self.emulator.servos.values()}
        return torque

    @override
    def lose_replies(self, hardware: Hardware) -> None:
        self.emulator.faults.silent |= set(self.emulator.servos)

    @override
    def unplug(self, hardware: Hardware) -> None:
        self.emulator.unplug()

    @override
    def stall(self, hardware: Hardware, joint: int) -> None:
        self.emulator.faults.blocked.add(joint + 1)


class Rig:
    """A connected follower with what it is connected to."""

    def __init__(self, emulator: Emulator, clock: SteppedClock, follower: FeetechFollower) -> None:
        self.emulator, self.clock, self.follower = emulator, clock, follower

    def tick(self, goal: Any = None) -> Any:
        self.clock.advance(10_000_000)
        reading = self.follower.read()
        self.follower.write(reading.position if goal is None else np.asarray(goal))
        return reading

    def run(self, ticks: int, goal: Any = None) -> list[Any]:
        return [self.tick(goal) for _ in range(ticks)]

    def register(self, name: str) -> list[int]:
        if self.follower._bus.is_open:
            self.follower._bus.read_faulty(1, "id")  # once it is answered, all that was sent before it has arrived
        with self.emulator.lock:
            return [servo.get(name) for servo in self.emulator.servos.values()]


@pytest.fixture
def rig(calibration_file: Path) -> Iterator[Rig]:
    with rig_of(calibration_file) as rig:
        rig.follower.connect()
        yield rig


@contextmanager
def rig_of(file: Path, link: Path | None = None, servos: Any = 6, **options: Any) -> Iterator[Rig]:
    """On a line; with `link` on a pseudo-terminal."""
    clock = SteppedClock(START_NS)
    with Line(servos, clock=clock) if link is None else Emulator(servos, clock=clock, link=link) as emulator:
        prepare(emulator, load_calibration(file))
        ctx = control_context("arm", clock=clock)
        port = str(link) if link is not None else emulator.port
        follower = FeetechFollower(FollowerOptions(port=port, calibration=str(file), **options), ctx)
        try:
            yield Rig(emulator, clock, follower)
        finally:
            follower.disconnect()


class Joint:
    """Moves the joint of a servo, tick by tick, no faster than the motor can."""

    STEP_S = 0.01

    def __init__(self, servo: EmulatedServo) -> None:
        self._servo, self.speed = servo, 0.0

    def step(self, change: float) -> None:
        """Change the speed [ticks/s] evenly over a tick, and move."""
        before, self.speed = self.speed, min(max(self.speed + change, -3073.0), 3073.0)
        self._servo.drive(self._servo.encoder + (before + self.speed) / 2 * self.STEP_S, self.speed)


class TestSetUp:
    def test_the_servos_hold_where_they_stand_with_their_settings_locked(self, rig: Rig) -> None:
        assert rig.register("torque_enable") == [1] * 6
        assert rig.register("goal_position") == rig.register("present_position")
        assert rig.register("lock") == [1] * 6
        assert rig.register("return_delay") == [0] * 6
        assert rig.register("p_coefficient") == [16] * 6
        assert rig.register("max_torque") == [1000] * 5 + [500]
        assert rig.register("protection_current") == [500] * 5 + [250]

    def test_positions_are_radians_from_the_middle_and_from_the_grippers_closed_end(self, rig: Rig) -> None:
        # Every joint stands at the middle of its range, 2 ticks above the middle of the turn.
        expected = [2 * TICK, 2 * TICK, -2 * TICK, 2 * TICK, 2 * TICK, -0.2 + 750 * TICK]
        np.testing.assert_allclose(rig.tick().position, expected, atol=1e-9)

    def test_a_goal_goes_to_the_servos_in_their_ticks(self, rig: Rig) -> None:
        rig.tick([0.1, 0.2, 0.3, -0.1, 0.0, 0.5])
        expected = [2048 + 0.1 / TICK, 2048 + 0.2 / TICK, 2048 - 0.3 / TICK, 2048 - 0.1 / TICK, 2048]
        assert rig.register("goal_position") == [round(tick) for tick in (*expected, 1500 + 0.7 / TICK)]

    def test_missing_servos_are_named_all_at_once(self, calibration_file: Path) -> None:
        with rig_of(calibration_file, retries=0) as rig:
            rig.emulator.faults.silent |= {2, 5}
            with pytest.raises(NoReply, match=r"no reply from servos 2 \(shoulder_lift\), 5 \(wrist_roll\); check its"):
                rig.follower.connect()
            assert rig.register("torque_enable") == [0] * 6

    def test_another_model_is_refused(self, calibration_file: Path) -> None:
        with rig_of(calibration_file) as rig:
            rig.emulator.servos[4].set("model_number", 2825)
            with pytest.raises(HardwareError, match=r"servo 4 \(wrist_flex\), model_number: it is model 2825"):
                rig.follower.connect()

    def test_firmwares_that_differ_are_refused(self, calibration_file: Path) -> None:
        with rig_of(calibration_file) as rig:
            rig.emulator.servos[4].set("firmware_minor", 9)
            with pytest.raises(HardwareError, match=r"different firmware: shoulder_pan 3\.10, .*wrist_flex 3\.9"):
                rig.follower.connect()

    def test_a_calibration_that_the_servo_does_not_have_is_refused_or_written(self, calibration_file: Path) -> None:
        with rig_of(calibration_file) as rig:
            rig.emulator.servos[1].set("homing_offset", 7)
            with pytest.raises(
                HardwareError, match=r"servo 1 \(shoulder_pan\), homing_offset: the servo has 7, .*-120"
            ):
                rig.follower.connect()
        with rig_of(calibration_file, write_calibration=True) as rig:
            rig.emulator.servos[1].set("homing_offset", 7)
            rig.follower.connect()
            assert rig.register("homing_offset")[0] == -120

    def test_a_calibration_without_a_joint_is_refused(self, tmp_path: Path) -> None:
        joints = {name: joint for name, joint in arm_calibration().joints.items() if name != "gripper"}
        file = save_calibration(Calibration(joints), tmp_path / "short.json")
        with pytest.raises(CalibrationError, match="has no joint 'gripper'"), rig_of(file):
            pass

    @pytest.mark.parametrize("source", ["", "my arms/desk.yaml"])
    def test_without_an_emulator_the_error_names_its_command(self, tmp_path: Path, source: str) -> None:
        options = FollowerOptions(port=str(tmp_path / "arm"), calibration=str(tmp_path / "none.json"))
        physics = "--physics 'my arms/desk.yaml' " if source else ""
        arguments = f"{physics}--link {options.port} --calibration {options.calibration}"
        command = f"run `ibrobot feetech emulate {arguments}` in another terminal"
        ctx = control_context(source=source)
        for known in ("there is no such port", "its emulator has no calibration"):
            with pytest.raises(HardwareError, match=re.escape(command)) as error:
                FeetechFollower(options, ctx)
            assert known in str(error.value)
            Path(options.port).touch()

    def test_an_emulator_that_ended_is_named_with_its_command(self, calibration_file: Path, tmp_path: Path) -> None:
        options = FollowerOptions(port=str(tmp_path / "arm"), calibration=str(calibration_file))
        follower = FeetechFollower(options, control_context())
        command = f"run `ibrobot feetech emulate --link {options.port} --calibration {calibration_file}` in another"
        with pytest.raises(
            HardwareError, match=re.escape(f"{options.port}: there is no such port; for an emulated arm {command}")
        ):
            follower.connect()

    def test_no_port_says_what_to_do(self, calibration_file: Path) -> None:
        options = FollowerOptions(port="/dev/ttyNONE", calibration=str(calibration_file))
        with pytest.raises(PortError, match=r"/dev/ttyNONE: there is no such port; check the USB cable"):
            FeetechFollower(options, control_context()).connect()


class TestFaults:
    def test_lost_replies_are_stale_and_then_a_fault_that_names_the_servo(self, rig: Rig) -> None:
        before = rig.tick().position
        rig.emulator.faults.silent.add(3)
        for reading in rig.run(3, before + 0.2):
            assert reading.stale
            assert reading.position[2] == before[2]
        assert reading.position[0] > before[0], "the others go on"
        with pytest.raises(
            NoReply, match=r"servo 3 \(elbow_flex\), present_position: no valid reply for 4 ticks; check its power"
        ):
            rig.tick()
        assert rig.follower.counters()["lost_replies"] == 4

    def test_a_reply_that_comes_again_ends_the_staleness(self, rig: Rig) -> None:
        rig.emulator.faults.silent.add(3)
        rig.run(2)
        rig.emulator.faults.silent.clear()
        assert not rig.tick().stale

    def test_writes_go_on_after_a_fault(self, rig: Rig) -> None:
        goal = rig.tick().position + 0.1
        rig.emulator.faults.silent.add(3)
        with pytest.raises(NoReply):
            rig.run(4, goal)
        before = rig.register("goal_position")
        rig.follower.write(goal + 0.1)
        after = rig.register("goal_position")
        assert [a != b for a, b in zip(after, before, strict=True)] == [True, True, False, True, True, True]

    def test_a_servo_that_browned_out_is_set_up_again_by_reset(self, rig: Rig) -> None:
        rig.tick()
        with rig.emulator.lock:
            rig.emulator.servos[3].brown_out()
            rig.emulator.servos[3].turn(2300)
        rig.emulator.faults.silent.add(3)
        with pytest.raises(NoReply):
            rig.run(4)
        rig.emulator.faults.silent.clear()
        rig.follower.reset_faults()
        assert rig.register("torque_enable") == [1] * 6
        assert rig.register("p_coefficient") == [16] * 6
        assert rig.register("goal_position")[2] == 2300
        assert not rig.tick().stale

    def test_one_that_browned_out_while_the_arm_is_relaxed_is_set_up_and_stays_relaxed(self, rig: Rig) -> None:
        rig.tick()
        rig.follower.relax()
        with rig.emulator.lock:
            rig.emulator.servos[3].brown_out()
        rig.emulator.faults.silent.add(3)
        for _ in range(3):
            rig.follower.read()
        with pytest.raises(NoReply):
            rig.follower.read()
        rig.emulator.faults.silent.clear()
        rig.follower.reset_faults()
        assert rig.register("torque_enable") == [0] * 6
        assert rig.register("acceleration") == [254] * 6
        rig.tick()
        assert rig.register("torque_enable") == [1] * 6

    def test_unplugged_is_a_fault_at_once_and_replugged_it_comes_back(
        self, ports: None, tmp_path: Path, calibration_file: Path
    ) -> None:
        with rig_of(calibration_file, link=tmp_path / "port") as rig:
            rig.follower.connect()
            rig.tick()
            rig.emulator.unplug()
            with pytest.raises(PortError, match="the port is gone; check the USB cable"):
                rig.tick()
            with pytest.raises(PortError, match="there is no such port"):
                rig.follower.reset_faults()
            with pytest.raises(PortError):
                rig.tick()
            rig.emulator.replug()
            rig.follower.reset_faults()
            assert not rig.tick().stale

    @given(
        speed=st.floats(-3000.0, 3000.0),
        lost=st.lists(st.integers(0, 3), min_size=1, max_size=3),
        acceleration=st.floats(-25_000.0, 25_000.0),
    )
    @settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
    def test_lost_replies_are_ridden_out_at_any_speed(
        self, calibration_file: Path, speed: float, lost: list[int], acceleration: float
    ) -> None:
        """The joint reaches `speed` [ticks/s]; in each gap of lost replies it speeds up or brakes [ticks/s^2]."""
        with rig_of(calibration_file) as rig:
            rig.follower.connect()
            joint = Joint(rig.emulator.servos[2])
            while joint.speed != speed:
                joint.step(float(np.clip(speed - joint.speed, -250.0, 250.0)))
                assert not rig.tick().stale
            for gap in lost:
                rig.emulator.faults.silent.add(2)
                for _ in range(gap):
                    joint.step(acceleration * Joint.STEP_S)
                    assert rig.tick().stale
                rig.emulator.faults.silent.clear()
                joint.step(acceleration * Joint.STEP_S)
                assert not rig.tick().stale
                joint.step(0.0)
                rig.tick()
            assert rig.follower.counters()["implausible_positions"] == 0

    def test_a_position_that_no_speed_explains_is_not_believed_until_it_is_said_again(self, rig: Rig) -> None:
        before = rig.run(2)[-1].position[1]
        servo = rig.emulator.servos[2]
        with rig.emulator.lock:
            servo.drive(servo.encoder + 300, 0.0)
        first, second = rig.run(2)
        assert first.stale
        assert first.position[1] == before
        assert not second.stale
        assert second.position[1] == pytest.approx(before + 300 * TICK, abs=1e-6)
        assert rig.follower.counters()["implausible_positions"] == 1


class TestTorque:
    def test_relaxed_means_torque_off_and_a_write_takes_over_where_the_joints_are(self, rig: Rig) -> None:
        rig.tick()
        rig.follower.relax()
        assert rig.register("torque_enable") == [0] * 6
        with rig.emulator.lock:
            rig.emulator.servos[1].turn(1900)
        rig.run(2, rig.run(2)[-1].position)
        assert rig.register("torque_enable") == [1] * 6

    def test_an_overload_still_takes_torque_off(self, rig: Rig) -> None:
        rig.emulator.faults.overloaded |= {2, 6}
        rig.run(210)
        assert [code & OVERLOAD for code in rig.register("status")] == [0, OVERLOAD, 0, 0, 0, OVERLOAD]
        assert rig.follower.relax() is Torque.OFF
        assert rig.register("torque_enable") == [0] * 6
        assert rig.follower.holding() is None

    def test_torque_that_nothing_confirms_is_unknown_and_named(
        self, rig: Rig, caplog: pytest.LogCaptureFixture
    ) -> None:
        rig.emulator.faults.silent.add(4)
        assert rig.follower.relax() is Torque.UNKNOWN
        assert [value for i, value in enumerate(rig.register("torque_enable")) if i != 3] == [0] * 5
        assert "servo 4 (wrist_flex), torque_enable: no reply" in caplog.text
        assert rig.follower.holding() == Holding(rig.emulator.port, f"ibrobot feetech torque off '{rig.emulator.port}'")

    def test_torque_that_stays_on_is_an_error(self, rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(rig.emulator.servos[4], "write", lambda address, content: None)
        with pytest.raises(HardwareError, match=r"servo 4 \(wrist_flex\), torque_enable: its torque stays on; cut its"):
            rig.follower.relax()
        assert rig.register("torque_enable") == [0, 0, 0, 1, 0, 0]
        assert rig.follower.holding() is not None

    def test_a_port_that_is_gone_leaves_it_unknown(self, ports: None, tmp_path: Path, calibration_file: Path) -> None:
        with rig_of(calibration_file, link=tmp_path / "port") as rig:
            assert rig.follower.holding() is None
            rig.follower.connect()
            rig.emulator.unplug()
            assert rig.follower.relax() is Torque.UNKNOWN
            rig.follower.disconnect()
            command = f"ibrobot feetech torque off {tmp_path / 'port'}"
            assert rig.follower.holding() == Holding(str(tmp_path / "port"), command)

    def test_the_command_names_servos_that_are_not_those_of_an_so101(self, tmp_path: Path) -> None:
        joints = arm_calibration().joints
        moved = {name: attrs.evolve(joint, id=joint.id + 10) for name, joint in joints.items()}
        file = save_calibration(Calibration(moved), tmp_path / "second.json")
        with rig_of(file, servos={number: EmulatedServo(number) for number in range(11, 17)}) as rig:
            rig.follower.connect()
            held = rig.follower.holding()
            assert held is not None
            assert held.command.endswith("--id 11 --id 12 --id 13 --id 14 --id 15 --id 16")

    @pytest.mark.parametrize("lost", [2, 6])
    def test_a_failed_start_takes_off_the_torque_that_it_put_on(self, lost: int, calibration_file: Path) -> None:
        with rig_of(calibration_file, retries=0) as rig:
            servos = rig.emulator.servos

            def lose() -> None:
                if servos[lost].torque:
                    rig.emulator.faults.silent.add(lost)
                elif any(servo.torque for servo in servos.values()):
                    lose.torque = True  # type: ignore[attr-defined]

            rig.emulator.on_request = lose
            with pytest.raises(NoReply, match=f"servo {lost} "):
                rig.follower.connect()
            assert lose.torque  # type: ignore[attr-defined]
            assert [servo.torque for servo in servos.values()] == [number == lost for number in servos]
            assert rig.follower.holding() is not None, "the silent servo may hold"

    def test_a_start_that_fails_before_torque_is_on_holds_nothing(self, calibration_file: Path) -> None:
        with rig_of(calibration_file) as rig:
            rig.emulator.faults.errors[3] = 0x01
            with pytest.raises(ServoFault, match=r"servo 3 \(elbow_flex\).*voltage"):
                rig.follower.connect()
            assert rig.register("torque_enable") == [0] * 6
            assert rig.follower.holding() is None


class TestHealth:
    def conditions(self, rig: Rig) -> dict[tuple[str, str], Severity]:
        return {(found.joint, found.quantity): found.severity for found in rig.follower.health()}

    @pytest.mark.parametrize(
        ("bits", "quantities", "message"),
        [
            (0x04, ["temperature"], "servo 5 (wrist_roll): the servo reports overheating; let the arm rest"),
            (0x20, ["load"], "servo 5 (wrist_roll): the servo reports overload; check whether something blocks"),
            (0x09, ["voltage", "current"], "servo 5 (wrist_roll): the servo reports voltage; check the power supply"),
            (0x40, ["unknown error bit 6"], "servo 5 (wrist_roll): the servo reports unknown error bit 6"),
        ],
    )
    def test_what_a_servo_reports_twice_is_a_fault(
        self, rig: Rig, bits: int, quantities: list[str], message: str
    ) -> None:
        rig.tick()
        rig.emulator.faults.errors[5] = bits
        rig.tick()
        assert not rig.follower.health()
        assert not rig.tick().stale
        assert self.conditions(rig) == dict.fromkeys([("wrist_roll", name) for name in quantities], Severity.FAULT)
        assert message in rig.follower.health()[0].message

    def test_an_error_ends_when_it_is_not_reported_twice(self, rig: Rig) -> None:
        rig.emulator.faults.errors[5] = 0x20
        rig.run(2)
        rig.emulator.faults.errors.clear()
        rig.tick()
        assert rig.follower.health()
        rig.tick()
        assert not rig.follower.health()

    def test_reset_ends_an_overload_at_the_first_attempt(self, rig: Rig) -> None:
        rig.emulator.faults.overloaded.add(2)
        rig.run(220)
        assert self.conditions(rig) == {("shoulder_lift", "load"): Severity.FAULT}
        rig.emulator.faults.overloaded.clear()
        rig.follower.reset_faults()
        assert not rig.follower.health()
        rig.run(3)
        assert not rig.follower.health()
        assert rig.register("torque_enable") == [1] * 6

    def test_a_reset_after_one_that_failed_halfway_puts_torque_on_again(self, rig: Rig) -> None:
        rig.emulator.faults.overloaded.add(2)
        rig.run(220)
        rig.emulator.faults.overloaded.clear()

        def cut_off() -> None:
            if not rig.emulator.servos[2].torque:
                rig.emulator.faults.silent.add(2)

        rig.emulator.on_request = cut_off
        with pytest.raises(NoReply):
            rig.follower.reset_faults()
        rig.emulator.on_request = lambda: None
        rig.emulator.faults.silent.clear()
        rig.run(2)
        assert not rig.follower.health(), "torque off has ended the overload"
        rig.follower.reset_faults()
        assert rig.register("torque_enable") == [1] * 6

    def test_reset_refuses_an_error_that_torque_off_would_not_end_and_leaves_torque_on(self, rig: Rig) -> None:
        rig.emulator.faults.errors[2] = 0x04
        rig.run(2)
        with pytest.raises(ServoFault, match=r"servo 2 \(shoulder_lift\), status: the servo reports overheating"):
            rig.follower.reset_faults()
        assert rig.register("torque_enable") == [1] * 6
        assert self.conditions(rig) == {("shoulder_lift", "temperature"): Severity.FAULT}

    def test_a_gripper_in_overload_is_a_warning_and_keeps_its_grasp(self, rig: Rig) -> None:
        grasp = rig.tick().position
        rig.emulator.faults.blocked.add(6)
        grasp[5] -= 0.6
        rig.run(250, grasp)
        (warning,) = rig.follower.health()
        assert (warning.joint, warning.quantity, warning.severity) == ("gripper", "load", Severity.WARNING)
        assert not warning.sheds_load
        assert "servo 6 (gripper): the servo is in overload and holds on with its protective torque" in warning.message
        assert rig.register("present_load")[5] == -200
        released: list[bool] = []
        rig.emulator.on_request = lambda: released.append(not rig.emulator.servos[6].torque)
        rig.emulator.faults.silent.add(3)
        with pytest.raises(NoReply):
            rig.run(4, grasp)
        rig.emulator.faults.silent.clear()
        rig.follower.reset_faults()
        rig.run(3, grasp)
        assert not any(released), "the reset of another joint's fault does not let go"

    def test_a_gripper_that_is_hot_in_overload_is_a_fault(self, rig: Rig) -> None:
        rig.emulator.faults.errors[6] = 0x24
        rig.run(2)
        assert self.conditions(rig) == {
            ("gripper", "load"): Severity.WARNING,
            ("gripper", "temperature"): Severity.FAULT,
        }

    @pytest.mark.parametrize(
        ("register", "value", "severity", "message"),
        [
            ("present_temperature", 56, Severity.WARNING, "temperature 56 deg C, above warning_temperature (55 deg C)"),
            ("present_temperature", 66, Severity.FAULT, "temperature 66 deg C, above max_temperature (65 deg C)"),
            ("present_voltage", 100, Severity.WARNING, "voltage 10 V, below warning_voltage_drop (10.3 V)"),
            ("present_voltage", 80, Severity.FAULT, "voltage 8 V, below max_voltage_drop (8.47 V)"),
            ("max_voltage_limit", 80, None, ""),
        ],
    )
    def test_a_value_beyond_its_level_is_named_with_both(
        self, rig: Rig, register: str, value: int, severity: Severity | None, message: str
    ) -> None:
        rig.tick()
        rig.emulator.servos[2].set(register, value)
        rig.run(103)
        quantity = register.removeprefix("present_")
        assert self.conditions(rig).get(("shoulder_lift", quantity)) is severity
        assert message in "".join(found.message for found in rig.follower.health())

    def test_the_servos_own_voltage_limits_are_faults(self, calibration_file: Path) -> None:
        with rig_of(calibration_file) as rig:
            for servo in rig.emulator.servos.values():
                servo.set("max_voltage_limit", 80)
                servo.set("present_voltage", 74)
            rig.follower.connect()
            rig.emulator.servos[1].set("present_voltage", 84)
            rig.run(3)
            assert self.conditions(rig) == {("shoulder_pan", "voltage"): Severity.FAULT}

    def test_a_single_odd_value_is_not_believed(self, rig: Rig) -> None:
        rig.tick()
        rig.emulator.servos[2].set("present_temperature", 60)
        temperature = np.zeros(6)
        while temperature[1] != 60.0:
            rig.tick()
            rig.follower.read_signal(0, temperature)
        rig.emulator.servos[2].set("present_temperature", 30)
        rig.run(3)
        assert not rig.follower.health()

    def test_a_brown_out_is_named_and_ended_by_reset(self, rig: Rig) -> None:
        rig.tick()
        rig.emulator.faults.brown_out.add(3)
        rig.run(103)
        (fault,) = rig.follower.health()
        assert (fault.joint, fault.quantity, fault.severity) == ("elbow_flex", "torque", Severity.FAULT)
        assert "servo 3 (elbow_flex): its torque went off by itself, as after a loss of power" in fault.message
        rig.follower.reset_faults()
        assert rig.register("torque_enable") == [1] * 6
        assert rig.register("acceleration") == [254] * 6
        rig.run(103)
        assert not rig.follower.health()

    def test_torque_that_was_taken_off_does_not_count_as_brown_out(self, rig: Rig) -> None:
        rig.tick()
        rig.follower.relax()
        for _ in range(103):
            rig.clock.advance(10_000_000)
            rig.follower.read()
        assert not rig.follower.health()

    def test_a_heavy_load_counts_when_it_lasts(self, rig: Rig) -> None:
        rig.emulator.servos[2].set("overload_torque", 100)
        rig.emulator.servos[2].set("protection_time", 254)
        rig.tick()
        rig.emulator.servos[2].set("torque_limit", 800)
        rig.emulator.faults.overloaded.add(2)
        rig.run(50)
        rig.emulator.faults.overloaded.clear()
        rig.run(60)
        rig.emulator.faults.overloaded.add(2)
        rig.run(90)
        assert not rig.follower.health(), "it did not last for a health_period"
        rig.run(130)
        (warning,) = rig.follower.health()
        assert "load 0.8 of full torque, above warning_load (0.7 of full torque)" in warning.message
        assert (warning.severity, warning.sheds_load) == (Severity.WARNING, True)

    @given(st.lists(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=5), min_size=1, max_size=4))
    def test_a_steady_load_is_the_least_of_the_last_complete_period(self, periods: list[list[float]]) -> None:
        steady = SteadyLoad(1, period_ns=10)
        for now_ns, loads in zip(range(10, 1000, 10), periods, strict=False):
            for load in loads:
                steady.add(np.array([load]), np.array([True]))
                steady.add(np.array([0.0]), np.array([False]))
            assert steady.held(now_ns) == min(map(abs, loads))
            assert steady.held(now_ns + 5) == min(map(abs, loads))

    def test_a_slow_reading_that_was_not_complete_is_soon_repeated(self, rig: Rig) -> None:
        temperature = np.zeros(6)
        rig.emulator.faults.silent.add(4)
        rig.tick()
        rig.emulator.faults.silent.clear()
        rig.follower.read_signal(0, temperature)
        assert np.isnan(temperature).all()
        rig.run(6)
        rig.follower.read_signal(0, temperature)
        assert temperature.tolist() == [28.0] * 6


class TestSignals:
    def test_health_is_read_in_si(self, rig: Rig) -> None:
        rig.emulator.servos[1].set("present_current", -10)
        rig.tick()
        values = {}
        for index, signal in enumerate(rig.follower.signals):
            values[signal.topic] = np.empty(6)
            rig.follower.read_signal(index, values[signal.topic])
        assert values["/arm/temperature"].tolist() == [28.0] * 6
        assert values["/arm/voltage"] == pytest.approx([12.1] * 6)
        assert values["/arm/current"][0] == pytest.approx(-0.065)
        assert set(values) == {"/arm/temperature", "/arm/voltage", "/arm/current", "/arm/load"}

    def test_effort_is_missing_unless_the_motors_torque_is_given(self, rig: Rig, calibration_file: Path) -> None:
        assert np.isnan(rig.tick().effort).all()
        with rig_of(calibration_file, stall_torque=2.0) as strong:
            strong.follower.connect()
            assert np.isfinite(strong.tick().effort).all()


def test_options_have_ranges() -> None:
    for change in ({"lost_replies": -1}, {"p_coefficient": 255}, {"max_temperature": 90.0}):
        with pytest.raises(ValueError):
            attrs.evolve(FollowerOptions(port="a", calibration="b"), **change)


def test_the_joints_of_the_fixture_are_those_of_the_robot() -> None:
    assert control_context().joints == JOINTS
