"""Runs in the guest: each device as the kernel shows it jogs the simulated SO-101, is unplugged in motion, comes back.

Prints a line for each device; the last line is `guest: all passed` or says what failed.
"""

from __future__ import annotations

import struct
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from tests.guest.kernel_devices import HidDevice, Joystick, descriptor

from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config
from tests import fake_hid

CONFIG = Path(__file__).parents[4] / "configs" / "so101_blind.yaml"
UNPLUGS = 20
TICK_S = 0.002
"""What the kernel has to pass a report on."""
GAMEPAD, JOYSTICK, MULTI_AXIS = 0x05, 0x04, 0x08


@attrs.frozen
class Kind:
    """A device and what an operator does with it: nothing, hold the deadman, move to one side or the other."""

    plug: Callable[[], Any]
    rest: Any
    held: Any
    right: Any
    left: Any
    type: str = "gamepad"


def dualsense_features() -> dict[int, bytes]:
    """What hid-playstation reads of a DualSense over USB: calibration, address, firmware."""
    calibration = struct.pack("<B17h", 5, 0, 0, 0, 8192, -8192, 8192, -8192, 8192, -8192, 540, 540, *[8192, -8192] * 3)
    return {
        0x05: calibration.ljust(41, b"\0"),
        0x09: bytes([9, 1, 2, 3, 4, 5, 6]).ljust(20, b"\0"),
        0x20: bytes([0x20]).ljust(64, b"\0"),
    }


def dualshock_features() -> dict[int, bytes]:
    """What hid-sony reads of a DualShock 4 over USB: calibration, address, versions."""
    calibration = struct.pack("<B17h", 2, 0, 0, 0, 8192, -8192, 8192, -8192, 8192, -8192, 540, 540, *[8192, -8192] * 3)
    return {
        0x02: calibration.ljust(37, b"\0"),
        0x81: bytes([0x81, 1, 2, 3, 4, 5, 7]),
        0x12: bytes([0x12, 1, 2, 3, 4, 5, 7]).ljust(16, b"\0"),
        0xA3: bytes([0xA3]).ljust(49, b"\0"),
    }


def dualshock(*, held: bool = False, x: float = 0.0) -> bytes:
    stick = fake_hid.stick_byte(x)
    return bytes([1, stick, 128, 128, 128, fake_hid.HAT_REST, int(held), 0, 0, 0]).ljust(64, b"\0")


def xbox(*, held: bool = False, x: int = 32768) -> bytes:
    return struct.pack("<B4H2H4B", 1, x, 32768, 32768, 32768, 0, 0, 0, 0x40 * held, 0, 0)


def eight(*, held: bool = False, x: int = 127) -> bytes:
    return bytes([1, 15, x, 127, 127, 127, 0, 0, 0x40 * held, 0]).ljust(34, b"\0")


def packed(a: int, b: int) -> bytes:
    return bytes([a & 255, a >> 8 | (b & 15) << 4, b >> 4])


def switch(*, held: bool = False, x: int = 2000, number: int = 0x30, rest: bytes = b"") -> bytes:
    head = bytes([number, 0, 0x8E, 0, 0, 0x40 * held]) + packed(x, 2100) + packed(2050, 2040) + b"\0"
    return (head + rest).ljust(64, b"\0")


def answer_switch(request: bytes) -> bytes | None:
    """The calibration, when it is asked for. Buttons stand in this report, too: here, the deadman is held."""
    if request[10:11] != b"\x10":
        return None
    pairs = ((1400, 1300), (2000, 2100), (1500, 1600), (2050, 2040), (1450, 1350), (1420, 1320))
    data = b"".join(packed(*pair) for pair in pairs)
    return switch(held=True, number=0x21, rest=bytes([0x90, 0x10]) + request[11:16] + data)


def hid(
    vendor: int, product: int, usage: int, inputs: dict[int, int], outputs: dict[int, int] | None = None, **more: Any
) -> Callable[[], HidDevice]:
    layout = descriptor(usage, inputs, outputs or {})
    return lambda: HidDevice(vendor, product, layout, "Emulated", **more)


def move(joystick: Joystick, held: bool, x: int) -> None:
    joystick.key(Joystick.LEFT_SHOULDER, pressed=held)
    joystick.axis(Joystick.LEFT_X, x)


LB = "left_shoulder"
KINDS = {
    "DualSense, hid-playstation": Kind(
        hid(0x054C, 0x0CE6, GAMEPAD, {1: 63}, {2: 47}, features=dualsense_features()), fake_hid.dualsense(),
        fake_hid.dualsense(LB), fake_hid.dualsense(LB, left=(1, 0)), fake_hid.dualsense(LB, left=(-1, 0)),
    ),
    "DualShock 4, hid-sony": Kind(
        hid(0x054C, 0x09CC, GAMEPAD, {1: 63}, {5: 31}, features=dualshock_features()), dualshock(),
        dualshock(held=True), dualshock(held=True, x=1), dualshock(held=True, x=-1),
    ),
    "Xbox Series by Bluetooth's reports": Kind(
        hid(0x045E, 0x0B13, GAMEPAD, {1: 16}, {3: 8}), xbox(), xbox(held=True), xbox(held=True, x=65535),
        xbox(held=True, x=0),
    ),
    "Switch Pro": Kind(
        hid(0x057E, 0x2009, JOYSTICK, {0x30: 63, 0x21: 63}, {1: 48}, on_output=answer_switch), switch(),
        switch(held=True), switch(held=True, x=3500), switch(held=True, x=500),
    ),
    "8BitDo Pro 2": Kind(
        hid(0x2DC8, 0x6003, GAMEPAD, {1: 33}), eight(), eight(held=True), eight(held=True, x=255), eight(held=True, x=0)
    ),
    "Xbox 360, evdev through SDL": Kind(Joystick, (False, 0), (True, 0), (True, 32767), (True, -32768)),
    "SpaceMouse": Kind(
        hid(0x256F, 0xC635, MULTI_AXIS, {1: 12, 3: 2}), fake_hid.mouse_buttons(), fake_hid.mouse_buttons(0),
        fake_hid.spacemouse(yaw=1), fake_hid.spacemouse(yaw=-1), "spacemouse",
    ),
}  # fmt: skip


class Drive:
    """A run of the simulated arm with a device."""

    def __init__(self, kind: Kind) -> None:
        self.kind = kind
        made = f"{{type: {kind.type}, start: joints}}"
        mode = "{executors: [arm_position, gripper_position], teleop: device}"
        registry = installed_plugins()
        overrides = [f"teleoperation.device={made}", f"control_modes.device={mode}"]
        config = load_config(CONFIG, sim=True, mode="device", overrides=overrides, registry=registry)
        self.runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, seed=3)))
        self.device = self.plug()
        self.runtime.start()

    def plug(self) -> Any:
        device = self.kind.plug()
        time.sleep(0.3)  # until the kernel has bound a driver
        return device

    @property
    def pan(self) -> float:
        return float(self.runtime.session.measured().position[0])

    def ticks(self, count: int, report: Any = None) -> None:
        for _ in range(count):
            if isinstance(report, bytes):
                self.device.send(report)
            elif report is not None:
                move(self.device, *report)
            time.sleep(TICK_S)
            assert not self.runtime.step(), self.runtime.session.failure_text

    def jog(self, way: Any, count: int) -> float:
        """Press the deadman and move; returns how far the first joint went [rad]."""
        before = self.pan
        self.ticks(10, self.kind.rest)
        self.ticks(5, self.kind.held)
        self.ticks(count, way)
        return self.pan - before


def check(name: str, kind: Kind) -> None:
    drive = Drive(kind)
    try:
        drive.ticks(60, kind.rest)
        far = drive.jog(kind.right, 40)
        assert abs(far) > 0.1, f"went {far:.3f} rad"
        sign = np.sign(far)
        for i in range(UNPLUGS):
            way = kind.left if i % 2 == 0 else kind.right
            went = drive.jog(way, 20)
            assert went * sign * (-1 if i % 2 == 0 else 1) > 0.03, f"unplug {i}: went {went:.3f} rad"
            drive.device.unplug()
            drive.ticks(20)
            stopped = drive.pan
            drive.ticks(20)
            drive.device = drive.plug()
            drive.ticks(70, way)
            assert abs(drive.pan - stopped) < 5e-3, f"unplug {i}: moved without the deadman"
        assert drive.runtime.session.faults == (), drive.runtime.session.faults
        print(f"guest: {name}: jogged {far:+.2f} rad, {UNPLUGS} unplugs in motion held", flush=True)
    finally:
        drive.runtime.stop()
        drive.device.unplug()


def main() -> None:
    """Check every device."""
    failed = []
    wanted = sys.argv[1:]
    for name, kind in KINDS.items():
        if wanted and not any(each.lower() in name.lower() for each in wanted):
            continue
        try:
            check(name, kind)
        except Exception as error:  # noqa: BLE001 - all devices are tried, and what failed is printed
            traceback.print_exc()
            failed.append(f"{name}: {error}")
    print(f"guest: {'failed: ' + '; '.join(failed) if failed else 'all passed'}", flush=True)


if __name__ == "__main__":
    main()
