"""What the recorder writes: bags that other tools open, splits, latched topics, pictures, and what a bad disk costs."""

from __future__ import annotations

import errno
import os
import resource
import threading
import time
from collections import Counter
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import yaml
from ibrobot_mcap import bagfile, ibrobot_recorders, output
from ibrobot_mcap.recorder import McapRecorder
from ibrobot_ros2 import definition, encode, type_hash
from ibrobot_testing.contexts import START_NS, host_context
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2

from ibrobot_core.api import NS_PER_S, EpisodeEnd, Image, JointState, RecorderError, String

from .conftest import CAMERA, JOINTS, Bench, joints, picture, read, stamp, summary

MIB = 1 << 20


def files(path):
    return sorted(path.glob("*.mcap"), key=lambda file: int(file.stem.rpartition("_")[2]))


def mcap_messages(file):
    with file.open("rb") as stream:
        return list(make_reader(stream, validate_crcs=True).iter_messages())


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_other_readers_open_it_and_count_the_same(bench, compression):
    made = bench(compression=compression, chunk_size=4096)
    made.begin(prompt="1e3")
    made.write(300)
    made.write(20, CAMERA, picture, start=300)
    path = made.end()
    (file,) = files(path)
    counts = Counter(channel.topic for _, channel, _ in mcap_messages(file))
    assert counts == {JOINTS: 300, CAMERA: 20}
    with AnyReader([path]) as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == counts
        found = Counter(connection.topic for connection, _, _ in reader.messages())
        assert found == counts
        joint_state: Any = reader.deserialize(next(reader.messages())[2], JointState.ros_type)
        assert joint_state.position.tolist() == [0.0, 0.0]
    assert {topic: kept.count for topic, kept in summary(path).topics.items()} == counts


def test_the_file_is_what_ros_tools_expect(bench):
    made = bench()
    made.begin(prompt="pick")
    made.write(3)
    path = made.end()
    with files(path)[0].open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        records = [yaml.safe_load(r.metadata["serialized_metadata"]) for r in reader.iter_metadata()]
        ((schema, channel, message), *_) = reader.iter_messages()
    assert [record["message_count"] for record in records] == [0, 3]
    assert records[0]["custom_data"] == {"prompt": "pick"}
    assert schema is not None
    assert (schema.name, schema.encoding, channel.message_encoding) == (JointState.ros_type, "ros2msg", "cdr")
    assert schema.data.decode() == definition(JointState.ros_type)
    assert channel.metadata["topic_type_hash"] == type_hash(JointState.ros_type)
    assert (message.log_time, message.publish_time, message.sequence) == (START_NS, START_NS, 1)
    facts = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert facts == records[1]
    assert (facts["version"], facts["storage_identifier"], facts["message_count"]) == (9, "mcap", 3)
    assert facts["starting_time"] == {"nanoseconds_since_epoch": START_NS}
    assert facts["duration"] == {"nanoseconds": stamp(2) - stamp(0)}
    (topic,) = facts["topics_with_message_count"]
    assert topic["topic_metadata"]["type_description_hash"] == type_hash(JointState.ros_type)
    assert topic["topic_metadata"]["offered_qos_profiles"][0]["durability"] == "volatile"
    assert facts["custom_data"] == {"prompt": "pick", "outcome": "success", "dropped": "{}"}


def test_faults_during_an_episode_are_in_its_metadata(bench):
    made = bench()
    made.begin()
    path = made.recorder.end(EpisodeEnd(stamp(3), "failure", faults=("emergency stop", "servo 3 is hot")))
    facts = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert facts["custom_data"]["faults"] == '["emergency stop", "servo 3 is hot"]'


def test_a_topic_that_stays_silent_is_listed(bench):
    made = bench()
    made.begin(topics=(JOINTS, CAMERA))
    made.write(2)
    kept = summary(made.end()).topics
    assert (kept[CAMERA].type, kept[CAMERA].count) == (Image.ros_type, 0)


def test_equal_runs_give_equal_bytes(bench):
    paths = []
    for folder in ("one", "two"):
        made = bench(folder, compression="zstd", chunk_size=2048)
        made.begin()
        made.write(100)
        paths.append(made.end())
    assert files(paths[0])[0].read_bytes() == files(paths[1])[0].read_bytes()


@pytest.mark.parametrize(("option", "value"), [("split_duration", 1.0), ("split_size", 64 * 1024)])
def test_splits_begin_with_what_is_latched(bench, option, value):
    made = bench(**{option: value}, chunk_period_s=0.1)
    made.ctx.bus.publish("/robot_description", String("<urdf/>"), latched=True)
    made.begin()
    made.recorder.write("/robot_description", String("<urdf/>"), stamp(0))
    made.write(700)
    path = made.end()
    parts = files(path)
    assert len(parts) > 1
    begins = []
    for part in parts:
        with AnyReader([part]) as reader:
            (connection,) = [c for c in reader.connections if c.topic == "/robot_description"]
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            assert connection.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"
            ((_, begin_ns, _),) = reader.messages([connection])
            assert begin_ns == reader.start_time
        begins.append(begin_ns)
        assert [r.message for r in read(part, {"/robot_description"})] == [String("<urdf/>")]
    assert begins == sorted(set(begins))
    copies = [m for part in parts for _, channel, m in mcap_messages(part) if channel.topic == "/robot_description"]
    assert {copy.publish_time for copy in copies} == {stamp(0)}
    # The episode as a whole has every message once.
    found = read(path)
    assert Counter(r.topic for r in found) == {JOINTS: 700, "/robot_description": 1}
    assert [r.message for r in found if r.topic == JOINTS] == [joints(i) for i in range(700)]
    assert summary(path).topics["/robot_description"].count == 1
    with AnyReader([path]) as reader:
        assert reader.message_count == 700 + len(parts) == len(list(reader.messages()))
    facts = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert [part["path"] for part in facts["files"]] == [part.name for part in parts] == facts["relative_file_paths"]
    assert sum(part["message_count"] for part in facts["files"]) == facts["message_count"]


@pytest.mark.parametrize(("encoding", "channels"), [("rgb8", 3), ("bgr8", 3), ("mono8", 1)])
def test_pictures_may_be_jpeg(bench, encoding, channels):
    made = bench(images="jpeg", jpeg_quality=95)
    made.begin(topics=(CAMERA,))
    made.write(3, CAMERA, lambda index: picture(index, encoding, channels))
    path = made.end()
    with AnyReader([path]) as reader:
        (connection,) = reader.connections
        assert connection.msgtype == "sensor_msgs/msg/CompressedImage"
        first: Any = reader.deserialize(next(reader.messages())[2], connection.msgtype)
    assert first.format == f"{encoding}; jpeg compressed {'mono8' if channels == 1 else 'bgr8'}"
    assert first.data[:3].tobytes() == b"\xff\xd8\xff"
    assert len(first.data) < picture(0, encoding, channels).data.nbytes
    assert summary(path).topics[CAMERA].type == Image.ros_type
    for index, kept in enumerate(read(path)):
        original = picture(index, encoding, channels)
        image = kept.message
        assert (image.header, image.encoding, image.step) == (original.header, encoding, 64 * channels)
        assert abs(image.data.astype(int) - original.data).mean() < 3


def test_pictures_that_jpeg_cannot_hold_stay_as_they_are(bench):
    made = bench(images="jpeg")
    made.begin(topics=(CAMERA,))
    depth = picture(0, "16UC1", 1, "uint16")
    made.recorder.write(CAMERA, depth, stamp(0))
    with pytest.raises(RecorderError, match=f"{CAMERA}: carries std_msgs/msg/String, was sensor_msgs/msg/Image"):
        made.recorder.write(CAMERA, String("x"), stamp(1))
    assert [r.message for r in read(made.end())] == [depth]


def test_an_encoding_that_changes_is_refused(bench):
    made = bench(images="jpeg")
    made.begin(topics=(CAMERA,))
    made.write(1, CAMERA, picture)
    with pytest.raises(
        RecorderError, match=f"{CAMERA}: a 16UC1 image cannot be encoded as JPEG, only rgb8, bgr8, mono8"
    ):
        made.recorder.write(CAMERA, picture(1, "16UC1", 1, "uint16"), stamp(1))


def test_a_slow_disk_costs_messages_which_are_counted_and_no_time(bench, monkeypatch):
    """The disk is stuck until everything was offered: what does not fit into the queue is lost, the rest is kept."""
    made = bench(threaded=True, queue_size=MIB, chunk_size=1024)
    made.begin(topics=(JOINTS, CAMERA))
    stuck, go_on, write = threading.Event(), threading.Event(), output.Output.write

    def slowly(self, data):
        stuck.set()
        assert go_on.wait(60)
        return write(self, data)

    monkeypatch.setattr(output.Output, "write", slowly)
    made.write(1, CAMERA, picture)
    assert stuck.wait(60)
    size = picture(0).data.nbytes
    offered = 2 * MIB // size
    made.write(offered, CAMERA, picture, start=1)
    made.write(10, start=offered + 1)
    go_on.set()
    path = made.end(**{CAMERA: 5})
    found = Counter(r.topic for r in read(path))
    kept = summary(path).topics
    assert MIB // size - 5 < found[CAMERA] <= MIB // size
    assert kept[CAMERA].dropped == offered + 1 - found[CAMERA] + 5
    assert found[JOINTS] + kept[JOINTS].dropped == 10
    assert [r.message for r in read(path, {CAMERA})] == [picture(i) for i in range(found[CAMERA])]


def test_a_chunk_is_written_when_it_is_old_though_nothing_more_comes(bench, monkeypatch):
    flushed = threading.Event()
    flush = bagfile.BagFile.flush

    def flush_and_tell(self):
        flush(self)
        flushed.set()

    monkeypatch.setattr(bagfile.BagFile, "flush", flush_and_tell)
    made = bench(threaded=True, chunk_period_s=0.05)
    made.begin()
    made.write(1)
    assert flushed.wait(60)
    assert [r.message for r in read(made.path)] == [joints(0)]


class Disk:
    """Tells of as much free space as it is given."""

    def __init__(self, monkeypatch) -> None:
        self.free = 1 << 40
        real = os.statvfs
        monkeypatch.setattr(os, "statvfs", lambda path: self._of(real(path)))

    def _of(self, disk):
        values = list(disk)
        values[1], values[4] = 4096, self.free // 4096
        return os.statvfs_result(values)


def test_a_nearly_full_disk_is_refused_before_anything_is_written(bench, monkeypatch):
    Disk(monkeypatch).free = 100 * MIB
    made = bench(min_free=200 * MIB)
    with pytest.raises(RecorderError, match=r"its disk has 100 MiB left, recording needs 200 MiB \(min_free\)"):
        made.begin()
    assert not made.path.exists()


@pytest.mark.parametrize("threaded", [False, True])
def test_a_disk_that_fills_up_ends_the_episode_whole(bench, monkeypatch, threaded):
    disk = Disk(monkeypatch)
    made = bench(threaded=threaded, min_free=200 * MIB, chunk_period_s=0.001)
    made.begin()
    made.write(50)
    while made.recorder.waiting():  # a busy machine has its thread come later
        time.sleep(0.001)
    disk.free = 100 * MIB
    big = picture(0)
    big = Image(big.header, 2048, 2048, "mono8", 2048, np.zeros(4 * MIB))
    with pytest.raises(RecorderError, match="its disk has 100 MiB left"):
        made.write(100_000, CAMERA, lambda index: big, start=50)
    path = made.end("unknown")
    kept = summary(path)
    assert (kept.finished, kept.topics[JOINTS].count) == (True, 50)
    assert len(read(path, {JOINTS})) == 50
    made.path = made.path.with_name("episode_000002")
    disk.free = 300 * MIB
    made.begin()
    made.write(1)
    assert len(read(made.end())) == 1


@contextmanager
def small_files():
    """No file may exceed 100 000 bytes; within the test alone, since the log of the tests is a file too."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)


@pytest.mark.parametrize("threaded", [False, True])
def test_a_disk_that_refuses_leaves_an_unfinished_episode_of_whole_records(bench, threaded):
    made = bench(threaded=threaded, chunk_size=8192)
    made.begin(prompt="pick")
    with small_files():
        with pytest.raises(RecorderError, match="cannot be written: File too large; it stays unfinished"):
            made.write(1_000_000)
        with pytest.raises(RecorderError, match="cannot be written"):
            made.end()
    kept = summary(made.path)
    assert (kept.finished, dict(kept.metadata), kept.outcome) == (False, {"prompt": "pick"}, "unknown")
    found = [r.message for r in read(made.path)]
    assert len(found) > 100
    assert found == [joints(i) for i in range(len(found))]
    made.path = made.path.with_name("episode_000002")
    made.begin()
    made.write(3)
    assert len(read(made.end())) == 3


def test_a_folder_that_cannot_be_made_is_reported(bench):
    made = bench()
    made.path = made.path / "in" / "nowhere"
    with pytest.raises(RecorderError, match=r"cannot record into .*nowhere: No such file"):
        made.begin()


def test_the_hook_offers_the_recorder():
    (descriptor,) = ibrobot_recorders()
    assert isinstance(descriptor.make(descriptor.options(), host_context()), McapRecorder)


def test_a_period_is_counted_by_stamps_in_lockstep(bench):
    """What a killed run leaves behind lacks no more than a period of its own time."""
    made = bench(chunk_period_s=0.5)
    made.begin()
    made.write(1000)
    found = read(made.path)
    assert stamp(999) - found[-1].received_ns <= 0.5 * NS_PER_S


@pytest.mark.parametrize(("images", "most"), [("raw", 1.01), ("jpeg", 0.5)])
def test_what_a_message_takes_is_known_beforehand(images, most):
    (descriptor,) = ibrobot_recorders()
    recorder = McapRecorder(descriptor.options(images=images, min_free=7 * MIB), host_context())
    shot = picture(0)
    assert recorder.min_free == 7 * MIB
    assert 0.001 < recorder.size_of(shot) / shot.data.nbytes < most
    assert recorder.size_of(joints(0)) == len(encode(joints(0)))


def test_a_sync_that_takes_long_holds_up_no_message(bench, monkeypatch):
    syncing, release, flushed = threading.Event(), threading.Event(), threading.Event()
    flush = bagfile.BagFile.flush

    def sync(descriptor):
        syncing.set()
        release.wait(60)

    def flush_and_tell(self):
        flush(self)
        if syncing.is_set():
            flushed.set()

    monkeypatch.setattr(output, "_sync", sync)
    monkeypatch.setattr(bagfile.BagFile, "flush", flush_and_tell)
    made = bench(threaded=True, chunk_period_s=0.001, sync_period_s=1e-6)
    made.begin()
    made.write(1)
    assert syncing.wait(60)
    made.write(1, start=1)
    assert flushed.wait(60)
    release.set()
    made.end()


def test_a_sync_that_the_disk_refuses_ends_the_recording(bench, monkeypatch):
    def refused(descriptor):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(output, "_sync", refused)
    made = bench(threaded=True, chunk_period_s=0.001, sync_period_s=1e-6)
    made.begin()
    made.write(1)
    with pytest.raises(RecorderError, match="cannot be written: Input/output error; it stays unfinished"):
        made.end()


def test_a_folder_whose_name_is_not_utf8_is_recorded_into(tmp_path):
    made = Bench(tmp_path)
    made.path = tmp_path / os.fsdecode(b"caf\xe9")
    made.begin()
    made.write(10)
    made.end()
    assert len(read(made.path)) == 10


def test_metadata_that_could_not_be_read_again_are_refused_before_anything_is_written(tmp_path):
    made = Bench(tmp_path)
    with pytest.raises(RecorderError, match=r"prompt has half of a character, U\+D800 at character 6"):
        made.begin(prompt="pick \ud800")
    assert list(tmp_path.iterdir()) == []
    made.begin(prompt="pick it: \U0001f9ca, \"é\", 'x', \t, 1e3, ~, {a}")
    made.write(1)
    made.end()
    assert summary(made.path).metadata["prompt"] == "pick it: \U0001f9ca, \"é\", 'x', \t, 1e3, ~, {a}"
