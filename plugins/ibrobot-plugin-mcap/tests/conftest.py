"""Recording and reading in tests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.reader import Rosbag2Reader
from ibrobot_mcap.recorder import McapRecorder
from ibrobot_testing.contexts import START_NS, host_context

from ibrobot_core.api import EpisodeEnd, EpisodeStart, Header, Image, JointState, RealClock

STEP_NS = 10_000_000
JOINTS = "/joint_states"
CAMERA = "/top/image_raw"


def stamp(index):
    return START_NS + index * STEP_NS


def joints(index):
    return JointState(Header(stamp(index)), ("pan", "tilt"), [float(index), -float(index)])


def picture(index, encoding="rgb8", channels=3, dtype=np.uint8):
    rows = np.add.outer(np.arange(48), np.arange(64))[..., None] + np.zeros(channels)
    data = ((rows + index) % 200).astype(dtype)
    return Image(Header(stamp(index)), 48, 64, encoding, 64 * channels * data.itemsize, data.view(np.uint8).ravel())


class Bench:
    """A recorder in a folder; `threaded` ones write as in real time."""

    def __init__(self, folder, *, threaded=False, **options) -> None:
        self.ctx = host_context(clock=RealClock()) if threaded else host_context()
        self.recorder = McapRecorder(McapOptions(**options), self.ctx)
        self.path = folder / "episode_000001"

    def begin(self, topics=(JOINTS,), **metadata):
        known = {JOINTS: JointState.ros_type, CAMERA: Image.ros_type}
        announced = {topic: known[topic] for topic in topics if topic in known}
        self.recorder.begin(EpisodeStart(self.path, START_NS, announced, metadata, any_topic=True))

    def write(self, count, topic=JOINTS, make=joints, start=0):
        for index in range(start, start + count):
            self.recorder.write(topic, make(index), stamp(index))

    def end(self, outcome="success", **dropped):
        return self.recorder.end(EpisodeEnd(stamp(10_000), outcome, dropped))


@pytest.fixture
def bench(tmp_path):
    made = []

    def make(folder="kept", **options):
        (tmp_path / folder).mkdir()
        made.append(Bench(tmp_path / folder, **options))
        return made[-1]

    yield make
    for each in made:
        each.recorder.close()


@contextmanager
def reading(path) -> Iterator[Rosbag2Reader]:
    reader = Rosbag2Reader(path)
    try:
        yield reader
    finally:
        reader.close()


def read(path, topics=None):
    with reading(path) as reader:
        return list(reader.messages(topics))


def summary(path):
    with reading(path) as reader:
        return reader.summary()
