"""Datasets that LeRobot itself writes, by its own calls, are read here as LeRobot loads them, and back again."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run_here
from ibrobot_lerobot.layout import existing_dataset
from ibrobot_lerobot.rows import EpisodeRows
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from numpy.typing import NDArray

from ibrobot_core.api import Float64MultiArray
from ibrobot_core.app import installed_plugins

pytestmark = [
    pytest.mark.lerobot,
    # LeRobot stores features of one value so.
    pytest.mark.filterwarnings("ignore:Conversion of an array with ndim > 0:DeprecationWarning"),
]

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
NAMES = [f"{joint}.pos" for joint in JOINTS]
TOP = "observation.images.top"
FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (6,), "names": NAMES},
    "action": {"dtype": "float32", "shape": (6,), "names": NAMES},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    TOP: {"dtype": "video", "shape": (64, 96, 3), "names": ["height", "width", "channels"]},
}
LENGTHS, FPS = (4, 6, 3), 30
CONTRACT = """\
robot:
  name: desk
  joints:
    - {name: shoulder_pan, lower: -1.0, upper: 1.0, max_velocity: 8.0, max_acceleration: 90.0}
    - {name: shoulder_lift, lower: -1.0, upper: 1.0, max_velocity: 8.0, max_acceleration: 90.0}
    - {name: elbow_flex, lower: -1.0, upper: 1.0, max_velocity: 8.0, max_acceleration: 90.0}
    - {name: wrist_flex, lower: -1.0, upper: 1.0, max_velocity: 8.0, max_acceleration: 90.0}
    - {name: wrist_roll, lower: -1.0, upper: 1.0, max_velocity: 8.0, max_acceleration: 90.0}
    - {name: gripper, lower: 0.0, upper: 1.0, max_velocity: 8.0, max_acceleration: 90.0}
  groups: {arm: [shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll, gripper]}
  description:
    mjcf: package://so101_nexus/assets/SO101_menagerie/so101.xml
    poses: {rest: [0, 0, 0, 0, 0, 0]}
simulation: {type: mujoco}
executors: {arm_position: {type: position, group: arm}}
control_modes: {idle: {executors: [arm_position]}}
default_control_mode: idle
contract:
  rate_hz: 30
  observations:
    - key: observation.state
      topic: /joint_states
      select: [position.shoulder_pan, position.shoulder_lift, position.elbow_flex, position.wrist_flex,
        position.wrist_roll, position.gripper]
    - {key: observation.images.top, topic: /camera/top/image_raw, type: sensor_msgs/msg/Image}
  actions:
    - {executor: arm_position, topic: /arm/commands}
"""


def values(number: int) -> dict[str, NDArray[Any]]:
    """What frame `number` has."""
    chance = np.random.default_rng(number)
    blocks = chance.choice(np.array([30, 220], np.uint8), (2, 3, 3)).repeat(32, 0).repeat(32, 1)
    return {
        "observation.state": (0.01 * number + 0.001 * np.arange(6)).astype(np.float32),
        "action": (0.01 * number + 0.002 * np.arange(6)).astype(np.float32),
        "next.reward": np.array([number], np.float32),
        TOP: blocks,
    }


@pytest.fixture(scope="module", params=[True, False], ids=["videos", "pictures"])
def theirs(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of three episodes, written by LeRobot."""
    root = tmp_path_factory.mktemp("theirs") / "set"
    features = FEATURES if request.param else FEATURES | {TOP: {**FEATURES[TOP], "dtype": "image"}}
    dataset: Any = LeRobotDataset.create(
        "local/desk", FPS, features, root=root, robot_type="so101_follower", use_videos=request.param
    )
    add: Callable[..., object] = dataset.add_frame
    apart = "task" in inspect.signature(add).parameters
    number = 0
    for episode, length in enumerate(LENGTHS):
        for _ in range(length):
            task = f"task {episode % 2}"
            add(values(number), task) if apart else add({**values(number), "task": task})
            number += 1
        dataset.save_episode()
    if hasattr(dataset, "finalize"):
        dataset.finalize()
    return root


def loaded(root: Path) -> Any:
    """The dataset as LeRobot loads it, with the one decoder that needs no library of the system."""
    return LeRobotDataset("local/desk", root=root, video_backend="pyav")


def compare(root: Path, begin: int = 0) -> int:
    """Compare the rows that we read with those that LeRobot loads; their number."""
    dataset, frames, number = existing_dataset(root), loaded(root), 0
    for episode in range(dataset.info["total_episodes"]):
        rows = EpisodeRows(dataset, episode)
        for row in rows.read(dataset.features):
            frame = frames[number]
            assert frame["task"] == rows.tasks[0]
            for key in set(FEATURES) & set(row):
                seen = frame[key].numpy()
                if key == TOP:
                    difference = np.abs(seen.transpose(1, 2, 0) * 255 - row[key])
                    assert difference.max() <= 2, "other decoders round colours otherwise"
                else:
                    np.testing.assert_array_equal(np.ravel(seen), row[key])
            np.testing.assert_array_equal(row["action"], values((number + begin) % sum(LENGTHS))["action"])
            number += 1
    assert number == len(frames)
    return number


def test_rows_are_those_that_lerobot_loads(theirs: Path) -> None:
    assert compare(theirs) == sum(LENGTHS)


def test_lerobot_loads_what_merging_makes_of_its_own(theirs: Path, tmp_path: Path) -> None:
    done = run_here("datasets", "merge", theirs, theirs, "--out", tmp_path / "twice")
    assert done.returncode == 0, done.stderr
    assert compare(tmp_path / "twice") == 2 * sum(LENGTHS)
    stats = [json.loads((root / "meta/stats.json").read_bytes()) for root in (theirs, tmp_path / "twice")]
    for key in FEATURES:
        for name in ("min", "max", "mean"):
            # Of a video, LeRobot counts some pictures, or some before they are encoded.
            tolerance = 0.15 if key == TOP else 1e-5
            np.testing.assert_allclose(
                stats[1][key][name], stats[0][key][name], atol=tolerance, err_msg=f"{key} {name}"
            )


def test_its_episodes_become_bags_and_are_replayed(
    theirs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("desk.yaml").write_text(CONTRACT)
    given = ("--config", "desk.yaml", "--norm-mode", "radians")
    done = run_here("convert", theirs, "--to", "bag", "--out", "bags", *given)
    assert done.returncode == 0, done.stdout + done.stderr
    reader = installed_plugins().open_episode(sorted(Path("bags/episodes").iterdir())[1])
    sent = [each.message for each in reader.messages({"/arm/commands"})]
    found = [each.data for each in sent if isinstance(each, Float64MultiArray)]
    reader.close()
    np.testing.assert_array_equal(found, [values(4 + i)["action"] for i in range(6)])
    listed = run_here("episodes", "info", "bags/episodes/episode_000002")
    assert (listed.returncode, "no messages" in listed.stdout) == (0, False), listed.stdout
    replayed = run_here(
        "replay", f"{theirs}:1", "desk.yaml", "--sim", "--lockstep", "--headless", "--norm-mode", "radians"
    )
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr
