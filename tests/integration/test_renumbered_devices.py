"""After a reboot every port and camera has another number: a robot finds its devices, or says which is which."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

import attrs
import pytest
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_camera import device as device_module
from ibrobot_camera.options import OpenCvOptions
from ibrobot_feetech import bus
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import Emulator
from ibrobot_feetech.follower import FeetechFollower
from ibrobot_feetech.leader import read_pose
from ibrobot_feetech.options import FollowerOptions, LeaderOptions
from ibrobot_feetech.ticks import TICKS_PER_RADIAN
from ibrobot_testing.contexts import control_context, host_context
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from ibrobot_core.config import find_config, load_config
from ibrobot_core.errors import HardwareError, MissingDependency, TeleopError
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.schema import RobotConfig

pytestmark = pytest.mark.integration

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
ARMS = {"FOLLOWER": 1500, "LEADER": 2600}
"""Serial number of an adapter -> where all servos of its arm stand [ticks]."""
CAMERAS = {"top": "pci-0000:00:14.0-usb-0:1:1.0", "wrist": "pci-0000:00:14.0-usb-0:2:1.0", "side": "usb-HD_Cam_0042"}
"""Camera -> its name by the USB port, or by its serial number."""


class Bench:
    """Two emulated arms behind USB adapters, and three cameras, under the numbers of a boot."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, stack: ExitStack) -> None:
        self._folder = folder
        self._monkeypatch = monkeypatch
        self.arms = {serial: stack.enter_context(Emulator(6)) for serial in ARMS}
        for serial, emulator in self.arms.items():
            for servo in emulator.servos.values():
                servo.set("homing_offset", 0)
                servo.set("min_position_limit", 900)
                servo.set("max_position_limit", 3200)
                servo.turn(ARMS[serial])
        monkeypatch.setattr(device_module, "BY_ID", folder / "by-id")
        monkeypatch.setattr(device_module, "BY_PATH", folder / "by-path")

    def boot(self, ports: Mapping[str, str], videos: Mapping[str, int]) -> None:
        """Number the devices: adapter -> name of its port, camera -> number."""
        found = []
        for number, (serial, name) in enumerate(ports.items()):
            link = self._folder / name
            link.unlink(missing_ok=True)
            link.symlink_to(self.arms[serial].port)
            info = ListPortInfo(str(link.resolve()))
            info.vid, info.pid, info.serial_number, info.location = 0x1A86, 0x55D3, serial, f"1-{number}"
            found.append(info)
        self._monkeypatch.setattr(list_ports, "comports", lambda: found)
        for camera, number in videos.items():
            node = self._folder / f"video{number}"
            node.write_text(camera)
            link = self._folder / ("by-path" if CAMERAS[camera].startswith("pci") else "by-id") / CAMERAS[camera]
            link.parent.mkdir(exist_ok=True)
            link.unlink(missing_ok=True)
            link.symlink_to(node)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setattr(bus, "_ADAPTER_S", 30.0)  # the emulators, threads of this process, may be slow
    with ExitStack() as stack:
        yield Bench(tmp_path, monkeypatch, stack)


def robot(folder: Path, follower: str, leader: str, cameras: Mapping[str, str | int]) -> RobotConfig:
    """An SO-101 with these ports and devices, and calibrations that know their adapters."""
    for serial in ARMS:
        joints = {name: JointCalibration(i, 0, 0, 900, 3200) for i, name in enumerate(JOINTS, 1)}
        save_calibration(attrs.evolve(Calibration(joints), adapter=serial), folder / f"{serial}.json")
    overrides = [
        f"hardware={{type: feetech_so101, port: '{follower}', calibration: {folder}/FOLLOWER.json}}",
        f"teleoperation.leader={{type: so101_leader, port: '{leader}', calibration: {folder}/LEADER.json}}",
        *(f"peripherals.{i}.device={cameras[name]}" for i, name in enumerate(("top", "wrist"))),
    ]
    return load_config(find_config("so101", installed_plugins()), overrides=overrides)


def follower_of(config: RobotConfig) -> FeetechFollower:
    (hardware,) = config.hardware.values()
    assert isinstance(hardware.options, FollowerOptions)
    return FeetechFollower(hardware.options, control_context("arm"))


def leader_of(config: RobotConfig) -> LeaderOptions:
    options = config.teleoperation["leader"].options
    assert isinstance(options, LeaderOptions)
    return options


def camera_of(config: RobotConfig, name: str) -> OpenCvOptions:
    options = config.peripherals[name].options
    assert isinstance(options, OpenCvOptions)
    return options


PORTS = [dict(zip(ARMS, names, strict=True)) for names in itertools.permutations(("ttyACM0", "ttyACM1", "ttyACM2"), 2)]
VIDEOS = [dict(zip(CAMERAS, numbers, strict=True)) for numbers in itertools.permutations((0, 2, 4))]


@pytest.mark.parametrize("boot", range(6))
def test_devices_that_are_named_by_what_stays_are_found(bench: Bench, tmp_path: Path, boot: int) -> None:
    bench.boot(PORTS[0], VIDEOS[0])
    config = robot(tmp_path, "serial:FOLLOWER", "serial:LEADER", CAMERAS)
    bench.boot(PORTS[boot], VIDEOS[boot])  # the robot YAML stays as it is
    arm = follower_of(config)
    arm.connect()
    pan = arm.read().position[0]
    arm.disconnect()
    assert pan == pytest.approx((ARMS["FOLLOWER"] - 2048) / TICKS_PER_RADIAN, abs=0.01), "it is the follower"
    pose = read_pose(leader_of(config), host_context("leader"))
    assert pose["shoulder_pan"] == pytest.approx((ARMS["LEADER"] - 2048) / TICKS_PER_RADIAN, abs=0.01)
    for name in ("top", "wrist"):
        assert Path(camera_of(config, name).devices()["device"]).read_text() == name
    assert Path(OpenCvOptions(device=CAMERAS["side"]).devices()["device"]).read_text() == "side"


def test_a_robot_that_counts_ports_refuses_exchanged_arms_and_says_which_is_which(bench: Bench, tmp_path: Path) -> None:
    follower, leader = (str(tmp_path / name) for name in ("ttyACM0", "ttyACM1"))
    bench.boot({"FOLLOWER": "ttyACM0", "LEADER": "ttyACM1"}, VIDEOS[0])
    config = robot(tmp_path, follower, leader, {"top": 0, "wrist": 2})
    arm = follower_of(config)
    arm.connect()
    arm.disconnect()
    bench.boot({"FOLLOWER": "ttyACM1", "LEADER": "ttyACM0"}, VIDEOS[0])
    with pytest.raises(HardwareError, match=r"another arm: .* LEADER, .* made with FOLLOWER") as refused:
        follower_of(config).connect()
    assert "`port: serial:FOLLOWER`, which finds it wherever it is" in str(refused.value)
    assert os.path.realpath(bench.arms["FOLLOWER"].port) in str(refused.value)
    with pytest.raises(TeleopError, match=r"its adapter has .* FOLLOWER, .* was made with LEADER"):
        read_pose(leader_of(config), host_context("leader"))
    assert not any(servo.torque for servo in bench.arms["LEADER"].servos.values()), "nothing moves the wrong arm"


def test_what_was_unplugged_is_named_with_what_is_there(bench: Bench, tmp_path: Path) -> None:
    bench.boot(PORTS[0], VIDEOS[0])
    config = robot(tmp_path, "serial:FOLLOWER", "serial:LEADER", CAMERAS)
    bench.boot({"LEADER": "ttyACM0"}, VIDEOS[0])
    with pytest.raises(HardwareError, match=r"no USB adapter with this serial number .* serial:LEADER at "):
        follower_of(config).connect()
    (tmp_path / "by-path" / CAMERAS["wrist"]).unlink()
    with pytest.raises(MissingDependency) as missing:
        camera_of(config, "wrist").find_device()
    for words in (CAMERAS["wrist"], f"by-path: {CAMERAS['top']}", f"by-id: {CAMERAS['side']}", "`ibrobot camera list`"):
        assert words in str(missing.value)
