"""Depth from bags to datasets: raw and as PNG, in millimetres and metres, with pixels that have no reading."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import run_here
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.recorder import McapRecorder
from ibrobot_testing.contexts import host_context
from numpy.typing import NDArray
from PIL import Image as Pillow
from recordings import JOINTS, START_NS

from ibrobot_core.clock import SteppedClock
from ibrobot_core.contract.specs import ActionPart, Contract, ObservationPart
from ibrobot_core.interfaces import EpisodeEnd, EpisodeStart, Feature
from ibrobot_core.messages import CompressedImage, Float64MultiArray, Header, Image, JointState
from ibrobot_core.schema import Align, ImageSpec

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("first_conversion")]

HEIGHT, WIDTH = 6, 8
STEP_NS = 100_000_000
PICTURES = 12
A, B = 3.0, 1.0
"""Of the quantisation of compressedDepth in metres: depth = A / (value - B)."""
ENCODINGS = {"png": "16UC1", "compressed": "16UC1", "quantised": "32FC1", "raw": "32FC1"}
"""Camera -> encoding of its depth."""


def millimetres(number: int) -> NDArray[np.uint16]:
    """A picture without a reading in its first row."""
    values = (1000 * number + np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)).astype(np.uint16)
    values[0] = 0
    return values


def metres(number: int) -> NDArray[np.float32]:
    """Unknown, too near and too far in its first pixels, as REP 118 has it."""
    values = (millimetres(number) / 1000).astype(np.float32)
    values[0, :3] = np.nan, -np.inf, np.inf
    return values


def png(values: NDArray[np.uint16]) -> bytes:
    file = io.BytesIO()
    Pillow.fromarray(values).save(file, "PNG")
    return file.getvalue()


def picture(camera: str, number: int, header: Header) -> Image | CompressedImage:
    """What a node publishes."""
    values = millimetres(number)
    match camera:
        case "png":
            return CompressedImage(header, "16UC1; png compressed", np.frombuffer(png(values), np.uint8))
        case "compressed":
            content = struct.pack("<iff", 0, 0, 0) + png(values)
            return CompressedImage(header, "16UC1; compressedDepth png", np.frombuffer(content, np.uint8))
        case "quantised":
            content = struct.pack("<iff", 0, A, B) + png(values)
            return CompressedImage(header, "32FC1; compressedDepth png", np.frombuffer(content, np.uint8))
    return Image(header, HEIGHT, WIDTH, "32FC1", 4 * WIDTH, metres(number).view(np.uint8).ravel())


def expected(camera: str, number: int) -> NDArray[np.generic]:
    """What a dataset has: 0 where there is no reading."""
    values = millimetres(number)
    if camera == "raw":
        return np.nan_to_num(metres(number), nan=0, posinf=0, neginf=0)
    if camera == "quantised":
        known = values > 0
        inverse = np.where(known, values.astype(np.float32) - np.float32(B), 1).astype(np.float32)
        return np.where(known, np.float32(A) / inverse, np.float32(0))
    return values


def record(folder: Path) -> None:
    """An episode with all cameras, a picture at every tick."""
    parts = (
        ObservationPart(
            "observation.state", "/joint_states", JointState.ros_type, tuple(f"position.{j}" for j in JOINTS), None,
            Align(), Feature("float32", (3,), tuple(f"{j}.pos" for j in JOINTS)),
        ),
        *(
            ObservationPart(
                f"observation.images.{camera}", f"/{camera}", Image.ros_type, (), ImageSpec(encoding=encoding),
                Align("asof", tol_ms=50.0),
                Feature(
                    "uint16" if encoding == "16UC1" else "float32", (HEIGHT, WIDTH, 1),
                    ("height", "width", "channels"),
                ),
            )
            for camera, encoding in ENCODINGS.items()
        ),
    )  # fmt: skip
    actions = (ActionPart("arm", "/commands", Float64MultiArray.ros_type, "hold", JOINTS),)
    contract = Contract(1e9 / STEP_NS, parts, actions)
    recorder = McapRecorder(McapOptions(), host_context(clock=SteppedClock(START_NS)))
    kinds = {f"/{camera}": picture(camera, 1, Header()).ros_type for camera in ENCODINGS}
    metadata = {"prompt": "look", "contract": json.dumps(contract.canonical())}
    recorder.begin(EpisodeStart(folder, START_NS, {**contract.topics, **kinds}, metadata))
    for number in range(1, PICTURES + 1):
        at_ns = START_NS + number * STEP_NS
        for camera in ENCODINGS:
            recorder.write(f"/{camera}", picture(camera, number, Header(at_ns)), at_ns)
        recorder.write("/joint_states", JointState(Header(at_ns), JOINTS, np.zeros(3)), at_ns)
        recorder.write("/commands", Float64MultiArray(np.zeros(3)), at_ns)
    recorder.end(EpisodeEnd(START_NS + PICTURES * STEP_NS, "success"))
    recorder.close()


def test_depth_is_in_the_dataset_as_the_camera_measured_it(tmp_path: Path) -> None:
    record(tmp_path / "episode_000001")
    done = run_here("convert", tmp_path / "episode_000001", "--out", tmp_path / "set")
    assert done.returncode == 0, done.stderr
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet").to_pydict()
    for camera in ENCODINGS:
        files = [row["bytes"] for row in table[f"observation.images.{camera}"]]
        found = [np.asarray(Pillow.open(io.BytesIO(file))) for file in files]
        assert len(found) == PICTURES
        for number, values in enumerate(found, start=1):
            np.testing.assert_array_equal(values, expected(camera, number), f"{camera} {number}")
    stats = json.loads((tmp_path / "set/meta/stats.json").read_bytes())
    assert stats["observation.images.raw"]["min"] == [[[0.0]]]
    assert np.ravel(stats["observation.images.raw"]["max"]) == pytest.approx(metres(PICTURES)[-1, -1])
