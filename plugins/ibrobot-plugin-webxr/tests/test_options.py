"""Mistakes in the section `teleoperation`: each is one error with line, key and what would be right."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from ibrobot_testing import check_descriptor
from ibrobot_testing.site import made_up_site
from ibrobot_webxr import ibrobot_teleop
from ibrobot_webxr.certificate import server_names
from ibrobot_webxr.options import WebxrOptions

from ibrobot_core.app import ConfigError, load_config

ROBOT = """\
robot:
  name: mini
  joints:
    - {name: shoulder_pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
  groups: {arm: [shoulder_pan], gripper: []}
  description: {mjcf: arm.xml, tip: tool}
hardware: {type: arm}
executors: {arm: {type: position, group: arm}}
control_modes: {teleop: {executors: [arm], teleop: device}}
default_control_mode: teleop
teleoperation:
  device:
    type: webxr
"""
LINE = ROBOT.count("\n") + 1


@pytest.fixture(autouse=True)
def arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mjcf: Path) -> Iterator[None]:
    (tmp_path / "arm.xml").write_text(mjcf.read_text())
    with made_up_site(tmp_path / "site", Path(__file__).parent, monkeypatch) as site:
        site.add("arms", "arms.py")
        yield


def problem(path: Path, text: str) -> str:
    """The one error of a file."""
    path.write_text(text)
    with pytest.raises(ConfigError) as refused:
        load_config(path)
    (line,) = str(refused.value).splitlines()
    return line.removeprefix(f"{path}:")


MISTAKES = {
    "prot: 8443": "prot: unknown key, did you mean 'port'?",
    "port: 70000": "port: 70000 is too large, must be at most 65535",
    "port: https": "port: expected a whole number, got 'https'",
    "host: robot.lab": "host: 'robot.lab' is not an address of this machine: 127.0.0.1 serves this machine alone, "
    "0.0.0.0 the network",
    "host: 1.2.3": "host: '1.2.3' is not an address of this machine",
    "names: robot.lab": "names: expected a list, got 'robot.lab'",
    "names: [robot_1]": "names: 'robot_1' is not a host name or an address, e.g. robot.lab or 192.168.1.5",
    "names: [192.168.1]": "names: '192.168.1' is not a host name or an address",
    "names: ['robot.lab:8443']": "names: 'robot.lab:8443' is not a host name or an address",
    "names: ['https://robot.lab']": "names: 'https://robot.lab' is not a host name or an address",
    "certificate: arm.xml": "certificate and key belong together: give both, or neither",
    "key: arm.xml": "certificate and key belong together: give both, or neither",
    "{certificate: arm.xml, key: none.pem}": "key: ",
    "hand: both": "hand: 'both' is not one of: any, left, right",
    "gripper: griper": "gripper: unknown group 'griper', did you mean 'gripper'?; `none` if nothing grips",
    "gripper: hand": "gripper: unknown group 'hand'; the groups are: arm, gripper, none; `none` if nothing grips",
    "scale: 0": "scale: 0.0 is too small, must be above 0",
    "scale: .nan": "scale: nan is too small, must be above 0",
    "facing: 180": "facing: 180.0 is too large, must be at most 7 rad",
    "turn: 1": "turn: expected true or false, got 1",
    "tool_speed: 2": "tool_speed: 2.0 is too large, must be at most 1 m/s",
    "turn_speed: -1": "turn_speed: -1.0 is too small, must be above 0 rad/s",
    "timeout: 0.5": "timeout: 0.5 is too large, must be at most 0.09 s",
    "timeout: 0.001": "timeout: 0.001 is too small, must be at least 0.03 s",
    "cutoff: 0": "cutoff: 0.0 is too small, must be above 0 Hz",
    "follow_time: 0": "follow_time: 0.0 is too small, must be at least 0.02 s",
    "dead_zone: 0.1": "dead_zone: 0.1 is too large, must be below 0.05 m",
    "image_rate: 100": "image_rate: 100.0 is too large, must be at most 60 Hz",
    "cameras: 1": "cameras: expected a list, got 1",
    "{port: 0, names: [robot.lab]}": "port 0, any free port, is for tests on this machine: names needs a fixed port",
}


@pytest.mark.parametrize(("line", "message"), MISTAKES.items(), ids=MISTAKES)
def test_mistakes_are_named_with_line_and_key(tmp_path: Path, line: str, message: str):
    if line.startswith("{"):
        text = ROBOT.replace("\n    type: webxr", f" {{type: webxr, {line[1:]}")
        error = problem(tmp_path / "mini.yaml", text)
        assert error.startswith(f"{LINE - 2}: teleoperation.device")
    else:
        error = problem(tmp_path / "mini.yaml", f"{ROBOT}    {line}\n")
        assert error.startswith((f"{LINE}: teleoperation.device", f"{LINE - 2}: teleoperation.device"))
    assert message in error


def test_a_robot_without_a_model_is_refused(tmp_path: Path):
    error = problem(tmp_path / "mini.yaml", ROBOT.replace("mjcf: arm.xml, ", ""))
    assert error.endswith("teleoperation.device: a hand moves the tool, which needs robot.description.mjcf: set it")


def test_a_key_that_is_missing_is_named(tmp_path: Path):
    text = f"{ROBOT}    certificate: arm.xml\n    key: none.pem\n"
    error = problem(tmp_path / "mini.yaml", text)
    assert error.startswith(f"{LINE + 1}: teleoperation.device.key: ")
    assert error.endswith("none.pem: no such file; `ibrobot certs` makes certificates and keys")


def test_the_descriptor_fits_its_options():
    (descriptor,) = ibrobot_teleop()
    check_descriptor(descriptor, WebxrOptions())


def test_the_page_is_for_this_machine_alone_unless_configured_otherwise():
    assert server_names(WebxrOptions()) == ("localhost", "127.0.0.1", "::1")
    assert server_names(WebxrOptions(host="0.0.0.0", names=("robot.lab",)))[0] == "robot.lab"
    assert len(server_names(WebxrOptions(host="0.0.0.0"))) >= 3
    assert server_names(WebxrOptions(host="192.168.1.5"))[0] == "192.168.1.5"
