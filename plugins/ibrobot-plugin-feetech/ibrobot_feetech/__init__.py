"""The plugin's hooks: hardware `feetech_so101`, the commands `ibrobot feetech …`, a check of the serial ports."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ibrobot_core.descriptors import HardwareDescriptor
from ibrobot_core.hookspecs import hookimpl
from ibrobot_feetech.options import FollowerOptions

if TYPE_CHECKING:
    from ibrobot_core.interfaces import Context, Hardware


def _follower(options: Any, ctx: Context) -> Hardware:
    from ibrobot_feetech.follower import FeetechFollower

    return FeetechFollower(options, ctx)


@hookimpl
def ibrobot_hardware() -> Iterable[HardwareDescriptor]:
    """The SO-101 on its servo bus."""
    yield HardwareDescriptor(
        type="feetech_so101", options=FollowerOptions, make=_follower, summary="SO-101 arm: STS3215 servos on one bus"
    )
