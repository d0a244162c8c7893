"""The emulated servo bus by its raw bytes, through a pseudo-terminal."""

from __future__ import annotations

import os
import select
import termios
import time
import tty
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
import serial
from ibrobot_feetech.emulator import EmulatedServo, Emulator
from ibrobot_feetech.protocol import BROADCAST, Instruction, Packet, Scanner, pack
from ibrobot_feetech.registers import BAUD_RATES, register

from ibrobot_core.api import SteppedClock, ns

SERVOS = 3
OVERLOAD = 0x20
PING_1 = bytes.fromhex("FF FF 01 02 01 FB")
PONG_1 = bytes.fromhex("FF FF 01 02 00 FC")


class Host:
    """The other end of the cable: raw bytes, with no bus code of ours."""

    def __init__(self, port: str) -> None:
        self.descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.descriptor)
        self.baud(termios.B1000000)

    def baud(self, speed: int) -> None:
        attributes = termios.tcgetattr(self.descriptor)
        attributes[4] = attributes[5] = speed
        termios.tcsetattr(self.descriptor, termios.TCSANOW, attributes)

    def send(self, request: bytes) -> None:
        os.write(self.descriptor, request)

    def receive(self, size: int) -> bytes:
        received = b""
        while len(received) < size:
            ready, _, _ = select.select((self.descriptor,), (), (), 10.0)
            assert ready, f"got only {received.hex(' ')} of {size} bytes"
            received += os.read(self.descriptor, size - len(received))
        return received

    def ask(self, servo: int, code: int, parameters: bytes = b"", answers: int = 1) -> list[Packet]:
        """Send a packet; returns that many replies."""
        self.send(pack(Packet(servo, code, parameters)))
        scanner = Scanner()
        replies: list[Packet] = []
        while len(replies) < answers:
            replies += scanner.feed(self.receive(1))
        return replies

    def write(self, servo: int, name: str, value: int) -> Packet:
        found = register(name)
        return self.ask(servo, Instruction.WRITE, bytes((found.address,)) + found.encode(value))[0]

    def read(self, servo: int, name: str) -> int:
        found = register(name)
        reply = self.ask(servo, Instruction.READ, bytes((found.address, found.size)))[0]
        assert reply.servo == servo
        return found.decode(reply.parameters)

    def quiet(self) -> None:
        """Nothing was sent but what was received: the next reply is the one to the next request."""
        self.send(PING_1)
        assert self.receive(len(PONG_1)) == PONG_1


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock()


@pytest.fixture
def emulator(clock: SteppedClock) -> Iterator[Emulator]:
    with Emulator(SERVOS, clock=clock) as served:
        yield served


@pytest.fixture
def host(emulator: Emulator) -> Iterator[Host]:
    made = Host(emulator.port)
    yield made
    os.close(made.descriptor)


class TestPackets:
    def test_ping(self, host: Host) -> None:
        host.send(PING_1)
        assert host.receive(6) == PONG_1

    def test_read_of_position(self, host: Host, emulator: Emulator) -> None:
        emulator.servos[1].turn(0x0518)
        host.send(bytes.fromhex("FF FF 01 04 02 38 02 BE"))
        assert host.receive(8) == bytes.fromhex("FF FF 01 04 00 18 05 DD")

    def test_write_is_acknowledged(self, host: Host, emulator: Emulator) -> None:
        host.send(bytes.fromhex("FF FF 01 05 03 2A 00 08 C4"))
        assert host.receive(6) == PONG_1
        assert emulator.servos[1].get("goal_position") == 2048

    def test_wrong_checksum_is_not_heard(self, host: Host) -> None:
        host.send(bytes.fromhex("FF FF 01 02 01 FC"))
        host.quiet()

    def test_broadcast_ping_is_answered_by_all_in_order(self, host: Host) -> None:
        assert [reply.servo for reply in host.ask(BROADCAST, Instruction.PING, answers=SERVOS)] == [1, 2, 3]

    def test_broadcast_write_is_carried_out_and_not_answered(self, host: Host, emulator: Emulator) -> None:
        host.send(pack(Packet(BROADCAST, Instruction.WRITE, bytes((40, 1)))))
        host.quiet()
        assert all(servo.torque for servo in emulator.servos.values())

    def test_sync_read_is_answered_in_the_order_asked(self, host: Host, emulator: Emulator) -> None:
        emulator.faults.silent.add(1)
        replies = host.ask(BROADCAST, Instruction.SYNC_READ, bytes((5, 1, 3, 1, 2)), answers=2)
        assert replies == [Packet(3, 0, b"\x03"), Packet(2, 0, b"\x02")]

    def test_sync_write(self, host: Host, emulator: Emulator) -> None:
        host.send(pack(Packet(BROADCAST, Instruction.SYNC_WRITE, bytes((42, 2, 1, 0x10, 4, 3, 0x20, 4, 9, 0, 0)))))
        host.quiet()
        assert [emulator.servos[i].get("goal_position") for i in (1, 2, 3)] == [0x410, 2048, 0x420]

    def test_reg_write_waits_for_action(self, host: Host, emulator: Emulator) -> None:
        host.ask(1, Instruction.REG_WRITE, bytes((42, 0, 4)))
        assert emulator.servos[1].get("goal_position") == 2048
        host.send(pack(Packet(BROADCAST, Instruction.ACTION)))
        host.quiet()
        assert emulator.servos[1].get("goal_position") == 1024

    def test_status_return_level_0_answers_only_what_is_asked(self, host: Host) -> None:
        host.write(2, "lock", 0)
        host.write(2, "status_return_level", 0)  # itself answered still
        host.send(pack(Packet(2, Instruction.WRITE, bytes((40, 1)))))
        host.quiet()
        assert host.read(2, "torque_enable") == 1


class TestTable:
    def test_as_it_ships(self, host: Host) -> None:
        shipped = {
            "model_number": 777, "id": 1, "baud_rate": 0, "return_delay": 250, "min_position_limit": 0,
            "max_position_limit": 4095, "max_torque": 1000, "p_coefficient": 32, "d_coefficient": 32,
            "i_coefficient": 0, "homing_offset": 0, "operating_mode": 0, "torque_enable": 0, "lock": 1,
        }  # fmt: skip
        assert {name: host.read(1, name) for name in shipped} == shipped

    def test_eprom_keeps_its_values_while_locked(self, host: Host) -> None:
        host.write(1, "p_coefficient", 16)
        assert host.read(1, "p_coefficient") == 32
        host.write(1, "lock", 0)
        host.write(1, "p_coefficient", 16)
        assert host.read(1, "p_coefficient") == 16

    def test_measured_values_cannot_be_written(self, host: Host) -> None:
        host.write(1, "present_temperature", 99)
        assert host.read(1, "present_temperature") == 28

    def test_a_new_id_is_answered_by_the_former_one(self, host: Host) -> None:
        host.write(2, "lock", 0)
        assert host.write(2, "id", 20).servo == 2
        assert host.read(20, "id") == 20
        host.send(pack(Packet(2, Instruction.PING)))
        host.quiet()

    def test_a_new_baud_rate_counts_from_now_on(self, host: Host, emulator: Emulator) -> None:
        host.write(1, "lock", 0)
        host.send(pack(Packet(1, Instruction.WRITE, bytes((6, 4)))))
        host.receive(6)
        assert host.read(2, "id") == 2
        assert [reply.servo for reply in host.ask(BROADCAST, Instruction.PING, answers=2)] == [2, 3]
        host.baud(termios.B115200)
        assert host.read(1, "baud_rate") == 4

    @pytest.mark.parametrize("offset", [-2047, -1, 0, 1000, 2047])
    def test_reported_position_is_the_encoder_less_the_offset(
        self, offset: int, host: Host, emulator: Emulator
    ) -> None:
        host.write(1, "lock", 0)
        host.write(1, "homing_offset", offset)
        raw = offset if offset >= 0 else 0x800 | -offset
        assert emulator.servos[1].read(31, 2) == raw.to_bytes(2, "little")
        for encoder in (100, 2048, 4000):
            emulator.servos[1].turn(encoder)
            assert host.read(1, "present_position") == (encoder - offset) % 4096

    def test_bit_4_of_phase_reports_beyond_one_turn(self, host: Host, emulator: Emulator) -> None:
        host.write(1, "lock", 0)
        host.write(1, "homing_offset", 1000)
        host.write(1, "phase", 12 | 0x10)
        emulator.servos[1].turn(100)
        assert host.read(1, "present_position") == -900

    def test_torque_128_makes_here_the_middle(self, host: Host, emulator: Emulator) -> None:
        emulator.servos[1].turn(3000)
        host.write(1, "torque_enable", 128)
        assert host.read(1, "present_position") == 2048
        assert host.read(1, "torque_enable") == 0

    def test_too_hot_and_too_little_voltage_are_in_the_error_byte(self, host: Host, emulator: Emulator) -> None:
        emulator.servos[1].set("present_temperature", 71)
        emulator.servos[2].set("present_voltage", 39)
        assert [reply.code for reply in host.ask(BROADCAST, Instruction.PING, answers=3)] == [0x04, 0x01, 0]

    def test_brown_out_keeps_only_eprom(self, host: Host, emulator: Emulator) -> None:
        host.write(1, "lock", 0)
        host.write(1, "p_coefficient", 16)
        host.write(1, "torque_enable", 1)
        emulator.servos[1].brown_out()
        names = ("p_coefficient", "torque_enable", "lock")
        assert [host.read(1, name) for name in names] == [16, 0, 1]


class TestMotion:
    def follow(self, host: Host, clock: SteppedClock, count: int, step_s: float = 0.02) -> list[int]:
        positions = []
        for _ in range(count):
            clock.advance(ns(step_s))
            positions.append(host.read(1, "present_position"))
        return positions

    def test_trapezoid_within_velocity_and_acceleration(self, host: Host, clock: SteppedClock) -> None:
        host.write(1, "acceleration", 50)  # 5000 ticks/s²
        host.write(1, "goal_velocity", 1000)
        host.write(1, "torque_enable", 1)
        host.write(1, "goal_position", 3048)
        positions = [2048, *self.follow(host, clock, 80)]
        steps = [after - before for before, after in pairwise(positions)]
        assert positions[-1] == 3048
        assert all(0 <= step <= 1000 * 0.02 + 1 for step in steps)
        assert max(steps) >= 19  # it does reach its velocity
        assert all(abs(b - a) <= 5000 * 0.02**2 + 2 for a, b in pairwise(steps))
        assert host.read(1, "moving") == 0

    def test_without_torque_it_stays(self, host: Host, clock: SteppedClock) -> None:
        host.write(1, "goal_position", 3000)
        assert self.follow(host, clock, 10) == [2048] * 10

    def test_goals_are_held_within_the_limits(self, host: Host, clock: SteppedClock) -> None:
        host.write(1, "lock", 0)
        host.write(1, "max_position_limit", 2500)
        host.write(1, "torque_enable", 1)
        host.write(1, "goal_position", 4000)
        assert self.follow(host, clock, 100)[-1] == 2500

    def test_a_hand_is_weaker_than_the_motor(self) -> None:
        servo = EmulatedServo(1)
        servo.set("torque_enable", 1)
        with pytest.raises(ValueError, match="servo 1 has torque on"):
            servo.turn(100)


class TestFaults:
    def test_dropped(self, host: Host, emulator: Emulator) -> None:
        emulator.faults.drop = 1.0
        host.send(pack(Packet(2, Instruction.WRITE, bytes((40, 1)))))
        while not emulator.faults.counts["dropped"]:
            os.sched_yield()
        emulator.faults.drop = 0.0
        host.quiet()
        assert emulator.servos[2].torque  # only the reply is lost

    def test_duplicated(self, host: Host, emulator: Emulator) -> None:
        emulator.faults.duplicate = 1.0
        host.send(PING_1)
        assert host.receive(12) == PONG_1 * 2

    def test_corrupt_is_the_same_for_the_same_seed(self) -> None:
        def received(seed: int) -> bytes:
            with Emulator(1, seed=seed) as emulator:
                emulator.faults.corrupt = 0.3
                host = Host(emulator.port)
                host.send(PING_1)
                got = host.receive(6)
                os.close(host.descriptor)
                return got

        assert received(1) == received(1) != received(2)

    def test_a_late_reply_comes_after_the_next_one(self, host: Host, emulator: Emulator) -> None:
        emulator.faults.late, emulator.faults.late_s = 1.0, 0.3
        host.send(pack(Packet(2, Instruction.PING)))
        while not emulator.faults.counts["late"]:
            os.sched_yield()
        emulator.faults.late = 0.0
        host.quiet()
        assert host.receive(6)[2] == 2

    def test_error_bits(self, host: Host, emulator: Emulator) -> None:
        emulator.faults.errors[1] = 0x20
        assert host.ask(1, Instruction.PING)[0].code == 0x20

    def test_a_blocked_joint_stays_and_is_in_overload_after_its_protection_time(
        self, host: Host, emulator: Emulator, clock: SteppedClock
    ) -> None:
        host.write(1, "torque_enable", 1)
        emulator.faults.blocked.add(1)
        host.write(1, "goal_position", 3000)
        clock.advance(ns(1.9))
        assert host.read(1, "present_position") == 2048
        assert host.read(1, "present_load") == 1000
        assert host.read(1, "status") == 0
        clock.advance(ns(0.2))
        assert host.read(1, "status") == OVERLOAD
        assert host.read(1, "present_load") == 200, "the protective torque"
        emulator.faults.blocked.clear()
        clock.advance(ns(1.0))
        assert host.read(1, "present_position") == 3000
        assert host.read(1, "status") == OVERLOAD, "it lasts until the torque was off"

    def test_the_acknowledgement_of_torque_off_still_carries_the_overload(
        self, host: Host, emulator: Emulator, clock: SteppedClock
    ) -> None:
        host.write(1, "torque_enable", 1)
        emulator.faults.overloaded.add(1)
        host.read(1, "status")
        clock.advance(ns(2.1))
        assert host.read(1, "status") == OVERLOAD
        emulator.faults.overloaded.clear()
        assert host.write(1, "torque_enable", 0).code == OVERLOAD
        assert host.write(1, "torque_enable", 1).code == 0

    def test_a_light_load_never_overloads(self, host: Host, emulator: Emulator, clock: SteppedClock) -> None:
        host.write(1, "torque_enable", 1)
        emulator.faults.blocked.add(1)
        host.write(1, "goal_position", 2048 + 50)
        clock.advance(ns(60.0))
        assert 0 < host.read(1, "present_load") < 800
        assert host.read(1, "status") == 0

    def test_a_brown_out_happens_once(self, host: Host, emulator: Emulator) -> None:
        host.write(2, "torque_enable", 1)
        host.write(2, "acceleration", 7)
        emulator.faults.brown_out.add(2)
        assert host.read(2, "torque_enable") == 0
        assert host.read(2, "acceleration") == 0
        assert emulator.faults.brown_out == set()
        host.write(2, "torque_enable", 1)
        assert host.read(2, "torque_enable") == 1

    def test_a_disconnected_servo_is_silent_and_comes_back_without_torque(self, host: Host, emulator: Emulator) -> None:
        host.write(2, "torque_enable", 1)
        emulator.faults.disconnected.add(2)
        host.send(pack(Packet(2, Instruction.PING)))
        host.quiet()
        with emulator.lock:
            emulator.servos[2].turn(1000)
        emulator.faults.disconnected.clear()
        assert host.read(2, "torque_enable") == 0
        assert host.read(2, "present_position") == 1000


class TestPort:
    @pytest.mark.parametrize("rate", BAUD_RATES)
    def test_servos_answer_at_their_own_rate_and_no_other_ends_the_service(self, rate: int) -> None:
        with Emulator(1, baud_rate=rate, throttle=True) as emulator:
            emulator.servos[1].set("baud_rate", BAUD_RATES[rate])
            for asked in (*BAUD_RATES, 300):
                with serial.Serial(emulator.port, asked, timeout=5.0 if asked == rate else 0.02) as port:
                    port.write(PING_1)
                    assert port.read(6) == (PONG_1 if asked == rate else b"")

    def test_throttled_bytes_take_at_least_their_time_on_the_wire(self) -> None:
        with Emulator(1, throttle=True) as emulator:
            emulator.servos[1].set("return_delay", 0)
            host = Host(emulator.port)
            begin = time.monotonic()
            host.ask(1, Instruction.READ, bytes((0, 100)))
            elapsed_s = time.monotonic() - begin
            os.close(host.descriptor)
        assert elapsed_s >= (8 + 106) * 10 / 1e6  # request and reply, ten bits a byte

    def test_unplug_and_replug_under_the_same_link(self, tmp_path: Path) -> None:
        link = tmp_path / "arm"
        with Emulator(1, link=link) as emulator:
            host = Host(str(link))
            emulator.unplug()
            with pytest.raises(OSError, match="Input/output error"):
                host.send(PING_1)
            os.close(host.descriptor)
            assert not link.is_symlink()
            emulator.replug()
            host = Host(str(link))
            host.quiet()
            os.close(host.descriptor)
        assert not link.is_symlink()

    def test_what_goes_wrong_while_serving_is_raised_at_the_end(self) -> None:
        emulator = Emulator(1)
        emulator.on_request = lambda: 1 / 0  # type: ignore[assignment]
        emulator.start()
        host = Host(emulator.port)
        host.send(PING_1)
        assert emulator._thread is not None
        emulator._thread.join(10.0)
        os.close(host.descriptor)
        with pytest.raises(ZeroDivisionError):
            emulator.stop()
