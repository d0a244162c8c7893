"""`ibrobot feetech emulate` as a user runs it."""

from __future__ import annotations

import os
import signal
import subprocess
from itertools import pairwise
from pathlib import Path

import pytest
from ibrobot_calibration import load_calibration
from ibrobot_feetech import bus as bus_module
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.commands.emulate import Hand
from ibrobot_feetech.emulator import Emulator
from ibrobot_feetech.ticks import MIDDLE_TICK, TICKS_PER_RADIAN
from ibrobot_testing import ibrobot_command


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_says_its_port_serves_and_ends_cleanly(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bus_module, "_ADAPTER_S", 2.0)  # so long does a scan take, whoever answers
    link = tmp_path / "arm"
    command = (
        *ibrobot_command(), "feetech", "emulate", "--servos", "2", "--link", str(link), "--calibration", "two",
        "--prefix", "left_",
    )  # fmt: skip
    environment = {**os.environ, "XDG_CONFIG_HOME": str(tmp_path)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as ran:
        try:
            assert ran.stdout is not None
            assert ran.stderr is not None
            assert ran.stdout.readline() == f"{link}\n"
            bus = FeetechBus(str(link))
            bus.open()
            assert bus.scan() == {1: 777, 2: 777}
            low = bus.read(2, "min_position_limit")
            bus.close()
            ran.send_signal(number)
            assert "Traceback" not in ran.stderr.read()
        finally:
            ran.terminate()
    assert ran.returncode == 0
    assert not link.is_symlink()
    calibration = load_calibration(tmp_path / "ibrobot" / "calibration" / "two.json")
    assert list(calibration.joints) == ["left_shoulder_pan", "left_shoulder_lift"]
    assert calibration.joints["left_shoulder_lift"].range_min == low


def test_a_file_in_the_links_place_is_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "notes"
    file.write_text("mine")
    ran = subprocess.run(
        (*ibrobot_command(), "feetech", "emulate", "--link", str(file)),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ran.returncode == 2
    assert f"{file} exists already and is not a link" in ran.stderr
    assert file.read_text() == "mine"


def test_a_link_in_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    command = (*ibrobot_command(), "feetech", "emulate", "--link", str(tmp_path / "missing" / "arm"))
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == 2
    assert f"{tmp_path / 'missing'} is not a folder that you can write into" in ran.stderr


def test_a_hand_swings_the_joints_that_have_no_torque() -> None:
    with Emulator(3) as arm:
        hand = Hand(arm, 0.3)

        def moved(steps: int) -> list[list[float]]:
            seen: list[list[float]] = [[servo.encoder for servo in arm.servos.values()]]
            for _ in range(steps):
                hand.move(0.02)
                seen.append([servo.encoder for servo in arm.servos.values()])
            return [[(tick - MIDDLE_TICK) / TICKS_PER_RADIAN for tick in joint] for joint in zip(*seen, strict=True)]

        for joint in moved(400):
            assert max(joint) == pytest.approx(0.3, abs=0.01)
            assert min(joint) == pytest.approx(-0.3, abs=0.01)
            assert max(abs(b - a) for a, b in pairwise(joint)) <= 0.02 + 1e-9, "no faster than 1 rad/s"
        arm.servos[2].set("torque_enable", 1)
        free, held, _ = moved(100)
        assert max(free) - min(free) > 0.1
        assert max(held) == min(held)
        arm.servos[2].set("torque_enable", 0)
        _, again, _ = moved(400)
        assert max(again) - min(again) == pytest.approx(0.6, abs=0.02)


@pytest.mark.parametrize("other", [("--physics", "so101_emulated"), ("--mechanics",)])
def test_nothing_else_moves_what_a_hand_does(other: tuple[str, ...]) -> None:
    command = (*ibrobot_command(), "feetech", "emulate", *other, "--swing", "0.3")
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == 2
    assert "--swing excludes --physics and --mechanics" in ran.stderr


@pytest.mark.parametrize(("cable", "known"), [(0, 6), (3, 2), (7, 6), (8, 6)])
def test_a_cable_at_no_joint_is_refused(cable: int, known: int) -> None:
    servos = "2" if known == 2 else "8"
    options = ("--mechanics", "--servos", servos, "--cable", str(cable), "2500")
    command = (*ibrobot_command(), "feetech", "emulate", *options)
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == 2
    assert f"--cable: servo {cable} has no joint of an SO-101; ids are 1 to {known}" in ran.stderr


@pytest.mark.parametrize("option", [("--mechanics", "--cable"), ("--error",)])
@pytest.mark.parametrize("values", [("30", "30"), ("30", "12")])
def test_a_servo_is_given_once_to_an_option(option: tuple[str, ...], values: tuple[str, ...]) -> None:
    given = [word for value in values for word in (option[-1], "3", value)]
    command = (*ibrobot_command(), "feetech", "emulate", *option[:-1], option[-1], "2", "5", *given)
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == 2
    assert f"{option[-1]}: servo 3 is given twice, with {values[0]} and with {values[1]}; give it once" in ran.stderr
