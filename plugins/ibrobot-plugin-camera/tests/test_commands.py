"""`ibrobot camera …` with real sources: the output, the files and the page in the browser."""

from __future__ import annotations

import subprocess
import urllib.error
import urllib.request
from pathlib import Path

import cv2
import pytest
from click.testing import CliRunner
from ibrobot_camera import v4l2
from ibrobot_camera.commands import calibrate
from ibrobot_testing import ibrobot_command
from ibrobot_testing.command import command_line
from stream_server import StreamServer

from ibrobot_core.api import SensorError
from ibrobot_core.app import RequestError

camera = command_line("camera")

ROBOT = """
robot: {{name: r, joints: [{{name: j, lower: -1, upper: 1, max_velocity: 1, max_acceleration: 5}}], groups: {{a: [j]}}}}
simulation: {{type: fake}}
executors: {{arm: {{type: position, group: a}}}}
control_modes: {{still: {{executors: [arm]}}}}
default_control_mode: still
peripherals:
  - {{name: top, kind: camera, type: opencv, device: "{url}"}}
  - {{name: wrist, kind: camera, type: opencv, device: "{url}"}}
"""


def test_list_without_cameras_says_what_to_look_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(v4l2, "cameras", list)
    result = CliRunner().invoke(camera, ["list"])
    assert result.exit_code == 0
    assert "no camera: there is no /dev/video*" in result.output
    assert CliRunner().invoke(camera, ["list", "--json"]).output == "[]\n"


def test_list_shows_stable_ids_and_modes(monkeypatch: pytest.MonkeyPatch) -> None:
    modes = (v4l2.Mode("MJPG", 640, 480, (30.0, 15.0)),)
    found = [
        v4l2.Camera("/dev/video0", "HD Cam", "usb-HD_Cam-video-index0", modes, usb_path="pci-usb-0:2:1.0-video-index0"),
        v4l2.Camera("/dev/video2", "", "", (), "Permission denied"),
    ]
    monkeypatch.setattr(v4l2, "cameras", lambda: found)
    output = CliRunner().invoke(camera, ["list"]).output
    for text in (
        "/dev/video0  HD Cam",
        "usb-HD_Cam-video-index0",
        "port: pci-usb-0:2",
        "MJPG",
        "640x480",
        "30, 15",
        "Permission denied",
    ):
        assert text in output


def test_snapshot_saves_the_picture_and_says_its_rate(tmp_path: Path) -> None:
    with StreamServer() as server:
        arguments = ["snapshot", server.url, "-o", str(tmp_path / "a.png"), "--seconds", "0.5"]
        result = CliRunner().invoke(camera, arguments, catch_exceptions=False)
    assert result.output.startswith(f"{tmp_path / 'a.png'}: camera, 64x48 rgb8, ")
    saved = cv2.imread(str(tmp_path / "a.png"))
    assert saved is not None
    assert saved.shape == (48, 64, 3)


def test_a_calibration_opens_only_the_camera_that_it_measures(tmp_path: Path) -> None:
    robot = tmp_path / "robot.yaml"
    with StreamServer() as server:
        robot.write_text(ROBOT.format(url=server.url).replace(server.url, "/dev/video77", 1))
        with calibrate.camera(str(robot), "wrist") as (name, read):
            picture = read(10.0)
    assert name == "wrist"
    assert picture is not None
    assert picture.shape == (48, 64, 3)
    for named, message in (
        ("", r"has several cameras \(top, wrist\)"),
        ("side", r"no opencv camera 'side'; it has: top, "),
    ):
        with pytest.raises(RequestError, match=message), calibrate.camera(str(robot), named):
            raise AssertionError("it opened")


def test_snapshot_refuses_what_it_cannot_write() -> None:
    with pytest.raises(RequestError, match=r"--output: a\.gif: must end in \.png or \.jpg"):
        CliRunner().invoke(camera, ["snapshot", "0", "-o", "a.gif"], catch_exceptions=False)
    with pytest.raises(SensorError, match="no file, URL or device"):
        CliRunner().invoke(camera, ["snapshot", "nothing"], catch_exceptions=False)
    with pytest.raises(SensorError, match=r"^/dev/video77: there is no such device"):
        CliRunner().invoke(camera, ["snapshot", "77"], catch_exceptions=False)


def test_preview_shows_the_stream_to_who_has_the_token() -> None:
    with StreamServer() as server:
        command = (*ibrobot_command(), "camera", "preview", server.url)
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as preview:
            assert preview.stdout is not None
            assert preview.stderr is not None
            try:
                url = preview.stdout.readline().strip()
                browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
                page = browser.open(url, timeout=20).read().decode()
                assert '<img src="/stream/0" alt="camera">' in page
                address = url.partition("?")[0]
                for path in ("", "stream/0"):
                    with pytest.raises(urllib.error.HTTPError, match="401"):
                        urllib.request.urlopen(address + path, timeout=20)
                stream = browser.open(f"{address}stream/0", timeout=20)
                assert stream.headers["Content-Type"].startswith("multipart/x-mixed-replace")
                received = stream.read(6000)
                assert received.count(b"--picture") >= 2
                assert b"\xff\xd8" in received
                stream.close()
                again = browser.open(f"{address}stream/0", timeout=20)
                assert again.read(60_000).count(b"--picture") > 2, "pictures also for the page that was closed"
                again.close()
            finally:
                preview.terminate()
            assert "Traceback" not in preview.stderr.read(), "a page that is closed is no error"
        assert preview.returncode == 0
