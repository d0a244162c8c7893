"""The bus against the emulated servos: every kind of request, every kind of damage, and no reply taken for another."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.emulator import Emulator
from ibrobot_feetech.errors import (
    EpromLocked,
    FeetechError,
    NoReply,
    PacketError,
    PortError,
    ServoFault,
    UnexpectedReply,
)
from ibrobot_feetech.sync import SyncReader, SyncWriter

from .conftest import arm_calibration, prepare
from .line import Line

SERVOS = (1, 2, 3, 4, 5, 6)


@pytest.fixture
def bus(emulator: Emulator) -> Iterator[FeetechBus]:
    bus = FeetechBus(emulator.port, joints={3: "elbow_flex"}, retries=0)
    bus.open()
    yield bus
    bus.close()


class OnALine:
    """Where replies are late or missing: in memory, by the bus's own measure of time and not by the machine's."""

    @pytest.fixture
    def emulator(self, lines: None) -> Iterator[Emulator]:
        with Line(6) as emulator:
            prepare(emulator, arm_calibration())
            yield emulator


class TestRequests:
    def test_what_is_written_is_read(self, bus: FeetechBus, emulator: Emulator) -> None:
        bus.write(2, "goal_position", 1234)
        assert bus.read(2, "goal_position") == 1234
        bus.write(2, "lock", 0)
        bus.write(2, "homing_offset", -77)
        assert bus.read(2, "homing_offset") == emulator.servos[2].get("homing_offset") == -77

    def test_eprom_is_written_while_unlocked_alone(self, bus: FeetechBus, emulator: Emulator) -> None:
        with pytest.raises(EpromLocked, match="servo 2, p_coefficient: EPROM is locked, 20 was not written"):
            bus.write(2, "p_coefficient", 20)
        bus.write(2, "lock", 0)
        bus.write(2, "p_coefficient", 20)
        bus.write(2, "lock", 1)
        emulator.servos[2].brown_out()
        assert bus.read(2, "p_coefficient") == 20

    def test_what_can_only_be_read_is_not_written(self, bus: FeetechBus) -> None:
        for write in (
            lambda: bus.write(2, "present_load", 1),
            lambda: bus.sync_write("present_load", {2: 1}),
            lambda: SyncWriter(bus, SERVOS, "present_load"),
        ):
            with pytest.raises(ValueError, match="present_load is read-only"):
                write()

    def test_sync_read_and_write_reach_all(self, bus: FeetechBus) -> None:
        goals = {servo: 2000 + servo for servo in SERVOS}
        bus.sync_write("goal_position", goals)
        assert bus.sync_read("goal_position", SERVOS) == goals

    def test_a_value_that_does_not_fit_is_refused_before_it_is_sent(self, bus: FeetechBus) -> None:
        with pytest.raises(ValueError, match="acceleration must be 0 to 255, not 256"):
            bus.write(1, "acceleration", 256)
        with pytest.raises(KeyError, match="did you mean 'goal_position'"):
            bus.read(1, "goal_positon")

    def test_the_ticks_traffic_is_the_same_as_single_requests(self, bus: FeetechBus) -> None:
        values = [100, 4095, 0, 2048, 7, 3000]
        SyncWriter(bus, SERVOS).write(np.array(values))
        replies = SyncReader(bus, SERVOS, "torque_enable", "present_current").read()
        reader = SyncReader(bus, SERVOS, "torque_enable", "present_current")
        assert replies.complete
        for row, servo in zip(replies.values, SERVOS, strict=True):
            assert row.tolist() == [bus.read(servo, name) for name in reader.registers]

    def test_negative_goals_are_sent_as_sign_and_magnitude(self, bus: FeetechBus) -> None:
        SyncWriter(bus, SERVOS).write([-5, 1, 2, 3, 4, 5])
        assert bus.read(1, "goal_position") == -5


class TestErrors:
    def test_what_a_servo_reports_is_named(self, bus: FeetechBus, emulator: Emulator) -> None:
        emulator.faults.errors[3] = 0x21
        with pytest.raises(ServoFault, match=r"servo 3 \(elbow_flex\), present_position: .*reports voltage, overload"):
            bus.read(3, "present_position")
        assert bus.read_faulty(3, "id") == 3
        replies = SyncReader(bus, SERVOS, "present_position").read()
        assert replies.errors.tolist() == [0, 0, 0x21, 0, 0, 0]
        assert replies.answered.all()
        assert not replies.complete

    def test_a_port_held_by_another_is_refused(self, bus: FeetechBus, emulator: Emulator) -> None:
        with pytest.raises(PortError, match="another program holds the port"):
            FeetechBus(emulator.port).open()

    def test_a_closed_bus_says_so_and_opens_again(self, bus: FeetechBus) -> None:
        bus.close()
        bus.close()
        with pytest.raises(PortError, match="the port is not open"):
            bus.read(1, "id")
        bus.open()
        assert bus.read(1, "id") == 1

    def test_a_port_that_vanishes_is_reported_at_once(self, bus: FeetechBus, emulator: Emulator) -> None:
        reader = SyncReader(bus, SERVOS, "present_position")
        emulator.unplug()
        for act in (reader.read, lambda: bus.read(1, "id"), lambda: bus.write(1, "lock", 0)):
            with pytest.raises(PortError, match="the port is gone"):
                act()

    def test_a_folder_is_refused_as_port(self, tmp_path: Path) -> None:
        with pytest.raises(PortError, match=r"cannot be opened|no permission"):
            FeetechBus(str(tmp_path)).open()


class TestSilence(OnALine):
    def test_scan_finds_those_that_are_there(self, bus: FeetechBus, emulator: Emulator) -> None:
        emulator.faults.silent.add(4)
        assert bus.scan(range(1, 10)) == dict.fromkeys((1, 2, 3, 5, 6), 777)

    def test_ping_says_who_is_missing(self, bus: FeetechBus) -> None:
        assert bus.ping(3) == 777
        with pytest.raises(NoReply, match=r"servo 9, model_number: no reply within .* ms; check its power"):
            bus.ping(9)

    def test_a_damaged_reply_differs_from_none(self, bus: FeetechBus, emulator: Emulator) -> None:
        emulator.faults.corrupt = 1.0
        with pytest.raises((PacketError, NoReply)):
            bus.read(1, "present_position")

    def test_retries_are_bounded_and_counted(self, emulator: Emulator) -> None:
        bus = FeetechBus(emulator.port, retries=3)
        bus.open()
        emulator.faults.silent.add(1)
        with pytest.raises(NoReply):
            bus.read(1, "present_position")
        assert (bus.counters["retries"], bus.counters["timeouts"]) == (3, 4)
        bus.close()

    def test_the_silence_of_one_does_not_hide_the_others(self, bus: FeetechBus, emulator: Emulator) -> None:
        emulator.faults.silent.add(3)
        replies = SyncReader(bus, SERVOS, "present_position").read()
        assert replies.answered.tolist() == [True, True, False, True, True, True]
        with pytest.raises(NoReply, match=r"servo 3 \(elbow_flex\), present_position: no reply"):
            bus.sync_read("present_position", SERVOS)


class TestLateReplies(OnALine):
    """The servo counts up with every request, so that an answer tells which request it is of."""

    @pytest.fixture
    def counting(self, emulator: Emulator) -> Emulator:
        state = {"count": -1}

        def count() -> None:
            state["count"] += 1
            for servo in emulator.servos.values():
                servo.drive(1000 + state["count"] + servo.get("homing_offset"), 0.0)

        count()
        emulator.on_request = count
        emulator.truth = lambda: 1000 + state["count"]  # type: ignore[attr-defined]
        return emulator

    @pytest.mark.parametrize("late_s", [0.0056, 0.006, 0.0065, 0.007, 0.008, 0.010, 0.012, 0.018, 0.025, 0.05])
    @pytest.mark.parametrize("late", [0.2, 1.0])
    def test_none_is_taken_for_the_answer_to_a_later_request(
        self, bus: FeetechBus, counting: Emulator, late: float, late_s: float
    ) -> None:
        faults = counting.faults
        reader = SyncReader(bus, SERVOS, "present_position", "present_load")
        for number in range(30):
            faults.late, faults.late_s = (late, late_s) if number % 3 == 0 else (0.0, 0.0)
            before = counting.truth()  # type: ignore[attr-defined]
            if number % 2:
                replies = reader.read()
                found = replies.values[replies.answered, 0].tolist()
            else:
                try:
                    found = [bus.read(2, "present_position")]
                except FeetechError:
                    found = []
            # Older values answer an earlier request; on a busy machine the servos may have had more requests since.
            assert all(before <= value <= counting.truth() for value in found)  # type: ignore[attr-defined]

    def test_a_servo_that_was_late_is_heard_again(self, bus: FeetechBus, counting: Emulator) -> None:
        reader = SyncReader(bus, SERVOS, "present_position", "present_load")
        counting.faults.late, counting.faults.late_s = 1.0, 0.02
        assert not reader.read().answered.any()
        counting.faults.late = 0.0
        assert any(reader.read().answered.all() for _ in range(20))

    def test_a_write_is_not_believed_by_the_acknowledgement_of_another(
        self, bus: FeetechBus, emulator: Emulator
    ) -> None:
        emulator.faults.late, emulator.faults.late_s = 1.0, 0.028
        bus.retries = 0
        with pytest.raises(FeetechError):
            bus.write(2, "goal_position", 1500)
        emulator.faults.late = 0.0
        emulator.servos[2].set("goal_position", 2000)
        emulator.faults.silent.add(2)
        with pytest.raises(NoReply):
            bus.write(2, "goal_position", 1600)

    def test_a_lost_acknowledgement_is_made_up_for_by_reading_back(self, bus: FeetechBus, emulator: Emulator) -> None:
        emulator.faults.drop = 1.0
        emulator.on_request = lambda: setattr(emulator.faults, "drop", 0.0)
        bus.write(2, "goal_position", 1500)
        assert bus.counters["timeouts"] == 1

    def test_a_register_that_does_not_keep_its_value_is_reported(self, bus: FeetechBus, emulator: Emulator) -> None:
        def overwrite() -> None:
            emulator.faults.drop = 0.0
            emulator.servos[2].set("acceleration", 5)

        emulator.faults.drop = 1.0
        emulator.on_request = overwrite
        with pytest.raises(UnexpectedReply, match=r"acceleration: it was set to 20 and reads 5"):
            bus.write(2, "acceleration", 20)

    def test_an_acknowledgement_that_nobody_waited_for_may_be_late_too(
        self, bus: FeetechBus, emulator: Emulator
    ) -> None:
        emulator.faults.drop = 1.0
        with pytest.raises(NoReply):
            bus.write(2, "acceleration", 20)
        emulator.faults.drop = 0.0
        until = bus.outstanding[2, 0]
        bus.write(2, "acceleration", 30)
        assert bus.outstanding[2, 0] > until

    def test_resynchronise_forgets_nothing_too_early(self, bus: FeetechBus, counting: Emulator) -> None:
        counting.faults.late, counting.faults.late_s = 1.0, 0.1
        with pytest.raises(NoReply):
            bus.read(2, "present_position")
        counting.faults.late = 0.0
        bus.resynchronise()
        assert bus.counters["discarded_bytes"] > 0
        before = counting.truth()  # type: ignore[attr-defined]
        assert bus.read(2, "present_position") >= before


class TestDamage(OnALine):
    @pytest.mark.parametrize("seed", range(3))
    def test_garbage_and_duplicates_are_passed_over(self, lines: None, seed: int) -> None:
        with Line(6, seed=seed) as emulator:
            emulator.faults.corrupt, emulator.faults.drop, emulator.faults.duplicate = 0.01, 0.02, 0.05
            bus = FeetechBus(emulator.port, retries=8)
            bus.open()
            for servo in SERVOS:
                emulator.servos[servo].drive(2000 + 10 * servo, 0.0)
            wrong = 0
            for _ in range(200):
                for servo, value in bus.sync_read("present_position", SERVOS).items():
                    wrong += value != 2000 + 10 * servo
            # Two damaged bytes may agree with an 8-bit checksum, once in 256 such packets.
            assert wrong <= 1
            assert bus.counters["bad_packets"] > 0
            assert bus.counters["late_replies"] > 0
            bus.close()
