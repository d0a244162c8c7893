"""Devices with known reports, read by hidapi."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any, override

from ibrobot_core.api import ns
from ibrobot_gamepad.controls import Controls
from ibrobot_gamepad.devices import Device, DeviceGone, Found
from ibrobot_gamepad.reports import Kind, Model, model_of

_LONGEST = 128
"""Bytes of the longest report, and some more."""
_MOST = 256
"""Maximum number of reports per poll, so that a flooding device cannot block the robot."""
_SILENT_NS = ns(0.3)
"""Silence after which a continuously sending device counts as out of range."""
_ASK_NS = ns(0.5)
"""Period of repeated requests for the data that a device must send first."""


def _hidapi() -> Any:
    """The binding; on Linux that to the kernel's hidraw devices, since the other one finds none."""
    if sys.platform == "linux":
        import hidraw

        return hidraw
    import hid

    return hid


def find_hid(kind: Kind) -> list[Found]:
    """The devices of a kind with known reports."""
    by_path: dict[bytes, Found] = {}
    for entry in _hidapi().enumerate():
        model = model_of(entry["vendor_id"], entry["product_id"], entry["usage_page"], entry["usage"])
        if model is not None and model.kind == kind:
            by_path.setdefault(entry["path"], _found(entry, model))
    return list(by_path.values())


def _found(entry: Mapping[str, Any], model: Model) -> Found:
    path: bytes = entry["path"]
    name = " ".join((entry["product_string"] or model.name).split()) or model.name
    return Found(
        name, entry["vendor_id"], entry["product_id"], entry["serial_number"] or "", model.name, "hid",
        lambda: HidDevice(path, model), path.decode(errors="replace"),
    )  # fmt: skip


class HidDevice(Device):
    """A device that sends reports of a model.

    Args:
        path: its path in hidapi.
        model: its reports.

    Raises:
        OSError: when it cannot be opened, e.g. without the permission.
    """

    def __init__(self, path: bytes, model: Model) -> None:
        self._model = model
        self.streams = model.streams
        self._parse = model.start()
        self._heard_ns: int | None = None
        self._asked_ns: int | None = None
        self._spoke = False
        self._device: Any = _hidapi().device()
        self._device.open_path(path)
        self._device.set_nonblocking(1)

    @override
    def poll(self, now_ns: int) -> list[Controls]:
        if self._device is None:
            raise DeviceGone("closed")
        try:
            states = self._read()
            if states:
                self._spoke, self._heard_ns = True, now_ns
            elif not self._spoke:
                self._ask(now_ns)
        except (OSError, ValueError) as error:  # ValueError: hidapi raises it for a closed device
            raise DeviceGone(str(error)) from error
        if self._heard_ns is None:
            self._heard_ns = now_ns
        if self._spoke and self._model.streams and now_ns - self._heard_ns > _SILENT_NS:
            raise DeviceGone("it stopped sending")
        return states

    @override
    def close(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            device.close()

    def _read(self) -> list[Controls]:
        states = []
        for _ in range(_MOST):
            report = self._device.read(_LONGEST)
            if not report:
                break
            if (state := self._parse(bytes(report))) is not None:
                states.append(state)
        return states

    def _ask(self, now_ns: int) -> None:
        """Request the data that the parser needs before it can read reports."""
        if self._model.opening and (self._asked_ns is None or now_ns - self._asked_ns > _ASK_NS):
            self._asked_ns = now_ns
            for request in self._model.opening:
                self._device.write(request)
