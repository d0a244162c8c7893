"""An emulator of a Feetech servo bus on a pseudo-terminal, for tests and for use without an arm."""

from ibrobot_feetech.emulator.faults import Faults
from ibrobot_feetech.emulator.pty import Emulator
from ibrobot_feetech.emulator.servo import EmulatedServo

__all__ = ["EmulatedServo", "Emulator", "Faults"]
