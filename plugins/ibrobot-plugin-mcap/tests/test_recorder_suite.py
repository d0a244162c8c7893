"""The recorder conforms, in lockstep and with its writing thread."""

from __future__ import annotations

from typing import Any

import pytest
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.reader import Rosbag2Reader
from ibrobot_mcap.recorder import McapRecorder
from ibrobot_testing import RecorderSuite
from ibrobot_testing.contexts import START_NS, host_context

from ibrobot_core.api import RealClock


class McapSuite(RecorderSuite):
    options = McapOptions()

    def make(self, ctx):
        return McapRecorder(self.options, ctx)

    def read_back(self, path):
        reader = Rosbag2Reader(path)
        try:
            found: dict[str, list[Any]] = {topic: [] for topic in reader.summary().topics}
            for item in reader.messages():
                found[item.topic].append((item.received_ns, item.message))
        finally:
            reader.close()
        return found

    def read_metadata(self, path):
        reader = Rosbag2Reader(path)
        try:
            summary = reader.summary()
        finally:
            reader.close()
        return {**summary.metadata, "outcome": summary.outcome}

    def read_dropped(self, path):
        reader = Rosbag2Reader(path)
        try:
            return {topic: each.dropped for topic, each in reader.summary().topics.items()}
        finally:
            reader.close()


class TestInLockstep(McapSuite):
    pass


class TestLz4(McapSuite):
    options = McapOptions(compression="lz4")


class TestZstd(McapSuite):
    options = McapOptions(compression="zstd", chunk_period_s=1.0)


class TestInSmallSplits(McapSuite):
    options = McapOptions(split_duration=0.7, chunk_size=1024)

    @pytest.mark.long
    def test_loses_nothing_of_a_long_episode(self, tmp_path):
        super().test_loses_nothing_of_a_long_episode(tmp_path)


class StillClock(RealClock):
    """A real clock, which makes the recorder use its thread; it stands still, so that records repeat."""

    def now_ns(self):
        return START_NS


class TestWithItsThread(McapSuite):
    # The thread writes by wall time: test_kill.py sees what a killed process leaves.
    test_a_crash_costs_little = None  # type: ignore[assignment]  # pytest then does not collect it

    def context(self):
        return host_context(clock=StillClock())
