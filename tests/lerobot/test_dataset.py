"""LeRobot itself loads what `ibrobot convert` makes, finds every frame as the bag has it, and trains on it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.recorder import McapRecorder
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from mcap.reader import make_reader
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from tqdm import tqdm

from ibrobot_core.clock import SteppedClock
from ibrobot_core.config.schema import Align, ImageSpec
from ibrobot_core.contract.specs import ActionPart, Contract, ObservationPart
from ibrobot_core.interfaces import EpisodeEnd, EpisodeStart, Feature
from ibrobot_core.messages import Float64MultiArray, Header, Image, JointState
from ibrobot_core.recording.convert import Request, convert, find_episodes
from ibrobot_core.testing.contexts import host_context

pytestmark = pytest.mark.lerobot
tqdm.monitor_interval = 0  # no thread that outlives the test

LOSSY = 0.15
"""Mean difference to what went into a codec, of values 0 to 1; another picture is about 0.37 away."""
START_NS = 1_700_000_000_000_000_000
JOINTS = ("pan", "lift", "gripper")
BLOCK = 32
SIZE = (3 * BLOCK, 4 * BLOCK)
CAMERAS = ("top", "wrist")
CONTRACT = Contract(
    30.0,
    (
        ObservationPart(
            "observation.state", "/joint_states", JointState.ros_type, tuple(f"position.{j}" for j in JOINTS), None,
            Align(), Feature("float32", (3,), tuple(f"{j}.pos" for j in JOINTS)),
        ),
        *(
            ObservationPart(
                f"observation.images.{camera}", f"/{camera}", Image.ros_type, (), ImageSpec(),
                Align("asof", tol_ms=200.0), Feature("image", (*SIZE, 3), ("height", "width", "channels")),
            )
            for camera in CAMERAS
        ),
    ),
    (ActionPart("arm", "/commands", Float64MultiArray.ros_type, "hold", JOINTS),),
)  # fmt: skip


def numbered(number: int) -> NDArray[np.uint8]:
    """A picture of blocks that are others for each number, so that no codec can hide which one it is."""
    shape = (SIZE[0] // BLOCK, SIZE[1] // BLOCK, 3)
    blocks = np.random.default_rng(number).choice(np.array([30, 220], np.uint8), shape)
    return blocks.repeat(BLOCK, 0).repeat(BLOCK, 1)


def record(folder: Path, seed: int, seconds: float, prompt: str) -> None:
    """Streams of their own rates, stamps ahead of their receipt by a few jittered milliseconds."""
    rng = np.random.default_rng(seed)
    recorder = McapRecorder(McapOptions(), host_context(clock=SteppedClock(START_NS)))
    metadata = {"contract": json.dumps(CONTRACT.canonical()), "prompt": prompt, "robot_type": "so101_follower"}
    recorder.begin(EpisodeStart(folder, START_NS, CONTRACT.topics, metadata))
    events: list[tuple[int, str, Any]] = []
    for topic, rate in (("/joint_states", 100), ("/commands", 50), ("/top", 30), ("/wrist", 24)):
        for i in range(int(seconds * rate)):
            stamp = START_NS + round(i * 1e9 / rate)
            received = stamp + int(rng.integers(0, 9_000_000))
            if topic == "/joint_states":
                message: Any = JointState(Header(stamp), JOINTS, rng.normal(size=3))
            elif topic == "/commands":
                message = Float64MultiArray(rng.normal(size=3))
            else:
                pixels = numbered(seed * 1000 + i + (500 if topic == "/wrist" else 0))
                message = Image(Header(stamp), *SIZE, "rgb8", SIZE[1] * 3, pixels.ravel())
            events.append((received, topic, message))
    for received, topic, message in sorted(events, key=lambda event: event[0]):
        recorder.write(topic, message, received)
    recorder.end(EpisodeEnd(START_NS + round(seconds * 1e9), "success"))


def independently(folder: Path) -> list[dict[str, NDArray[Any]]]:
    """The rows of a bag, by the MCAP library, rosbags and a search through all messages."""
    store = get_typestore(Stores.ROS2_JAZZY)
    streams: dict[str, list[tuple[int, int, Any]]] = {}
    [path] = folder.glob("*.mcap")
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            decoded: Any = store.deserialize_cdr(message.data, schema.name)
            header = getattr(decoded, "header", None)
            stamp = header.stamp.sec * 10**9 + header.stamp.nanosec if header else message.log_time
            streams.setdefault(channel.topic, []).append((stamp, message.log_time, decoded))
    first = min(each[0][1] for each in streams.values())
    last = max(each[-1][1] for each in streams.values())
    rows = []
    for t in range(first, last + 1, round(1e9 / 30)):
        known = {topic: [each for each in stream if each[1] <= t and each[0] <= t] for topic, stream in streams.items()}
        if all(known.values()):
            newest = {topic: max(each, key=lambda sample: sample[0])[2] for topic, each in known.items()}
            row = {
                "observation.state": newest["/joint_states"].position.astype(np.float32),
                "action": newest["/commands"].data.astype(np.float32),
            }
            for camera in CAMERAS:
                row[f"observation.images.{camera}"] = newest[f"/{camera}"].data.reshape(*SIZE, 3)
            rows.append(row)
    return rows


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("bags")
    for number, seconds in ((1, 1.5), (2, 0.8), (3, 2.1)):
        record(root / f"episode_{number:06d}", number, seconds, "sort the blocks" if number == 2 else "pick the cube")
    return root


def converted(bags: Path, out: Path, **options: Any) -> LeRobotDataset:
    report = convert(Request(out, LeRobotOptions(**options)), find_episodes([bags]))
    assert not report.failed
    return LeRobotDataset("local/converted", root=out)


def check_frames(dataset: LeRobotDataset, bags: Path, tolerance: float) -> None:
    episodes = {number: independently(bags / f"episode_{number:06d}") for number in (1, 2, 3)}
    rows = [(number, i, row) for number, each in episodes.items() for i, row in enumerate(each)]
    assert len(dataset) == len(rows) > 100
    for item, (number, i, row) in zip(dataset, rows, strict=True):
        assert item["episode_index"] == number - 1
        assert item["frame_index"] == i
        assert item["timestamp"] == np.float32(i / 30)
        assert item["task"] == ("sort the blocks" if number == 2 else "pick the cube")
        for key in ("observation.state", "action"):
            np.testing.assert_array_equal(item[key].numpy(), row[key])
        for camera in CAMERAS:
            image = item[f"observation.images.{camera}"].numpy().transpose(1, 2, 0)
            wanted = row[f"observation.images.{camera}"] / 255
            assert np.abs(image - wanted).mean() <= tolerance


def test_every_frame_is_that_of_the_bag(bags: Path, tmp_path: Path) -> None:
    check_frames(converted(bags, tmp_path / "set"), bags, LOSSY)


def test_pictures_without_videos_are_exact(bags: Path, tmp_path: Path) -> None:
    check_frames(converted(bags, tmp_path / "set", videos=False), bags, 1e-7)


def test_codecs_that_reorder_pictures_keep_step(bags: Path, tmp_path: Path) -> None:
    check_frames(converted(bags, tmp_path / "set", codec="h264", gop=30, crf=18), bags, LOSSY)


def test_small_files_keep_step(bags: Path, tmp_path: Path) -> None:
    first = convert(Request(tmp_path / "set", LeRobotOptions()), find_episodes([bags / "episode_000001"]))
    rest = convert(Request(tmp_path / "set", LeRobotOptions(), append=True), find_episodes([bags]))
    assert (len(first.converted), len(rest.converted)) == (1, 2)
    check_frames(LeRobotDataset("local/converted", root=tmp_path / "set"), bags, LOSSY)


def test_statistics_are_lerobots(bags: Path, tmp_path: Path) -> None:
    ours = converted(bags, tmp_path / "ours", videos=False)
    features = {key: f for key, f in ours.meta.features.items() if key in ours[0] and key.startswith(("obs", "act"))}
    theirs = LeRobotDataset.create("local/theirs", 30, features, root=tmp_path / "theirs", use_videos=False)
    for number in (1, 2, 3):
        for row in independently(bags / f"episode_{number:06d}"):
            theirs.add_frame(row | {"task": "pick the cube"})
        theirs.save_episode()
    theirs.finalize()
    for key in features:
        found, wanted = ours.meta.stats[key], theirs.meta.stats[key]
        assert {name: value.shape for name, value in found.items()} == {n: v.shape for n, v in wanted.items()}
        np.testing.assert_array_equal(found["count"], wanted["count"])
        for name in ("min", "max", "mean", "std"):
            # LeRobot adds up in single precision.
            np.testing.assert_allclose(found[name], wanted[name], rtol=1e-2, atol=1e-4, err_msg=f"{key} {name}")


def test_act_trains_on_it(bags: Path, tmp_path: Path) -> None:
    converted(bags, tmp_path / "set")
    command = [
        sys.executable, "-m", "lerobot.scripts.lerobot_train", "--dataset.repo_id=local/converted",
        f"--dataset.root={tmp_path / 'set'}", "--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false",
        "--policy.pretrained_backbone_weights=null", "--policy.dim_model=32", "--policy.n_heads=2",
        "--policy.dim_feedforward=64", "--policy.n_encoder_layers=1", "--policy.n_vae_encoder_layers=1",
        "--policy.chunk_size=10", "--policy.n_action_steps=10", "--steps=20", "--batch_size=2", "--num_workers=0",
        "--log_freq=5", "--save_freq=20", f"--output_dir={tmp_path / 'out'}",
    ]  # fmt: skip
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr[-3000:]
    assert (tmp_path / "out/checkpoints/000020/pretrained_model/model.safetensors").is_file()
