"""A rectified camera: what the policy saw, the bag and a conversion have the same bits; what is missing is named."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from ibrobot_data.ticks import frames
from ibrobot_diagnose.pictures import shrink
from ibrobot_diagnose.references import read_episode
from ibrobot_diagnose.rig import STILL_WIDTH
from ibrobot_testing import ibrobot_command
from keeper_robot import keeper_robot

from ibrobot_core.config import find_config, load_config
from ibrobot_core.contract.check import check_policy
from ibrobot_core.contract.frames import FrameAssembler
from ibrobot_core.contract.image import pixels
from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import ConfigError, ContractError
from ibrobot_core.interfaces.policy import PolicySpec
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.messages import Image
from ibrobot_core.plugins import Registry, installed_plugins

pytestmark = pytest.mark.integration

SIZE = 96, 128
TOP = "observation.images.top"
CALIBRATION = {
    "image_width": 128, "image_height": 96, "distortion_model": "plumb_bob",
    "camera_matrix": {"data": [110.0, 0.0, 63.0, 0.0, 112.0, 48.5, 0.0, 0.0, 1.0]},
    "distortion_coefficients": {"data": [-0.3, 0.08, 0.002, -0.001, 0.0]},
    "rectification_matrix": {"data": np.eye(3).ravel().tolist()},
    "projection_matrix": {"data": [105.0, 0.0, 64.0, 0.0, 0.0, 108.0, 47.0, 0.0, 0.0, 0.0, 1.0, 0.0]},
}  # fmt: skip


def video(path: Path) -> Path:
    """A chessboard that moves to the right."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, SIZE[::-1])
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    for number in range(40):
        squares = ((columns + number) // 12 + rows // 12) % 2 * 180 + 40
        writer.write(np.repeat(squares.astype(np.uint8)[..., None], 3, axis=2))
    writer.release()
    return path


def robot(folder: Path, calibration: dict[str, Any] | None = CALIBRATION, policy: str = "fake", **image: Any) -> Path:
    camera: dict[str, Any] = {"name": "top", "kind": "camera", "type": "opencv", "device": str(folder / "top.avi")}
    if not (folder / "top.avi").exists():
        video(folder / "top.avi")
    if calibration is not None:
        (folder / "lens.yaml").write_text(yaml.safe_dump(calibration))
        camera["info"] = str(folder / "lens.yaml")
    observation = {"key": TOP, "peripheral": "top", "image": {"rectify": True, **image}}
    return keeper_robot(folder, policy, camera, observation)


@pytest.fixture
def recorded(site: Any, tmp_path: Path) -> Path:
    """The bag of a run, whose frames are in `KEPT` of the policy."""
    site.add("frame-keeper", "frame_keeper.py")
    config = load_config(robot(tmp_path, policy="picture_keeper", resize=[48, 64]), sim=True)
    runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(lockstep=True, duration_s=1.5)))
    runtime.start()
    try:
        while not runtime.step():
            pass
    finally:
        runtime.stop()
    fingerprint = Contract.from_config(config).fingerprint()
    (tmp_path / "lens.yaml").unlink()  # the recording has the intrinsics
    [path] = (tmp_path / "bags/default/episodes").iterdir()
    assert read(path)[0].fingerprint() == fingerprint
    return path


def read(episode: Path) -> tuple[Contract, list[tuple[str, Any, int]]]:
    """The contract of an episode, and its messages: topic, message, and when it was received [ns]."""
    with closing(installed_plugins().open_episode(episode)) as reader:
        contract = Contract.of_episode(reader.summary().metadata)
        assert contract is not None
        return contract, [(each.topic, each.message, each.received_ns) for each in reader.messages(contract.topics)]


def test_a_policy_sees_what_the_conversion_gives(recorded: Path) -> None:
    kept = sys.modules["frame_keeper"].KEPT
    assert len(kept) > 20
    spec, messages = read(recorded)
    converted = list(frames(FrameAssembler(spec), messages, [frame.stamp_ns for frame in kept]))
    for live, later in zip(kept, converted, strict=True):
        assert live.values.keys() == later.values.keys()
        for key, value in live.values.items():
            np.testing.assert_array_equal(value, later.values[key], strict=True)

    plain = json.loads(json.dumps(spec.canonical()))
    del plain["observations"][TOP][0]["model"]
    distorted = Contract.from_canonical(plain)
    other = list(frames(FrameAssembler(distorted), messages, [kept[-1].stamp_ns]))
    apart = np.abs(other[0].values[TOP].astype(int) - converted[-1].values[TOP].astype(int))
    assert apart.max() > 50, "the pictures are rectified"
    assert "rectify" in spec.difference(distorted)


def convert(*line: str | Path) -> None:
    command = [*ibrobot_command(), "convert", *map(str, line)]
    subprocess.run(command, check=True, capture_output=True, timeout=120)


def test_pictures_of_a_dataset_are_not_rectified_once_more(recorded: Path, tmp_path: Path) -> None:
    """They would be on the way back to a bag, and where a model is asked again."""
    out = tmp_path / "dataset"
    convert(recorded, "--out", out, "--outcome", "unknown", "--jobs", "1")
    info = json.loads((out / "meta/info.json").read_text())
    assert info["features"][TOP]["shape"] == [48, 64, 3]

    robot(tmp_path, resize=[48, 64])
    convert(out, "--to", "bag", "--out", tmp_path / "again", "--config", tmp_path / "tryout.yaml")
    (bag,) = (tmp_path / "again/episodes").iterdir()
    for episode in (tmp_path / "dataset:0", bag):
        pinhole, messages = read(episode)
        pictures = [message for _, message, _ in messages if isinstance(message, Image)]
        assert len(pictures) > 20
        again = frames(FrameAssembler(pinhole), messages, [each.header.stamp_ns for each in pictures])
        for frame, picture in zip(again, pictures, strict=True):
            np.testing.assert_array_equal(frame.values[TOP], picture.data.reshape(48, 64, 3))
        check_policy(read(recorded)[0], PolicySpec({TOP: (48, 64, 3)}, None, 2, 1, contract=pinhole.canonical()))


def test_explain_looks_at_what_the_policy_saw(recorded: Path) -> None:
    """Datasets have such pictures, too. Where a camera is mounted is seen in its own."""
    spec, messages = read(recorded)
    raw = next(np.asarray(pixels(message), np.uint8) for _, message, _ in messages if isinstance(message, Image))
    rectify = spec.parts(TOP)[0].rectifier
    assert rectify is not None
    camera = read_episode(recorded).cameras[TOP]
    np.testing.assert_array_equal(camera.kept[0], shrink(rectify(raw)))
    np.testing.assert_array_equal(next(iter(camera.stills.values())), shrink(raw, STILL_WIDTH))


def test_a_policy_fits_any_lens_but_no_picture_that_is_not_rectified(tmp_path: Path) -> None:
    def contract(**changes: Any) -> Contract:
        return Contract.from_config(load_config(robot(tmp_path, {**CALIBRATION, **changes}), sim=True))

    trained = contract()
    policy = PolicySpec({"observation.state": (2,), TOP: (-1, -1, 3)}, None, 2, 1, contract=trained.canonical())
    other = contract(distortion_coefficients={"data": [0.1, 0.0, 0.0, 0.0, 0.0]})
    assert other.fingerprint() != trained.fingerprint(), "the same messages give other pictures"
    check_policy(other, policy)
    distorted = Contract.from_config(load_config(robot(tmp_path, rectify=False), sim=True))
    with pytest.raises(ContractError, match=r"the policy does not fit the contract(.|\n)*rectify"):
        check_policy(distorted, policy)


@pytest.mark.parametrize("model", [5, None, "rectify", ["rectify"], [["rectify"]]])
def test_a_recorded_contract_with_a_damaged_model_is_refused(tmp_path: Path, model: Any) -> None:
    recorded = Contract.from_config(load_config(robot(tmp_path), sim=True)).canonical()
    recorded["observations"][TOP][0]["model"] = model
    with pytest.raises(ContractError, match="not a recorded contract"):
        Contract.from_canonical(recorded)


@pytest.mark.parametrize(
    ("calibration", "message"),
    [
        (None, r"tryout.yaml:\d+: contract.observations.1.image.rectify: .*`info` of the camera: a calibration file"),
        (
            {**CALIBRATION, "distortion_model": "fov"},
            r"image.rectify: rectify: distortion_model: 'fov' is none of plumb_bob, rational_polynomial, equidistant",
        ),
        ({**CALIBRATION, "camera_matrix": {"data": [0.0] * 9}}, r"image.rectify: rectify: k: .* is not the matrix of"),
        ({**CALIBRATION, "camera_matrix": 3}, r"lens.yaml: camera_matrix: must have `data`"),
    ],
)
def test_missing_and_wrong_intrinsics_are_named(
    tmp_path: Path, calibration: dict[str, Any] | None, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(robot(tmp_path, calibration), sim=True)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (
            {"key": TOP, "topic": "/top", "type": "sensor_msgs/msg/Image", "image": {"rectify": True}},
            "image.rectify: needs a peripheral's lens: camera_info is not read",
        ),
        ({"key": TOP, "peripheral": "top", "image": {"rectify": "side.yaml"}}, "rectify"),
        ({"key": TOP, "peripheral": "top", "image": {"rectifi": True}}, "unknown key, did you mean 'rectify'"),
        ({"key": "observation.state", "topic": "/joint_states", "image": {"rectify": True}}, "needs a"),
    ],
)
def test_where_it_has_no_meaning_it_is_refused(tmp_path: Path, observation: dict[str, Any], message: str) -> None:
    path = robot(tmp_path)
    given = yaml.safe_load(path.read_text())
    given["contract"]["observations"] = [observation]
    path.write_text(yaml.safe_dump(given, sort_keys=False))
    with pytest.raises(ConfigError, match=message):
        load_config(path, sim=True)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (
            {"type": "lerobot", "camera": "zmq"},
            r"a peripheral of type 'lerobot' does not know the intrinsics of its cam",
        ),
        ({"type": "realsense"}, r"image.rectify: needs `info` of the camera: a calibration file"),
    ],
)
def test_a_camera_without_intrinsics(tmp_path: Path, camera: dict[str, Any], message: str) -> None:
    path = robot(tmp_path)
    given = yaml.safe_load(path.read_text())
    given["peripherals"] = [{"name": "top", "kind": "camera", **camera}]
    path.write_text(yaml.safe_dump(given, sort_keys=False))
    with pytest.raises(ConfigError, match=message):
        load_config(path, sim=True)


def test_a_realsense_is_rectified_by_its_calibration_file(tmp_path: Path) -> None:
    path = robot(tmp_path)
    given = yaml.safe_load(path.read_text())
    info = str(tmp_path / "lens.yaml")
    given["peripherals"] = [
        {"name": "top", "kind": "camera", "type": "realsense", "width": 128, "height": 96, "info": info}
    ]
    path.write_text(yaml.safe_dump(given, sort_keys=False))
    part = Contract.from_config(load_config(path)).parts(TOP)[0]
    assert part.model["rectify"]["d"] == [-0.3, 0.08, 0.002, -0.001, 0.0]


def test_without_a_plugin_that_rectifies_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    from ibrobot_core.errors import PluginError

    with pytest.raises(PluginError, match=r"ibrobot-plugin-camera"):
        Registry().rectifier({})


def test_a_simulated_camera_has_no_distortion(tmp_path: Path) -> None:
    so101 = find_config("so101", installed_plugins())
    config = load_config(so101, overrides=["contract.observations.1.image.rectify=true"], sim=True)
    part = Contract.from_config(config).parts(TOP)[0]
    assert part.rectifier is not None
    height, width = config.peripherals["top"].options.picture or (0, 0)
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    np.testing.assert_array_equal(part.rectifier(image), image)
