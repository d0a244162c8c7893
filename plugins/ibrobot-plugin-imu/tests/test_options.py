"""Mistakes in the section `teleoperation`: each is one error with line, key and what would be right."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from ibrobot_testing.site import made_up_site

from ibrobot_core.app import ConfigError, installed_plugins, load_config

ROBOT = """\
robot:
  name: mini
  joints:
    - {name: l_pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
    - {name: r_pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
  groups: {left: [l_pan], right: [r_pan]}
  description: {mjcf: arm.xml, tip: tool, arms: {l_: [0, 0, 0, 0], r_: [0, 0.2, 0, 0]}}
hardware: {type: arm}
executors: {left: {type: position, group: left}}
control_modes: {teleop: {executors: [left], teleop: {left: device}}}
default_control_mode: teleop
teleoperation:
  device: {type: imu, port: /dev/ttyUSB0, model: bno08x}
"""
MJCF = '<mujoco><worldbody><body><joint name="pan"/><geom size="1"/><site name="tool"/></body></worldbody></mujoco>'
AT = "robot.yaml:13: teleoperation.device"
CASES = {
    "no port": ("port: /dev/ttyUSB0, ", "", f"{AT}.port: required key is missing"),
    "no model": (", model: bno08x", "", f"{AT}.model: required key is missing"),
    "model": ("bno08x", "bno055", f"{AT}.model: 'bno055' is not one of: bno08x, witmotion"),
    "baud rate": ("bno08x}", "bno08x, baud_rate: 0}", f"{AT}.baud_rate: 0 is too small, must be above 0 baud"),
    "baud rate text": ("bno08x}", "bno08x, baud_rate: fast}", f"{AT}.baud_rate: expected a whole number, got 'fast'"),
    "axis": ("bno08x}", "bno08x, tool: {rol: pitch}}",
        f"{AT}.tool: unknown axis of the tool 'rol', did you mean 'roll'?"),
    "tilt": ("bno08x}", "bno08x, tool: {x: -pich}}", f"{AT}.tool: x: unknown tilt '-pich', did you mean 'pitch'?"),
    "no axis": ("bno08x}", "bno08x, tool: {x: none, y: none, z: none}}",
        f"{AT}: tool: every axis is none, so nothing could move; give at least one a tilt"),
    "speed": ("bno08x}", "bno08x, speed: -0.1}", f"{AT}.speed: -0.1 is too small, must be above 0 m/s"),
    "turn speed": ("bno08x}", "bno08x, turn_speed: .nan}", f"{AT}.turn_speed: nan is too small, must be above 0 rad/s"),
    "dead zone": ("bno08x}", "bno08x, dead_zone: 0.6}",
        f"{AT}: dead_zone is 0.6, must be below full_tilt, which is 0.6"),
    "full tilt": ("bno08x}", "bno08x, full_tilt: 35}", f"{AT}.full_tilt: 35.0 is too large, must be at most 1.5 rad"),
    "deadman": ("bno08x}", "bno08x, deadman: none}", f"{AT}.deadman: 'none' is not one of: key, cts, dsr"),
    "release": ("bno08x}", "bno08x, release: 2}", f"{AT}.release: 2.0 is too large, must be at most 1 s"),
    "timeout": ("bno08x}", "bno08x, timeout: 0}", f"{AT}.timeout: 0.0 is too small, must be above 0 s"),
    "follow": ("bno08x}", "bno08x, follow: 0}", f"{AT}.follow: 0.0 is too small, must be above 0 rad"),
    "gripper": ("bno08x}", "bno08x, gripper: lef}", f"{AT}.gripper: unknown group 'lef', did you mean 'left'?"),
    "unknown key": ("bno08x}", "bno08x, deadmann: key}", f"{AT}.deadmann: unknown key, did you mean 'deadman'?"),
    "no model of the arm": ("mjcf: arm.xml, tip: tool, ", "",
        f"{AT}: tilting moves a tool, which needs robot.description.mjcf: set it"),
    "several arms": ("teleop: {left: device}", "teleop: device",
        f"{AT}: the robot has several arms: give the device one in the mode, e.g. teleop: {{left: DEVICE}}"),
}  # fmt: skip


@pytest.fixture(autouse=True)
def arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    Path("arm.xml").write_text(MJCF)
    with made_up_site(tmp_path / "site", Path(__file__).parent, monkeypatch) as site:
        site.add("arms", "arms.py")
        yield


def test_a_right_section_loads() -> None:
    Path("robot.yaml").write_text(ROBOT)
    options = load_config("robot.yaml", registry=installed_plugins()).teleoperation["device"].options
    assert (options.rate, dict(options.axes)) == (115_200, {"x": "pitch", "y": "-roll", "z": "yaw"})


@pytest.mark.parametrize("case", CASES)
def test_message(case: str) -> None:
    old, new, expected = CASES[case]
    assert ROBOT.count(old) == 1
    Path("robot.yaml").write_text(ROBOT.replace(old, new))
    with pytest.raises(ConfigError) as told:
        load_config("robot.yaml", registry=installed_plugins())
    assert str(told.value).splitlines() == [expected]


def test_two_sensors_need_two_ports() -> None:
    text = ROBOT.replace("[left], teleop: {left: device}", "[left, right], teleop: {left: device, right: other}")
    text = text.replace("group: left}}", "group: left}, right: {type: position, group: right}}")
    Path("robot.yaml").write_text(f"{text}  other: {{type: imu, port: /dev/ttyUSB0, model: witmotion}}\n")
    with pytest.raises(ConfigError) as told:
        load_config("robot.yaml", registry=installed_plugins())
    expected = "robot.yaml:14: teleoperation.other.port: /dev/ttyUSB0 is already used by teleoperation.device"
    assert str(told.value) == expected
