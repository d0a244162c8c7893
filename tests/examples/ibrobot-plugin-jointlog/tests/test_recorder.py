"""The joint log recorder: what it keeps, what a crash leaves, and that the reader gives it back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import override

import numpy as np
import pytest
from ibrobot_jointlog import ibrobot_recorders
from ibrobot_jointlog.log import read_log
from ibrobot_jointlog.reader import JointLogReader
from ibrobot_jointlog.recorder import JointLogRecorder
from ibrobot_testing import RecorderSuite, host_context, make_robot
from ibrobot_testing.contexts import START_NS
from numpy.typing import ArrayLike

from ibrobot_core.api import (
    NS_PER_S,
    Context,
    EpisodeAddress,
    EpisodeEnd,
    EpisodeStart,
    Header,
    JointState,
    Message,
    RecorderError,
    String,
    ns,
)

JOINTS = make_robot().joint_names
TOPICS = {"/joint_states": JointState.ros_type}


class TestJointLogRecorder(RecorderSuite):
    """A joint log keeps header stamps and positions, so these are all that the suite's messages have."""

    joint_states_only = True

    @override
    def make(self, ctx: Context) -> JointLogRecorder:
        return JointLogRecorder(ctx)

    @override
    def records(self, ctx: Context, count: int = 50) -> list[tuple[int, Message]]:
        return [
            (m.header.stamp_ns, JointState(m.header, m.name, m.position))
            for _, m in super().records(ctx, count)
            if isinstance(m, JointState)
        ]

    @override
    def read_back(self, path: Path) -> Mapping[str, Sequence[tuple[int, Message]]]:
        log = read_log(path / "joints.csv")
        start_ns = json.loads((path / "metadata.json").read_text())["start_stamp_ns"]
        stamps = [start_ns + ns(t) for t in log.times.tolist()]
        messages = [JointState(Header(s), JOINTS, p) for s, p in zip(stamps, log.positions, strict=True)]
        return {"/joint_states": list(zip(stamps, messages, strict=True))}

    @override
    def read_dropped(self, path: Path) -> Mapping[str, int]:
        topics = JointLogReader(EpisodeAddress(path)).summary().topics
        return {topic: each.dropped for topic, each in topics.items()}

    @override
    def read_metadata(self, path: Path) -> Mapping[str, str]:
        facts = json.loads((path / "metadata.json").read_text())
        return {**facts["metadata"], "outcome": facts["outcome"]}


def state(stamp_ns: int, position: ArrayLike, joints: tuple[str, ...] = JOINTS) -> JointState:
    return JointState(Header(stamp_ns), joints, position)


@pytest.fixture
def episode(tmp_path):
    return EpisodeStart(tmp_path / "episode", START_NS, TOPICS, {"prompt": "wave"})


@pytest.fixture
def recorder():
    recorder = JointLogRecorder(host_context())
    yield recorder
    recorder.close()


def metadata(episode: EpisodeStart) -> dict[str, object]:
    return json.loads((episode.directory / "metadata.json").read_text())


def test_reader_gives_back_what_was_recorded(recorder, episode):
    rng = np.random.default_rng(0)
    motion = np.cumsum(rng.uniform(-0.01, 0.01, (200, 6)), axis=0)
    stamps = START_NS + np.cumsum(rng.integers(9_000_000, 11_000_000, 200))
    recorder.begin(episode)
    for stamp, position in zip(stamps.tolist(), motion, strict=True):
        recorder.write("/joint_states", state(stamp, position), stamp + 1)
    path = recorder.end(EpisodeEnd(int(stamps[-1]), "success"))

    reader = JointLogReader(EpisodeAddress(path))
    summary = reader.summary()
    assert (summary.finished, summary.outcome, summary.path) == (True, "success", path)
    messages = list(reader.messages())
    assert [each.received_ns for each in messages] == stamps.tolist()
    states = [each.message for each in messages if isinstance(each.message, JointState)]
    np.testing.assert_array_equal([each.position for each in states], motion)


def test_messages_may_name_the_joints_in_any_order_and_others_too(recorder, episode):
    recorder.begin(episode)
    recorder.write("/joint_states", state(START_NS, [7.0, *range(6)], ("wheel", *JOINTS[::-1])), START_NS)
    path = recorder.end(EpisodeEnd(START_NS, "success"))
    np.testing.assert_array_equal(read_log(path / "joints.csv").positions, [[5, 4, 3, 2, 1, 0]])


def test_samples_before_the_start_have_negative_times(recorder, episode):
    recorder.begin(episode)
    recorder.write("/joint_states", state(START_NS - 1_500_000, [0.0] * 6), START_NS)
    path = recorder.end(EpisodeEnd(START_NS, "success"))
    assert read_log(path / "joints.csv").times.tolist() == [-0.0015]


def test_a_reading_under_an_old_stamp_is_counted_and_not_written(recorder, episode):
    recorder.begin(episode)
    for stamp in (START_NS, START_NS, START_NS - 1, START_NS + 1):
        recorder.write("/joint_states", state(stamp, [0.0] * 6), stamp)
    path = recorder.end(EpisodeEnd(START_NS + 2, "failure", {"/joint_states": 3}))
    assert read_log(path / "joints.csv").times.tolist() == [0.0, 1e-9]
    assert metadata(episode) == {
        "format": "joint_log",
        "start_stamp_ns": START_NS,
        "end_stamp_ns": START_NS + 2,
        "metadata": {"prompt": "wave"},
        "outcome": "failure",
        "samples": 2,
        "repeated": 2,
        "dropped": {"/joint_states": 3},
    }


def test_an_unfinished_episode_says_so_and_holds_whole_lines_only(recorder, episode):
    recorder.begin(episode)
    for i in range(1234):
        stamp = START_NS + i * 10_000_000
        recorder.write("/joint_states", state(stamp, np.full(6, 1 / 3)), stamp)
        text = (episode.directory / "joints.csv").read_text()
        assert text.endswith("\n")
        assert i - text.count("\n") < 100
    assert metadata(episode)["outcome"] == "unfinished"


def test_a_full_disk_is_an_error_and_leaves_what_was_written(recorder, episode, monkeypatch):
    recorder.begin(episode)
    recorder.write("/joint_states", state(START_NS, [0.0] * 6), START_NS)
    recorder.write("/joint_states", state(START_NS + NS_PER_S, [1.0] * 6), START_NS)

    import os

    whole_write = os.write
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", lambda fd, block: whole_write(fd, block[:10]))
        recorder.write("/joint_states", state(START_NS + 2 * NS_PER_S, [2.0] * 6), START_NS)
        with pytest.raises(RecorderError, match=r"joints\.csv: only 10 of .* bytes were written"):
            recorder.write("/joint_states", state(START_NS + 3 * NS_PER_S, [3.0] * 6), START_NS)
    recorder.write("/joint_states", state(START_NS + 4 * NS_PER_S, [4.0] * 6), START_NS)
    path = recorder.end(EpisodeEnd(START_NS, "unknown"))
    assert read_log(path / "joints.csv").times.tolist() == [0.0, 1.0, 4.0]


WRONG = {
    "joint missing": (
        state(START_NS, [0.0] * 5, JOINTS[:5]),
        "/joint_states lacks joint 'gripper'; it has: shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll",
    ),
    "no positions": (state(START_NS, []), "/joint_states has 6 joints but 0 positions"),
    "not finite": (
        state(START_NS, [0, 0, np.nan, 0, 0, 0]),
        "/joint_states: position of joint 'elbow_flex' is nan, must be finite",
    ),
    "another type": (String("x"), "/joint_states carries std_msgs/msg/String, must be sensor_msgs/msg/JointState"),
}


@pytest.mark.parametrize(("message", "reason"), WRONG.values(), ids=WRONG.keys())
def test_messages_that_do_not_fit_are_refused_and_the_episode_goes_on(recorder, episode, message, reason):
    recorder.begin(episode)
    with pytest.raises(RecorderError) as refused:
        recorder.write("/joint_states", message, START_NS)
    assert str(refused.value) == reason
    recorder.write("/joint_states", state(START_NS, [0.0] * 6), START_NS)
    path = recorder.end(EpisodeEnd(START_NS, "success"))
    assert len(read_log(path / "joints.csv").times) == 1


def test_an_episode_without_joint_states_is_refused(recorder, tmp_path):
    with pytest.raises(RecorderError, match="records /joint_states, which is not among: /imu"):
        recorder.begin(EpisodeStart(tmp_path / "episode", 0, {"/imu": "sensor_msgs/msg/Imu"}, {}))
    assert not (tmp_path / "episode").exists()


def test_the_hook_offers_the_recorder():
    (descriptor,) = ibrobot_recorders()
    assert isinstance(descriptor.make(descriptor.options(), host_context()), JointLogRecorder)


def test_an_episode_whose_log_lacks_its_last_lines_is_refused(recorder, episode):
    recorder.begin(episode)
    for i in range(3):
        recorder.write("/joint_states", state(START_NS + i, [0.0] * 6), START_NS)
    path = recorder.end(EpisodeEnd(START_NS + 3, "success"))
    log = path / "joints.csv"
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:-1]))
    for address in (path, log):
        with pytest.raises(RecorderError, match=r"joints\.csv: has 2 samples, metadata\.json says 3: lines are"):
            JointLogReader(EpisodeAddress(address))
