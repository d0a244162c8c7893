"""Statistics are those of all rows, however they are spread over episodes and merges."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from ibrobot_lerobot import merge as merging
from ibrobot_lerobot.layout import PIXELS
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_lerobot.stats import QUANTILES, DepthStats, PixelStats
from ibrobot_lerobot.writer import LeRobotDatasetWriter
from numpy.typing import NDArray

from ibrobot_core.api import DatasetError, Feature

from .conftest import CAMERA, FPS, rows

FEATURES = {
    "action": Feature("float32", (2,), ("a", "b")),
    "next.success": Feature("bool", (1,)),
    "observation.images.top": CAMERA,
    "observation.depth": Feature("uint16", (32, 32, 1)),
}
LENGTHS = (3, 40, 7)


def frame(episode: int, chance: np.random.Generator) -> dict[str, NDArray[Any]]:
    """Of an episode that is at another place than the others: brighter, farther, on another side."""
    return {
        "action": chance.normal(3 * episode, 0.3, 2).astype(np.float32),
        "next.success": np.array([episode == 1]),
        "observation.images.top": chance.integers(60 * episode, 60 * episode + 90, CAMERA.shape).astype(np.uint8),
        "observation.depth": chance.integers(500 * episode, 500 * episode + 700, (32, 32, 1)).astype(np.uint16),
    }


def make(folder: Path, **options: Any) -> tuple[list[Path], dict[str, NDArray[Any]]]:
    """Datasets of one episode each, and all values of each feature."""
    chance, parts = np.random.default_rng(0), []
    seen: dict[str, list[NDArray[Any]]] = {key: [] for key in FEATURES}
    for episode, length in enumerate(LENGTHS):
        writer = LeRobotDatasetWriter(LeRobotOptions(**options))
        writer.create(folder / str(episode), FPS, FEATURES, {})
        for _ in range(length):
            values = frame(episode, chance)
            writer.add_frame(values, "task")
            for key, value in values.items():
                seen[key].append(value)
        writer.save_episode()
        writer.finalize()
        parts.append(folder / str(episode))
    return parts, {key: np.stack(values) for key, values in seen.items()}


def stats(root: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((root / "meta/stats.json").read_bytes())
    return found


def check(root: Path, seen: dict[str, NDArray[Any]]) -> None:
    found = stats(root)
    for key in ("action", "next.success"):
        for name, share in QUANTILES.items():
            expected = np.quantile(seen[key].astype(float), share, axis=0)
            np.testing.assert_allclose(found[key][name], expected, rtol=1e-6, err_msg=f"{key} {name}")
    index = [row["index"] for row in rows(root)]
    assert found["index"]["q10"] == [np.quantile(index, 0.1)]
    for key, scale in (("observation.images.top", 255.0), ("observation.depth", 1.0)):
        pixels = seen[key].reshape(-1, seen[key].shape[-1]) / scale
        for name, share in QUANTILES.items():
            expected = np.quantile(pixels, share, axis=0, method="inverted_cdf")
            np.testing.assert_allclose(np.ravel(found[key][name]), expected, err_msg=f"{key} {name}")
        np.testing.assert_allclose(np.ravel(found[key]["mean"]), pixels.mean(0))
        np.testing.assert_allclose(np.ravel(found[key]["std"]), pixels.std(0), rtol=1e-6)


def test_quantiles_are_those_of_all_rows_also_after_appending(tmp_path: Path) -> None:
    parts, seen = make(tmp_path / "parts")
    merging.merge(tmp_path / "at_once", parts, {})
    check(tmp_path / "at_once", seen)
    merging.merge(tmp_path / "grown", parts[:1], {})
    for part in parts[1:]:
        merging.merge(tmp_path / "grown", [part], {})
    check(tmp_path / "grown", seen)
    action = seen["action"][:, 0]
    low, high = (stats(tmp_path / "grown")["action"][name][0] for name in ("q01", "q99"))
    assert np.mean((action < low) | (action > high)) <= 0.04


@pytest.mark.parametrize("without", [0, 1, 2])
def test_pictures_of_a_dataset_that_keeps_no_counts_are_counted(tmp_path: Path, without: int) -> None:
    parts, seen = make(tmp_path / "parts", videos=False)  # as exact as the counts
    merging.merge(tmp_path / "set", parts[:1], {})
    for path in (tmp_path / "set", *parts[1:])[: without + 1]:
        (path / PIXELS).unlink()
    merging.merge(tmp_path / "set", parts[1:], {})
    check(tmp_path / "set", seen)
    shutil.rmtree(tmp_path / "set")


@settings(max_examples=50, deadline=None)
@given(arrays.arrays(np.float32, (4, 4, 1), elements=st.floats(0, 1e4, width=32)), st.integers(1, 3))
def test_quantiles_of_depth_in_metres_are_right_to_their_stated_error(depth: NDArray[Any], parts: int) -> None:
    joined = DepthStats("float32")
    for _ in range(parts):
        each = DepthStats("float32")
        each.add(depth)
        joined.join(json.loads(json.dumps(each.state())))
    found = joined.stats()
    for name, share in QUANTILES.items():
        expected = np.quantile(np.tile(depth.ravel().astype(float), parts), share, method="inverted_cdf")
        np.testing.assert_allclose(found[name].item(), expected, rtol=0.004, atol=1e-37)
    assert (found["min"].item(), found["max"].item()) == (depth.min(), depth.max())


def test_depth_that_no_camera_measures_is_refused() -> None:
    for value in (np.nan, -1.0):
        with pytest.raises(DatasetError, match="negative or not finite"):
            DepthStats("float32").add(np.full((2, 2, 1), value, np.float32))


@settings(max_examples=30, deadline=None)
@given(arrays.arrays(np.uint8, (5, 6, 3)))
def test_counts_of_pixels_survive_a_file(image: NDArray[np.uint8]) -> None:
    one, other = PixelStats(3), PixelStats(3)
    one.add(image)
    other.join(json.loads(json.dumps(one.state())))
    assert {name: value.tolist() for name, value in one.stats().items()} == {
        name: value.tolist() for name, value in other.stats().items()
    }
