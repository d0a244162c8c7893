"""`ibrobot camera mount`: made-up sessions give their mounts back, and bad ones are refused with the reason."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import attrs
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_camera.intrinsics.board import Board
from ibrobot_camera.mounting import episode
from ibrobot_camera.mounting.closed import SOLVERS, solved
from ibrobot_camera.mounting.edit import with_transform
from ibrobot_camera.mounting.fit import Session
from ibrobot_camera.mounting.shots import shot_of
from ibrobot_camera.mounting.solve import solve_mount
from ibrobot_kinematics.frames import transform
from ibrobot_kinematics.link_chain import Chain
from ibrobot_kinematics.poses import homogeneous, matrix
from ibrobot_kinematics.rotations import exp
from ibrobot_kinematics.urdf import read_urdf

from ibrobot_core.api import JOINT_STATES, CameraInfo, Header, IbrobotError, Pose, SensorError
from ibrobot_core.app import parse_yaml

from .mount_rig import JOINTS, LENS, OPTICAL, made, off, urdf

IN_MOUNT = OPTICAL["in its mount"]


@pytest.mark.parametrize("in_hand", [True, False], ids=["in hand", "on a stand"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_mount_is_found_with_noise_and_a_fifth_of_outliers(tmp_path: Path, in_hand: bool, seed: int) -> None:
    truth = made(tmp_path, seed, in_hand=in_hand, outliers=0.2)
    result = solve_mount(truth.session)
    mm, degrees = off(result.place @ IN_MOUNT, truth.camera)
    assert mm < 3.0
    assert degrees < 0.5
    assert sorted(result.dropped) == sorted(truth.wrong)
    assert off(result.board, truth.board)[0] < 3.0
    text = "\n".join(result.lines())
    assert all(f"left out: {name}, " in text for name in truth.wrong)
    assert {"Park", "Shah"} == set(result.solvers)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_of_an_arm_that_is_not_exact_the_closed_form_counts(tmp_path: Path, seed: int) -> None:
    truth = made(tmp_path, seed, noise=0.3, shaken=0.005)
    fit = truth.session.fit()
    refined = off(truth.session.some(fit.used).refined(fit.camera, fit.board)[0], truth.camera)[0]
    assert off(fit.camera, truth.camera)[0] < min(10.0, refined)


def test_from_a_measured_place_the_mount_follows_without_motion(tmp_path: Path) -> None:
    truth = made(tmp_path, outliers=0.2, measured=True)
    result = solve_mount(truth.session)
    assert off(result.place @ IN_MOUNT, truth.camera)[0] < 3.0
    still = made(tmp_path, spread=0.0, measured=True, count=5)
    assert off(solve_mount(still.session).place @ IN_MOUNT, still.camera)[1] < 1.0


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "too few": ({"count": 5}, r"5 pictures can be used, at least 8 are needed"),
    "none": ({"count": 0}, r"0 pictures can be used"),
    "still": ({"spread": 0.001}, r"turns the camera or the board by at most 0 degrees, at least 20"),
    "wrist only": ({"spread": np.array([0, 0, 0, 0, 0.6, 0])}, r"about one axis only .* turn the wrist, too"),
    "in a plane": ({"spread": np.array([0, 0.3, 0.3, 0.3, 0, 0])}, r"about one axis only .* turn the wrist, too"),
    "board moved": ({"moves_at": 9}, r"before and after picture (8|9|10) fit each other.* the camera has moved"),
    "names exchanged": ({"swapped": (0, 4)}, r"fit if the readings of pan and roll are exchanged"),
    "parallel joints exchanged": ({"swapped": (1, 2)}, r"fit if the readings of lift and elbow are exchanged"),
    "reversed": ({"reversed_": 4}, r"fit if roll turns the other way: is it reversed"),
    "large squares": ({"square": 1.1, "in_hand": False}, r"the squares of the board are 1\.1\d* times as large"),
    "small squares": ({"square": 0.9}, r"the squares of the board are 0\.[89]\d* times as large as stated"),
    "another size": ({"size": (1280, 960)}, r"has 1280x960 pixels, the calibration is for 640x480"),
    "an arm that lies": ({"shaken": 0.1, "in_hand": False}, r"zeros of the joints and the URDF right|agree with one"),
    "half of them wrong": ({"outliers": 0.5}, r"of 20 pictures only \d+ agree with one another"),
}  # fmt: skip


SLOW = ("board moved", "names exchanged", "parallel joints exchanged", "reversed", "large squares", "small squares",
        "an arm that lies", "half of them wrong")  # fmt: skip
"""Sessions of which the search tries many explanations."""


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[pytest.mark.long] * (kind in SLOW)) for kind in BAD])
def test_a_session_that_cannot_tell_is_refused_with_the_reason(tmp_path: Path, kind: str) -> None:
    options, reason = BAD[kind]
    with pytest.raises(SensorError, match=reason):
        solve_mount(made(tmp_path, **options).session)


def test_pictures_that_do_not_count_are_named_where_too_few_remain(tmp_path: Path) -> None:
    with pytest.raises(SensorError, match=r"at least 8 are needed: the arm stood still 9 times, but 4 show nothing"):
        solve_mount(made(tmp_path, count=5).session, ": the arm stood still 9 times, but 4 show nothing")


poses = st.builds(
    lambda turn, place: homogeneous(exp(np.array(turn)), np.array(place)),
    st.tuples(*[st.floats(-1.5, 1.5)] * 3), st.tuples(*[st.floats(-1, 1)] * 3),
)  # fmt: skip


@settings(max_examples=30, deadline=None)
@given(camera=poses, board=poses, seed=st.integers(0, 99))
@pytest.mark.parametrize("name", SOLVERS)
def test_each_solver_closes_the_loop(name: str, camera: Any, board: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    arm = np.array([homogeneous(exp(rng.normal(0, 0.8, 3)), rng.normal(0, 0.3, 3)) for _ in range(8)])
    x, y = solved(arm, np.linalg.inv(camera) @ arm @ board, SOLVERS[name])
    np.testing.assert_allclose(x, camera, atol=1e-6)
    np.testing.assert_allclose(y, board, atol=1e-6)


@pytest.mark.skipif(not hasattr(cv2, "calibrateHandEye"), reason="this OpenCV has no bindings of its solvers")
def test_solvers_agree_with_opencv(tmp_path: Path) -> None:
    session = made(tmp_path, noise=0.3).session
    inverse = np.linalg.inv(session.arm)
    solve: Any = cv2.calibrateHandEye  # type: ignore[attr-defined, unused-ignore]
    turn, place = solve(list(inverse[:, :3, :3]), list(inverse[:, :3, 3]), list(session.seen[:, :3, :3]),
                        list(session.seen[:, :3, 3]), method=cv2.CALIB_HAND_EYE_PARK)  # fmt: skip
    mm, degrees = off(solved(session.arm, session.seen, SOLVERS["Park"])[0], homogeneous(turn, place.ravel()))
    assert mm < 1.0
    assert degrees < 0.1


def test_the_chain_is_the_one_of_the_frames(tmp_path: Path) -> None:
    arm, q = read_urdf(urdf(tmp_path)), np.array([0.3, -0.2, 0.5, 0.1, -0.7, 0.2])
    placed = np.eye(4)
    for joint in arm.chain("base", "hand") or ():
        each = transform(joint, float(q[JOINTS.index(joint.name)]), 0)
        placed = placed @ matrix(Pose(each.translation, each.rotation))
    chain = Chain(arm, JOINTS, "base", "hand")
    np.testing.assert_allclose(chain.pose(q), placed, atol=1e-12)
    assert chain.names == JOINTS[:5]
    both = Chain(arm, JOINTS, "jaw", "hand")
    assert both.names == ("gripper",)


def test_a_link_or_joint_that_is_missing_is_named(tmp_path: Path) -> None:
    arm = read_urdf(urdf(tmp_path))
    with pytest.raises(IbrobotError, match="has no link 'hnd', did you mean 'hand'"):
        Chain(arm, JOINTS, "hnd", "base")
    with pytest.raises(IbrobotError, match=r"elbow moves between hand and base, but is not in robot\.joints"):
        Chain(arm, [name for name in JOINTS if name != "elbow"], "hand", "base")


def test_the_same_pictures_give_the_same_mount(tmp_path: Path) -> None:
    session = made(tmp_path, outliers=0.2).session
    again = Session(session.shots, session.chain, LENS)
    assert solve_mount(session).xyz == solve_mount(again).xyz


MOUNT: dict[str, Any] = {"parent": "hand", "xyz": (0.1, -0.02, 0.3), "rpy": (0.0, 1.25, -0.5)}
TEXTS = {
    "flow": "a: 1\nperipherals:   # what looks\n  - {name: top, kind: camera}   # above\n"
    "  - {name: wrist, kind: camera} # W\nb: 2\n",
    "block": "peripherals:\n  # above\n  - name: top\n    kind: camera  # a kind\n\n"
    "  - name: wrist   # W\n    kind: camera\n",
    "last line": "peripherals:\n- name: wrist\n  kind: camera",
    "has one": "peripherals:\n  - name: wrist  # W\n    transform:\n      # from a ruler\n      parent: base  # B\n"
    "      xyz: [1, 2, 3]  # m\n    kind: camera\nb: 2\n",
    "has a flow one": "peripherals:\n  - {name: wrist, transform: {parent: base, frame: eye}, kind: camera}  # W\n",
    "several lines": "peripherals:\n  - {name: wrist, kind: camera,   # W\n"
    "     device: '${X:0}', transform: {parent: base,\n     rpy: [0, 0, 0]}}\n",
}


@pytest.mark.parametrize("kind", TEXTS)
def test_the_mount_is_put_into_the_text_and_comments_stay(kind: str) -> None:
    text = TEXTS[kind]
    changed = with_transform(text, "wrist", MOUNT)
    comments = [line.partition("#")[2] for line in text.splitlines() if "#" in line]
    assert [line.partition("#")[2] for line in changed.splitlines() if "#" in line] == comments
    root = parse_yaml(changed, "", expands=False).root
    (wrist,) = (each for each in root["peripherals"] if each["name"] == "wrist")
    mount = wrist["transform"]
    expected = {key: value if isinstance(value, str) else list(value) for key, value in MOUNT.items()}
    assert {key: mount[key] for key in MOUNT} == expected
    assert with_transform(changed, "wrist", MOUNT) == changed


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("a: 1", "has no peripheral 'wrist'"),
        ("peripherals: [{name: top}]", "has no peripheral 'wrist'"),
        ("a: [", "is not YAML"),
        ("peripherals: [{name: wrist, transform: 3}]", "transform must be a mapping"),
        ("peripherals: {wrist: 1}", "has no peripheral"),
    ],
)
def test_a_text_that_cannot_take_the_mount_is_refused(text: str, wrong: str) -> None:
    with pytest.raises(IbrobotError, match=wrong):
        with_transform(text, "wrist", MOUNT)


def test_corners_that_are_not_of_the_board_are_left_out(tmp_path: Path) -> None:
    truth = made(tmp_path)
    shot = truth.session.shots[0]
    corners = shot.view.corners.copy()
    corners[:8] += 25.0
    kept = shot_of(attrs.evolve(shot.view, corners=corners), shot.joints, LENS)
    assert kept is not None
    assert len(kept.view.ids) <= len(corners) - 8
    assert off(kept.board, shot.board)[0] < 2.0


@pytest.mark.parametrize(
    ("info", "wrong"),
    [
        ({"k": np.ones(9), "distortion_model": "equidistant"}, "distortion model equidistant is not supported"),
        ({"k": np.ones(9), "d": np.ones(8)}, "the calibration has 8 numbers of distortion, plumb_bob has at most 5"),
        ({"k": np.array([-5.0, 0, 3, 0, 5, 2, 0, 0, 1])}, "the calibration has no finite focal lengths"),
        ({"k": np.array([np.nan, 0, 3, 0, 5, 2, 0, 0, 1])}, "the calibration has no finite focal lengths"),
        ({"k": np.ones(9), "d": np.full(5, np.inf)}, "the calibration has no finite focal lengths"),
    ],
)
def test_a_calibration_that_cannot_be_used_is_named_with_its_episode(
    monkeypatch: pytest.MonkeyPatch, info: dict[str, Any], wrong: str
) -> None:
    message = attrs.evolve(CameraInfo(Header(0, "eye"), 48, 64), **info)
    reader = SimpleNamespace(
        summary=lambda: SimpleNamespace(topics=(JOINT_STATES, "/camera/eye/image_raw")),
        messages=lambda topics: [SimpleNamespace(message=message)],
        close=lambda: None,
    )
    monkeypatch.setattr(episode, "installed_plugins", lambda: SimpleNamespace(open_episode=lambda path: reader))
    source = episode.Source("/camera/eye/image_raw", JOINTS, (0,), Board(), None)
    with pytest.raises(SensorError, match=f"^bag: /camera/eye/image_raw: {wrong}"):
        source.read(Path("bag"), "")
