"""The engine `monolithic`, as any other."""

from __future__ import annotations

from typing import override

from ibrobot_testing import EngineSuite, check_descriptor

from ibrobot_core.api import Context, Engine
from ibrobot_core.plugins import discover


class TestMonolithic(EngineSuite):
    @override
    def make(self, ctx: Context) -> Engine:
        descriptor = discover([]).find("engine", "monolithic")
        check_descriptor(descriptor, descriptor.options())
        engine: Engine = descriptor.make(descriptor.options(), ctx)
        return engine
