"""`lerobot-record`, `-replay`, `-teleoperate` and `-rollout`, unmodified, drive a robot of ibrobot in simulation."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import Emulator
from ibrobot_testing.site import made_up_site
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_robot_ibrobot import IbrobotRobot, IbrobotRobotConfig

from ibrobot_core.app import ComponentFailed

sys.path.insert(0, str(Path(__file__).parent))
import made_up_camera  # noqa: F401 - registers itself
from checkpoints import SIZE, STATE, TOP, WRIST, act, save

pytestmark = pytest.mark.lerobot

PLUGINS = Path(__file__).parents[1] / "shared" / "plugins"
ROBOT = ("--robot.type=ibrobot", "--robot.config=so101_blind", "--robot.sim=true")
WAVING = (
    "--teleop.type=ibrobot",
    "--teleop.config=so101_blind",
    "--teleop.sim=true",
    "--teleop.device=waving",
    "--teleop.overrides=['teleoperation.waving={type: waving}']",
)


@pytest.fixture
def run(
    lerobot_command: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., None]]:
    """Runs a command of LeRobot, which has a teleoperator that waves."""
    with made_up_site(tmp_path / "site", PLUGINS, monkeypatch) as site:
        site.add("waving", "waving.py")
        register_third_party_plugins()
        yield lerobot_command


def column(dataset: Path, name: str) -> np.ndarray:
    (file,) = (dataset / "data").rglob("*.parquet")
    return np.array(pq.read_table(file)[name].to_pylist())


def test_commands_drive_a_simulated_robot(run: Callable[..., None], tmp_path: Path) -> None:
    dataset = tmp_path / "dataset"
    data = ("--dataset.repo_id=me/wave", f"--dataset.root={dataset}")
    run(
        "record",
        *ROBOT,
        *WAVING,
        *data,
        "--dataset.num_episodes=1",
        "--dataset.episode_time_s=2",
        "--dataset.reset_time_s=0",
        "--dataset.single_task=wave",
        "--dataset.push_to_hub=false",
        "--play_sounds=false",
    )
    info = json.loads((dataset / "meta" / "info.json").read_text())
    theirs = SO101Follower(SO101FollowerConfig(port="/dev/null", id="any", calibration_dir=tmp_path))
    names = list(theirs.action_features)
    assert info["robot_type"] == "so101_follower"
    for key in (STATE, "action"):
        assert info["features"][key] == {"dtype": "float32", "names": names, "shape": [SIZE]}
    actions, states = column(dataset, "action"), column(dataset, STATE)
    assert np.ptp(actions[:, 0]) > 15.0  # degrees
    assert np.ptp(states[:, 0]) > 10.0
    assert np.ptp(states[:, 1:], axis=0).max() < 3.0

    run("replay", *ROBOT, *data, "--dataset.episode=0", "--play_sounds=false")
    run("teleoperate", *ROBOT, *WAVING, "--fps=30", "--teleop_time_s=1")


@pytest.mark.long  # in stepped time: tests/integration/test_entrances.py, lerobot-robot-ibrobot
def test_the_guard_stops_what_a_program_of_lerobot_sends(run: Callable[..., None], tmp_path: Path) -> None:
    """The wave goes 17 degrees to either side; a wall beside the hand leaves less of one."""
    wall = "world.objects={wall: {shape: box, size: [0.3, 0.02, 0.3], position: [0.3, 0.09, 0.15]}}"
    farthest = {}
    for name, more in (("guarded", ()), ("unguarded", ("control.guard=null",))):
        dataset = tmp_path / name
        overrides = ["simulation={type: mujoco, scene: empty, start_pose: home}", wall, *more]
        run(
            "record",
            *ROBOT,
            f"--robot.overrides={overrides}",
            *WAVING,
            f"--dataset.repo_id=me/{name}",
            f"--dataset.root={dataset}",
            "--dataset.num_episodes=1",
            "--dataset.episode_time_s=3",
            "--dataset.reset_time_s=0",
            "--dataset.single_task=wave",
            "--dataset.push_to_hub=false",
            "--play_sounds=false",
        )
        actions, states = column(dataset, "action")[:, 0], column(dataset, STATE)[:, 0]
        assert (actions.min(), actions.max()) == pytest.approx((-17.2, 17.2), abs=1.5)
        farthest[name] = states.min(), states.max()
    assert farthest["unguarded"] == pytest.approx((-17.2, 17.2), abs=3.0)
    assert np.abs(np.subtract(farthest["guarded"], farthest["unguarded"])).max() > 4.0, "the wall stops nothing"
    assert np.abs(np.subtract(farthest["guarded"], farthest["unguarded"])).min() < 1.0, "the way back is free"


def test_rollout_drives_a_simulated_robot_with_cameras(run: Callable[..., None], tmp_path: Path) -> None:
    """A policy of the features that a dataset from LeRobot's own so101_follower with these cameras has."""
    shapes = {STATE: (SIZE,), TOP: (3, 240, 320), WRIST: (3, 240, 320)}
    kinds = {STATE: FeatureType.STATE, TOP: FeatureType.VISUAL, WRIST: FeatureType.VISUAL}
    config = act(input_features={key: PolicyFeature(kinds[key], shape) for key, shape in shapes.items()})
    joints = {"mean": np.array([0, -80, 80, 40, 0, 20], np.float32), "std": np.full(SIZE, 5.0, np.float32)}
    pictures = {"mean": np.full((3, 1, 1), 0.5, np.float32), "std": np.full((3, 1, 1), 0.3, np.float32)}
    policy = save(config, tmp_path / "checkpoint", {STATE: joints, TOP: pictures, WRIST: pictures, "action": joints})
    run(
        "rollout",
        "--robot.type=ibrobot",
        "--robot.config=so101",
        "--robot.sim=true",
        f"--policy.path={policy}",
        "--policy.device=cpu",
        "--duration=1",
        "--task=wave",
        "--play_sounds=false",
        "--return_to_initial_position=false",
    )


@pytest.fixture
def follower(tmp_path: Path) -> Iterator[tuple[str, ...]]:
    """The options of LeRobot's own so101_follower on an emulated bus, with cameras as the simulated robot has."""
    names = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
    calibration = {name: JointCalibration(servo, 0, 0, 700, 3400) for servo, name in enumerate(names, 1)}
    save_calibration(Calibration(calibration), tmp_path / "arm.json")
    with Emulator() as emulator:
        for servo in emulator.servos.values():
            servo.set("min_position_limit", 700)
            servo.set("max_position_limit", 3400)
        camera = "{type: made_up, width: 320, height: 240, fps: 30}"
        yield (
            "--robot.type=so101_follower",
            f"--robot.port={emulator.port}",
            "--robot.id=arm",
            f"--robot.calibration_dir={tmp_path}",
            f"--robot.cameras={{top: {camera}, wrist: {camera}}}",
        )


@pytest.mark.long
@pytest.mark.usefixtures("patient_buses")
def test_datasets_have_the_features_of_lerobots_own_and_policies_of_one_run_on_the_other(
    run: Callable[..., None], follower: tuple[str, ...], tmp_path: Path
) -> None:
    """Two recordings, two trainings of two steps, two rollouts: one to three minutes."""
    simulated = ("--robot.type=ibrobot", "--robot.config=so101", "--robot.sim=true")
    robots = {"ours": simulated, "theirs": follower}
    features, policies = {}, {}
    small = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1, "n_vae_encoder_layers": 1}
    for name, robot in robots.items():
        out = tmp_path / "out" / name
        dataset = (f"--dataset.repo_id=me/{name}", f"--dataset.root={tmp_path / name}")
        run(
            "record",
            *robot,
            *WAVING,
            "--teleop.pose=home",
            *dataset,
            "--dataset.num_episodes=1",
            "--dataset.episode_time_s=2",
            "--dataset.reset_time_s=0",
            "--dataset.single_task=wave",
            "--dataset.push_to_hub=false",
            "--play_sounds=false",
        )
        info = json.loads((tmp_path / name / "meta" / "info.json").read_text())
        features[name] = info["features"]
        run(
            "train", *dataset, "--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false",
            "--policy.pretrained_backbone_weights=null", *(f"--policy.{key}={value}" for key, value in small.items()),
            "--steps=2", "--save_freq=2", "--batch_size=2", "--num_workers=0", f"--output_dir={out}",
        )  # fmt: skip
        policies[name] = out / "checkpoints" / "last" / "pretrained_model"
    assert features["ours"] == features["theirs"]
    for name, robot in robots.items():
        (other,) = (policy for of, policy in policies.items() if of != name)
        run(
            "rollout",
            *robot,
            f"--policy.path={other}",
            "--policy.device=cpu",
            "--duration=1",
            "--task=wave",
            "--play_sounds=false",
            "--return_to_initial_position=false",
        )


def test_a_fault_is_an_exception_with_its_text(tmp_path: Path) -> None:
    robot = IbrobotRobot(IbrobotRobotConfig(id="any", calibration_dir=tmp_path, config="so101_blind", sim=True))
    robot.connect()
    try:
        observation = robot.get_observation()
        assert list(observation) == list(robot.observation_features)
        with pytest.raises(ComponentFailed, match=r"shoulder_pan\.pos is nan"):
            robot.send_action({**observation, "shoulder_pan.pos": float("nan")})
        assert robot.link._child is not None
        os.kill(robot.link._child.pid, signal.SIGKILL)
        with pytest.raises(ComponentFailed, match="the run has ended: killed by SIGKILL"):
            robot.get_observation()
    finally:
        robot.disconnect()
