"""`rectify` in the contract: images of a lens as a pinhole camera takes them, live and converted with the same bits."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_camera.calibration import load_info
from ibrobot_camera.options import OpenCvOptions
from ibrobot_camera.rectify import Rectifier, facts_of
from numpy.typing import NDArray

from ibrobot_core.api import ContractError, Header, SensorError

SIZE = 96, 128
K = [110.0, 0.0, 63.0, 0.0, 112.0, 48.5, 0.0, 0.0, 1.0]
P = [105.0, 0.0, 64.0, 0.0, 0.0, 108.0, 47.0, 0.0, 0.0, 0.0, 1.0, 0.0]
EYE = np.eye(3).ravel().tolist()
LENS: Mapping[str, Any] = {
    "width": 128, "height": 96, "distortion_model": "plumb_bob", "d": [-0.3, 0.08, 0.002, -0.001, 0.0], "k": K,
    "r": EYE, "p": P,
}  # fmt: skip


def scene(seed: int = 0, channels: int = 3) -> NDArray[np.uint8]:
    """A smooth picture, so that a fraction of a pixel makes a small difference."""
    noise = np.random.default_rng(seed).uniform(0, 255, (*SIZE, channels))
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 4.0), np.float64).reshape(*SIZE, channels).astype(np.uint8)


def bent(x: float, y: float, d: list[float]) -> tuple[float, float]:
    """The model plumb_bob, as ROS documents it."""
    k1, k2, p1, p2, k3 = d
    s = x * x + y * y
    radial = 1 + k1 * s + k2 * s**2 + k3 * s**3
    return x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y


def test_each_pixel_comes_from_where_the_lens_shows_it() -> None:
    """By the formulas of ROS, pixel by pixel, without OpenCV."""
    image = scene()
    rectified = Rectifier.of(LENS)(image)
    assert (rectified.shape, rectified.dtype) == (image.shape, image.dtype)
    apart = []
    for row in range(0, 96, 5):
        for column in range(0, 128, 5):
            x, y = bent((column - P[2]) / P[0], (row - P[6]) / P[5], LENS["d"])
            u, v = K[0] * x + K[2], K[4] * y + K[5]
            if not (0 <= u < 127 and 0 <= v < 95):
                continue
            (i, j), (a, b) = (int(v), int(u)), (v % 1, u % 1)
            part = image[i : i + 2, j : j + 2].astype(float)
            wanted = (1 - a) * ((1 - b) * part[0, 0] + b * part[0, 1]) + a * ((1 - b) * part[1, 0] + b * part[1, 1])
            apart.append(np.abs(rectified[row, column] - wanted).max())
    assert len(apart) > 300
    assert max(apart) <= 2.0


@pytest.mark.parametrize(
    ("model", "d"),
    [
        ("rational_polynomial", [0.2, -0.1, 0.001, 0.0005, 0.01, 0.25, -0.05, 0.0]),
        ("equidistant", [-0.02, 0.01, -0.003, 0.0]),
        ("plumb_bob", [-0.3, 0.08, 0.002, -0.001]),
        ("plumb_bob", []),
        ("equidistant", []),
    ],
)
def test_straight_lines_become_straight(model: str, d: list[float]) -> None:
    """A line in space, drawn through the lens, is straight in the rectified image."""
    line = np.stack([np.linspace(-0.45, 0.45, 4000), np.full(4000, 0.28), np.ones(4000)], axis=1)[:, None]
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    coefficients = np.array(d) if d else np.zeros(4)
    seen, _ = project(line, np.zeros(3), np.zeros(3), np.reshape(K, (3, 3)), coefficients)
    image = np.zeros((*SIZE, 1), np.uint8)
    for x, y in np.rint(seen.reshape(-1, 2)).astype(int).tolist():
        if 0 <= x < 128 and 0 <= y < 96:
            image[y, x] = 255
    rectified = Rectifier.of({**LENS, "distortion_model": model, "d": d})(image)[..., 0].astype(float)
    columns = np.flatnonzero(rectified.sum(axis=0) > 128)
    assert len(columns) > 80
    rows = (rectified * np.arange(96)[:, None]).sum(axis=0)[columns] / rectified.sum(axis=0)[columns]
    np.testing.assert_allclose(rows, P[5] * 0.28 + P[6], atol=1.0)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_depth_is_not_mixed_across_an_edge(dtype: type[np.generic]) -> None:
    depth = np.full((*SIZE, 1), 500, dtype)
    depth[:, 60:] = 2000
    rectified = Rectifier.of(LENS)(depth)
    assert {*np.unique(rectified).tolist()} <= {0, 500, 2000}
    assert (rectified.dtype, rectified.shape) == (depth.dtype, depth.shape)
    # The nearest pixel is the one where interpolation is more than halfway between them.
    halfway = Rectifier.of(LENS)(np.where(depth == 500, 0, 255).astype(np.uint8))
    np.testing.assert_array_equal(rectified[40:60, 5:120] == 2000, halfway[40:60, 5:120] >= 127)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_maps_are_made_for_the_first_image_only(dtype: type[np.generic], monkeypatch: pytest.MonkeyPatch) -> None:
    maps, remap = [], cv2.remap

    def noted(image: Any, given: Any, *more: Any) -> Any:
        maps.append(given)
        return remap(image, given, *more)

    monkeypatch.setattr(cv2, "remap", noted)
    rectify = Rectifier.of(LENS)
    for seed in range(2):
        rectify(scene(seed, 1).astype(dtype))
    assert maps[0] is maps[1]


def test_what_the_lens_does_not_show_is_black() -> None:
    wide = [*P]
    wide[0] = wide[5] = 50.0
    rectified = Rectifier.of({**LENS, "p": wide})(np.full((*SIZE, 3), 200, np.uint8))
    assert not rectified[0, 0].any()
    assert (rectified[40:50, 60:70] == 200).all()


def test_a_pinhole_changes_nothing() -> None:
    same = {**LENS, "d": [], "p": [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]}
    image = scene()
    assert Rectifier.of(same)(image) is image


def test_an_image_of_another_size_is_an_error() -> None:
    with pytest.raises(ContractError, match="the calibration is for images of 128x96, this one has 64x48"):
        Rectifier.of(LENS)(np.zeros((48, 64, 3), np.uint8))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "width: must be a whole number from 2 to 8192, not 0"),
        ({"height": True}, "height: must be a whole number from 2 to 8192, not True"),
        ({"height": 10**9}, "height: must be a whole number from 2 to 8192, not 1000000000"),
        ({"distortion_model": "fov"}, "'fov' is none of plumb_bob, rational_polynomial, equidistant"),
        ({"distortion_model": ["plumb_bob"]}, "distortion_model"),
        ({"d": [0.1]}, "plumb_bob has 0 or 4 or 5 coefficients, not 1"),
        ({"d": [float("nan")] * 5}, "d: must be a list of finite numbers"),
        ({"k": [0.0] * 9}, "k: .* is not the matrix of a camera"),
        ({"p": [0.0] * 12}, "p: .* is not the matrix of a camera"),
        ({"r": "none"}, "r: must be a list of finite numbers, not 'none'"),
        ({"r": [1.0] * 8}, "r: must have 9 numbers, not 8"),
        ({"k": None}, "k: must be a list of finite numbers, not None"),
        ({"d": [10**400] * 5}, "d: must be a list of finite numbers"),
        ({"k": [1e300, 0.0, 0.0, 0.0, 1e300, 0.0, 0.0, 0.0, 1.0]}, "k: .* is not the matrix of a camera"),
    ],
)
def test_intrinsics_of_no_camera_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ContractError, match=message):
        Rectifier.of({**LENS, **changes})


values = st.one_of(
    st.none(), st.booleans(), st.integers(-3, 10_000), st.floats(), st.text(max_size=3),
    st.lists(st.one_of(st.floats(), st.none(), st.text(max_size=2), st.just(10**400)), max_size=13),
)  # fmt: skip


@settings(max_examples=100, deadline=None)
@given(lens=st.dictionaries(st.sampled_from([*LENS]), values), given=st.booleans())
def test_damaged_intrinsics_of_a_recording_are_refused_or_used(lens: dict[str, Any], given: bool) -> None:
    try:
        rectify = Rectifier.of({**LENS, **lens} if given else lens)
    except ContractError as error:
        message = str(error)
    else:
        message = ""
        assert min(rectify.width, rectify.height) >= 2
    assert not message or message.startswith("rectify: ")


def test_no_intrinsics_at_all() -> None:
    with pytest.raises(ContractError, match="needs the intrinsics of the camera, not None"):
        Rectifier.of(None)  # type: ignore[arg-type]


def calibration(path: Path) -> Path:
    """As `ibrobot camera calibrate` writes it."""
    matrices = {
        "camera_matrix": K, "distortion_coefficients": LENS["d"], "rectification_matrix": EYE, "projection_matrix": P,
    }  # fmt: skip
    document = {"image_width": 128, "image_height": 96, "distortion_model": "plumb_bob"}
    path.write_text(json.dumps({**document, **{name: {"data": data} for name, data in matrices.items()}}))
    return path


def test_a_camera_has_the_intrinsics_of_its_file(tmp_path: Path) -> None:
    options = OpenCvOptions(device=0, info=calibration(tmp_path / "top.yaml"))
    assert options.lens == LENS
    assert facts_of(load_info(tmp_path / "top.yaml")(Header())) == LENS
    assert json.loads(json.dumps(options.lens)) == LENS


def test_a_camera_without_a_file_says_what_is_missing() -> None:
    with pytest.raises(SensorError, match=r"`info` of the camera: a calibration file, as `ibrobot camera calibrate`"):
        _ = OpenCvOptions(device=0).lens


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff\xfe", "cannot be read"),
        (b"[" * 100_000, "cannot be read"),
        (
            b"image_width: 2\nimage_height: 2\ndistortion_coefficients: {data: [1" + b"0" * 400 + b"]}",
            "must have `data`",
        ),
    ],
    ids=["no text", "deep", "beyond all numbers"],
)
def test_a_damaged_calibration_file_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "top.yaml").write_bytes(content)
    with pytest.raises(SensorError, match=rf"top\.yaml: .*{message}"):
        load_info(tmp_path / "top.yaml")
