"""`ibrobot camera mount` of a recorded episode whose pictures MuJoCo has rendered, and what uses its result."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import attrs
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from ibrobot_mujoco.gl import choose

from ibrobot_core.errors import MissingDependency

pytestmark = pytest.mark.integration

ROBOT = Path("configs/so101.yaml")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with episodes: `good`, `still` (the arm never stops), and `bare` (no calibration); and the truth."""
    try:
        chosen = {"MUJOCO_GL": choose()}
    except MissingDependency as missing:
        pytest.skip(f"nothing renders here: {missing}")
    folder = tmp_path_factory.mktemp("mount")
    done = subprocess.run(
        [sys.executable, __file__, folder], env={**os.environ, **chosen, "PYTHONPATH": "tests/shared"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder


def run(*arguments: str) -> tuple[int, str]:
    """The exit status and output of `ibrobot camera mount`."""
    from ibrobot_testing.command import command_line

    ran = CliRunner().invoke(command_line("camera"), ["mount", *arguments, "--columns", "8", "--rows", "6"])
    return ran.exit_code, ran.output + str(ran.exception or "")


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A robot YAML of one's own."""
    return Path(shutil.copy(ROBOT, tmp_path / "desk.yaml"))


def test_the_mount_is_written_into_the_robot_yaml_and_used(recorded: Path, robot: Path) -> None:
    from ibrobot_kinematics.frames import mounted
    from ibrobot_mujoco.arm_view import ArmView
    from ibrobot_web.objects import mounts

    from ibrobot_core.api import CameraInfo, Header
    from ibrobot_core.app import load_config

    before = robot.read_text()
    code, output = run(str(robot), str(recorded / "good"), "--camera", "wrist", "--on", "gripper_link", "--write")
    assert code == 0, output
    truth = np.loadtxt(recorded / "truth.txt")
    transform = next(each for each in yaml.safe_load(robot.read_text())["peripherals"] if each["name"] == "wrist")[
        "transform"
    ]
    assert transform["parent"] == "gripper_link"
    assert 1000 * np.linalg.norm(np.array(transform["xyz"]) - truth[:3]) < 3.0
    assert np.degrees(np.abs(np.array(transform["rpy"]) - truth[3:])).max() < 0.5
    assert "left out: 10.5 s, " in output  # in it, the board has slipped
    comments = [line.partition("#")[2] for line in before.splitlines() if "#" in line]
    assert [line.partition("#")[2] for line in robot.read_text().splitlines() if "#" in line] == comments
    config = load_config(robot)
    (frame,) = mounted(config)
    assert [each.child_frame_id for each in frame.transforms(0)] == ["wrist_frame", "wrist_optical_frame"]
    (shown,) = mounts(config.peripherals)
    assert (shown["parent"], shown["xyz"]) == ("gripper_link", transform["xyz"])
    k = np.array([579.4, 0, 319.5, 0, 579.4, 239.5, 0, 0, 1])
    view = ArmView(config, "wrist", CameraInfo(Header(0), 480, 640, k=k), (240, 320))
    try:
        assert not view.stands  # it moves with the gripper, whose link has another name in the MJCF
        assert 0.02 < 1 - view.moving(np.zeros(6)).mean() < 0.9
    finally:
        view.close()


@pytest.mark.parametrize(
    ("episode", "more", "reason"),
    [
        ("still", (), "0 pictures can be used, at least 8 are needed: the arm stood still 0 times"),
        ("bare", (), "the camera has no calibration on /camera/wrist/camera_info"),
        ("good", ("--square", "12"), "times as large as stated: measure a row of them"),
        ("blurred", (), r"but 20 pictures are blurred"),
        ("good", ("--on", "gripper"), "has no link 'gripper'"),
        ("good", ("--on", "base_link"), "no joint moves base_link against base_link"),
        ("good", ("--board-at", "1,2"), "must be six numbers"),
        ("good", ("--camera", "side"), "has no camera 'side'; it has: top, wrist"),
        ("good", ("--camera", "top"), r"has no pictures (/camera/top/image_raw)"),
    ],
)
def test_an_episode_that_cannot_tell_is_refused_with_the_reason(
    recorded: Path, robot: Path, episode: str, more: tuple[str, ...], reason: str
) -> None:
    before = robot.read_text()
    usual = ("--camera", "wrist", "--on", "gripper_link", "--write")
    code, output = run(str(robot), str(recorded / episode), *usual, *more)
    assert code != 0
    assert reason in output
    assert robot.read_text() == before


def answers(robot: Path | str, episode: Path, **changes: str | bool) -> dict[str, str | bool]:
    """Of an operator on the page."""
    return {
        "robot": str(robot), "episode": str(episode), "camera": "wrist", "on": "gripper_link", "board_on": "",
        "board_at": "", "squares": "8 x 6", "square": "25", "simulated": False, **changes,
    }  # fmt: skip


def test_the_page_measures_the_same_and_writes_it_if_the_operator_agrees(recorded: Path, robot: Path) -> None:
    from ibrobot_camera.commands.mount import guided, questions
    from ibrobot_terminal.fakes import FakeGuide

    assert {each.name for each in questions()} == set(answers(robot, recorded))
    guide = FakeGuide()
    guided(answers(robot, recorded / "good"), guide)
    assert any("cross-validation" in text for text in guide.said)
    assert guide.said[-1] == f"{robot}: the mount of wrist is written"
    (transform,) = [each.get("transform") for each in yaml.safe_load(robot.read_text())["peripherals"][1:]]
    assert str(transform["xyz"]) in " ".join(guide.said)
    shipped = FakeGuide()
    guided(answers("so101", recorded / "good"), shipped)
    assert shipped.said[-1].startswith("This robot is shipped with ibrobot")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"squares": "8"}, "give its squares as 10 x 7"),
        ({"squares": "8 x 99"}, "give its squares as 10 x 7"),
        ({"square": "wide"}, "give its squares as 10 x 7"),
        ({"on": "gripper"}, "has no link 'gripper'"),
        ({"camera": "side"}, "has no camera 'side'; it has: top, wrist"),
    ],
)
def test_wrong_answers_are_named(recorded: Path, robot: Path, changes: dict[str, str], reason: str) -> None:
    from ibrobot_camera.commands.mount import guided
    from ibrobot_terminal.fakes import FakeGuide

    from ibrobot_core.errors import IbrobotError

    before = robot.read_text()
    with pytest.raises(IbrobotError, match=reason):
        guided(answers(robot, recorded / "good", **changes), FakeGuide())
    assert robot.read_text() == before


def test_a_shipped_robot_is_not_written(recorded: Path) -> None:
    code, output = run("so101", str(recorded / "good"), "--camera", "wrist", "--on", "gripper_link", "--write")
    assert code != 0
    assert "is shipped with ibrobot: `ibrobot config copy` makes a file of your own" in output


def write_episodes(folder: Path) -> None:
    """Record episodes of a simulated arm that looks at a board."""
    import cv2
    from ibrobot_kinematics.rotations import rpy
    from ibrobot_mcap.options import McapOptions
    from ibrobot_mcap.recorder import McapRecorder
    from ibrobot_ros2.jpeg import to_jpeg
    from ibrobot_testing import host_context
    from mount_scene import HEIGHT, MATRIX, OPTICAL, USUAL, WIDTH, Scene, rig, slipped

    from ibrobot_core.api import CameraInfo, CompressedImage, EpisodeEnd, EpisodeStart, Header, Image, JointState
    from ibrobot_core.app import find_config, installed_plugins, load_config

    config = load_config(find_config("so101", installed_plugins()), sim=True)
    rng = np.random.default_rng(5)
    each = rig(config, rng)
    mount = each.camera @ OPTICAL.T
    np.savetxt(folder / "truth.txt", [*mount[:3, 3], *rpy(mount[:3, :3])])
    info = CameraInfo(Header(0, "wrist_optical_frame"), HEIGHT, WIDTH, d=np.zeros(5), k=MATRIX.ravel())
    shown = []
    with Scene(config, each.camera, folder) as scene:
        for number, joints in enumerate(each.joints):
            placed = each.board @ slipped(rng) if number in (3, 11) else each.board
            shown.append(scene.picture(joints, placed))
        between = scene.picture(USUAL, each.board)
    pictures = {id(picture): picture for picture in (*shown, between)}

    @cache  # most pictures are shown several times
    def encoded(number: int, blurred: bool) -> CompressedImage:
        picture = pictures[number]
        if blurred:
            picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 9), np.uint8)
        data = np.ascontiguousarray(picture).reshape(-1)
        return to_jpeg(Image(Header(0), HEIGHT, WIDTH, "rgb8", 3 * WIDTH, data), 90)

    for name in ("good", "still", "bare", "blurred"):
        recorder = McapRecorder(McapOptions(), host_context())
        recorder.begin(EpisodeStart(folder / name, 1_000_000_000, {}, {}, any_topic=True))
        now_ns = 1_000_000_000
        if name != "bare":
            recorder.write("/camera/wrist/camera_info", info, now_ns)
        for joints, seen in zip(each.joints, shown, strict=True):
            for step in range(30):  # 0.6 s in which the arm stands, after 0.3 s in which it moves
                now_ns += 30_000_000
                moves = step < 10 or name == "still"
                at = joints + 0.02 * step if moves else joints
                for part in range(3):
                    stamp_ns = now_ns + 10_000_000 * part
                    recorder.write(
                        "/joint_states", JointState(Header(stamp_ns), config.robot.joint_names, at), stamp_ns
                    )
                if step % 6 == 0:
                    picture = between if moves and name != "still" else seen
                    header = Header(now_ns, "wrist_optical_frame")
                    compressed = attrs.evolve(encoded(id(picture), name == "blurred"), header=header)
                    recorder.write("/camera/wrist/image_raw", compressed, now_ns)
        recorder.end(EpisodeEnd(now_ns, "success"))
        recorder.close()


if __name__ == "__main__":
    write_episodes(Path(sys.argv[1]))
