"""Opens the port of an arm, and says where the arm is if it is elsewhere."""

from __future__ import annotations

from pathlib import Path

from ibrobot_calibration import Calibration

from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.errors import PortError
from ibrobot_feetech.usb import GIVE, adapter_elsewhere


def open_port(bus: FeetechBus, calibration: Calibration) -> None:
    """Open an arm's port; if it does not exist, the error says where the arm's adapter is now.

    Raises:
        PortError: if it cannot be opened.
    """
    try:
        bus.open()
    except PortError as error:
        elsewhere = adapter_elsewhere(calibration)
        if Path(bus.port.path).exists() or elsewhere is None:
            raise
        where = f"the adapter of {calibration.path} is at {elsewhere.stable or elsewhere.path}"
        raise PortError(error.place, f"there is no such port; {where}: {GIVE.format(calibration.adapter)}") from None
