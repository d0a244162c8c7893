"""LeRobot's Feetech bus and arms, and the SDK below them, unmodified, on the emulated bus."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import scservo_sdk as scs
from ibrobot_calibration import Calibration, JointCalibration, load_calibration
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import EmulatedServo, Emulator
from ibrobot_feetech.registers import BAUD_RATES
from lerobot.motors import Motor, MotorCalibration, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus
from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig
from lerobot.teleoperators.so_leader import SO101Leader, SO101LeaderConfig
from lerobot_units import normalised
from lerobot_version import LEROBOT
from packaging.version import Version

from ibrobot_core.clock import SteppedClock

pytestmark = [pytest.mark.lerobot, pytest.mark.usefixtures("patient_buses")]

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
CALIBRATION = {
    name: MotorCalibration(servo, 0, -300 + 100 * servo, 500 + servo, 3500 + servo)
    for servo, name in enumerate(JOINTS, 1)
}
ADDRESS = {"torque_enable": 40, "goal_position": 42, "present_position": 56}


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock()


@pytest.fixture
def emulator(clock: SteppedClock) -> Iterator[Emulator]:
    with Emulator(clock=clock) as served:
        yield served


@pytest.fixture
def bus(emulator: Emulator) -> Iterator[FeetechMotorsBus]:
    """Connected, with a handshake: every motor and its firmware."""
    made = FeetechMotorsBus(emulator.port, motors())
    made.connect()
    yield made
    made.disconnect()


def motors() -> dict[str, Motor]:
    return {name: Motor(servo, "sts3215", MotorNormMode.RANGE_M100_100) for servo, name in enumerate(JOINTS, 1)}


def everywhere(emulator: Emulator, register: str) -> list[int]:
    """A register of every servo, by id."""
    with emulator.lock:
        return [emulator.servos[servo].get(register) for servo in range(1, 7)]


def turn(emulator: Emulator, servo: int, encoder: float) -> None:
    with emulator.lock:
        emulator.servos[servo].turn(encoder)


class TestBus:
    def test_ping_and_broadcast_ping(self, bus: FeetechMotorsBus) -> None:
        assert bus.ping("gripper") == 777
        assert bus.broadcast_ping() == dict.fromkeys(range(1, 7), 777)

    def test_a_missing_motor_fails_the_handshake(self, emulator: Emulator) -> None:
        emulator.faults.silent.add(4)
        made = FeetechMotorsBus(emulator.port, motors())
        with pytest.raises(RuntimeError, match=r"Missing motor IDs:\s+- 4 "):
            made.connect()
        made.port_handler.closePort()

    @pytest.mark.parametrize("rate", [1_000_000, 38_400])
    def test_scan_finds_the_rate(self, rate: int, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(FeetechMotorsBus, "available_baudrates", [38_400, 115_200, 1_000_000])
        monkeypatch.setattr("tqdm.tqdm.monitor_interval", 0)  # no thread of tqdm's
        servos = {servo: EmulatedServo(servo) for servo in (1, 2)}
        for servo in servos.values():
            servo.set("baud_rate", BAUD_RATES[rate])
        with Emulator(servos) as emulator:
            assert FeetechMotorsBus.scan_port(emulator.port) == {rate: [1, 2]}

    def test_read_decodes_signs(self, bus: FeetechMotorsBus, emulator: Emulator) -> None:
        with emulator.lock:
            emulator.servos[3].set("homing_offset", -1234)
            emulator.servos[3].turn(1000)
        assert bus.read("Homing_Offset", "elbow_flex") == -1234
        assert bus.read("Present_Position", "elbow_flex", normalize=False) == 2234

    def test_write_encodes_signs_and_obeys_the_lock(self, bus: FeetechMotorsBus, emulator: Emulator) -> None:
        bus.enable_torque()
        assert everywhere(emulator, "lock") == [1] * 6
        bus.write("Homing_Offset", "wrist_roll", -700)
        assert everywhere(emulator, "homing_offset") == [0] * 6
        bus.disable_torque()
        assert everywhere(emulator, "lock") == everywhere(emulator, "torque_enable") == [0] * 6
        bus.write("Homing_Offset", "wrist_roll", -700)
        assert everywhere(emulator, "homing_offset") == [0, 0, 0, 0, -700, 0]

    def test_sync_read_of_what_can_be_read(self, bus: FeetechMotorsBus, emulator: Emulator) -> None:
        for servo in range(1, 7):
            turn(emulator, servo, 1000 + servo)
        assert list(bus.sync_read("Present_Position", normalize=False).values()) == list(range(1001, 1007))
        assert bus.sync_read("Present_Position", ["gripper", "elbow_flex"], normalize=False) == {
            "gripper": 1006,
            "elbow_flex": 1003,
        }
        assert set(bus.sync_read("Present_Voltage").values()) == {121}
        assert set(bus.sync_read("Present_Temperature").values()) == {28}
        assert set(bus.sync_read("Present_Velocity").values()) == {0}
        assert set(bus.sync_read("Present_Load").values()) == {0}
        assert set(bus.sync_read("Moving").values()) == {0}

    def test_sync_write_of_goals_one_value_and_some_motors(self, bus: FeetechMotorsBus, emulator: Emulator) -> None:
        bus.sync_write("Goal_Position", {name: 1500 + servo for servo, name in enumerate(JOINTS)}, normalize=False)
        bus.sync_write("Acceleration", 20)
        bus.sync_write("Goal_Velocity", {"gripper": -250})
        # A sync-write is not answered: what is read afterwards, in the same line, was written before.
        assert list(bus.sync_read("Goal_Position", normalize=False).values()) == [1500, 1501, 1502, 1503, 1504, 1505]
        assert everywhere(emulator, "acceleration") == [20] * 6
        assert everywhere(emulator, "goal_velocity") == [0, 0, 0, 0, 0, -250]

    def test_normalised_positions_are_ours(self, bus: FeetechMotorsBus, emulator: Emulator) -> None:
        bus.disable_torque()
        bus.write_calibration(CALIBRATION)
        turn(emulator, 2, 1800.0)
        calibration = CALIBRATION["shoulder_lift"]
        assert bus.read("Present_Position", "shoulder_lift") == normalised(
            1800 - calibration.homing_offset, "range_m100_100", calibration
        )

    def test_configure_motors(self, bus: FeetechMotorsBus, emulator: Emulator) -> None:
        with emulator.lock:
            emulator.servos[2].set("phase", 28)
        bus.disable_torque()
        bus.configure_motors()
        assert everywhere(emulator, "return_delay") == [0] * 6
        assert everywhere(emulator, "maximum_acceleration") == everywhere(emulator, "acceleration") == [254] * 6
        if Version("0.6") <= LEROBOT:  # it turns a servo that counts turns back
            assert everywhere(emulator, "phase") == [12] * 6

    def test_an_error_bit_is_named(self, bus: FeetechMotorsBus, emulator: Emulator) -> None:
        emulator.faults.errors[5] = 0x04
        with pytest.raises(RuntimeError, match="Overheat"):
            bus.read("Present_Position", "wrist_roll", normalize=False)
        emulator.faults.errors.clear()

    def test_a_servo_gone_silent_fails_a_sync_read(self, bus: FeetechMotorsBus, emulator: Emulator) -> None:
        emulator.faults.silent.add(6)
        with pytest.raises(ConnectionError, match="Failed to sync read 'Present_Position'"):
            bus.sync_read("Present_Position", normalize=False)
        emulator.faults.silent.clear()

    def test_goals_are_followed(self, bus: FeetechMotorsBus, clock: SteppedClock) -> None:
        bus.enable_torque()
        bus.sync_write("Goal_Position", dict.fromkeys(JOINTS, 2600), normalize=False)
        assert set(bus.sync_read("Present_Position", normalize=False).values()) == {2048}
        clock.advance(5_000_000_000)
        assert set(bus.sync_read("Present_Position", normalize=False).values()) == {2600}


class TestCalibration:
    def test_what_is_written_is_read_and_is_calibrated(self, bus: FeetechMotorsBus) -> None:
        assert not bus.is_calibrated
        bus.disable_torque()
        bus.write_calibration(CALIBRATION)
        assert bus.read_calibration() == CALIBRATION
        assert bus.is_calibrated
        bus.reset_calibration()
        assert set(bus.sync_read("Max_Position_Limit").values()) == {4095}

    def test_half_turn_homings(self, bus: FeetechMotorsBus, emulator: Emulator) -> None:
        bus.disable_torque()
        for servo, encoder in enumerate((100, 1000, 2047, 3000, 4000, 4094), 1):
            turn(emulator, servo, encoder)
        offsets = bus.set_half_turn_homings()
        assert list(offsets.values()) == [-1947, -1047, 0, 953, 1953, 2047]
        assert everywhere(emulator, "homing_offset") == list(offsets.values())
        assert set(bus.sync_read("Present_Position", normalize=False).values()) == {2047}

    def test_an_offset_that_has_no_code_is_refused(self, bus: FeetechMotorsBus, emulator: Emulator) -> None:
        bus.disable_torque()
        turn(emulator, 1, 4095)
        with pytest.raises(ValueError, match="exceeds 2047"):
            bus.set_half_turn_homings()

    def test_ranges_of_motion(self, bus: FeetechMotorsBus, emulator: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
        bus.disable_torque()
        steps = iter([(1000, False), (3000, False), (2000, True)])

        def moved_by_hand() -> bool:
            encoder, enter = next(steps)
            for servo in range(1, 7):
                turn(emulator, servo, encoder + servo)
            return enter

        monkeypatch.setattr("lerobot.motors.motors_bus.enter_pressed", moved_by_hand)
        least, greatest = bus.record_ranges_of_motion(display_values=False)
        assert list(least.values()) == list(range(1001, 1007))
        assert list(greatest.values()) == list(range(3001, 3007))

    def test_what_we_save_and_write_is_calibrated_for_lerobot(self, emulator: Emulator, tmp_path: Path) -> None:
        joints = {name: JointCalibration(servo, 0, 40 * servo - 100, 700, 3300) for servo, name in enumerate(JOINTS, 1)}
        save_calibration(Calibration(joints, robot="left"), tmp_path / "left.json")
        ours = FeetechBus(emulator.port)
        ours.open()
        for joint in joints.values():
            ours.write(joint.id, "lock", 0)
            ours.write(joint.id, "homing_offset", joint.homing_offset)
            ours.write(joint.id, "min_position_limit", joint.range_min)
            ours.write(joint.id, "max_position_limit", joint.range_max)
            ours.write(joint.id, "lock", 1)
        ours.close()
        follower = SO101Follower(SO101FollowerConfig(port=emulator.port, id="left", calibration_dir=tmp_path))
        follower.connect(calibrate=False)
        assert follower.is_calibrated
        follower.disconnect()


@pytest.mark.parametrize(("initial_id", "rate"), [(1, 1_000_000), (9, 115_200)])
def test_setup_motor_changes_id_and_rate(initial_id: int, rate: int) -> None:
    servo = EmulatedServo(initial_id)
    servo.set("baud_rate", BAUD_RATES[rate])
    with Emulator({initial_id: servo}) as emulator:
        bus = FeetechMotorsBus(emulator.port, {"gripper": Motor(6, "sts3215", MotorNormMode.RANGE_0_100)})
        bus.setup_motor("gripper", initial_baudrate=rate)
        assert bus.get_baudrate() == 1_000_000
        assert bus.ping("gripper") == 777
        bus.port_handler.closePort()
    assert (servo.id, servo.get("baud_rate")) == (6, 0)


class TestArms:
    @pytest.fixture(autouse=True)
    def calibrated(self, emulator: Emulator, tmp_path: Path) -> None:
        """A file of ours, whose numbers the arm does not have yet."""
        joints = {name: JointCalibration(**vars(CALIBRATION[name])) for name in JOINTS}
        save_calibration(Calibration(joints), tmp_path / "arm.json")

    def test_follower(
        self, emulator: Emulator, clock: SteppedClock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("builtins.input", lambda prompt: "")  # enter: take the file's calibration
        config = SO101FollowerConfig(port=emulator.port, id="arm", calibration_dir=tmp_path, use_degrees=False)
        follower = SO101Follower(config)
        # As after a run of LeRobot's: torque off and unlocked.
        follower.bus.connect()
        follower.bus.disconnect()
        follower.connect()
        assert follower.is_calibrated
        assert everywhere(emulator, "p_coefficient") == [16] * 6
        assert everywhere(emulator, "max_torque") == [1000] * 5 + [500]
        assert everywhere(emulator, "torque_enable") == [1] * 6
        action = {f"{name}.pos": 20.0 for name in JOINTS}
        assert follower.send_action(action) == action
        follower.get_observation()
        clock.advance(5_000_000_000)
        # Goals are cut to whole ticks: 3000 ticks are 200 (gripper: 100) units.
        assert follower.get_observation() == pytest.approx(action, abs=200 / 3000)
        follower.disconnect()
        assert everywhere(emulator, "torque_enable") == [0] * 6

    def test_leader(self, emulator: Emulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("builtins.input", lambda prompt: "")
        config = SO101LeaderConfig(port=emulator.port, id="arm", calibration_dir=tmp_path, use_degrees=False)
        leader = SO101Leader(config)
        leader.bus.connect()
        leader.bus.disconnect()
        leader.connect()
        for servo, name in enumerate(JOINTS, 1):
            turn(emulator, servo, CALIBRATION[name].range_max + CALIBRATION[name].homing_offset)
        assert leader.get_action() == {f"{name}.pos": 100.0 for name in JOINTS}
        leader.disconnect()

    def test_follower_calibrates_and_we_load_its_file(
        self, emulator: Emulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for servo in range(1, 7):
            turn(emulator, servo, 1500 + 100 * servo)
        steps = iter([(-800, False), (900, True)])

        def moved_by_hand() -> bool:
            way, enter = next(steps)
            for servo in (1, 2, 3, 4, 6):
                turn(emulator, servo, 1500 + 100 * servo + way)
            return enter

        monkeypatch.setattr("builtins.input", lambda prompt: "")
        monkeypatch.setattr("lerobot.motors.motors_bus.enter_pressed", moved_by_hand)
        follower = SO101Follower(SO101FollowerConfig(port=emulator.port, id="new", calibration_dir=tmp_path))
        follower.connect()
        loaded = load_calibration(tmp_path / "new.json", JOINTS)
        assert [joint.homing_offset for joint in loaded.joints.values()] == [-447, -347, -247, -147, -47, 53]
        assert loaded.joints["elbow_flex"].range_min == 2047 - 800
        assert loaded.joints["wrist_roll"].range_max == 4095
        follower.disconnect()


class TestSdk:
    """feetech-servo-sdk itself, with nothing of LeRobot's between."""

    @pytest.fixture
    def port(self, emulator: Emulator) -> Iterator[scs.PortHandler]:
        handler = scs.PortHandler(emulator.port)
        assert handler.openPort()
        assert handler.setBaudRate(1_000_000)
        yield handler
        handler.closePort()

    def test_ping_read_and_write(self, port: scs.PortHandler, emulator: Emulator) -> None:
        packets = scs.PacketHandler(0)
        assert packets.ping(port, 2) == (777, scs.COMM_SUCCESS, 0)
        assert packets.write2ByteTxRx(port, 2, ADDRESS["goal_position"], 1234) == (scs.COMM_SUCCESS, 0)
        assert packets.read2ByteTxRx(port, 2, ADDRESS["goal_position"]) == (1234, scs.COMM_SUCCESS, 0)
        assert packets.write1ByteTxRx(port, 2, ADDRESS["torque_enable"], 1) == (scs.COMM_SUCCESS, 0)
        assert everywhere(emulator, "torque_enable") == [0, 1, 0, 0, 0, 0]
        assert packets.ping(port, 9)[1] == scs.COMM_RX_TIMEOUT

    def test_reg_write_waits_for_action(self, port: scs.PortHandler, emulator: Emulator) -> None:
        packets = scs.PacketHandler(0)
        assert packets.regWriteTxRx(port, 3, ADDRESS["goal_position"], 2, [0x10, 0x04]) == (scs.COMM_SUCCESS, 0)
        assert everywhere(emulator, "goal_position")[2] == 2048
        assert packets.action(port, scs.BROADCAST_ID) == scs.COMM_SUCCESS
        assert packets.read2ByteTxRx(port, 3, ADDRESS["goal_position"])[0] == 0x0410

    def test_group_sync_write_and_read(self, port: scs.PortHandler, emulator: Emulator) -> None:
        packets = scs.PacketHandler(0)
        writer = scs.GroupSyncWrite(port, packets, ADDRESS["goal_position"], 2)
        for servo in range(1, 7):
            assert writer.addParam(servo, [servo, 7])
        assert writer.txPacket() == scs.COMM_SUCCESS
        reader = scs.GroupSyncRead(port, packets, ADDRESS["goal_position"], 2)
        for servo in range(1, 7):
            assert reader.addParam(servo)
        assert reader.txRxPacket() == scs.COMM_SUCCESS
        for servo in range(1, 7):
            assert reader.isAvailable(servo, ADDRESS["goal_position"], 2)
            assert reader.getData(servo, ADDRESS["goal_position"], 2) == 7 * 256 + servo
