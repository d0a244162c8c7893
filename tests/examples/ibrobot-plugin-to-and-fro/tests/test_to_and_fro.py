"""The cause `to_and_fro` is accused where it is at work, and nowhere else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

import numpy as np
from ibrobot_diagnose.cause import Cause, Reference
from ibrobot_diagnose.testing import CauseSuite, make_window
from ibrobot_diagnose.window import Window
from ibrobot_to_and_fro import ibrobot_causes

from ibrobot_core.api import Context


def swaying(turns_per_s: float, begin_s: float = 0.0) -> Window:
    """Four seconds in which the elbow is commanded to and fro from some time on, and the shoulder goes its way."""
    times = np.arange(120) / 30
    swing = 0.2 * np.sin(np.pi * turns_per_s * np.maximum(times - begin_s, 0.0))
    commands = np.column_stack([0.1 * times, swing])
    return make_window(commands, joints=("shoulder", "elbow"), name=f"{turns_per_s} turns per second")


class TestToAndFro(CauseSuite):
    @override
    def make(self, ctx: Context) -> Cause:
        (descriptor,) = ibrobot_causes()
        return descriptor.make()

    @override
    def accused(self) -> Sequence[Window]:
        return [swaying(6.0), swaying(10.0)]

    @override
    def healthy(self) -> Sequence[Window]:
        return [swaying(0.0), swaying(2.5)]

    def test_names_the_joint_and_the_time(self) -> None:
        evidence = self.subject().test(swaying(10.0, begin_s=1.0), Reference())
        assert evidence is not None
        assert evidence.text.startswith("elbow was commanded to turn around")
        assert evidence.since_s is not None
        assert 1.0 <= evidence.since_s <= 1.1
