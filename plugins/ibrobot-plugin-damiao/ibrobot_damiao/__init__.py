"""The plugin's hooks: hardware `damiao`, and `ibrobot damiao …`."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import HardwareDescriptor, Late, hookimpl
from ibrobot_core.app import Command
from ibrobot_damiao.options import DamiaoOptions


@hookimpl
def ibrobot_hardware() -> Iterable[HardwareDescriptor]:
    """An arm on a CAN bus."""
    yield HardwareDescriptor(
        type="damiao",
        options=DamiaoOptions,
        make=Late("ibrobot_damiao.arm:DamiaoArm"),
        torque_off="ibrobot damiao off",
        summary="arm with Damiao motors on a CAN bus, as OpenArm or reBot B601",
    )


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot damiao …`."""
    yield Command(
        "damiao",
        summary="Set up, zero and emulate Damiao motors on a CAN bus.",
        about="CHANNEL is a network interface, e.g. can0, or the serial port of an adapter that speaks slcan.",
    )
    yield Command("damiao scan", Late("ibrobot_damiao.commands:Scan"))
    yield Command("damiao zero", Late("ibrobot_damiao.commands:Zero"))
    yield Command("damiao off", Late("ibrobot_damiao.commands:Off"))
    yield Command("damiao set-id", Late("ibrobot_damiao.commands:SetId"))
    yield Command("damiao emulate", Late("ibrobot_damiao.emulator.serve:Emulate"))
