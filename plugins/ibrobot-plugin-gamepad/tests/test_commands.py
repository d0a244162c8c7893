"""`ibrobot gamepad …` and the lines of `ibrobot doctor`, with fake devices."""

from __future__ import annotations

import json
import os
from collections import deque
from pathlib import Path

import attrs
import pytest
import yaml
from click.testing import CliRunner
from ibrobot_gamepad import ibrobot_doctor
from ibrobot_gamepad.permissions import checks
from ibrobot_testing.command import command_line
from ibrobot_testing.site import made_up_site

from ibrobot_core.api import TeleopError

from .fake_hid import DUALSENSE, SPACEMOUSE, FakeHidapi, Plugged, dualsense, mouse_buttons, spacemouse
from .test_options import ROBOT

gamepad = command_line("gamepad")


@attrs.define
class Replaying(Plugged):
    """Sends one report a poll, and the last one again and again."""

    reports: deque[bytes] = attrs.field(factory=deque)
    fresh: bool = True

    def take(self) -> bytes | None:
        self.fresh = not self.fresh
        if self.fresh:
            return None
        return self.reports.popleft() if len(self.reports) > 1 else self.reports[0]


@pytest.fixture(autouse=True)
def sdl_sees_none(hidapi: FakeHidapi, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ibrobot_gamepad.sdl.find_sdl", list)


def run(*arguments: str) -> str:
    result = CliRunner().invoke(gamepad, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    return result.output


def test_list_says_where_to_look_when_there_is_nothing():
    assert run("list") == "no gamepad or SpaceMouse is plugged in; `ibrobot doctor` names those without permission\n"
    assert run("list", "--json") == "[]\n"


def test_list_shows_ids_and_models(hidapi: FakeHidapi):
    hidapi.plug(Plugged(*DUALSENSE, name="Wireless Controller", serial="a1"))
    hidapi.plug(Plugged(*DUALSENSE, name="Wireless Controller", serial="a1"))  # another interface of the same path
    hidapi.plug(Plugged(*SPACEMOUSE, usage=0x08, name="", path=b"/dev/hidraw4"))
    assert run("list").splitlines() == [
        "gamepad     Wireless Controller  054c:0ce6:a1  DualSense   read by its own reports",
        "spacemouse  SpaceMouse           256f:c635     SpaceMouse  read by its own reports",
    ]
    first, second = json.loads(run("list", "--json"))
    assert (first["device"], first["via"], second["path"]) == ("054c:0ce6:a1", "hid", "/dev/hidraw4")


def test_test_shows_what_changes(hidapi: FakeHidapi):
    reports = [dualsense(), dualsense("south", left=(1, 0)), dualsense("south", left=(1, 0)), dualsense(hat=(0, -1))]
    hidapi.plug(Replaying(*DUALSENSE, reports=deque(reports)))
    assert run("test", "--seconds", "0.2").splitlines() == [
        "Pad (054c:0ce6, DualSense): move its axes, press its buttons",
        "at rest",
        "left_x +1.00  south",
        "dpad_y -1.00",
    ]


def test_test_of_a_device_that_is_not_there(hidapi: FakeHidapi):
    message = "no gamepad or SpaceMouse 045e:0b13 is plugged in; `ibrobot gamepad list` shows all"
    with pytest.raises(TeleopError, match=message):
        run("test", "--device", "045e:0b13")


def test_test_ends_when_the_device_is_unplugged(hidapi: FakeHidapi):
    class Failing(Plugged):
        def take(self) -> bytes | None:
            raise OSError("read error")

    hidapi.plug(Failing(*DUALSENSE))
    with pytest.raises(TeleopError, match="the device is gone: read error"):
        run("test")


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "mini.yaml"
    path.write_text(ROBOT)
    return path


def test_map_learns_controls_and_prints_yaml(hidapi: FakeHidapi, robot: Path, monkeypatch: pytest.MonkeyPatch):
    reports = [dualsense()]
    for pressed in (dualsense(left=(-1, 0)), dualsense(right=(0, 1))):  # pan, lift
        reports += [pressed, dualsense()]
    for axis in (dualsense(left=(0, 1)), dualsense(left=(1, 0)), dualsense(right=(0, -1))):  # x, y, z
        reports += [axis, dualsense()]
    for axis in (dualsense(hat=(1, 0)), dualsense(hat=(0, 1)), dualsense(right=(1, 0))):  # roll, pitch, yaw
        reports += [axis, dualsense()]
    reports += [dualsense(triggers=(0, 1)), dualsense(), dualsense("north"), dualsense()]  # deadman, toggle
    hidapi.plug(Replaying(*DUALSENSE, reports=deque(reports)))
    with made_up_site(robot.parent / "site", Path(__file__).parent, monkeypatch) as site:
        site.add("arms", "arms.py")
        output = run("map", str(robot), "--wait", "0.05")
    assert "Move what moves pan towards its upper limit: -left_x" in output
    assert "Press the button of the emergency stop (estop): default" in output
    assert yaml.safe_load(output[output.index("teleoperation:") :]) == {
        "teleoperation": {"gamepad": {
            "type": "gamepad", "device": "054c:0ce6", "joints": {"pan": "-left_x", "lift": "right_y"},
            "tool": {"x": "left_y", "y": "left_x", "z": "-right_y", "roll": "dpad_x", "pitch": "dpad_y",
                     "yaw": "right_x"},
            "buttons": {"deadman": "right_trigger", "toggle": "north"},
        }}
    }  # fmt: skip


def test_map_learns_a_spacemouse(hidapi: FakeHidapi, robot: Path, monkeypatch: pytest.MonkeyPatch):
    reports = [mouse_buttons(), spacemouse(yaw=-1), spacemouse(), spacemouse(x=1), spacemouse()]
    hidapi.plug(Replaying(*SPACEMOUSE, usage=0x08, reports=deque(reports)))
    with made_up_site(robot.parent / "site", Path(__file__).parent, monkeypatch) as site:
        site.add("arms", "arms.py")
        output = run("map", str(robot), "--wait", "0.02")
    section = yaml.safe_load(output[output.index("teleoperation:") :])["teleoperation"]["spacemouse"]
    assert section == {"type": "spacemouse", "device": "256f:c635", "joints": {"pan": "-yaw", "lift": "x"}}


def test_udev_prints_a_rule_for_each_vendor():
    lines = run("udev").splitlines()
    assert 'KERNEL=="hidraw*", KERNELS=="*:054C:*", MODE="0660", TAG+="uaccess"' in lines
    assert len(lines) == 1 + 6


def test_doctor_names_devices_and_what_to_do(hidapi: FakeHidapi, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert list(ibrobot_doctor()) == []
    hidapi.plug(Plugged(*DUALSENSE, path=b"/dev/none"))
    hidapi.plug(Plugged(*SPACEMOUSE, usage=0x08, name="SpaceMouse", path=b"DevSrvsID:1"))
    node = tmp_path / "by-id" / "usb-Xbox-event-joystick"
    node.parent.mkdir()
    node.touch()
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    pad, mouse, joystick = checks(tmp_path)
    assert (pad.name, pad.ok) == ("gamepad", False)
    assert pad.found == "Pad (054c:0ce6) at /dev/none: no permission"
    assert pad.remedy == (
        "ibrobot gamepad udev | sudo tee /etc/udev/rules.d/60-ibrobot-gamepad.rules && sudo udevadm control --reload, "
        "then plug it in again"
    )
    assert mouse.ok
    assert (joystick.ok, joystick.remedy) == (False, "sudo usermod -aG input $USER, log in again")
