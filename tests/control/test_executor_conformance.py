"""The built-in executor passes the suite that plugin authors use."""

from __future__ import annotations

from typing import override

from ibrobot_testing import ExecutorSuite

from ibrobot_core.control.position import PositionExecutor
from ibrobot_core.descriptors import StreamOptions


class TestPosition(ExecutorSuite):
    @override
    def make(self, ctx):
        return PositionExecutor(StreamOptions(), ctx)
