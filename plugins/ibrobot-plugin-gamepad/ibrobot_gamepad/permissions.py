"""Permissions of the user to open devices, and the udev rule that grants them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from ibrobot_core.api import Check
from ibrobot_gamepad.hid import find_hid
from ibrobot_gamepad.reports import KINDS, MODELS, THREEDCONNEXION

RULES = "/etc/udev/rules.d/60-ibrobot-gamepad.rules"
"""Must sort before 73-seat-late.rules, which gives devices tagged `uaccess` to the user logged in at the machine."""
WRITE_RULES = f"ibrobot gamepad udev | sudo tee {RULES} && sudo udevadm control --reload, then plug it in again"
_LOGITECH = "*:046D:C6*"
"""SpaceMice made by Logitech."""
_JOYSTICKS = "by-*/*-event-joystick"


def udev_rules() -> str:
    """The rule that lets users open devices with known reports, over USB and Bluetooth."""
    vendors = sorted({vendor for model in MODELS for vendor, _ in model.ids} | {THREEDCONNEXION})
    parents = [f"*:{vendor:04X}:*" for vendor in vendors] + [_LOGITECH]
    lines = [f'KERNEL=="hidraw*", KERNELS=="{parent}", MODE="0660", TAG+="uaccess"' for parent in parents]
    return "\n".join(["# Gamepads and SpaceMice, for ibrobot", *lines])


def checks(joysticks: Path = Path("/dev/input")) -> Iterator[Check]:
    """A check for each device: of hidraw for devices with known reports, and of evdev for all others."""
    for kind in KINDS:
        for pad in find_hid(kind):
            # On other systems than Linux a path is not that of a file.
            allowed = not pad.path.startswith("/dev/") or os.access(pad.path, os.R_OK | os.W_OK)
            text = f"{pad.name} ({pad.id}) at {pad.path}"
            yield Check(kind, allowed, text if allowed else f"{text}: no permission", WRITE_RULES)
    for path in sorted(joysticks.glob(_JOYSTICKS)):
        allowed = os.access(path, os.R_OK)
        text = f"{path.name} at {path.resolve()}"
        remedy = "sudo usermod -aG input $USER, log in again"
        yield Check("joystick", allowed, text if allowed else f"{text}: no permission", remedy)
