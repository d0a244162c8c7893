"""Devices that the kernel takes for real ones: HID by /dev/uhid, joysticks by /dev/uinput; for a guest of its own."""

from __future__ import annotations

import fcntl
import os
import struct
import threading
from collections.abc import Callable, Mapping

_DESTROY, _OUTPUT, _GET_REPORT, _GET_REPORT_REPLY = 1, 6, 9, 10
_CREATE2, _INPUT2, _SET_REPORT, _SET_REPORT_REPLY = 11, 12, 13, 14
"""Of linux/uhid.h."""
_EVENT_BYTES = 4380
_USB = 0x03
_DATA_BYTES = 4096


def descriptor(usage: int, inputs: Mapping[int, int], outputs: Mapping[int, int] = {}) -> bytes:
    """A report descriptor of one collection.

    Args:
        usage: of the page Generic Desktop, e.g. 0x05 for a gamepad.
        inputs: report number -> its bytes, the number left out.
        outputs: the same of output reports.
    """
    items = bytes([0x05, 0x01, 0x09, usage, 0xA1, 0x01, 0x06, 0x00, 0xFF, 0x15, 0x00, 0x26, 0xFF, 0x00, 0x75, 0x08])
    for main, reports in ((0x81, inputs), (0x91, outputs)):
        for number, size in reports.items():
            items += bytes([0x85, number, 0x09, 0x20, 0x95, size, main, 0x02])
    return items + b"\xc0"


class HidDevice:
    """A HID device from its creation to `unplug`.

    Args:
        vendor: of USB.
        product: the vendor's number.
        report_descriptor: as `descriptor` makes it.
        name: what it is called.
        features: feature report -> what it answers, with which the kernel's driver sets it up.
        on_output: called with each output report; returns the input report that answers it, if any.
    """

    def __init__(
        self,
        vendor: int,
        product: int,
        report_descriptor: bytes,
        name: str,
        *,
        features: Mapping[int, bytes] = {},
        on_output: Callable[[bytes], bytes | None] = lambda report: None,
    ) -> None:
        self._features = features
        self._on_output = on_output
        self._file = os.open("/dev/uhid", os.O_RDWR | os.O_CLOEXEC)
        create = struct.pack(
            "<I128s64s64sHHIIII",
            _CREATE2, name.encode(), b"", b"", len(report_descriptor), _USB, vendor, product, 0x100, 0,
        )  # fmt: skip
        self._write(create + report_descriptor)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def send(self, report: bytes) -> None:
        """Send an input report."""
        self._write(struct.pack("<IH", _INPUT2, len(report)) + report)

    def unplug(self) -> None:
        """Take the device away."""
        self._write(struct.pack("<I", _DESTROY))
        os.close(self._file)

    def _write(self, event: bytes) -> None:
        os.write(self._file, event.ljust(_EVENT_BYTES, b"\0"))

    def _serve(self) -> None:
        try:
            while True:
                event = os.read(self._file, _EVENT_BYTES)
                (kind,) = struct.unpack_from("<I", event)
                if kind == _GET_REPORT:
                    number, report = struct.unpack_from("<IB", event, 4)
                    answer = self._features.get(report)
                    error = 0 if answer is not None else 5
                    answer = answer or b""
                    self._write(struct.pack("<IIHH", _GET_REPORT_REPLY, number, error, len(answer)) + answer)
                elif kind == _SET_REPORT:
                    (number,) = struct.unpack_from("<I", event, 4)
                    self._write(struct.pack("<IIH", _SET_REPORT_REPLY, number, 0))
                elif kind == _OUTPUT:
                    (size,) = struct.unpack_from("<H", event, 4 + _DATA_BYTES)
                    answer = self._on_output(event[4 : 4 + size])
                    if answer is not None:
                        self.send(answer)
        except OSError:  # unplugged
            return


_SET_EVENTS, _SET_KEYS, _SET_AXES, _CREATE, _REMOVE = 0x40045564, 0x40045565, 0x40045567, 0x5501, 0x5502
_EV_SYN, _EV_KEY, _EV_ABS = 0, 1, 3


class Joystick:
    """What the kernel's driver makes of an Xbox 360 pad over USB.

    Keys and axes are those of linux/input-event-codes.h, as xpad uses them.
    """

    KEYS = (0x130, 0x131, 0x133, 0x134, 0x136, 0x137, 0x13A, 0x13B, 0x13C, 0x13D, 0x13E)
    STICKS, TRIGGERS, HATS = (0, 1, 3, 4), (2, 5), (16, 17)
    LEFT_SHOULDER, LEFT_X = 0x136, 0

    def __init__(self) -> None:
        self._file = os.open("/dev/uinput", os.O_RDWR | os.O_CLOEXEC)
        for kind in (_EV_KEY, _EV_ABS):
            fcntl.ioctl(self._file, _SET_EVENTS, kind)
        for key in self.KEYS:
            fcntl.ioctl(self._file, _SET_KEYS, key)
        highest, lowest = [0] * 64, [0] * 64
        for axes, low, high in ((self.STICKS, -32768, 32767), (self.TRIGGERS, 0, 255), (self.HATS, -1, 1)):
            for axis in axes:
                fcntl.ioctl(self._file, _SET_AXES, axis)
                lowest[axis], highest[axis] = low, high
        head = struct.pack("80sHHHHI", b"Microsoft X-Box 360 pad", _USB, 0x045E, 0x028E, 0x0114, 0)
        os.write(self._file, head + struct.pack("256i", *highest, *lowest, *[0] * 128))
        fcntl.ioctl(self._file, _CREATE)

    def key(self, code: int, *, pressed: bool) -> None:
        """Press or release a key."""
        self._event(_EV_KEY, code, int(pressed))

    def axis(self, code: int, value: int) -> None:
        """Move an axis."""
        self._event(_EV_ABS, code, value)

    def unplug(self) -> None:
        """Take the joystick away."""
        fcntl.ioctl(self._file, _REMOVE)
        os.close(self._file)

    def _event(self, kind: int, code: int, value: int) -> None:
        for each in ((kind, code, value), (_EV_SYN, 0, 0)):
            os.write(self._file, struct.pack("qqHHi", 0, 0, *each))
