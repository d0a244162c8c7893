"""Parity: a frame converted from the bag of a run is the frame that the policy saw in that run, bit by bit."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_camera.camera import OpenCvCamera
from ibrobot_camera.options import OpenCvOptions
from ibrobot_data.ticks import Ticks, frames
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.reader import Rosbag2Reader
from ibrobot_mcap.recorder import McapRecorder
from ibrobot_ros2.jpeg import to_jpeg
from ibrobot_testing.contexts import host_context
from ibrobot_testing.images import encode_image
from numpy.typing import NDArray
from stream_server import StreamServer, number_of

from ibrobot_core.bus import Bus
from ibrobot_core.clock import RealClock, SteppedClock
from ibrobot_core.config import find_config, load_config
from ibrobot_core.contract.frames import FrameAssembler, FrameSampler
from ibrobot_core.contract.specs import ActionPart, Contract, ObservationPart
from ibrobot_core.interfaces import EpisodeEnd, EpisodeStart, Feature, Frame
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.messages import CompressedImage, Float64MultiArray, Header, Imu, JointState, Message, Vector3
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.schema import Align, ImageSpec

pytestmark = pytest.mark.integration

RUNS = 200
START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
JOINTS = ("pan", "lift")
PIXELS = (6, 8)
COMMANDS = "/commands"


def contract(rng: np.random.Generator) -> Contract:
    """A rate, and how each observation is aligned, by chance."""

    def align(*stamps: str) -> Align:
        strategy = str(rng.choice(["hold", "asof", "drop"]))
        tolerance = float(rng.choice([0.0, 60.0, 150.0, 300.0])) if strategy == "asof" else None
        return Align(strategy, str(rng.choice(stamps)), tolerance)

    resize = ((4, 4), None)[rng.integers(2)]
    return Contract(
        float(rng.choice([7.5, 10.0, 24.0, 30.0, 50.0])),
        (
            ObservationPart(
                "observation.state", "/joint_states", JointState.ros_type, ("position.lift", "position.pan"), None,
                align("header", "receive"), Feature("float32", (2,)),
            ),
            ObservationPart(
                "observation.motion", "/imu", Imu.ros_type, ("angular_velocity",), None,
                align("header", "receive"), Feature("float32", (3,)),
            ),
            ObservationPart(
                "observation.motion", "/joint_states", JointState.ros_type, ("velocity.pan",), None,
                align("header", "receive"), Feature("float32", (1,)),
            ),
            ObservationPart(
                "observation.images.top", "/top", "sensor_msgs/msg/Image", (), ImageSpec(resize),
                align("header", "receive"), Feature("image", (*(resize or PIXELS), 3)),
            ),
            ObservationPart(
                "observation.images.wrist", "/wrist", "sensor_msgs/msg/Image", (), ImageSpec(resize),
                Align("hold", str(rng.choice(["header", "receive"]))), Feature("image", (*(resize or PIXELS), 3)),
            ),
            ObservationPart(
                "observation.environment_state", "/scene", Float64MultiArray.ros_type, ("data",), None,
                align("receive"), Feature("float32", (3,)),
            ),
        ),
        (ActionPart("arm", COMMANDS, Float64MultiArray.ros_type, "hold", JOINTS),),
        max_age=float(rng.choice([0.1, 0.25, 5.0])),
    )  # fmt: skip


def message(topic: str, stamp_ns: int, rng: np.random.Generator) -> Message:
    if topic == "/joint_states":
        return JointState(Header(stamp_ns), JOINTS, rng.normal(size=2), rng.normal(size=2))
    if topic == "/imu":
        return Imu(Header(stamp_ns), angular_velocity=Vector3(*rng.normal(size=3)))
    if topic == "/top":
        encoding = str(rng.choice(["rgb8", "bgr8", "rgba8", "mono8"]))
        channels = {"rgba8": 4, "mono8": 1}.get(encoding, 3)
        pixels = rng.integers(0, 256, (*PIXELS, channels), np.uint8)
        return encode_image(pixels, encoding, Header(stamp_ns), padding=int(rng.integers(3)))
    if topic == "/wrist":
        pixels = rng.integers(0, 256, (*PIXELS, 3), np.uint8)
        sent = to_jpeg(encode_image(pixels, "bgr8", Header(stamp_ns)), int(rng.integers(20, 100)))
        return attrs.evolve(sent, format="jpeg") if rng.random() < 0.5 else sent
    return Float64MultiArray(rng.normal(size=2 if topic == COMMANDS else 3))


def publications(rng: np.random.Generator, duration_ns: int) -> list[tuple[int, str, Message]]:
    """Time of receipt [ns], topic and message: jittered, late, out of order, twice, and not at all."""
    found = []
    rates = {"/joint_states": 100, "/imu": 60, "/top": 30, "/wrist": 25, "/scene": 20, COMMANDS: 50}
    for topic, rate in rates.items():
        skew_ns = int(rng.choice([0, 3 * MS, -40 * MS, 5_000 * MS], p=[0.75, 0.12, 0.1, 0.03]))
        jump = int(rng.integers(duration_ns)) if rng.random() < 0.1 else duration_ns
        for i in range(duration_ns * rate // 10**9):
            if rng.random() < 0.1:
                continue
            due_ns = round(i * 1e9 / rate)
            late_ns = int(
                rng.choice([0, rng.integers(5 * MS), rng.integers(80 * MS), 700 * MS], p=[0.2, 0.6, 0.18, 0.02])
            )
            stamp_ns = START_NS + due_ns + skew_ns - (3_000 * MS if due_ns > jump else 0)
            made = message(topic, stamp_ns, rng)
            found += [(START_NS + due_ns + late_ns, topic, made)] * (2 if rng.random() < 0.1 else 1)
    return sorted(found, key=lambda publication: publication[0])


def record(path: Path, contract: Contract, sent: list[tuple[int, str, Message]]) -> list[Frame]:
    """Publish on a real bus, with a sampler and a recorder on it; the frames at the contract's ticks."""
    clock = SteppedClock(sent[0][0])
    bus = Bus(clock)
    sampler = FrameSampler(contract, bus)
    everything = bus.subscribe(None, 1000)
    recorder = McapRecorder(McapOptions(), host_context(clock=clock))
    recorder.begin(EpisodeStart(path, clock.now_ns(), contract.topics, {"contract": json.dumps(contract.canonical())}))
    seen: list[Frame] = []
    tick_ns = sent[0][0]

    def sample_until(t_ns: int) -> None:
        nonlocal tick_ns
        while tick_ns <= t_ns:
            clock.advance(tick_ns - clock.now_ns())
            seen.append(sampler.sample(bus.snapshot_ns()))
            tick_ns += contract.step_ns

    for received_ns, topic, made in sent:
        sample_until(received_ns - 1)
        clock.advance(received_ns - clock.now_ns())
        bus.publish(topic, made)
        for item in everything.drain():
            recorder.write(item.topic, item.message, item.received_ns)
    sample_until(sent[-1][0])
    recorder.end(EpisodeEnd(sent[-1][0], "success"))
    recorder.close()
    return seen


def same(one: NDArray[Any], other: NDArray[Any]) -> bool:
    return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()


def assert_equal(seen: Frame, converted: Frame) -> None:
    assert (seen.stamp_ns, seen.missing, list(seen.values)) == (
        converted.stamp_ns,
        converted.missing,
        list(converted.values),
    )
    for key, value in seen.values.items():
        assert same(value, converted.values[key]), f"{key} at {seen.stamp_ns}"


@pytest.mark.parametrize("block", [0, *(pytest.param(block, marks=pytest.mark.long) for block in range(1, 10))])
def test_frames_from_the_bag_are_those_of_the_run(tmp_path: Path, block: int) -> None:
    complete = 0
    for seed in range(block * RUNS // 10, (block + 1) * RUNS // 10):
        rng = np.random.default_rng(seed)
        spec = contract(rng)
        sent = publications(rng, 1_200 * MS)
        seen = record(tmp_path / f"bag_{seed}", spec, sent)
        reader = installed_plugins().open_episode(tmp_path / f"bag_{seed}")
        messages = ((each.topic, each.message, each.received_ns) for each in reader.messages(spec.topics))
        converted = list(frames(FrameAssembler(spec), messages, [frame.stamp_ns for frame in seen]))
        assert len(converted) == len(seen)
        for live, later in zip(seen, converted, strict=True):
            assert_equal(live, later)
        complete += check_rows(reader, spec, seen, sent)
        reader.close()
    assert complete > 100, "runs in which nothing is ever whole show nothing"


def check_rows(reader: Any, spec: Contract, seen: list[Frame], sent: list[tuple[int, str, Message]]) -> int:
    """The rows of a conversion are the frames in which nothing is missing, with the newest command beside."""
    wanted = []
    for frame in seen:
        commands = [(at, made) for at, topic, made in sent if topic == COMMANDS and at <= frame.stamp_ns]
        if commands and frame.stamp_ns - commands[-1][0] <= spec.max_age * 1e9 and not frame.missing:
            wanted.append({**frame.values, "action": np.asarray(commands[-1][1].data, np.float32)})  # type: ignore[attr-defined]
    if not wanted:
        return 0
    rows = list(Ticks(reader, spec, "skip"))
    assert len(rows) == len(wanted)
    for row, values in zip(rows, wanted, strict=True):
        assert row.keys() == values.keys()
        assert all(same(row[key], values[key]) for key in values)
    return len(rows)


def test_pictures_of_a_motion_jpeg_camera(tmp_path: Path) -> None:
    """What it sent is in the bag byte by byte, and its decoding is what a policy saw and what a dataset gets."""
    image = ObservationPart(
        "observation.images.top",
        "/camera/top/image_raw",
        "sensor_msgs/msg/Image",
        (),
        ImageSpec(),
        Align("hold", "header"),
        Feature("image", (-1, -1, 3)),
    )
    spec = Contract(30.0, (image,), ())
    clock = RealClock()
    bus = Bus(clock)
    sampler = FrameSampler(spec, bus)
    recorder = McapRecorder(McapOptions(), host_context(clock=clock))
    recorder.begin(EpisodeStart(tmp_path / "bag", clock.now_ns(), spec.topics, {}))
    arrived = bus.subscribe(image.topic, 100)
    sent: list[Any] = []
    seen: list[Any] = []
    with StreamServer() as server:
        camera = OpenCvCamera(OpenCvOptions(device=server.url), host_context("top", clock=clock))
        camera.open()
        while len(seen) < 20:
            picture = camera.read(30.0)
            assert isinstance(picture, CompressedImage)
            bus.publish(camera.topic, picture)
            sent.append(picture.data.tobytes())
            for item in arrived.drain():
                recorder.write(item.topic, item.message, item.received_ns)
            seen.append(sampler.sample(bus.snapshot_ns()))
        camera.close()
        assert sent[0] == server.jpeg(number_of(decoded(picture_of(sent[0]))))
    recorder.end(EpisodeEnd(clock.now_ns(), "success"))
    recorder.close()
    reader = Rosbag2Reader(tmp_path / "bag")
    assert [bytes(raw.data).endswith(one) for raw, one in zip(reader.raw(), sent, strict=True)] == [True] * 20
    messages = ((each.topic, each.message, each.received_ns) for each in reader.messages(spec.topics))
    for live, later in zip(
        seen, frames(FrameAssembler(spec), messages, [frame.stamp_ns for frame in seen]), strict=True
    ):
        assert not live.missing
        assert_equal(live, later)
    reader.close()


def picture_of(jpeg: bytes) -> CompressedImage:
    return CompressedImage(Header(), "jpeg", np.frombuffer(jpeg, np.uint8))


def decoded(picture: CompressedImage) -> NDArray[Any]:
    image = installed_plugins().decode(picture)
    return image.data.reshape(image.height, image.width, 3)


def test_a_whole_run_in_simulation(site: Any, tmp_path: Path, rendering: None) -> None:
    site.add("frame-keeper", "frame_keeper.py")
    registry = installed_plugins()
    robot = find_config("so101", registry)
    overrides = (
        "models={keeper: {type: keeper}}",
        "control_modes.model_inference.inference.model=keeper",
        f"recording={{type: mcap, root: {tmp_path}}}",
    )
    config = load_config(robot, overrides=overrides, mode="model_inference", sim=True)
    runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, duration_s=1.5)))
    runtime.start()
    try:
        while not runtime.step():
            pass
    finally:
        runtime.stop()
    kept = sys.modules["frame_keeper"].KEPT
    assert len(kept) > 40
    [path] = (tmp_path / "default/episodes").iterdir()
    spec = Contract.from_config(config)
    reader = registry.open_episode(path)
    messages = ((each.topic, each.message, each.received_ns) for each in reader.messages(spec.topics))
    for live, later in zip(
        kept, frames(FrameAssembler(spec), messages, [frame.stamp_ns for frame in kept]), strict=True
    ):
        assert_equal(live, later)
    reader.close()
