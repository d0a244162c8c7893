"""Reading: any beginning of a file, damage, order, and bags from elsewhere."""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_mcap import ibrobot_readers
from ibrobot_mcap.bag_metadata import read_bag_info
from ibrobot_mcap.checks import problems_of
from ibrobot_mcap.draft import draft
from ibrobot_mcap.reader import Rosbag2Reader, is_rosbag2
from ibrobot_mcap.scan import McapFile
from ibrobot_ros2 import definition, encode
from mcap.writer import CompressionType, Writer
from PIL import Image as Pillow
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ibrobot_core.api import (
    CompressedImage,
    Contract,
    Feature,
    Header,
    IbrobotError,
    Image,
    JointState,
    Message,
    ObservationPart,
    RecorderError,
    pixels,
)
from ibrobot_core.app import Align, FrameAssembler, installed_plugins

from .conftest import CAMERA, JOINTS, Bench, joints, picture, read, reading, stamp, summary

LAMP = "builtin_interfaces/Time since\nstring[] marks\n"


@pytest.fixture(scope="module", params=["none", "lz4", "zstd"])
def unfinished(request, tmp_path_factory):
    """The file of an episode that was never ended, with 400 messages in many chunks."""
    made = Bench(tmp_path_factory.mktemp("kept"), compression=request.param, chunk_size=2048)
    made.begin(prompt="pick")
    made.write(400)
    assert made.recorder._storage is not None
    made.recorder._storage.flush_due()
    copy = tmp_path_factory.mktemp("copy") / "file.mcap"
    shutil.copyfile(made.path / "episode_000001_0.mcap", copy)
    made.end()
    return copy


def test_any_beginning_of_a_file_can_be_read(unfinished, tmp_path_factory):
    """What a killed process leaves ends anywhere. What is read is a beginning of what was written."""
    whole = unfinished.read_bytes()
    path = tmp_path_factory.mktemp("cut") / "file.mcap"
    counts = {}

    @settings(max_examples=20, deadline=None)
    @given(st.integers(0, len(whole)) | st.integers(len(whole) - 100, len(whole)))
    def check(length):
        path.write_bytes(whole[:length])
        found = [r.message for r in read(path)]
        assert found == [joints(i) for i in range(len(found))]
        kept = summary(path)
        assert not kept.finished
        assert sum(topic.count for topic in kept.topics.values()) == len(found)
        assert (kept.start_ns, kept.end_ns) == ((stamp(0), stamp(len(found) - 1)) if found else (0, 0))
        counts[length] = len(found)

    check()
    lengths = sorted(counts)
    assert [counts[length] for length in lengths] == sorted(counts.values())
    assert max(counts.values()) > 300


def test_zeros_behind_what_was_written_are_passed_over(unfinished, tmp_path):
    """A power failure may leave a file longer than what reached the disk."""
    path = tmp_path / "file.mcap"
    path.write_bytes(unfinished.read_bytes() + bytes(5000))
    assert len(read(path)) == len(read(unfinished))


def test_an_unfinished_episode_tells_what_it_is(unfinished, tmp_path):
    folder = tmp_path / "episode_000007"
    folder.mkdir()
    shutil.copyfile(unfinished, folder / "episode_000007_0.mcap")
    kept = summary(folder)
    assert (kept.finished, dict(kept.metadata), kept.outcome) == (False, {"prompt": "pick"}, "unknown")


def test_damage_in_the_midst_is_reported_after_what_came_before(bench):
    made = bench(chunk_size=2048)
    made.begin()
    made.write(200)
    path = made.end()
    file = path / "episode_000001_0.mcap"
    chunks = McapFile(file)
    chunks.close()
    block = chunks.blocks[len(chunks.blocks) // 2]
    content = bytearray(file.read_bytes())
    content[block.offset + block.length - 5] ^= 0xFF
    file.write_bytes(content)
    found: list[Message] = []
    with (
        reading(path) as reader,
        pytest.raises(RecorderError, match=rf"chunk at byte {block.offset} is damaged: its checksum"),
    ):
        found.extend(item.message for item in reader.messages())
    assert 10 < len(found) < 190
    assert found == [joints(i) for i in range(len(found))]


def test_metadata_that_lists_missing_files_is_refused(bench):
    made = bench()
    made.begin()
    path = made.end()
    (path / "episode_000001_0.mcap").rename(path / "other.mcap")
    with pytest.raises(RecorderError, match=r"episode_000001_0.mcap is missing, which metadata.yaml lists"):
        Rosbag2Reader(path)


NOT_BAGS = {
    "file.mcap": (b"RIFF....WAVE", "not an MCAP file: begins with 52 49 46 46"),
    "file.db3": (b"no database", "file.db3: "),
}


@pytest.mark.parametrize(("name", "content", "reason"), [(n, *rest) for n, rest in NOT_BAGS.items()])
def test_other_folders_and_files_are_refused_as_bags(tmp_path, name, content, reason):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecorderError, match=reason):
        Rosbag2Reader(tmp_path / name)


@pytest.mark.parametrize("text", ["- 1\n", "{", "rosbag2_bagfile_information: 5\n"])
def test_metadata_that_is_none_is_refused(tmp_path, text):
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(RecorderError, match=r"metadata.yaml: is not metadata of a rosbag2"):
        Rosbag2Reader(tmp_path)


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("/dev/zero", "is not a file"),
        ("pipe", "is not a file"),
        ("huge", "is larger than 16 MiB, too large for a bag's metadata"),
    ],
)
def test_metadata_that_would_fill_the_memory_is_not_read(tmp_path, kind, why):
    path = tmp_path / "metadata.yaml"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "huge":
        with path.open("wb") as file:
            file.truncate(1 << 40)
    else:
        path.symlink_to(kind)
    with pytest.raises(RecorderError, match=f"metadata.yaml: {why}"):
        Rosbag2Reader(tmp_path)


def test_metadata_that_cannot_be_reached_are_an_error_of_the_recording(tmp_path):
    path = tmp_path / ("a" * 300) / "metadata.yaml"
    with pytest.raises(RecorderError, match=r"metadata\.yaml: cannot be read: "):
        read_bag_info(path)


def test_an_episode_that_is_moved_while_it_is_opened_is_not_there(bench, monkeypatch):
    made = bench()
    made.begin()
    path = made.end()

    def move(metadata):
        path.rename(path.with_name("elsewhere"))

    monkeypatch.setattr("ibrobot_mcap.reader.read_bag_info", move)
    with pytest.raises(RecorderError, match="there is no such episode"):
        Rosbag2Reader(path)


def test_bags_are_known_by_their_looks(tmp_path, bench):
    assert not is_rosbag2(tmp_path)
    made = bench()
    made.begin()
    assert is_rosbag2(made.path)
    (reader,) = ibrobot_readers()
    assert reader.reads(made.path)
    opened = installed_plugins().open_episode(made.end())
    assert opened.summary().finished
    opened.close()
    opened.close()


def test_messages_may_be_read_again_and_by_topic(bench):
    made = bench(chunk_size=2048)
    made.begin(topics=(JOINTS, CAMERA))
    made.write(50)
    made.write(2, CAMERA, picture, start=50)
    with reading(made.end()) as reader:
        assert [r.message for r in reader.messages({CAMERA})] == [picture(50), picture(51)]
        assert [r.message for r in reader.messages({JOINTS, "/nowhere"})] == [joints(i) for i in range(50)]
        assert len(list(reader.messages())) == 52 == len(list(reader.messages()))
        item = next(reader.messages())
        assert (item.topic, item.received_ns, item.published_ns) == (JOINTS, stamp(0), stamp(0))


def test_messages_keep_no_chunk_in_memory(bench):
    made = bench()
    made.begin()
    made.write(1000)
    first = read(made.end())[0].message.position
    while first.base is not None and not isinstance(first.base, bytes | memoryview):
        first = first.base
    owner: Any = first.base.obj if isinstance(first.base, memoryview) else first.base
    assert len(owner) < 500


@pytest.mark.parametrize("chunking", [True, False])
@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(0, 50), min_size=1, max_size=60))
def test_messages_come_in_the_order_of_receipt(tmp_path_factory, chunking, stamps):
    """Also from a file whose chunks overlap; equal stamps stay in the order written."""
    path = tmp_path_factory.mktemp("mixed") / "file.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=300, compression=CompressionType.NONE, use_chunking=chunking)
        writer.start("ros2", "another writer")
        schema = writer.register_schema(JointState.ros_type, "ros2msg", definition(JointState.ros_type).encode())
        channel = writer.register_channel(JOINTS, "cdr", schema)
        for index, at_ns in enumerate(stamps):
            writer.add_message(channel, at_ns, bytes(encode(JointState(Header(index), ()))), at_ns + 7)
        writer.finish()
    found = read(path)
    expected = sorted(range(len(stamps)), key=lambda index: stamps[index])
    assert [r.message.header.stamp_ns for r in found] == expected
    assert [(r.received_ns, r.published_ns) for r in found] == [(stamps[i], stamps[i] + 7) for i in expected]
    kept = summary(path)
    assert (kept.finished, kept.start_ns, kept.end_ns) == (True, min(stamps), max(stamps))
    assert kept.topics[JOINTS].count == len(stamps)


def test_channels_of_one_topic_count_together(tmp_path):
    """Each of several publishers may have a channel of its own."""
    path = tmp_path / "two.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "another writer")
        schema = writer.register_schema(JointState.ros_type, "ros2msg", definition(JointState.ros_type).encode())
        for count in (2, 3):
            channel = writer.register_channel(JOINTS, "cdr", schema, metadata={"publisher": str(count)})
            for index in range(count):
                writer.add_message(channel, stamp(index), bytes(encode(JointState(Header(index), ()))), stamp(index))
        writer.finish()
    assert len(read(path)) == summary(path).topics[JOINTS].count == 5
    assert [problem for problem in problems_of(path, 5.0) if "message" in problem] == []


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("compression", [None, CompressionMode.MESSAGE, CompressionMode.FILE])
def test_foreign_bags_are_read(tmp_path, storage, compression):
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(LAMP, "lamp_msgs/msg/Lamp"))
    kind = store.types
    writer = RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        known = writer.add_connection(JOINTS, JointState.ros_type, typestore=store)
        foreign = writer.add_connection("/lamp", "lamp_msgs/msg/Lamp", typestore=store)
        writer.set_custom_data("place", "lab")
        lamp = kind["lamp_msgs/msg/Lamp"](kind["builtin_interfaces/msg/Time"](1, 2), ["a"])
        for index in range(20):
            writer.write(known, stamp(index), bytes(encode(joints(index))))
            writer.write(foreign, stamp(index), store.serialize_cdr(lamp, "lamp_msgs/msg/Lamp"))
    kept = summary(tmp_path / "bag")
    assert {topic: (t.type, t.count) for topic, t in kept.topics.items()} == {
        JOINTS: (JointState.ros_type, 20),
        "/lamp": ("lamp_msgs/msg/Lamp", 20),
    }
    assert (kept.finished, kept.start_ns, kept.end_ns) == (True, stamp(0), stamp(19))
    assert (dict(kept.metadata), kept.outcome) == ({"place": "lab"}, "unknown")
    assert [r.message for r in read(tmp_path / "bag", {JOINTS})] == [joints(i) for i in range(20)]
    lamps = read(tmp_path / "bag", {"/lamp"})
    assert {(r.message.since_ns, r.message.marks) for r in lamps} == {(1_000_000_002, ("a",))}
    assert [r.received_ns for r in lamps] == [r.published_ns for r in lamps] == [stamp(i) for i in range(20)]


def unchecked_bag(folder, storage):
    """A bag of 20 messages without checksums; returns its one file beside `metadata.yaml`."""
    with RosbagsWriter(folder, version=9, storage_plugin=storage) as writer:
        known = writer.add_connection(JOINTS, JointState.ros_type, typestore=get_typestore(Stores.ROS2_JAZZY))
        writer.set_custom_data("outcome", "success")
        for index in range(20):
            writer.write(known, stamp(index), bytes(encode(joints(index))))
    assert len(read(folder)) == 20
    return next(path for path in folder.iterdir() if path.suffix in (".mcap", ".db3"))


@pytest.mark.parametrize("index", [0, 7, 19])
def test_mcap_message_with_another_time_than_its_index_is_damage(tmp_path, index):
    """A later first message would otherwise leave an episode of fewer rows that still says success."""
    file = unchecked_bag(tmp_path / "bag", StoragePlugin.MCAP)
    content, ns = file.read_bytes(), stamp(index)
    times = struct.pack("<QQ", ns, ns)
    assert content.count(times) == 1
    file.write_bytes(content.replace(times, struct.pack("<QQ", ns ^ 128, ns)))
    with pytest.raises(RecorderError, match=r"is damaged|not within its span"):
        read(tmp_path / "bag")


@pytest.mark.parametrize("index", [0, 7, 19])
@pytest.mark.parametrize("where", ["table", "index"])
def test_sqlite_message_with_another_time_than_its_index_is_damage(tmp_path, where, index):
    file = unchecked_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    content, time = file.read_bytes(), struct.pack(">q", stamp(index))
    assert content.count(time) == 2
    before, middle, after = content.split(time)
    other = struct.pack(">q", stamp(index) ^ 128)
    first, second = (other, time) if where == "table" else (time, other)
    file.write_bytes(before + first + middle + second + after)
    with pytest.raises(RecorderError, match="is damaged: the times of its messages do not match its index"):
        read(tmp_path / "bag")


def assemble(contract, reader):
    assembler = FrameAssembler(contract)
    for each in reader.messages(contract.topics):
        assembler.take(each.topic, each.message, each.received_ns)
    return assembler.frame(stamp(1))


@pytest.mark.parametrize(("old", "new"), [("[] name", "[] nAme"), ("[] position", " position"), ("header", "hEader")])
def test_standard_type_that_a_bag_defines_otherwise_gives_no_rows(tmp_path, old, new):
    """Its messages have the standard type's name and not its fields; a damaged definition is one way to get there."""
    file = tmp_path / "file.mcap"
    text = definition(JointState.ros_type)
    assert old in text
    foreign_file(file, JointState.ros_type, text.replace(old, new), [bytes(encode(joints(0)))])
    part = ObservationPart(
        "observation.state", "/it", JointState.ros_type, ("position.pan",), None, Align(), Feature("float32", (1,))
    )
    with reading(file) as reader, pytest.raises(IbrobotError, match="/it"):
        assemble(Contract(100.0, (part,), ()), reader)
    problems_of(file, longest_gap=10.0)  # raises nothing


def foreign_file(path, type_name, text, payloads, encoding="ros2msg"):
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "another writer")
        schema = writer.register_schema(type_name, encoding, text.encode())
        channel = writer.register_channel("/it", "cdr", schema)
        for index, payload in enumerate(payloads):
            writer.add_message(channel, stamp(index), payload, stamp(index))
        writer.finish()


def test_a_type_that_cannot_be_read_is_reported_by_topic(tmp_path):
    foreign_file(tmp_path / "file.mcap", "odd_msgs/msg/Odd", "wstring text\n", [b"\x00\x01\x00\x00"])
    assert summary(tmp_path / "file.mcap").topics["/it"].count == 1
    with pytest.raises(RecorderError, match=r"/it cannot be read: odd_msgs/msg/Odd: "):
        read(tmp_path / "file.mcap")


PART = "=" * 80 + "\n"
INFO = """MSG: service_msgs/ServiceEventInfo
uint8 event_type
builtin_interfaces/Time stamp
char[16] client_gid
int64 sequence_number
"""
TIME = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
EVENT = "service_msgs/ServiceEventInfo info\n{0}_Request[<=1] request\n{0}_Response[<=1] response\n"
EVENTS = {
    "short names": PART.join([EVENT.format("sum_msgs/Add"), INFO, TIME, "MSG: sum_msgs/Add_Request\nint64 a\nint64 b\n",
                              "MSG: sum_msgs/Add_Response\nint64 sum\n"]),
    "names of services": PART.join([EVENT.format("sum_msgs/srv/Add"), INFO, TIME,
                                    "MSG: sum_msgs/srv/Add_Request\nint64 a\nint64 b\n",
                                    "MSG: sum_msgs/srv/Add_Response\nint64 sum\n"]),
    "text of the service": "int64 a\nint64 b\n---\nint64 sum\n",
    "text and parts": PART.join(["int64 a\nint64 b\n---\nint64 sum\n", INFO, TIME]),
}  # fmt: skip
"""The forms in which a bag may define the events of a service."""
EVENT_CDR = b"\0\1\0\0" + struct.pack("<B3xiI16s4xqI4xqqI", 1, 5, 6, b"g" * 16, 9, 1, 2, 3, 0)


def bag_beside_joints(path, topic, type_name, encoding, payload, *, text="", schema="ros2msg", joints_count=3):
    """An MCAP file with a foreign topic among joint states."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "another writer")
        known = writer.register_schema(JointState.ros_type, "ros2msg", definition(JointState.ros_type).encode())
        other = writer.register_schema(type_name, schema, text.encode()) if type_name else 0
        theirs = writer.register_channel(topic, encoding, other)
        ours = writer.register_channel(JOINTS, "cdr", known)
        for index in range(joints_count):
            writer.add_message(theirs, stamp(index), payload, stamp(index))
            writer.add_message(ours, stamp(index), bytes(encode(joints(index))), stamp(index))
        writer.finish()


@pytest.mark.parametrize("form", EVENTS)
def test_events_of_services_are_read_among_other_topics(tmp_path, form):
    path = tmp_path / "file.mcap"
    bag_beside_joints(path, "/add/_service_event", "sum_msgs/srv/Add_Event", "cdr", EVENT_CDR, text=EVENTS[form])
    found = read(path)
    assert len(found) == 6
    event = found[0].message
    assert (event.info.event_type, event.info.stamp_ns, event.info.sequence_number) == (1, 5_000_000_006, 9)
    assert [(each.a, each.b) for each in event.request] == [(2, 3)]
    assert event.response == ()


SERIALISATIONS = ("json", "protobuf", "ros1", "cbor", "flatbuffer", "cdr_v2", "")
UNDEFINED = (
    *((encoding, JointState.ros_type, "ros2msg", definition(JointState.ros_type)) for encoding in SERIALISATIONS),
    *((encoding, "", "", "") for encoding in SERIALISATIONS),
    ("json", "foxglove.CompressedImage", "jsonschema", "{}"),
    ("protobuf", "foxglove.CompressedImage", "protobuf", "x"),
    ("ros1", "sensor_msgs/JointState", "ros1msg", "Header header\nstring[] name\n"),
    ("cdr", "odd_msgs/msg/Odd", "ros2msg", "wstring text\n"),
    ("cdr", "odd_msgs/msg/Odd", "ros2msg", "other_msgs/Missing it\n"),
    ("cdr", "sum_msgs/srv/Add_Event", "ros2msg", EVENT.format("sum_msgs/Add")),
    ("cdr", "sum_msgs/srv/Add_Event", "ros2msg", ""),
    ("cdr", "odd_msgs/msg/Odd", "unknown", ""),
)


@pytest.mark.parametrize(("encoding", "type_name", "schema", "text"), UNDEFINED)
def test_a_topic_that_cannot_be_read_leaves_the_others(tmp_path, encoding, type_name, schema, text):
    path, payload = tmp_path / "file.mcap", bytes(encode(joints(7)))
    bag_beside_joints(path, "/it", type_name, encoding, payload, text=text, schema=schema)
    with reading(path) as reader:
        assert reader.summary().topics["/it"].count == 3
        assert [each.message for each in reader.messages({JOINTS})] == [joints(index) for index in range(3)]
        found: list[Any] = []
        why = (
            f"serialised as '{encoding}'; ibrobot reads 'cdr'"
            if encoding != "cdr"
            else "not defined|definition|odd_msgs"
        )
        with pytest.raises(RecorderError, match=f"file.mcap: /it cannot be read: .*({why})"):
            found.extend(reader.messages())
        assert [each.message for each in found] == [joints(index) for index in range(3)]
        with pytest.raises(RecorderError, match="/it cannot be read: "):
            next(reader.messages({"/it"}))
        assert draft(reader).count("topic: ") == 1
    assert [each for each in problems_of(path, 5.0) if "/it cannot be read" in each]


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_a_bag_that_states_another_serialisation_is_not_decoded_as_cdr(tmp_path, storage):
    folder = tmp_path / "bag"
    file = unchecked_bag(folder, storage)
    if storage is StoragePlugin.SQLITE3:
        database = sqlite3.connect(file)
        with database:
            database.execute("UPDATE topics SET serialization_format = 'json'")
        database.close()
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("serialization_format: cdr", "serialization_format: json"))
    for path in (folder, *([file] if storage is StoragePlugin.SQLITE3 else [])):
        assert summary(path).topics[JOINTS].count == 20
        with pytest.raises(RecorderError, match=f"{JOINTS} cannot be read: its messages are serialised as 'json'"):
            read(path, {JOINTS})


@pytest.mark.parametrize("encoding", ["ros1", "json", "protobuf"])
def test_a_draft_says_what_it_cannot_read(tmp_path, encoding):
    bag_beside_joints(tmp_path / "a.mcap", "/it", "", encoding, b"x", joints_count=0)
    bag_beside_joints(tmp_path / "b.mcap", JOINTS, JointState.ros_type, encoding, b"x")
    with reading(tmp_path / "a.mcap") as reader, pytest.raises(RecorderError, match=r"that can be read$"):
        draft(reader)
    with (
        reading(tmp_path / "b.mcap") as reader,
        pytest.raises(
            RecorderError,
            match=f"no topic with images .*; {JOINTS} cannot be read: its messages are serialised as '{encoding}'",
        ),
    ):
        draft(reader)


def png(array):
    file = BytesIO()
    Pillow.fromarray(array).save(file, "PNG")
    return file.getvalue()


@pytest.mark.parametrize(
    ("format_", "encoding", "header", "array"),
    [
        ("rgb8; png compressed bgr8", "rgb8", b"", np.arange(24, dtype=np.uint8).reshape(2, 4, 3)),
        ("mono16; png compressed mono16", "16UC1", b"", np.arange(0, 64000, 8000, dtype=np.uint16).reshape(2, 4)),
        ("16UC1; compressedDepth png", "16UC1", bytes(12), np.arange(0, 64000, 8000, dtype=np.uint16).reshape(2, 4)),
    ],
)
def test_foreign_png_pictures_come_as_images(tmp_path, format_, encoding, header, array):
    sent = CompressedImage(Header(1), format_, np.frombuffer(header + png(array), np.uint8))
    text = definition(CompressedImage.ros_type)
    foreign_file(tmp_path / "file.mcap", CompressedImage.ros_type, text, [bytes(encode(sent))])
    assert summary(tmp_path / "file.mcap").topics["/it"].type == Image.ros_type
    (found,) = [r.message for r in read(tmp_path / "file.mcap")]
    assert (found.header, found.encoding) == (Header(1), encoding)
    np.testing.assert_array_equal(pixels(found).reshape(array.shape), array)


def test_foreign_pictures_of_other_formats_come_as_they_are(tmp_path):
    rvl = CompressedImage(Header(1), "16UC1; compressedDepth rvl", np.zeros(40, np.uint8))
    text = definition(CompressedImage.ros_type)
    foreign_file(tmp_path / "file.mcap", CompressedImage.ros_type, text, [bytes(encode(rvl))])
    assert summary(tmp_path / "file.mcap").topics["/it"].type == CompressedImage.ros_type
    assert [r.message for r in read(tmp_path / "file.mcap")] == [rvl]


@pytest.mark.parametrize(("name", "begin"), [("JPEG", b"\xff\xd8\xff"), ("PNG", b"\x89PNG\r\n\x1a\n")])
def test_damaged_foreign_picture_is_named_by_topic_and_time(tmp_path, name, begin):
    text = definition(CompressedImage.ros_type)
    broken = CompressedImage(Header(1), name.lower(), np.frombuffer(begin + b"....", np.uint8))
    foreign_file(tmp_path / "file.mcap", CompressedImage.ros_type, text, [bytes(encode(broken))])
    with pytest.raises(RecorderError, match=rf"/it at {stamp(0)} ns: .*{name}"):
        read(tmp_path / "file.mcap")
