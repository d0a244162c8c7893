"""Every fake passes the suite of its kind."""

from __future__ import annotations

import json
from typing import override

import attrs
import numpy as np
import pytest

from ibrobot_core.local_transport import LocalTransport
from ibrobot_core.messages import Header, JointState
from ibrobot_core.testing import (
    DatasetSuite,
    ExecutorSuite,
    HardwareSuite,
    PlannerSuite,
    PolicySuite,
    RecorderSuite,
    SensorSuite,
    SimulatedHardwareSuite,
    TeleopSuite,
    TransportSuite,
    ViewerSuite,
)
from ibrobot_core.testing.fakes import (
    FakeDataset,
    FakeExecutor,
    FakeHardware,
    FakePlanner,
    FakePolicy,
    FakeRealHardware,
    FakeRecorder,
    FakeSensor,
    FakeTeleop,
    FakeViewer,
)


class TestHardware(HardwareSuite):
    @override
    def make(self, ctx):
        return FakeRealHardware(ctx)


class TestSimulatedHardware(SimulatedHardwareSuite):
    @override
    def make(self, ctx):
        return FakeHardware(ctx)


class TestSensor(SensorSuite):
    @override
    def make(self, ctx):
        return FakeSensor(ctx)


class TestTeleop(TeleopSuite):
    @override
    def make(self, ctx):
        return FakeTeleop(ctx)

    @override
    def engage(self, teleop):
        teleop.deadman = True

    @override
    def release(self, teleop):
        teleop.deadman = False

    @override
    def operate(self, teleop):
        teleop.velocity = 0.1


class TestPolicy(PolicySuite):
    @override
    def make(self, ctx):
        return FakePolicy(ctx)


class TestExecutor(ExecutorSuite):
    @override
    def make(self, ctx):
        return FakeExecutor(ctx)

    @override
    def goal(self, ctx, position):
        return {"position": position.tolist()}

    @override
    def wrong_goals(self, ctx):
        return [{}, {"position": [0.0]}, {"position": [float("nan")] * len(ctx.joints)}]


class TestPlanner(PlannerSuite):
    @override
    def make(self, ctx):
        return FakePlanner(ctx)


class TestTransport(TransportSuite):
    @override
    def make(self, ctx):
        return LocalTransport()


class TestRecorder(RecorderSuite):
    @override
    def make(self, ctx):
        return FakeRecorder(ctx)

    @override
    def read_back(self, path):
        kept: dict[str, list[tuple[int, JointState]]] = {}
        for text in (path / "records.jsonl").read_text().splitlines():
            line = json.loads(text)
            arrays = (np.array(line[name]) for name in ("position", "velocity", "effort"))
            message = JointState(Header(line["stamp_ns"]), tuple(line["name"]), *arrays)
            kept.setdefault(line["topic"], []).append((line["received_ns"], message))
        return kept

    @override
    def read_metadata(self, path):
        return json.loads((path / "metadata.json").read_text())


class TestDataset(DatasetSuite):
    @override
    def make(self, ctx):
        return FakeDataset(ctx)

    @override
    def read_back(self, root):
        return [dict(np.load(path)) for path in sorted(root.glob("episode_*.npz"))]


class TestViewer(ViewerSuite):
    @override
    def make(self, ctx):
        return FakeViewer(ctx)

    @override
    def shut(self, viewer):
        viewer.person_closed = True

    @override
    def shown(self, viewer):
        return viewer.shown


def test_fakes_are_frozen_to_their_context() -> None:
    """A fake owns only the joints of its context, so that two may share a robot."""
    ctx = TestHardware().context()
    pair = [FakeHardware(attrs.evolve(ctx, joints=joints)) for joints in (("gripper",), ("wrist_roll", "elbow_flex"))]
    assert [hardware.read().position.shape for hardware in pair if hardware.connect() is None] == [(1,), (2,)]


def test_an_unfinished_suite_says_what_it_lacks() -> None:
    with pytest.raises(NotImplementedError, match=r"HardwareSuite must define make"):
        HardwareSuite().make(HardwareSuite().context())
