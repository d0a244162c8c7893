"""Doctor's checks of serial ports, and the udev rule in their remedy."""

from __future__ import annotations

from typing import NamedTuple

import pytest
from ibrobot_imu import ibrobot_doctor
from serial.tools import list_ports


class Port(NamedTuple):
    """As pyserial lists one."""

    device: str
    vid: int | None
    description: str = "FT232R USB UART"


def test_each_usb_port_is_checked_and_a_locked_one_has_the_rule(tmp_path, monkeypatch: pytest.MonkeyPatch):
    free = tmp_path / "ttyUSB0"
    free.touch()
    ports = [Port("/dev/no-such-port", 0x10C4), Port(str(free), 0x0403)]
    monkeypatch.setattr(list_ports, "comports", lambda: iter(ports))
    locked, whole = ibrobot_doctor()
    assert (whole.name, whole.ok, whole.found) == ("imu port", True, f"FT232R USB UART at {free}")
    assert not locked.ok
    assert locked.found == "FT232R USB UART at /dev/no-such-port: no permission"
    assert locked.remedy == (
        """echo 'SUBSYSTEM=="tty", ATTRS{idVendor}=="10c4", TAG+="uaccess"' | sudo tee """
        "/etc/udev/rules.d/70-ibrobot-imu.rules && sudo udevadm control --reload, then replug it"
    )


def test_ports_that_are_not_usb_are_left_out(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(list_ports, "comports", lambda: [Port("/dev/ttyS0", None)])
    assert list(ibrobot_doctor()) == []
