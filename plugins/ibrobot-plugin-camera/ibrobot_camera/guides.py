"""Guide for pages: the cameras of this machine, with a picture of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ibrobot_terminal import Guide, Question

from ibrobot_camera import v4l2
from ibrobot_camera.commands.sources import browser_jpeg, opened
from ibrobot_core.api import SensorError

_WAIT_S = 5.0
_ALL = "all"


def camera_questions() -> Sequence[Question]:
    """Which camera: all, or one, as a robot YAML names it."""
    names = tuple(camera.lasting_name or camera.path for camera in v4l2.cameras())
    return (Question("camera", "Camera", _ALL, (_ALL, *names)),)


def show_cameras(answers: Mapping[str, str | bool], guide: Guide) -> None:
    """Show what `device` of a robot YAML may be, and a picture of each camera."""
    shown = [
        each
        for each in v4l2.cameras()
        if answers.get("camera", _ALL) in (_ALL, each.stable_id, each.usb_path, each.path)
    ]
    if not shown:
        guide.say("No camera: there is no /dev/video*. Is it plugged in, and does `lsusb` show it?")
    for camera in shown:
        guide.say(f"{camera.path}: {camera.name}")
        for stays in filter(None, (camera.stable_id, camera.usb_path)):
            guide.say(f"better for a YAML, because it does not change: {stays}")
        if camera.problem:
            guide.say(f"{camera.problem}: sudo usermod -aG video $USER, then log in again", warning=True)
            continue
        guide.show(v4l2.COLUMNS, [mode.row for mode in camera.modes])
        try:
            guide.picture(camera.path, _picture(camera.path))
        except SensorError as error:
            guide.say(f"no picture: {error}", warning=True)


def _picture(device: str) -> bytes:
    """A picture as JPEG."""
    with opened(device) as cameras:
        image = cameras["camera"].read(_WAIT_S)
    if image is None:
        raise SensorError(f"{device}: no image within {_WAIT_S:g} s; does a run use it?")
    return browser_jpeg(image)
