"""Episodes of datasets as messages: rows and pictures in step, units back to radians, clear words for what is wrong."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from ibrobot_lerobot import layout
from ibrobot_lerobot.pictures import PngEncoder, decode_picture, tiff
from ibrobot_lerobot.reader import LeRobotReader

from ibrobot_core.api import (
    ActionPart,
    CalibrationError,
    Contract,
    ContractError,
    DatasetError,
    EpisodeAddress,
    Feature,
    Float64MultiArray,
    Image,
    JointState,
    ObservationPart,
    RecorderError,
    pixels,
)
from ibrobot_core.app import Align, installed_plugins
from ibrobot_core.schema import ImageSpec

from .conftest import CAMERA, FPS, picture, values, write

NAMES = ("a.pos", "b.pos", "c.pos")
ACTION = Feature("float32", (3,), NAMES)
FEATURES = {"observation.state": Feature("float32", (3,), NAMES), "observation.images.top": CAMERA, "action": ACTION}
STEP_NS = round(1e9 / FPS)


def contract(names: tuple[str, ...] = ("a", "b", "c"), *, camera: bool = True) -> Contract:
    parts = [
        ObservationPart(
            "observation.state",
            "/joint_states",
            JointState.ros_type,
            tuple(f"position.{n}" for n in names),
            None,
            Align(),
            Feature("float32", (3,), tuple(f"{n}.pos" for n in names)),
        )
    ]
    if camera:
        parts.append(
            ObservationPart(
                "observation.images.top",
                "/top",
                Image.ros_type,
                (),
                ImageSpec(),
                Align(),
                Feature("image", (-1, -1, 3), ("height", "width", "channels")),
            )
        )
    return Contract(FPS, tuple(parts), (ActionPart("arm", "/arm", Float64MultiArray.ros_type, "hold", names),))


def provenance(described: Contract | None = None, norm_mode: str = "radians", **more: str) -> dict[str, str]:
    text = json.dumps((described or contract()).canonical())
    return {"contract": text, "norm_mode": norm_mode, **more}


def foreign(root: Path, **options: Any) -> Path:
    """A dataset of 3 + 40 + 5 frames that says nothing of robots."""
    return write(root, FEATURES, (3, 40, 5), **options)


def read(root: Path, number: int, **more: Any) -> list[Any]:
    return list(LeRobotReader(EpisodeAddress(root, number, more or provenance())).messages())


@pytest.mark.parametrize(("options", "exact"), [({"videos": False}, True), ({"codec": "h264", "crf": 20}, False)])
def test_rows_and_pictures_of_an_episode_in_the_middle_come_in_step(
    tmp_path: Path, options: dict[str, Any], exact: bool
):
    items = read(foreign(tmp_path / "set", **options), 1)
    assert [item.topic for item in items[:3]] == ["/joint_states", "/top", "/arm"]
    assert len(items) == 120
    for i in range(40):
        joints, camera, arm = items[3 * i : 3 * i + 3]
        wanted = values(FEATURES, 3 + i)
        assert joints.received_ns == joints.message.header.stamp_ns == (3 + i) * STEP_NS
        assert joints.message.name == ("a", "b", "c")
        np.testing.assert_array_equal(joints.message.position, wanted["observation.state"])
        np.testing.assert_array_equal(arm.message.data, wanted["action"])
        difference = np.abs(pixels(camera.message).astype(int) - wanted["observation.images.top"])
        assert difference.max() == 0 if exact else difference.mean() < 10


def test_the_summary_tells_topics_times_and_task_without_decoding(tmp_path: Path):
    root = foreign(tmp_path / "set", videos=False)
    reader = installed_plugins().open_episode(tmp_path / "set:2", provenance())
    summary = reader.summary()
    reader.close()
    assert summary.path == tmp_path / "set:2"
    assert {topic: each.count for topic, each in summary.topics.items()} == {"/joint_states": 5, "/top": 5, "/arm": 5}
    assert (summary.start_ns, summary.end_ns) == (43 * STEP_NS, 47 * STEP_NS)
    assert summary.metadata["prompt"] == "task 0"
    assert Contract.from_canonical(json.loads(summary.metadata["contract"])) is not None
    assert root.exists()


def test_reading_from_a_time_on_skips_the_rows_and_pictures_before(tmp_path: Path):
    reader = LeRobotReader(EpisodeAddress(foreign(tmp_path / "set", codec="h264"), 1, provenance()))
    everything = list(reader.messages())
    stamps = [item.received_ns for item in everything]
    for since in (0, stamps[0], stamps[40], stamps[40] + 1, stamps[-1], stamps[-1] + 1):
        found = list(reader.messages_since(since))
        assert [item.received_ns for item in found] == [stamp for stamp in stamps if stamp >= since]
        for one, other in zip(found, everything[len(everything) - len(found) :], strict=True):
            assert (one.topic, str(one.message)) == (other.topic, str(other.message))


def test_only_what_is_asked_for_is_read(tmp_path: Path):
    root = foreign(tmp_path / "set", codec="h264")
    for video in root.rglob("*.mp4"):
        video.write_bytes(b"no video")
    reader = LeRobotReader(EpisodeAddress(root, 0, provenance()))
    assert len(list(reader.messages({"/arm"}))) == 3
    with pytest.raises(RecorderError, match=r"set:0: .*file-000.mp4: cannot be read"):
        list(reader.messages())


def test_joints_come_in_radians(tmp_path: Path):
    joints = {
        n: {"id": i, "drive_mode": 0, "homing_offset": 0, "range_min": 1000, "range_max": 3100, "closed_at": None}
        for i, n in enumerate("abc")
    }
    more = provenance(norm_mode="degrees", calibration=json.dumps({"arm": joints}))
    items = read(foreign(tmp_path / "set", videos=False), 0, **more)
    degrees = values(FEATURES, 0)["action"].astype(float)
    expected = (degrees * 4095 / 360 + (1000 + 3100) / 2 - 2048) * 2 * np.pi / 4096
    np.testing.assert_allclose(items[2].message.data, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("more", "error", "words"),
    [
        (
            {"nothing": "x"},
            ContractError,
            "was not made by ibrobot, .*give a robot YAML with a matching contract",
        ),
        (
            {"contract": provenance()["contract"]},
            CalibrationError,
            "does not state the unit .*; give it: radians, degrees",
        ),
        (provenance(norm_mode="degrees"), CalibrationError, "degrees needs the calibration of joint 'a'"),
        (
            provenance(contract(("a", "c", "b"))),
            ContractError,
            r"dataset: \(3,\) a.pos, b.pos, c.pos\n *contract: .*a.pos, c",
        ),
    ],
)
def test_a_foreign_dataset_says_what_it_needs(tmp_path: Path, more: dict[str, str], error: Any, words: str):
    with pytest.raises(error, match=words):
        read(foreign(tmp_path / "set", videos=False), 0, **more)


def test_what_the_contract_has_and_the_dataset_lacks_is_named(tmp_path: Path):
    root = write(tmp_path / "set", {"observation.state": FEATURES["observation.state"]}, (2,))
    with pytest.raises(ContractError, match=r"lacks observation.images.top of the contract; available: observ"):
        read(root, 0)


def test_an_episode_goes_by_its_number(tmp_path: Path):
    foreign(tmp_path / "set", videos=False)
    registry = installed_plugins()
    with pytest.raises(RecorderError, match=r"set: is a dataset of 3 episodes; choose one, e.g. .*set:0"):
        registry.open_episode(tmp_path / "set", provenance())
    with pytest.raises(RecorderError, match=r"set: has no episode 3; available: 0 to 2"):
        registry.open_episode(tmp_path / "set:3", provenance())
    with pytest.raises(RecorderError, match=r"sat:0: there is no such episode"):
        registry.open_episode(tmp_path / "sat:0", provenance())


def test_a_table_without_some_of_the_rows_is_reported(tmp_path: Path):
    root = foreign(tmp_path / "set", videos=False)
    dataset = layout.open_dataset(root)
    assert dataset is not None
    (path,) = dataset.files(layout.EPISODES, "parquet")
    import pyarrow.parquet as pq

    rows = pq.read_table(path).to_pylist()
    rows[0]["length"] = 4
    pq.write_table(pq.ParquetFile(path).schema_arrow.empty_table().from_pylist(rows), path)
    with pytest.raises(RecorderError, match="episode 0 has 3 rows, must have 4"):
        read(root, 0)


@pytest.mark.parametrize("channels", [1, 3])
def test_pngs_are_decoded_as_they_were(channels: int):
    image = picture(5, (64, 96, channels))
    content = PngEncoder(64, 96, channels)(image)
    np.testing.assert_array_equal(decode_picture(content, Feature("image", image.shape)), image)


@pytest.mark.parametrize("dtype", ["uint16", "float32"])
def test_depth_is_decoded_as_it_was(dtype: str):
    depth = (np.random.default_rng(2).random((33, 47, 1)) * 3000).astype(dtype)
    np.testing.assert_array_equal(decode_picture(tiff(depth), Feature(dtype, depth.shape)), depth)


def test_jpegs_are_decoded():
    frame = av.VideoFrame.from_ndarray(picture(6), "rgb24").reformat(format="yuvj444p")
    codec: Any = av.CodecContext.create("mjpeg", "w")
    codec.width, codec.height, codec.pix_fmt, codec.time_base = 96, 64, "yuvj444p", Fraction(1, 30)
    content = b"".join(bytes(packet) for packet in [*codec.encode(frame), *codec.encode(None)])
    decoded = decode_picture(content, CAMERA)
    assert np.abs(decoded.astype(int) - picture(6)).mean() < 6


@pytest.mark.parametrize("content", [b"GIF89a", b"\x89PNG\r\n\x1a\n\0\0"])
def test_bytes_without_a_picture_are_refused(content: bytes):
    with pytest.raises(DatasetError, match="image"):
        decode_picture(content, CAMERA)


def test_a_picture_of_another_size_is_refused():
    with pytest.raises(DatasetError, match=r"has shape \(64, 96, 3\), must be \(32, 96, 3\)"):
        decode_picture(PngEncoder(64, 96, 3)(picture(1)), Feature("image", (32, 96, 3)))
