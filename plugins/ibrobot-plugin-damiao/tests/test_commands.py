"""The commands on emulated motors behind an slcan adapter, and a run with them."""

from __future__ import annotations

import json
import re
import select
import shlex
import socket
import subprocess
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import can
import pytest
import yaml
from click.testing import CliRunner
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from ibrobot_damiao import bus, protocol
from ibrobot_damiao.bus import Channel, DamiaoBus
from ibrobot_damiao.emulator import EmulatedMotor, EmulatedMotors, serve
from ibrobot_damiao.emulator.serve import SlcanServer
from ibrobot_testing import ibrobot_command
from ibrobot_testing.command import command_line

from ibrobot_core.api import HardwareError, IbrobotError

damiao = command_line("damiao")


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine may keep the emulator, a thread of this process, from answering for a while."""
    monkeypatch.setattr(bus, "_ANSWER_S", 0.1)


@pytest.fixture
def adapter() -> Iterator[SlcanServer]:
    with SlcanServer(EmulatedMotors([EmulatedMotor(motor) for motor in (1, 2, 5)])) as server:
        yield server


def ran(*arguments: str) -> tuple[int, str]:
    """The exit code, and what is on the screen, with the error that the command line prints."""
    result = CliRunner().invoke(damiao, arguments)
    if isinstance(result.exception, IbrobotError):
        return 1, f"{result.output}error: {result.exception}"
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


def config(folder: Path, channel: str, **changes: Any) -> Path:
    joints = {"pan": 1, "tilt": 2, "turn": 5}
    limits = {"lower": -1.0, "upper": 1.0, "max_velocity": 2.0, "max_acceleration": 10.0}
    motors = {joint: {"id": motor, "kp": 40.0, "kd": 1.5} for joint, motor in joints.items()}
    robot = {
        "robot": {
            "name": "tryout",
            "joints": [{"name": joint, **limits} for joint in joints],
            "groups": {"all": [*joints]},
        },
        "hardware": {"type": "damiao", "channel": channel, "motors": motors, **changes},
        "executors": {"joints": {"type": "position", "group": "all"}},
        "control_modes": {"work": {"executors": ["joints"]}},
        "default_control_mode": "work",
    }
    path = folder / "tryout.yaml"
    path.write_text(yaml.safe_dump(robot, sort_keys=False))
    return path


def test_scan_lists_the_motors_with_their_state(adapter: SlcanServer) -> None:
    adapter.motors[2].fail(0xB)
    code, screen = ran("scan", adapter.channel, "--last", "6")
    assert code == 0
    assert [line.split(":")[0] for line in screen.splitlines()] == ["motor 1", "motor 2", "motor 5"]
    assert "feedback id 0x12, torque over-temperature of the driver" in screen


def test_scan_lists_a_motor_whose_first_answer_is_lost(adapter: SlcanServer, monkeypatch: pytest.MonkeyPatch) -> None:
    receive, seen = EmulatedMotor.receive, set()

    def losing(motor: EmulatedMotor, arbitration_id: int, data: bytes, now_s: float) -> list[Any]:
        answers = [*receive(motor, arbitration_id, data, now_s)]
        first = bool(answers) and (arbitration_id, data) not in seen
        seen.add((arbitration_id, data))
        return [] if first else answers

    monkeypatch.setattr(EmulatedMotor, "receive", losing)
    code, screen = ran("scan", adapter.channel, "--last", "2")
    assert code == 0
    assert [line.split(":")[0] for line in screen.splitlines()] == ["motor 1", "motor 2"]


@pytest.mark.integration
@pytest.mark.skipif(find_spec("ibrobot_diagnose") is None, reason="needs ibrobot-plugin-diagnose")
def test_preflight_names_what_holds_torque(adapter: SlcanServer, tmp_path: Path) -> None:
    """It switches the torque on, so that the arm keeps its pose, and says how to switch it off."""
    robot = config(tmp_path, adapter.channel, lost_replies=1000)
    contract = {
        "rate_hz": 30,
        "observations": [{"key": "observation.state", "topic": "/joint_states"}],
        "actions": [{"key": "action", "executor": "joints", "topic": "/joints/commands"}],
    }
    robot.write_text(robot.read_text() + yaml.safe_dump({"contract": contract}))
    patient = ("--seconds", "0.5", "--set", "control.state_timeout=60")
    done = subprocess.run(
        [*ibrobot_command(), "preflight", str(robot), "--json", *patient],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (
        f"{adapter.channel} holds torque; to take it off: `ibrobot damiao off {adapter.channel} --id 1" in done.stderr
    )
    verdicts = {line["name"]: line["verdict"] for line in json.loads(done.stdout)["lines"]}
    failed = {name for name, verdict in verdicts.items() if verdict == "fail"}
    assert verdicts["joints_unwell"] == "ok"
    assert failed <= {"loop_slow", "ticks_missed"}, "a busy machine may be late, and nothing else fails"
    assert done.returncode == bool(failed)


def test_scan_of_an_empty_bus_says_what_to_check(adapter: SlcanServer) -> None:
    for motor in adapter.motors.motors:
        motor.silent = True
    code, screen = ran("scan", adapter.channel, "--last", "2")
    assert code == 1
    assert "no motor answers to ids 1 to 2; check the motors' power" in screen


@pytest.mark.parametrize(
    ("channel", "message"),
    [
        ("can77", "can77: cannot be opened: .*sudo ip link set can77 up type can bitrate 1000000"),
        ("/dev/none", "/dev/none: cannot be opened: .*check the adapter's cable"),
        ("socket://127.0.0.1:{free}", "cannot be opened: .*check the adapter's cable"),
    ],
)
def test_a_channel_that_is_not_there_says_how_to_get_it(channel: str, message: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        free = taken.getsockname()[1]
    code, screen = ran("scan", channel.format(free=free))
    assert code == 1
    assert re.search(message, screen), screen


def test_an_unknown_interface_type_names_those_that_are(adapter: SlcanServer) -> None:
    code, screen = ran("scan", "can0", "--interface", "sockecan")
    assert code != 0
    assert "socketcan" in screen


def test_off_takes_the_torque_of_those_that_are_there(adapter: SlcanServer) -> None:
    for motor in adapter.motors.motors:
        motor.state = 1
    code, screen = ran("off", adapter.channel, "--id", "1", "--id", "5", "--yes")
    assert code == 0
    assert "torque off: motor 1, motor 5" in screen
    assert [motor.state for motor in adapter.motors.motors] == [0, 1, 0]


def test_off_takes_the_torque_of_the_others_if_one_does_not_answer(adapter: SlcanServer) -> None:
    """As the end of a run prints the command, with the ids of all motors."""
    for motor in adapter.motors.motors:
        motor.state = 1
    adapter.motors[2].silent = True
    code, screen = ran("off", adapter.channel, "--id", "2", "--id", "1", "--id", "5", "--yes")
    assert code == 1
    assert "torque off: motor 1, motor 5" in screen
    assert re.search("sent to motor 2, but it is not confirmed: .*motor 2: does not answer", screen)
    assert [motor.state for motor in adapter.motors.motors] == [0, 1, 0]


def test_off_and_scan_reach_motors_that_cannot_be_used(adapter: SlcanServer) -> None:
    adapter.motors.motors.append(EmulatedMotor(2, feedback_id=0x44))
    adapter.motors[5].registers[21] = 9999.0
    for motor in adapter.motors.motors:
        motor.state = 1
    code, screen = ran("scan", adapter.channel, "--last", "6")
    assert code == 1
    assert re.search(
        "motor 1: feedback id 0x11, torque on, .*\n.*motor 2: 2 motors have .*\n.*motor 5: .*9999,", screen
    )
    assert "2 of 3 motors cannot be used" in screen
    code, screen = ran("off", adapter.channel, "--id", "1", "--id", "2", "--id", "5", "--yes")
    assert code == 1
    assert "torque off: motor 1" in screen
    assert "sent to motor 2, motor 5, but it is not confirmed" in screen
    assert not any(motor.state for motor in adapter.motors.motors)


def test_command_that_takes_the_torque_off_has_all_that_it_needs(adapter: SlcanServer) -> None:
    channel = Channel(adapter.channel, "slcan", 500_000)
    adapter.motors[1].state = 1
    code, screen = ran("off", *shlex.split(channel.arguments), "--id", "1", "--yes")
    assert (code, adapter.motors[1].state) == (0, 0), screen
    assert Channel("can0").arguments == "can0"
    assert Channel("a b", data_bitrate=5_000_000).arguments == "'a b' --data-bitrate 5000000"


@pytest.mark.parametrize("interface", ["socketcand", "neovi", "serial", "usb2can", "pcan", "etas"])
def test_interface_that_cannot_be_used_so_is_one_error(interface: str) -> None:
    code, screen = ran("scan", "nowhere", "--interface", interface)
    assert code == 1
    assert "error: nowhere: " in screen


def test_off_without_an_answer_changes_nothing(adapter: SlcanServer) -> None:
    adapter.motors[1].state = 1
    code, screen = ran("off", adapter.channel, "--id", "1")
    assert code != 0
    assert "--yes" in screen
    assert adapter.motors[1].state == 1


def test_the_present_pose_becomes_zero(adapter: SlcanServer, tmp_path: Path) -> None:
    for motor in adapter.motors.motors:
        motor.angle = 0.1 * motor.id
    code, screen = ran("zero", str(config(tmp_path, adapter.channel)), "--joint", "pan", "--joint", "turn", "--yes")
    assert code == 0, screen
    assert "turn: zero set; it was at 0.500 rad" in screen
    assert [round(motor.zero, 2) for motor in adapter.motors.motors] == [0.1, 0.0, 0.5]


def test_zero_of_an_unknown_joint_or_arm_names_the_known_ones(adapter: SlcanServer, tmp_path: Path) -> None:
    robot = str(config(tmp_path, adapter.channel))
    assert "no joint 'pam'; available: pan, tilt, turn" in ran("zero", robot, "--joint", "pam", "--yes")[1]
    assert "no arm 'left' of type damiao" in ran("zero", robot, "--arm", "left", "--yes")[1]
    assert not any(motor.zero for motor in adapter.motors.motors)


def test_a_motor_gets_an_id_that_it_keeps(adapter: SlcanServer) -> None:
    code, screen = ran("set-id", adapter.channel, "5", "3")
    assert code == 0, screen
    motor = adapter.motors[3]
    motor.restart()
    assert (motor.id, motor.registers[7]) == (3, 0x13)
    assert "motor 5 is motor 3, with feedback id 0x13" in screen


def test_an_id_that_is_taken_is_refused(adapter: SlcanServer) -> None:
    code, screen = ran("set-id", adapter.channel, "5", "2")
    assert code != 0
    assert "a motor has id 2 already" in screen
    assert [motor.id for motor in adapter.motors.motors] == [1, 2, 5]


def test_a_pulled_cable_ends_a_request_with_what_to_check(adapter: SlcanServer) -> None:
    opened = DamiaoBus(Channel(adapter.channel))
    opened.open()
    try:
        opened.find(1)
        adapter.unplug()
        with pytest.raises(HardwareError, match=r"(has failed|does not take a frame|does not answer).*check"):
            opened.ask(1)
    finally:
        opened.close()


@pytest.fixture
def opened(adapter: SlcanServer) -> Iterator[DamiaoBus]:
    """A bus on which motors 1 and 2 were found."""
    opened = DamiaoBus(Channel(adapter.channel))
    opened.open()
    try:
        opened.find(1)
        opened.find(2)
        yield opened
    finally:
        opened.close()


def test_request_on_a_silent_bus_waits_for_nothing_but_its_answers(
    opened: DamiaoBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A look for old frames that reads, in place of asking whether there are any, costs half as much as the answers."""
    receive, read = can.BusABC.recv, []

    def counted(bus: can.BusABC, timeout: float | None = None) -> can.Message | None:
        read.append(message := receive(bus, timeout))
        return message

    monkeypatch.setattr(can.BusABC, "recv", counted)
    assert opened.refresh((1, 2), 10.0).keys() == {1, 2}
    assert [message.arbitration_id for message in read if message is not None] == [0x11, 0x12]
    assert len(read) == 2


def test_feedback_that_came_before_a_request_is_not_its_answer(adapter: SlcanServer, opened: DamiaoBus) -> None:
    for number in range(20):
        opened.send(1, protocol.command(protocol.DISABLE))
        assert select.select([opened._opened()], [], [], 10.0)[0]
        adapter.motors[1].angle = number / 10
        assert opened.ask(1).position == pytest.approx(number / 10, abs=1e-3)
    assert opened.counters["strange_frames"] == 0


DAMAGED = (
    st.tuples(st.sampled_from("tTrRdDbBxzF"), st.text("0123456789ABCDEF", max_size=30)).map("".join).map(str.encode)
)
"""Lines of an adapter that were cut or changed, e.g. `t12`, whose parts are missing."""
NO_TEXT = st.builds(
    lambda left, byte, right: left + byte + right, DAMAGED, st.sampled_from([b"\x80", b"\xc3", b"\xff"]), DAMAGED
)
"""Lines with a byte that is not UTF-8."""


@given(line=DAMAGED | NO_TEXT)
@example(line=b"t0118\xff")
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_line_of_an_adapter_costs_at_most_a_retry(opened: DamiaoBus, line: bytes) -> None:
    original = serve.line_of
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(serve, "line_of", lambda frame: line + b"\r" + original(frame))
        assert opened.ask(1).motor == 1


def test_line_that_is_no_text_costs_no_other_and_is_counted(opened: DamiaoBus) -> None:
    original, before = serve.line_of, opened.counters["strange_frames"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(serve, "line_of", lambda frame: b"t0118\xff\r" + original(frame))
        assert opened.refresh((1, 2), 10.0).keys() == {1, 2}
    assert opened.counters["strange_frames"] == before + 2
