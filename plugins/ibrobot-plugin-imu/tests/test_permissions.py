"""Doctor's checks of serial ports, and the udev rule in their remedy."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from ibrobot_imu import ibrobot_doctor
from serial.tools import list_ports


def port(path: str, vendor: int | None) -> SimpleNamespace:
    return SimpleNamespace(device=path, description="FT232R USB UART", vid=vendor)


def test_each_usb_port_is_checked_and_a_locked_one_has_the_rule(tmp_path, monkeypatch: pytest.MonkeyPatch):
    free = tmp_path / "ttyUSB0"
    free.touch()
    ports = [port(str(free), 0x0403), port("/dev/no-such-port", 0x10C4)]
    monkeypatch.setattr(list_ports, "comports", lambda: iter(ports))
    monkeypatch.setattr("builtins.sorted", list)
    first, second = ibrobot_doctor()
    assert (first.name, first.ok, first.found) == ("imu port", True, f"FT232R USB UART at {free}")
    assert not second.ok
    assert second.found == "FT232R USB UART at /dev/no-such-port: no permission"
    assert second.remedy == (
        """echo 'SUBSYSTEM=="tty", ATTRS{idVendor}=="10c4", TAG+="uaccess"' | sudo tee """
        "/etc/udev/rules.d/70-ibrobot-imu.rules && sudo udevadm control --reload, then replug it"
    )


def test_ports_that_are_not_usb_are_left_out(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(list_ports, "comports", lambda: [port("/dev/ttyS0", None)])
    assert list(ibrobot_doctor()) == []
