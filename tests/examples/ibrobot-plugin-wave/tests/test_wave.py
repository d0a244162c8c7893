"""The wave is a correct teleoperation device."""

from typing import override

from ibrobot_testing import TeleopSuite
from ibrobot_wave import Wave, WaveOptions

from ibrobot_core.api import Context, Teleop


class TestWave(TeleopSuite):
    """Runs every check of the suite on the wave."""

    has_deadman = False
    has_operator = False  # it waves by itself

    @override
    def make(self, ctx: Context) -> Teleop:
        return Wave(WaveOptions(), ctx)

    @override
    def operate(self, teleop: Teleop) -> None:
        pass  # it waves by itself
