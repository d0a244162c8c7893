"""`ibrobot episodes …` on episodes that the recorder wrote: what they print, repair, cut, export and delete."""

from __future__ import annotations

import csv
import json
import shutil
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from ibrobot_mcap import metadata, rewrite
from ibrobot_mcap.commands.plot import PlotData, actions_of
from ibrobot_mcap.reader import Rosbag2Reader
from ibrobot_mcap.storage import Storage
from ibrobot_testing.command import command_line
from mcap.reader import make_reader
from PIL import Image as Png
from rosbags.rosbag2 import Reader as RosbagsReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ibrobot_core.api import JointState, RecorderError, String
from ibrobot_core.app import RequestError

from .conftest import CAMERA, JOINTS, Bench, joints, picture, stamp

episodes = command_line("episodes")


def run(*arguments, code=0):
    result = CliRunner().invoke(episodes, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output


def made(folder, number=1, *, outcome="success", frames=0, count=100, **metadata):
    """An episode in a dataset `pick`."""
    root = folder / "pick" / "episodes"
    root.mkdir(parents=True, exist_ok=True)
    bench = Bench(root)
    bench.path = root / f"episode_{number:06d}"
    bench.begin((JOINTS, CAMERA) if frames else (JOINTS,), **metadata)
    for index in range(count):
        bench.recorder.write(JOINTS, joints(index), stamp(index))
        if index < frames:
            bench.recorder.write(CAMERA, picture(index), stamp(index))
    bench.end(outcome)
    return bench.path


def unfinish(path, cut=0):
    """As a killed recorder leaves it."""
    (path / "metadata.yaml").unlink()
    (file,) = path.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: -cut or None])
    return path


def contents(path):
    reader = Rosbag2Reader(path)
    try:
        return reader.summary(), [(r.topic, r.message, r.received_ns, r.published_ns) for r in reader.messages()]
    finally:
        reader.close()


def test_list_tells_every_episode_of_a_folder_of_datasets(tmp_path):
    made(tmp_path, 1, prompt="pick the cube")
    unfinish(made(tmp_path, 2), cut=400)
    output = run("list", tmp_path)
    assert f" {tmp_path / 'pick'}:1 " in output
    assert "unfinished" in output
    rows = json.loads(run("list", tmp_path / "pick", "--json"))
    assert [row["finished"] for row in rows] == [True, False]
    assert rows[0]["messages"] == 100
    assert rows[0]["prompt"] == "pick the cube"


def test_every_command_takes_the_names_that_list_prints(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = made(tmp_path / "episodes", 12)
    (path.parent / "episode_000012_restored").mkdir()
    shutil.copytree(path, path.parent / "episode_000012_restored", dirs_exist_ok=True)
    for folder in ("episodes", "episodes/pick", "episodes/pick/episodes"):
        assert [line.split()[0] for line in run("list", folder).splitlines()[1:]] == [
            "pick:12",
            "episodes/pick/episodes/episode_000012_restored",
        ]
    assert run("list", tmp_path / "episodes").splitlines()[1].split()[0] == f"{tmp_path}/episodes/pick:12"
    for name in ("pick:12", "episodes/pick:12", f"{tmp_path}/episodes/pick:12"):
        for command in (
            ("list", name),
            ("info", name),
            ("verify", name),
            ("repair", name),
            ("mark", name, "success"),
            ("export", name, JOINTS, "-o", "joints.csv"),
            ("trim", name, "--to", "0.5", "-o", "part"),
            ("trim", name, "--in-place", "--to", "0.9"),
            ("delete", name, "--yes"),
        ):
            assert "no such" not in run(*command)
        assert not path.exists()
        (tmp_path / "joints.csv").unlink()
        shutil.rmtree(tmp_path / "part")
        run("trash", "episodes/pick", "--empty", "--yes")
        made(tmp_path / "episodes", 12)
    with pytest.raises(RecorderError, match="pick:13: there is no such episode"):
        run("info", "pick:13")


def test_names_are_whole_where_the_output_goes_to_a_file_or_a_program(tmp_path):
    prompt = "pick the very small red cube, put it into the blue bin on the left, and go home again"
    bench = Bench(tmp_path)
    bench.begin(prompt=prompt)
    topic = "/a_controller_of_a_very_long_name/and_of_a_group_in_it/of_which_the_topic_is/commands"
    bench.write(3, topic)
    bench.end()
    assert f" {topic} " in run("info", bench.path)
    assert prompt in run("list", tmp_path)


def test_one_that_cannot_be_read_does_not_hide_the_others(tmp_path):
    made(tmp_path, 1)
    bad = made(tmp_path, 2)
    (bad / "metadata.yaml").write_text("][")
    result = CliRunner().invoke(episodes, ["list", str(tmp_path)])
    assert result.exit_code == 1
    assert f"{tmp_path / 'pick'}:1 " in result.output
    assert "unreadable" in result.output


def test_info_needs_no_repair(tmp_path):
    path = unfinish(made(tmp_path, prompt="pick"), cut=300)
    output = run("info", path)
    assert "unfinished; `ibrobot episodes repair` makes it whole" in output
    assert "/joint_states" in output
    assert "prompt: pick" in output
    with pytest.raises(RecorderError, match=r"is a folder with an episode; choose one, e\.g\. .*episode_000001"):
        run("info", tmp_path)
    assert json.loads(run("info", path, "--json"))["metadata"]["prompt"] == "pick"


@pytest.mark.parametrize(
    ("begins_ns", "count", "words"),
    [
        (0, 3, "without a date, 2.00 s"),
        (1, 3, "without a date, 2.00 s"),
        (10**9, 3, "without a date, 2.00 s"),
        (1_800_000_000 * 10**9, 3, "2027-01-15 08:00 UTC, 2.00 s"),
        (0, 0, "no messages, 0.00 s"),
    ],
)
def test_an_episode_that_begins_at_time_0_has_messages_and_no_date(tmp_path, begins_ns, count, words):
    store = get_typestore(Stores.ROS2_JAZZY)
    text = store.types["std_msgs/msg/String"]
    with RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/words", "std_msgs/msg/String", typestore=store)
        for index in range(count):
            writer.write(topic, begins_ns + index * 10**9, store.serialize_cdr(text("x"), "std_msgs/msg/String"))
    assert words in run("info", tmp_path / "bag")


@pytest.mark.parametrize("cut", [0, 1, 300, 2000])
def test_repair_makes_an_episode_whole_with_all_that_was_there(tmp_path, cut):
    path = unfinish(made(tmp_path, frames=20, prompt="pick"), cut)
    before, messages = contents(path)
    assert not before.finished
    assert f"repaired, {len(messages)} messages" in run("repair", tmp_path)
    after, again = contents(path)
    assert after.finished
    assert again == messages
    stated = {metadata.STATED: "success"} if before.stated_outcome == "success" else {}
    assert after.metadata == {**before.metadata, rewrite.REPAIRED: "true", **stated}
    assert after.outcome == "unknown"
    assert [p.name for p in path.parent.iterdir()] == [path.name], "nothing else is left"
    assert "is whole" in run("repair", path)
    assert "good" in run("verify", path)


def test_a_cut_episode_does_not_count_as_success_and_keeps_what_is_missing_until_a_person_decides(tmp_path):
    path = made(tmp_path, count=3000)
    (file,) = path.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    before, messages = contents(path)
    missing = 3000 - len(messages)
    assert missing > 0
    assert (before.outcome, before.finished, before.topics[JOINTS].missing) == ("unknown", False, missing)
    assert f"{JOINTS}: {len(messages)} messages, metadata.yaml says 3000" in run("verify", path, code=1)
    with pytest.raises(RecorderError, match="is unfinished, or lacks messages; run `ibrobot episodes repair` first"):
        run("mark", path, "success")
    assert f"{missing} are missing; its outcome was success, now it is unknown" in run("repair", path)
    assert "is whole" in run("repair", path)
    after, again = contents(path)
    assert again == messages
    assert (after.outcome, after.finished, after.topics[JOINTS].missing) == ("unknown", True, missing)
    gap = f"{JOINTS}: lacks {missing} messages of the recorder"
    assert gap in run("verify", path, code=1)
    run("trim", path, "--to", "1", "-o", tmp_path / "cut")
    assert gap in run("info", tmp_path / "cut")
    run("mark", path, "success")
    marked, again = contents(path)
    assert again == messages
    assert (marked.outcome, marked.metadata["marked"]) == ("success", "true")
    assert gap in run("verify", path, code=1)


def test_messages_that_are_missing_from_within_keep_an_episode_from_being_read(tmp_path):
    path = made(tmp_path)
    text = (path / "metadata.yaml").read_text()
    (path / "metadata.yaml").write_text(text.replace("message_count: 100", "message_count: 103"))
    assert "100 messages, metadata.yaml says 103" in run("verify", path, code=1)
    with pytest.raises(RecorderError, match=r"missing in the middle: 3 of 103 of /joint_states; `ibrobot episodes re"):
        contents(path)
    assert "repaired, 100 messages, 0.99 s, 3 are missing" in run("repair", path)
    assert len(contents(path)[1]) == 100


def test_a_repair_that_fails_leaves_the_original(tmp_path, monkeypatch):
    path = unfinish(made(tmp_path), 300)
    kept = {p.name: p.read_bytes() for p in path.iterdir()}
    monkeypatch.setattr(Storage, "finish", lambda *_: (_ for _ in ()).throw(RecorderError("the disk is full")))
    assert "the disk is full" in run("repair", path, code=1)
    assert {p.name: p.read_bytes() for p in path.iterdir()} == kept
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_verify_says_what_is_wrong(tmp_path):
    good = made(tmp_path, 1, fingerprint="a" * 64)
    assert run("verify", good) == f"{good}: good\n"
    bench = Bench(good.parent)
    bench.path = good.parent / "episode_000002"
    bench.begin(fingerprint="b" * 64)
    bench.write(50)
    bench.recorder.write(JOINTS, joints(3), stamp(80))
    bench.end("success", **{JOINTS: 4})
    output = run("verify", tmp_path, code=1)
    assert f"{bench.path}: 4 problems\n  4 messages lost while recording: {JOINTS} 4\n" in output
    assert "header stamps went back 1 times" in output
    assert "a pause of 310 ms at 0.49 s, its period is 10.0 ms" in output
    assert "its contract is bbbbbbbbbbbb, that of episode_000001 is aaaaaaaaaaaa" in output
    text = (good / "metadata.yaml").read_text()
    (good / "metadata.yaml").write_text(text.replace("message_count: 100", "message_count: 101"))
    assert "100 messages, metadata.yaml says 101" in run("verify", good, code=1)
    unfinish(good)
    assert "unfinished" in run("verify", good, code=1)


def test_verify_counts_the_latched_messages_that_every_file_repeats(tmp_path):
    bench = Bench(tmp_path, split_duration=0.2)
    assert bench.ctx.bus is not None
    bench.ctx.bus.publish("/robot_description", String("<urdf/>"), latched=True)
    bench.begin()
    bench.recorder.write("/robot_description", String("<urdf/>"), stamp(0))
    bench.write(100)
    bench.end()
    assert len(list(bench.path.glob("*.mcap"))) == 5
    assert run("verify", bench.path) == f"{bench.path}: good\n"
    text = (bench.path / "metadata.yaml").read_text()
    (bench.path / "metadata.yaml").write_text(text.replace("message_count: 5\n", "message_count: 4\n"))
    assert "/robot_description: 5 messages, metadata.yaml says 4" in run("verify", bench.path, code=1)


def test_trim_copies_a_part(tmp_path):
    path = made(tmp_path, prompt="pick")
    assert "messages, 0.20 s" in run("trim", path, "--from", "0.3", "--to", "0.5", "-o", tmp_path / "cut")
    summary, messages = contents(tmp_path / "cut")
    assert [received for _, _, received, _ in messages] == [stamp(index) for index in range(30, 51)]
    assert messages[0][1] == joints(30)
    assert summary.finished
    assert summary.metadata["trimmed"] == "0.3 s to 0.5 s of episode_000001"
    with pytest.raises(RecorderError, match=r"is 0\.99 s long; --from 0\.5 --to 0\.2 is outside it"):
        run("trim", path, "--from", "0.5", "--to", "0.2", "-o", tmp_path / "none")


LAMP = "builtin_interfaces/Time since\nstring[] marks\n"


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_a_foreign_bag_is_trimmed_with_the_definitions_that_it_brings(tmp_path, storage):
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(LAMP, "lamp_msgs/msg/Lamp"))
    # Known here, but with another field: the copy must say what its sender meant.
    del store.fielddefs["std_msgs/msg/Bool"], store.types["std_msgs/msg/Bool"]
    store.register(get_types_from_msg("bool data\nuint8 more\n", "std_msgs/msg/Bool"))
    kind = store.types
    with RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=storage) as writer:
        topics = {
            type_: writer.add_connection(f"/{type_[:4]}", type_, typestore=store)
            for type_ in ("lamp_msgs/msg/Lamp", "std_msgs/msg/Bool")
        }
        for index in range(20):
            lamp = kind["lamp_msgs/msg/Lamp"](kind["builtin_interfaces/msg/Time"](index, 2), ["a"])
            both = (lamp, kind["std_msgs/msg/Bool"](True, index))
            for message in both:
                type_ = message.__msgtype__
                writer.write(topics[type_], stamp(index), store.serialize_cdr(message, type_))
    run("trim", tmp_path / "bag", "--from", "0.05", "-o", tmp_path / "cut")
    _, messages = contents(tmp_path / "cut")
    assert [m.since_ns // 10**9 for topic, m, _, _ in messages if topic == "/lamp"] == list(range(5, 20))
    assert [m.more for topic, m, _, _ in messages if topic == "/std_"] == list(range(5, 20))
    hashes = {name: store.hash_rihs01(name) for name in topics}
    with RosbagsReader(tmp_path / "cut") as reader:
        assert {c.msgtype: c.digest for c in reader.connections} == hashes
        assert all(each.msgdef.data for each in reader.connections)
    unfinish(tmp_path / "cut", cut=10)
    assert "repaired, 30 messages" in run("repair", tmp_path / "cut")
    assert str(contents(tmp_path / "cut")[1]) == str(messages), "of classes of their own"


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_a_copy_is_compressed_as_the_original_is(tmp_path, compression):
    bench = Bench(tmp_path, compression=compression)
    bench.begin()
    bench.write(500)
    bench.end()
    run("trim", bench.path, "-o", tmp_path / "cut")
    assert contents(tmp_path / "cut")[1] == contents(bench.path)[1]
    with (tmp_path / "cut" / "cut_0.mcap").open("rb") as file:
        found = make_reader(file).get_summary()
    assert found is not None
    assert {chunk.compression for chunk in found.chunk_indexes} == {"" if compression == "none" else compression}


def test_export_writes_numbers_by_joint(tmp_path):
    path = made(tmp_path, count=3)
    run("export", path, JOINTS, "-o", tmp_path / "joints.csv")
    with (tmp_path / "joints.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["position.tilt"]) for row in rows] == [0.0, -1.0, -2.0]
    assert int(rows[1]["header.stamp_ns"]) == stamp(1)
    with pytest.raises(RecorderError, match="exists already"):
        run("export", path, JOINTS, "-o", tmp_path / "joints.csv")
    with pytest.raises(RecorderError, match=r"has no topic '/imu'; available: /joint_states"):
        run("export", path, "/imu", "-o", tmp_path / "imu.csv")


def test_export_writes_pictures_without_loss(tmp_path):
    path = made(tmp_path, frames=3)
    run("export", path, CAMERA, "-o", tmp_path / "top")
    expected = picture(2)
    with Png.open(tmp_path / "top" / "000002.png") as png:
        pixels = np.asarray(png)
    np.testing.assert_array_equal(pixels, expected.data.reshape(48, 64, 3))
    lines = (tmp_path / "top" / "stamps.csv").read_text().splitlines()
    assert lines[3] == f"000002.png,{stamp(2)},{stamp(2)}"


def test_plot_draws_a_png(tmp_path):
    path = made(tmp_path, frames=40)
    run("plot", path, "-o", tmp_path / "a.png")
    with Png.open(tmp_path / "a.png") as png:
        width, height = png.size
    assert width > 1000
    assert height > 800


def test_plot_shows_the_first_and_the_last_picture_and_bears_states_without_positions(tmp_path):
    bench = Bench(tmp_path)
    bench.begin((JOINTS, CAMERA))
    bench.write(100, make=lambda index: JointState(joints(index).header, ("pan",), (), [1.0]))
    for index in range(0, 90, 3):
        bench.recorder.write(CAMERA, picture(index), stamp(index))
    bench.write(100, "/leader", start=100)
    bench.end()
    facts = PlotData(bench.path)
    pictures = facts.pictures[CAMERA]
    assert [place for place in pictures if place < 7] == list(range(len(pictures) - 1)), "none from its end on"
    np.testing.assert_array_equal(pictures[0][1], picture(0).data.reshape(48, 64, 3))
    np.testing.assert_array_equal(pictures[7][1], picture(87).data.reshape(48, 64, 3))
    assert set(facts.joints) == {("/leader", "pan"), ("/leader", "tilt")}
    run("plot", bench.path, "-o", tmp_path / "a.png")


def test_plot_takes_the_actions_and_their_joints_from_the_contract(tmp_path):
    action = {"topic": "/head/setpoint", "type": "std_msgs/msg/Float64MultiArray", "joints": ["pan", "tilt"]}
    contract = {"version": 1, "units": "SI", "rate_hz": 30.0, "observations": {}, "action": [action]}
    topics = ["/head/setpoint", "/arm/commands"]
    assert actions_of({"contract": json.dumps(contract)}, topics) == {"/head/setpoint": ("pan", "tilt")}
    assert actions_of({"contract": "of sale"}, topics) == {"/arm/commands": ()}
    assert actions_of({}, topics) == {"/arm/commands": ()}


def test_plot_without_matplotlib_says_how_to_install_it(tmp_path, monkeypatch):
    path = made(tmp_path)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(RecorderError, match=r"pip install \"ibrobot-plugin-mcap\[plot\]\""):
        run("plot", path)


def test_delete_asks_and_takes_nothing_but_episodes(tmp_path, monkeypatch):
    path = made(tmp_path)
    CliRunner().invoke(episodes, ["delete", str(path)], input="n\n")
    assert path.is_dir()
    with pytest.raises(RequestError, match="Standard input has no answer: run it in a terminal, or give --yes"):
        CliRunner().invoke(episodes, ["delete", str(path)], catch_exceptions=False)
    assert path.is_dir()
    with pytest.raises(RecorderError, match="is not an episode; nothing was deleted"):
        run("delete", "--yes", path, tmp_path)
    assert path.is_dir()
    run("delete", "--yes", path)
    assert not path.exists()


def test_what_is_not_there_is_reported(tmp_path):
    with pytest.raises(RecorderError, match="there is no such file or folder"):
        run("list", tmp_path / "none")
    with pytest.raises(RecorderError, match="contains no episode"):
        run("list", tmp_path)
