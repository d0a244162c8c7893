"""Serial adapters and cameras under the numbers of a boot, in every process of a run that has this plugin.

The folder that `RENUMBERED` names has `ports.json`, a list of path and serial number of each adapter; `videoN`, the
name of the camera with this number; `by-id` and `by-path`, links to these; and `NAME.png`, what each camera sees.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import cv2
import ibrobot_camera.camera
import ibrobot_camera.options
from ibrobot_camera import capture, device, v4l2
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

BENCH = Path(os.environ["RENUMBERED"])
_PERIOD_S = 0.05


class Node:
    """What OpenCV opens of a V4L2 device: a still picture, 20 times a second."""

    def __init__(self, node: Path) -> None:
        picture = cv2.imread(str(BENCH / f"{node.read_text(encoding='utf-8')}.png"))
        assert picture is not None
        self._picture = picture
        height, width = picture.shape[:2]
        self._properties = {
            cv2.CAP_PROP_FRAME_WIDTH: float(width), cv2.CAP_PROP_FRAME_HEIGHT: float(height),
            cv2.CAP_PROP_FPS: 1 / _PERIOD_S,
        }  # fmt: skip

    def get(self, prop: int) -> float:
        """A property; 0 if it is unknown."""
        return self._properties.get(prop, 0.0)

    def set(self, prop: int, value: float) -> bool:
        """Whether a property is that; none can be changed, so that pixels come as they are."""
        return self._properties.get(prop) == value

    def grab(self) -> bool:
        """Wait for the next picture."""
        time.sleep(_PERIOD_S)
        return True

    def retrieve(self) -> tuple[bool, Any]:
        """The picture."""
        return True, self._picture.copy()

    def release(self) -> None:
        """Close nothing."""


def _comports() -> list[ListPortInfo]:
    found = []
    for number, (path, serial) in enumerate(json.loads((BENCH / "ports.json").read_text(encoding="utf-8"))):
        info = ListPortInfo(os.path.realpath(path))
        info.vid, info.pid, info.serial_number, info.location = 0x1A86, 0x55D3, serial, f"1-{number}"
        info.description = "USB Single Serial"
        found.append(info)
    return found


def _find_device(given: int | str) -> device.Device:
    text = str(given)
    return device.Device("v4l2", str(BENCH / f"video{text}")) if text.isdigit() else device.find_device(given)


def _cameras() -> list[v4l2.Camera]:
    ids, paths = (
        {each.resolve(): each.name for each in (BENCH / folder).iterdir()} if (BENCH / folder).is_dir() else {}
        for folder in ("by-id", "by-path")
    )
    return [
        v4l2.Camera(str(node), "HD Cam", ids.get(node.resolve(), ""), (), usb_path=paths.get(node.resolve(), ""))
        for node in sorted(BENCH.glob("video*"))
    ]


for _module, _name, _value in (
    (list_ports, "comports", _comports),
    (device, "BY_ID", BENCH / "by-id"),
    (device, "BY_PATH", BENCH / "by-path"),
    (ibrobot_camera.camera, "find_device", _find_device),
    (ibrobot_camera.options, "find_device", _find_device),
    (capture.Capture, "_open", lambda self: Node(Path(self._device.target))),
    (v4l2, "cameras", _cameras),
):
    setattr(_module, _name, _value)
