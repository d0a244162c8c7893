"""Whether an arm is the one that its calibration is of, and stands the supply that it is given."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import attrs
import pytest
from click.testing import CliRunner
from ibrobot_calibration import load_calibration
from ibrobot_feetech import ibrobot_doctor
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.commands.check import differences
from ibrobot_feetech.emulator import Emulator
from ibrobot_feetech.errors import PortError, PortForbidden, PortHeld
from ibrobot_feetech.follower import FeetechFollower
from ibrobot_feetech.leader import LeaderTeleop
from ibrobot_feetech.options import FollowerOptions, LeaderOptions
from ibrobot_feetech.port import SerialPort
from ibrobot_testing.command import command_line
from ibrobot_testing.contexts import control_context, host_context
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from ibrobot_core.api import HardwareError, TeleopError

from .conftest import arm_calibration, prepare
from .line import Line

feetech = command_line("feetech")


@pytest.fixture(autouse=True)
def _in_memory(lines: None) -> None:
    pass


@pytest.fixture
def emulator() -> Iterator[Emulator]:
    with Line(6) as emulator:
        prepare(emulator, arm_calibration())
        yield emulator


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """The calibration of an arm whose adapter has the serial number FOLLOWER."""
    return save_calibration(attrs.evolve(arm_calibration(), adapter="FOLLOWER"), tmp_path / "follower.json")


def plug_in(monkeypatch: pytest.MonkeyPatch, adapters: Mapping[str, str | None]) -> None:
    """Make up USB adapters: port -> serial number."""
    found = []
    for path, serial_number in adapters.items():
        port = ListPortInfo(str(Path(path).resolve()))
        port.vid, port.pid, port.serial_number = 0x1A86, 0x55D3, serial_number
        found.append(port)
    monkeypatch.setattr(list_ports, "comports", lambda: found)


def follower(port: str, file: Path) -> FeetechFollower:
    return FeetechFollower(FollowerOptions(port, str(file)), control_context("arm"))


class TestAdapter:
    def test_the_right_one_connects(self, emulator: Emulator, file: Path, monkeypatch: pytest.MonkeyPatch):
        plug_in(monkeypatch, {emulator.port: "FOLLOWER"})
        arm = follower(emulator.port, file)
        arm.connect()
        arm.disconnect()

    def test_a_swapped_follower_is_refused_before_its_torque_is_on(
        self, emulator: Emulator, file: Path, monkeypatch: pytest.MonkeyPatch
    ):
        plug_in(monkeypatch, {emulator.port: "LEADER", "/dev/ttyACM7": "FOLLOWER"})
        with pytest.raises(HardwareError) as refused:
            follower(emulator.port, file).connect()
        for words in (
            emulator.port,
            "LEADER",
            "follower.json was made with FOLLOWER",
            "is at /dev/ttyACM7",
            "swapped?",
        ):
            assert words in str(refused.value)
        assert not any(servo.torque for servo in emulator.servos.values())

    @pytest.mark.parametrize("serial_number", ["LEADER", None])
    def test_a_swapped_leader_is_refused(
        self, emulator: Emulator, file: Path, monkeypatch: pytest.MonkeyPatch, serial_number: str | None
    ):
        plug_in(monkeypatch, {emulator.port: serial_number})
        leader = LeaderTeleop(LeaderOptions(emulator.port, str(file), deadman="none"), host_context("leader"))
        with pytest.raises(TeleopError, match=r"leader: .*another arm: its adapter has .* made with FOLLOWER"):
            leader.connect()

    def test_a_replaced_adapter_is_remembered_as_the_message_says(
        self, emulator: Emulator, file: Path, monkeypatch: pytest.MonkeyPatch
    ):
        plug_in(monkeypatch, {emulator.port: "NEW"})
        with pytest.raises(HardwareError, match=f"`ibrobot feetech import {file} --port {emulator.port} --yes`"):
            follower(emulator.port, file).connect()
        run = CliRunner().invoke
        absent = run(feetech, ["import", str(file), "--port", "/dev/ttyACM9", "--yes"])
        assert isinstance(absent.exception, HardwareError)
        assert "there is no USB adapter" in str(absent.exception)
        assert run(feetech, ["import", str(file), "--port", emulator.port, "--yes"]).exit_code == 0
        assert load_calibration(file).adapter == "NEW"
        arm = follower(emulator.port, file)
        arm.connect()
        arm.disconnect()
        assert run(feetech, ["import", str(file), "--zero-at", "range", "--yes"]).exit_code == 0
        assert load_calibration(file).adapter == "NEW", "another 0 rad is no other arm"

    def test_a_port_that_is_not_behind_usb_has_nothing_to_compare(self, emulator: Emulator, file: Path):
        arm = follower(emulator.port, file)
        arm.connect()
        arm.disconnect()


class TestRenumberedPorts:
    """After a reboot the adapters may have each other's number, or new ones."""

    @pytest.mark.usefixtures("ports")
    def test_an_arm_is_found_by_the_serial_number_of_its_adapter(self, file: Path, monkeypatch: pytest.MonkeyPatch):
        named = FollowerOptions("serial:FOLLOWER", str(file))
        with Emulator(6) as emulator:
            prepare(emulator, arm_calibration())
            plug_in(monkeypatch, {"/dev/ttyACM0": "LEADER", emulator.port: "FOLLOWER"})
            assert named.devices() == {"port": os.path.realpath(emulator.port)}
            arm = follower("serial:FOLLOWER", file)
            arm.connect()
            arm.disconnect()
            leader = LeaderTeleop(LeaderOptions("serial:FOLLOWER", str(file), deadman="none"), host_context("leader"))
            leader.connect()
            leader.disconnect()

    def test_an_adapter_that_is_absent_is_named_and_so_are_the_others(
        self, file: Path, monkeypatch: pytest.MonkeyPatch
    ):
        plug_in(monkeypatch, {"/dev/ttyACM0": "LEADER", "/dev/ttyACM1": None})
        with pytest.raises(PortError, match=r"no USB adapter with this .* there is serial:LEADER at /dev/ttyACM0;"):
            follower("serial:FOLLOWER", file).connect()
        assert FollowerOptions("serial:FOLLOWER", str(file)).devices() == {"port": "serial:FOLLOWER"}
        plug_in(monkeypatch, {})
        with pytest.raises(PortError, match=r"there is none with one"):
            SerialPort("serial:FOLLOWER", 1_000_000).open()

    def test_a_port_that_is_gone_says_where_its_arm_is(
        self, emulator: Emulator, file: Path, monkeypatch: pytest.MonkeyPatch
    ):
        plug_in(monkeypatch, {emulator.port: "FOLLOWER"})
        with pytest.raises(PortError) as refused:
            follower("/dev/ttyACM9", file).connect()
        for words in ("/dev/ttyACM9: there is no such port", "follower.json is at ", "`port: serial:FOLLOWER`"):
            assert words in str(refused.value)
        plug_in(monkeypatch, {"/dev/ttyACM3": "LEADER"})
        with pytest.raises(PortError, match=r"there is no such port; check"):
            follower("/dev/ttyACM9", file).connect()


class TestSupply:
    def test_servos_for_less_than_they_are_given_are_named(self, emulator: Emulator, file: Path):
        emulator.servos[3].set("max_voltage_limit", 80)
        with pytest.raises(HardwareError) as refused:
            follower(emulator.port, file).connect()
        for words in ("servo 3 (elbow_flex)", "measures 12.1 V", "made for 4.0 to 8.0 V", "unplug it now"):
            assert words in str(refused.value)
        assert not any(servo.torque for servo in emulator.servos.values())

    def test_a_supply_that_is_too_weak_is_another_matter(self, emulator: Emulator, file: Path):
        emulator.servos[2].set("present_voltage", 31)
        with pytest.raises(HardwareError, match=r"servo 2 .* measures 3\.1 V, and is made for 4\.0 .*check the supply"):
            follower(emulator.port, file).connect()

    def test_check_shows_what_a_servo_measures_and_its_limits(self, emulator: Emulator):
        emulator.servos[3].set("max_voltage_limit", 80)
        bus = FeetechBus(emulator.port)
        bus.open()
        (found,) = (each for each in differences(bus, arm_calibration()) if each.register == "present_voltage")
        bus.close()
        assert (found.joint, found.found, found.wanted, found.matters) == ("elbow_flex", "12.1 V", "4.0 to 8.0 V", True)
        assert "unplug it now" in found.remedy


class TestPort:
    @pytest.mark.parametrize(
        ("number", "kind", "message"),
        [
            (2, PortError, "there is no such port; check the USB cable"),
            (13, PortForbidden, "no permission; add yourself to the group"),
            (16, PortHeld, "another program holds the port; close that program"),
        ],
    )
    def test_the_remedy_is_that_of_what_happened(
        self, monkeypatch: pytest.MonkeyPatch, number: int, kind: type[PortError], message: str
    ):
        def refuse(*arguments: object, **options: object) -> None:
            raise OSError(number, "refused")

        monkeypatch.setattr("serial.Serial", refuse)
        with pytest.raises(kind, match=message) as refused:
            SerialPort("/dev/ttyACM0", 1_000_000).open()
        assert ("cable" in str(refused.value)) == (kind is PortError)


def test_doctor_names_ports_that_the_user_may_not_open(monkeypatch: pytest.MonkeyPatch) -> None:
    plug_in(monkeypatch, {"/dev/ttyACM0": "A", "/dev/ttyACM1": "B"})
    monkeypatch.setattr(os, "access", lambda path, mode: path.endswith("0"))
    free, locked = ibrobot_doctor()
    assert (free.ok, free.found) == (True, "readable and writable")
    assert (locked.ok, locked.name) == (False, "serial port /dev/ttyACM1")
    assert "dialout" in locked.remedy


def test_doctor_says_if_there_is_no_port(monkeypatch: pytest.MonkeyPatch) -> None:
    plug_in(monkeypatch, {})
    (none,) = ibrobot_doctor()
    assert (none.ok, none.found) == (True, "none; connect the arm if you expected one")
