"""`ibrobot convert --to bag`: what was recorded comes back from a dataset, and makes the same dataset again."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run_here
from ibrobot_lerobot.layout import open_dataset
from ibrobot_lerobot.rows import EpisodeRows
from ibrobot_testing.site import made_up_site
from recordings import CONTRACT, JOINTS, START_NS, record

from ibrobot_core.contract.specs import Contract
from ibrobot_core.messages import JointState
from ibrobot_core.plugins import installed_plugins

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("first_conversion")]

PLUGINS = Path(__file__).parents[1] / "shared/plugins"
CALIBRATION = {
    joint: {"id": i + 1, "drive_mode": i % 2, "homing_offset": 0, "range_min": 1000, "range_max": 3000}
    for i, joint in enumerate(JOINTS)
}
ROBOT: dict[str, Any] = {
    "robot": {
        "name": "bench",
        "robot_type": "bench_follower",
        "joints": [{"name": joint, "lower": -1.5, "upper": 1.5} for joint in JOINTS],
    },
    "hardware": {"type": "bench"},
}

Convert = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def convert() -> Convert:
    return partial(run_here, "convert")


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes, of which the second failed."""
    root = tmp_path_factory.mktemp("bags") / "blocks"
    for number in range(1, 4):
        record(
            root / f"episodes/episode_{number:06d}",
            number,
            0.3 + 0.2 * number,
            f"sort {number}",
            outcome="failure" if number == 2 else "success",
            mode=f"mode {number}",
            robot="bench",
            config=json.dumps(ROBOT),
            calibration=json.dumps({"arm": CALIBRATION}),
        )
    return root


@pytest.fixture(scope="module")
def exact(bags: Path, convert: Convert) -> Path:
    """Their dataset, with pictures as they were."""
    done = convert(bags, "--out", bags.parent / "exact", "--no-videos")
    assert done.returncode == 0, done.stderr
    return bags.parent / "exact"


def rows(dataset: Path, number: int) -> list[dict[str, Any]]:
    found = open_dataset(dataset)
    assert found is not None
    return list(EpisodeRows(found, number).read(CONTRACT.features()))


def test_a_dataset_made_of_what_came_back_is_the_same(exact: Path, convert: Convert, tmp_path: Path):
    assert (done := convert(exact, "--to", "bag", "--out", tmp_path / "back")).returncode == 0, done.stderr
    assert "3 episodes" in done.stdout
    assert convert(tmp_path / "back", "--out", tmp_path / "again", "--no-videos").returncode == 0
    for number in range(3):
        before, after = rows(exact, number), rows(tmp_path / "again", number)
        assert len(before) == len(after) > 10
        for one, other in zip(before, after, strict=True):
            assert one.keys() == other.keys() == CONTRACT.features().keys()
            for key, value in one.items():
                np.testing.assert_array_equal(other[key], value)
    kept = [json.loads((root / "meta/ibrobot.json").read_text()) for root in (exact, tmp_path / "again")]
    assert kept[0]["configs"] == kept[1]["configs"]
    assert kept[0]["fingerprint"] == kept[1]["fingerprint"]
    assert list(kept[0]["calibrations"].values()) == list(kept[1]["calibrations"].values()) == [CALIBRATION]


def test_what_an_episode_says_of_itself_comes_back(exact: Path, convert: Convert, tmp_path: Path):
    assert convert(exact, "--to", "bag", "--out", tmp_path / "back", "--episodes", "1-2").returncode == 0
    folders = sorted((tmp_path / "back/episodes").iterdir())
    assert [folder.name for folder in folders] == ["episode_000002", "episode_000003"]
    reader = installed_plugins().open_episode(folders[0])
    summary = reader.summary()
    reader.close()
    assert (summary.outcome, summary.finished) == ("failure", True)
    metadata = summary.metadata
    assert (metadata["prompt"], metadata["mode"], metadata["robot"], metadata["source"]) == (
        "sort 2",
        "mode 2",
        "bench",
        "exact:1",
    )
    assert json.loads(metadata["config"]) == ROBOT
    assert Contract.from_canonical(json.loads(metadata["contract"])).fingerprint() == metadata["fingerprint"]
    assert metadata["fingerprint"] in (tmp_path / "back/dataset.yaml").read_text()
    assert 0 <= summary.start_ns - START_NS < 1e9
    assert {topic: each.type for topic, each in summary.topics.items()} == dict(CONTRACT.topics)


@pytest.mark.parametrize("norm_mode", ["degrees", "range_m100_100"])
def test_joints_in_other_units_come_back_in_radians(
    bags: Path, exact: Path, convert: Convert, tmp_path: Path, norm_mode: str
):
    assert convert(bags, "--out", tmp_path / "units", "--no-videos", "--norm-mode", norm_mode).returncode == 0
    assert convert(tmp_path / "units:0", "--to", "bag", "--out", tmp_path / "back").returncode == 0
    assert convert(tmp_path / "back", "--out", tmp_path / "again", "--no-videos").returncode == 0
    for one, other in zip(rows(exact, 0), rows(tmp_path / "again", 0), strict=True):
        for key in ("observation.state", "action"):
            np.testing.assert_allclose(other[key], one[key], atol=1e-5)


def test_joints_in_the_units_of_a_plugin_come_back_by_it_or_not_at_all(
    exact: Path, convert: Convert, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Its degrees are not LeRobot's: by the calibration, all would come back elsewhere, in silence."""
    shutil.copytree(exact, tmp_path / "units")
    note = tmp_path / "units/meta/ibrobot.json"
    kept = json.loads(note.read_bytes())
    kept["conversion"] |= {"norm_mode": "degrees", "units": "other_units"}
    note.write_text(json.dumps(kept))
    done = convert(tmp_path / "units:0", "--to", "bag", "--out", tmp_path / "back")
    assert done.returncode == 1
    assert "unknown units type 'other_units'" in done.stderr
    with made_up_site(tmp_path / "site", PLUGINS, monkeypatch) as site:
        site.add("other-units", "other_units.py")
        with closing(installed_plugins().open_episode(tmp_path / "units:0")) as reader:
            read = [each.message for each in reader.messages(["/joint_states"]) if isinstance(each.message, JointState)]
    stated = np.array([row["observation.state"] for row in rows(exact, 0)])
    np.testing.assert_allclose([each.position for each in read], np.radians(stated), rtol=1e-6)


def test_pictures_of_videos_come_back_in_step(bags: Path, exact: Path, convert: Convert, tmp_path: Path):
    assert convert(bags, "--out", tmp_path / "videos", "--codec", "h264", "--crf", "20").returncode == 0
    # Straight from one dataset into another.
    assert convert(tmp_path / "videos:2", "--out", tmp_path / "again", "--no-videos").returncode == 0
    for one, other in zip(rows(exact, 2), rows(tmp_path / "again", 0), strict=True):
        for key in ("observation.images.top", "observation.images.wrist"):
            assert np.abs(one[key].astype(int) - other[key]).mean() < 10


def test_interrupted_it_goes_on_where_it_was(exact: Path, convert: Convert, tmp_path: Path):
    out = tmp_path / "back"
    assert convert(exact, "--to", "bag", "--out", out, "--episodes", "0").returncode == 0
    half = out / ".staging/episode_000002"  # what a kill leaves behind
    half.mkdir(parents=True)
    (half / "episode_000002_0.mcap").write_bytes(b"half")
    done = convert(exact, "--to", "bag", "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["episodes"], report["passed_over"]) == (2, 1)
    assert sorted(path.name for path in out.iterdir()) == ["dataset.yaml", "episodes"]
    assert len(list((out / "episodes").iterdir())) == 3


def test_equal_datasets_give_equal_bags(exact: Path, convert: Convert, tmp_path: Path):
    files = []
    for name in ("one", "two"):
        assert convert(exact, "--to", "bag", "--out", tmp_path / name, "--episodes", "2").returncode == 0
        files.append((tmp_path / name / "episodes/episode_000003/episode_000003_0.mcap").read_bytes())
    assert files[0] == files[1]


def test_another_episode_of_the_same_number_is_not_overwritten(exact: Path, bags: Path, convert: Convert):
    done = convert(exact, "--to", "bag", "--out", bags, "--episodes", "0")
    assert done.returncode == 1
    assert "episode_000001: is another episode (a recording); convert into another folder" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--to", "bag", "--append"], "--append does not apply to --to bag"),
        (["--to", "bag", "--units", "calibrated"], "--units does not apply to --to bag"),
        (["--episodes", "0"], "--episodes does not apply to --to dataset"),
        (["--to", "bag", "--episodes", "0,7"], "0,7: the dataset's episodes are 0 to 2"),
        (["--to", "bag", "--episodes", "all"], "'all' is neither a number nor a range"),
    ],
)
def test_options_that_cannot_be_meant(exact: Path, convert: Convert, tmp_path: Path, arguments: list[str], words: str):
    done = convert(exact, "--out", tmp_path / "out", *arguments)
    assert done.returncode == 2
    assert words in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_foreign_dataset_is_described_by_a_robot_yaml(exact: Path, convert: Convert, tmp_path: Path):
    (tmp_path / "theirs").mkdir()
    subprocess.run(["cp", "-r", f"{exact}/.", str(tmp_path / "theirs")], check=True)
    (tmp_path / "theirs/meta/ibrobot.json").unlink()
    done = convert(tmp_path / "theirs", "--to", "bag", "--out", tmp_path / "back")
    assert done.returncode == 1
    assert "was not made by ibrobot, so it does not name its robot" in done.stderr
    assert not (tmp_path / "back").exists()
    robot = {
        "robot": ROBOT["robot"]
        | {
            "joints": [each | {"max_velocity": 1, "max_acceleration": 1} for each in ROBOT["robot"]["joints"]],
            "groups": {"arm": list(JOINTS)},
        },
        "hardware": {"type": "feetech_so101", "port": "/dev/null", "calibration": "bench"},
        "executors": {"arm": {"type": "position", "group": "arm"}},
        "control_modes": {"idle": {"executors": ["arm"]}},
        "default_control_mode": "idle",
        "contract": {
            "rate_hz": 30,
            "observations": [{"key": "observation.state", "topic": "/joint_states"}],
            "actions": [{"executor": "arm", "topic": "/commands"}],
        },
    }
    (tmp_path / "theirs.yaml").write_text(json.dumps(robot))
    arguments = ["--config", tmp_path / "theirs.yaml", "--norm-mode", "radians"]
    done = convert(tmp_path / "theirs", "--to", "bag", "--out", tmp_path / "back", *arguments)
    assert done.returncode == 0, done.stderr
    reader = installed_plugins().open_episode(tmp_path / "back/episodes/episode_000001")
    items = [item for item in reader.messages({"/joint_states"})]
    metadata = reader.summary().metadata
    reader.close()
    assert isinstance(items[3].message, JointState)
    np.testing.assert_array_equal(items[3].message.position, rows(exact, 0)[3]["observation.state"])
    assert (metadata["prompt"], metadata["robot"]) == ("sort 1", "bench")
    info = tmp_path / "theirs/meta/info.json"
    document = json.loads(info.read_text())
    document["features"]["action"]["names"] = {"motors": list(reversed(JOINTS))}
    info.write_text(json.dumps(document))
    done = convert(tmp_path / "theirs", "--to", "bag", "--out", tmp_path / "other", *arguments)
    assert done.returncode == 1
    assert "action does not match the contract" in done.stderr
    document["features"]["action"]["names"] = {"motors": None}
    info.write_text(json.dumps(document))
    done = convert(tmp_path / "theirs", "--to", "bag", "--out", tmp_path / "other", *arguments)
    assert done.returncode == 1
    assert f"state it with --names action={JOINTS[0]}.pos" in done.stderr
    arguments += ["--names", f"action={','.join(JOINTS)}"]
    assert convert(tmp_path / "theirs", "--to", "bag", "--out", tmp_path / "other", *arguments).returncode == 0
    arguments[-1] = "action=,"
    assert convert(tmp_path / "theirs", "--to", "bag", "--out", tmp_path / "other", *arguments).returncode == 2


def test_gripper_of_a_robot_without_hardware_is_asked_for(exact: Path, convert: Convert, tmp_path: Path):
    shutil.copytree(exact, tmp_path / "theirs")
    (tmp_path / "theirs/meta/ibrobot.json").unlink()
    (tmp_path / "arm.json").write_text(json.dumps(CALIBRATION))
    contract = {
        "rate_hz": 30,
        "observations": [{"key": "observation.state", "topic": "/joint_states"}],
        "actions": [{"executor": "arm", "topic": "/commands"}],
    }
    robot = {
        "robot": ROBOT["robot"]
        | {
            "joints": [each | {"max_velocity": 1, "max_acceleration": 1} for each in ROBOT["robot"]["joints"]],
            "groups": {"arm": list(JOINTS)},
            "description": {"mjcf": str(tmp_path / "arm.xml"), "poses": {"rest": [0] * len(JOINTS)}},
        },
        "simulation": {"type": "mujoco"},
        "executors": {"arm": {"type": "position", "group": "arm"}},
        "control_modes": {"idle": {"executors": ["arm"]}},
        "default_control_mode": "idle",
        "contract": contract,
    }
    bodies = "".join(f'<body><joint name="{joint}" range="-1.5 1.5"/><geom size=".1"/></body>' for joint in JOINTS)
    actuators = "".join(f'<position name="{joint}" joint="{joint}"/>' for joint in JOINTS)
    model = (
        f"<mujoco><compiler angle='radian'/><worldbody>{bodies}</worldbody><actuator>{actuators}</actuator></mujoco>"
    )
    (tmp_path / "arm.xml").write_text(model)
    (tmp_path / "sim.yaml").write_text(json.dumps(robot))
    arguments: list[Any] = ["--to", "bag", "--config", tmp_path / "sim.yaml", "--norm-mode", "degrees"]
    arguments += ["--calibration", tmp_path / "arm.json", "--out", tmp_path / "back"]
    done = convert(tmp_path / "theirs", *arguments)
    assert done.returncode == 1
    assert "range from 0 to 100" in done.stderr
    assert not (tmp_path / "back").exists()
    done = convert(tmp_path / "theirs", *arguments, "--anchored", "jaw")
    assert "the robot has no joint 'jaw'" in done.stderr
    done = convert(tmp_path / "theirs", *arguments, "--anchored", JOINTS[-1])
    assert done.returncode == 0, done.stderr
