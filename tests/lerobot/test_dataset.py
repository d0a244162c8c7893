"""LeRobot itself loads what `ibrobot convert` makes, finds every frame as the bag has it, and trains on it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ibrobot_data.request import ConversionRequest
from ibrobot_data.run import convert, find_episodes
from ibrobot_lerobot.options import LeRobotOptions
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot_version import since
from mcap.reader import make_reader
from numpy.typing import NDArray
from recordings import CAMERAS, SIZE, record
from rosbags.typesys import Stores, get_typestore
from tqdm import tqdm

pytestmark = pytest.mark.lerobot
tqdm.monitor_interval = 0  # no thread that outlives the test

LOSSY = 0.15
"""Mean difference to what went into a codec, of values 0 to 1; another picture is about 0.37 away."""


COMMANDERS = {
    1: [(0.0, "policy"), (0.4, "handover"), (0.5, "operator"), (1.0, "handover"), (1.2, "policy")],
    2: [(0.0, "policy")],
    3: [(0.0, "operator")],
}
OUTCOMES = {1: "success", 2: "failure", 3: "success"}


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
    commanders = streams.pop("/commander")
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
            said = [message.data for _, received, message in commanders if received <= t]
            row["intervention"] = np.array([said[-1] == "operator"])
            rows.append(row)
    return rows


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("bags")
    for number, seconds in ((1, 1.5), (2, 0.8), (3, 2.1)):
        record(
            root / f"episode_{number:06d}",
            number,
            seconds,
            "sort the blocks" if number == 2 else "pick the cube",
            outcome=OUTCOMES[number],
            commanders=COMMANDERS[number],
        )
    # The first conversion starts a process, and opens memory, that live as long as the interpreter.
    convert(
        ConversionRequest(tmp_path_factory.mktemp("first") / "set", LeRobotOptions(videos=False), "lerobot"),
        find_episodes([root])[:1],
    )
    return root


def converted(bags: Path, out: Path, *, labels: bool = False, **options: Any) -> LeRobotDataset:
    request = ConversionRequest(out, LeRobotOptions(**options), "lerobot", labels=labels)
    report = convert(request, find_episodes([bags]))
    assert not report.failed
    return LeRobotDataset("local/converted", root=out, video_backend="pyav")


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
    first = convert(
        ConversionRequest(tmp_path / "set", LeRobotOptions(), "lerobot"), find_episodes([bags / "episode_000001"])
    )
    rest = convert(ConversionRequest(tmp_path / "set", LeRobotOptions(), "lerobot", append=True), find_episodes([bags]))
    assert (len(first.converted), len(rest.converted)) == (1, 2)
    check_frames(LeRobotDataset("local/converted", root=tmp_path / "set", video_backend="pyav"), bags, LOSSY)


def test_labels_say_who_commanded_and_how_episodes_end(bags: Path, tmp_path: Path) -> None:
    dataset = converted(bags, tmp_path / "set", labels=True, videos=False)
    flag = {"dtype": "bool", "shape": (1,), "names": None}
    labels = {"intervention": flag, "next.reward": {**flag, "dtype": "float32"}, "next.done": flag}
    assert {key: dataset.meta.features[key] for key in labels} == labels
    ends = np.array(dataset.meta.episodes["dataset_to_index"]) - 1
    succeeded = ends[[OUTCOMES[number] == "success" for number in (1, 2, 3)]]
    wanted = [row["intervention"] for number in (1, 2, 3) for row in independently(bags / f"episode_{number:06d}")]
    rows = np.arange(len(dataset))
    columns = {key: dataset.hf_dataset[key] for key in labels}
    found = {
        key: np.array([np.asarray(each).item() for each in column], dtype=np.dtype(str(labels[key]["dtype"])))
        for key, column in columns.items()
    }
    np.testing.assert_array_equal(found["intervention"], np.concatenate(wanted))
    np.testing.assert_array_equal(found["next.reward"], np.isin(rows, succeeded).astype(np.float32))
    np.testing.assert_array_equal(found["next.done"], np.isin(rows, ends))
    assert 10 < np.sum(found["intervention"]) < len(rows) - 10
    for row in (0, int(ends[0]), len(rows) - 1):
        item = dataset[row]
        assert [str(item[key].dtype) for key in labels] == ["torch.bool", "torch.float32", "torch.bool"]
        assert [item[key].item() for key in labels] == [found[key][row] for key in labels]
    theirs = LeRobotDataset.create("local/theirs", 30, labels, root=tmp_path / "theirs", use_videos=False)
    for i in range(3):
        theirs.add_frame({key: values[i : i + 1] for key, values in found.items()} | {"task": "pick the cube"})
    theirs.save_episode()
    theirs.finalize()
    theirs = LeRobotDataset("local/theirs", root=tmp_path / "theirs", video_backend="pyav")
    for key in labels:
        assert dataset.hf_dataset.features[key] == theirs.hf_dataset.features[key]


@since("0.6", "takes the deviation of pictures for that of the episodes' means")
def test_statistics_are_lerobots(bags: Path, tmp_path: Path) -> None:
    ours = converted(bags, tmp_path / "ours", videos=False)
    features = {key: f for key, f in ours.meta.features.items() if key in ours[0] and key.startswith(("obs", "act"))}
    theirs = LeRobotDataset.create("local/theirs", 30, features, root=tmp_path / "theirs", use_videos=False)
    for number in (1, 2, 3):
        for row in independently(bags / f"episode_{number:06d}"):
            theirs.add_frame({key: row[key] for key in features} | {"task": "pick the cube"})
        theirs.save_episode()
    theirs.finalize()
    for key in features:
        found, wanted = ours.meta.stats[key], theirs.meta.stats[key]
        assert {name: value.shape for name, value in found.items()} == {n: v.shape for n, v in wanted.items()}
        np.testing.assert_array_equal(found["count"], wanted["count"])
        for name in ("min", "max", "mean", "std"):
            # LeRobot adds up in single precision.
            np.testing.assert_allclose(found[name], wanted[name], rtol=1e-2, atol=1e-4, err_msg=f"{key} {name}")


@pytest.mark.long
def test_act_trains_on_it(bags: Path, tmp_path: Path) -> None:
    converted(bags, tmp_path / "set", labels=True)
    command = [
        sys.executable, "-m", "lerobot.scripts.lerobot_train", "--dataset.repo_id=local/converted",
        f"--dataset.root={tmp_path / 'set'}", "--dataset.video_backend=pyav",
        "--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false",
        "--policy.pretrained_backbone_weights=null", "--policy.dim_model=32", "--policy.n_heads=2",
        "--policy.dim_feedforward=64", "--policy.n_encoder_layers=1", "--policy.n_vae_encoder_layers=1",
        "--policy.chunk_size=10", "--policy.n_action_steps=10", "--steps=5", "--batch_size=2", "--num_workers=0",
        "--log_freq=5", "--save_freq=5", f"--output_dir={tmp_path / 'out'}",
    ]  # fmt: skip
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr[-3000:]
    assert (tmp_path / "out/checkpoints/000005/pretrained_model/model.safetensors").is_file()
