"""Datasets as other versions of LeRobot write them, and with the oddities of recordings of real arms."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command_line import run_here
from ibrobot_lerobot import layout
from ibrobot_lerobot.read_contents import dataset_contents
from ibrobot_lerobot.rows import EpisodeRows

from ibrobot_core.api import DatasetError, Feature

from .conftest import CAMERA, check, episodes, values, write

FEATURES = {
    "observation.state": Feature("float32", (3,), ("a.pos", "b.pos", "c.pos")),
    "observation.images.top": CAMERA,
    "observation.effort": Feature("float32", (3,), ("a", "b", "c")),
    "next.reward": Feature("float32", (1,)),
    "action": Feature("float32", (3,), ("a.pos", "b.pos", "c.pos")),
}
LENGTHS = (4, 6, 3)
TOP = "observation.images.top"


def edit(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change `info.json`."""
    info = json.loads((root / "meta/info.json").read_bytes())
    change(info)
    (root / "meta/info.json").write_text(json.dumps(info))


def jsonl(path: Path, lines: list[dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def rewritten(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    pq.write_table(change(pq.read_table(path)), path)


def current(root: Path, **options: Any) -> Path:
    """As LeRobot 0.4 to 0.6 write v3.0: without what ibrobot adds."""
    write(root, FEATURES, LENGTHS, **options)
    for own in ("meta/ibrobot.json", "meta/ibrobot_pixels.json"):
        (root / own).unlink(missing_ok=True)
    return root


def unnamed(root: Path, **options: Any) -> Path:
    """As LeRobot 0.4: the index of the tasks has no name."""
    current(root, **options)
    table = pq.read_table(root / "meta/tasks.parquet")
    names = ["__index_level_0__" if name == "task" else name for name in table.column_names]
    pq.write_table(table.rename_columns(names), root / "meta/tasks.parquet")
    return root


def older(version: str, root: Path, **options: Any) -> Path:
    """v2.0 and v2.1: files of one episode each, and lines of JSON."""
    parts, begin = [], 0
    for number, length in enumerate(LENGTHS):
        part = root.with_name(f"{root.name}-{number}")
        writer = write(part, FEATURES, (length,), begin=begin, task=number % 2, **options)
        parts.append(writer)
        table = pq.read_table(part / "data/chunk-000/file-000.parquet")
        shift = {"index": begin, "episode_index": number, "task_index": number % 2}
        for name, offset in shift.items():
            at = table.schema.get_field_index(name)
            table = table.set_column(at, name, pa.array([value + offset for value in table.column(name).to_pylist()]))
        target = root / f"data/chunk-000/episode_{number:06d}.parquet"
        target.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, target)
        for video in part.rglob("*.mp4"):
            copy = root / f"videos/chunk-000/{TOP}/episode_{number:06d}.mp4"
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(video, copy)
        begin += length
    meta = root / "meta"
    meta.mkdir()
    shutil.copy(parts[0] / "meta/info.json", meta / "info.json")
    edit(root, lambda info: info.update(
        codebase_version=version, total_episodes=len(LENGTHS), total_frames=begin, total_tasks=2,
        data_path="data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        video_path="videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    ))  # fmt: skip
    jsonl(meta / "tasks.jsonl", [{"task_index": i, "task": f"task {i}"} for i in range(2)])
    rows = [{"episode_index": i, "tasks": [f"task {i % 2}"], "length": n} for i, n in enumerate(LENGTHS)]
    jsonl(meta / "episodes.jsonl", rows)
    stats = [json.loads((part / "meta/stats.json").read_bytes()) for part in parts]
    kept = ("min", "max", "mean", "std", "count")
    plain = [{key: {name: each[name] for name in kept} for key, each in one.items()} for one in stats]
    if version == "v2.0":
        (meta / "stats.json").write_text(json.dumps(plain[0]))
    else:
        jsonl(meta / "episodes_stats.jsonl", [{"episode_index": i, "stats": each} for i, each in enumerate(plain)])
    return root


def content(root: Path) -> dict[Path, bytes]:
    """All files, but for the lock of those who read."""
    return {path: path.read_bytes() for path in root.rglob("*") if path.is_file() and path.name != ".merge.lock"}


VERSIONS: dict[str, Callable[..., Path]] = {
    "v3.0": current,
    "v3.0 of 0.4": unnamed,
    "v2.1": lambda root, **options: older("v2.1", root, **options),
    "v2.0": lambda root, **options: older("v2.0", root, **options),
}


class Sets:
    """Makes datasets of each version: each is encoded once, and copied for each test.

    Args:
        folder: where those are that are copied.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __call__(self, version: str, root: Path, **options: Any) -> Path:
        made = self._folder / f"{version} {options}" / "set"
        if not made.exists():
            made.parent.mkdir()
            VERSIONS[version](made, **options)
        return shutil.copytree(made, root)


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> Sets:
    return Sets(tmp_path_factory.mktemp("sets"))


@pytest.fixture(params=VERSIONS, ids=lambda name: name)
def version(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.mark.parametrize("options", [{"videos": False}, {"codec": "h264"}, {"codec": "hevc"}, {}], ids=str)
def test_rows_of_every_version_are_read(sets: Sets, version: str, options: dict[str, Any], tmp_path: Path) -> None:
    dataset = layout.existing_dataset(sets(version, tmp_path / "set", **options))
    number = 0
    for episode, length in enumerate(LENGTHS):
        rows = EpisodeRows(dataset, episode)
        assert (rows.length, rows.tasks, rows.begin) == (length, [f"task {episode % 2}"], number)
        for row in rows.read(FEATURES):
            wanted = values(FEATURES, number)
            for key in FEATURES:
                if key == TOP:
                    difference = np.abs(row[key].astype(int) - wanted[key]).mean()
                    assert difference == 0 if options == {"videos": False} else difference < 15
                else:
                    np.testing.assert_array_equal(row[key], wanted[key])
            number += 1
    assert number == sum(LENGTHS)


def test_every_version_is_shown(sets: Sets, version: str, tmp_path: Path) -> None:
    root = sets(version, tmp_path / "set")
    done = run_here("datasets", "info", root)
    assert done.returncode == 0, done.stderr
    assert f"LeRobot {version[:4]}, 3 episodes, 13 frames at 30 Hz" in done.stdout
    assert "task: task 0\ntask: task 1\n" in done.stdout
    assert ("note: an older version, which is read only" in done.stdout) == version.startswith("v2")


def test_statistics_of_episodes_are_shown_as_those_of_the_whole(sets: Sets, tmp_path: Path) -> None:
    shown, wanted = (dataset_contents(sets(each, tmp_path / each)) for each in ("v2.1", "v3.0"))
    for mine, other in zip(shown.features, wanted.features, strict=True):
        for name in ("min", "max", "mean", "std"):
            assert mine.stats[name] == pytest.approx(other.stats[name], rel=1e-6, abs=1e-9), (mine.key, name)
    without = dataset_contents(sets("v2.0", tmp_path / "v2.0"))
    assert [each.key for each in without.features] == list(FEATURES)


@pytest.mark.parametrize("options", [{"videos": False}, {"codec": "h264"}, {}], ids=str)
def test_every_version_becomes_the_current_one_by_merging(
    sets: Sets, version: str, options: dict[str, Any], tmp_path: Path
) -> None:
    root = sets(version, tmp_path / "set", **options)
    before = content(root)
    done = run_here("datasets", "merge", root, "--out", tmp_path / "new")
    assert done.returncode == 0, done.stderr
    assert {
        path: path.read_bytes() for path in root.rglob("*") if path.is_file() and path.name != ".merge.lock"
    } == before
    new = layout.existing_dataset(tmp_path / "new")
    assert new.is_current
    assert new.tasks == ["task 0", "task 1"]
    if options:
        options_of = {key: each for key, each in FEATURES.items() if "videos" not in options or key != TOP}
        check(tmp_path / "new", options_of, LENGTHS)
    again = write(tmp_path / "ours", FEATURES, LENGTHS, **options)
    ours, theirs = (json.loads((each / "meta/stats.json").read_bytes()) for each in (again, tmp_path / "new"))
    assert ours.keys() == theirs.keys()
    for key in ours:
        assert ours[key].keys() == theirs[key].keys()
        for name in ours[key]:
            if key == TOP and "videos" not in options:  # coding blurs the blocks, and moves all but the mean
                np.testing.assert_allclose(ours[key]["mean"], theirs[key]["mean"], atol=0.05)
            else:
                np.testing.assert_allclose(ours[key][name], theirs[key][name], rtol=1e-9, err_msg=f"{key} {name}")
    for mine, other in zip(episodes(again), episodes(tmp_path / "new"), strict=True):
        assert mine.keys() == other.keys()


def test_sets_of_different_versions_are_joined(sets: Sets, tmp_path: Path) -> None:
    made = [sets(each, tmp_path / f"set{i}") for i, each in enumerate(VERSIONS)]
    done = run_here("datasets", "merge", *made, "--out", tmp_path / "new")
    assert done.returncode == 0, done.stderr
    new = layout.existing_dataset(tmp_path / "new")
    assert (new.info["total_episodes"], new.info["total_frames"], new.tasks) == (12, 52, ["task 0", "task 1"])
    for number in range(12):
        rows = list(EpisodeRows(new, number).read(FEATURES))
        begin = sum(LENGTHS[: number % 3])
        for i, row in enumerate(rows):
            np.testing.assert_array_equal(row["action"], values(FEATURES, begin + i)["action"])
            assert np.abs(row[TOP].astype(int) - values(FEATURES, begin + i)[TOP]).mean() < 15


def no_videos(root: Path) -> None:
    shutil.rmtree(root / "videos")


def missing_video(root: Path) -> None:
    sorted(root.rglob("*.mp4"))[0].unlink()


def pointer(path: Path) -> None:
    """A pointer of Git LFS in place of a file, as in a clone without it."""
    oid = "f2d2364193a8380fd07852eeeb25692db021b4479e17536907c4fc6d5fca7ed4"
    path.write_text(f"version https://git-lfs.github.com/spec/v1\noid sha256:{oid}\nsize 1890\n")


def pointers_to_videos(root: Path) -> None:
    for path in root.rglob("*.mp4"):
        pointer(path)


def language(root: Path) -> None:
    """LeRobot 0.6: what is said, as lists of structures."""
    said = [[{"role": "user", "content": "pick it", "timestamp": 0.1}], []]
    for number, path in enumerate(sorted(root.glob("data/*/*.parquet"))):
        kind = pa.list_(pa.struct([("role", pa.string()), ("content", pa.string()), ("timestamp", pa.float64())]))

        def add(table: pa.Table, number: int = number, kind: pa.DataType = kind) -> pa.Table:
            return table.append_column(
                "language_persistent", pa.array([said[(number + i) % 2] for i in range(len(table))], kind)
            )

        rewritten(path, add)
    edit(root, lambda info: info["features"].update(
        language_persistent={"dtype": "language", "shape": [1], "names": None}
    ))  # fmt: skip


def channels_first(root: Path) -> None:
    edit(root, lambda info: info["features"][TOP].update(shape=[3, 64, 96], names=["channels", "height", "width"]))


def no_robot(root: Path) -> None:
    edit(root, lambda info: info.pop("robot_type", None))


def fps_of_no_integer(root: Path) -> None:
    edit(root, lambda info: info.update(fps=30.0))


def wrong_counts(root: Path) -> None:
    edit(root, lambda info: info.update(total_frames=14, total_episodes=4))


ODDITIES: dict[str, tuple[Callable[[Path], None], str]] = {
    "no videos": (no_videos, "observation.images.top: "),
    "a missing video": (missing_video, ": missing "),
    "pointers to videos": (pointers_to_videos, ": missing "),
    "language": (language, "language_persistent: [{"),
    "channels first": (channels_first, "64x96x3"),
    "no robot": (no_robot, "3 episodes"),
    "fps with a point": (fps_of_no_integer, "30 Hz"),
    "wrong counts": (wrong_counts, "note: meta/info.json says total_frames: 14, its episodes have 13"),
}


@pytest.mark.parametrize("oddity", ODDITIES)
def test_oddities_of_every_version_are_shown_and_their_tables_read(
    sets: Sets, version: str, oddity: str, tmp_path: Path
) -> None:
    change, words = ODDITIES[oddity]
    root = sets(version, tmp_path / "set")
    change(root)
    done = run_here("datasets", "info", root)
    assert done.returncode == 0, done.stderr
    assert words in done.stdout
    dataset = layout.existing_dataset(root)
    keys = [key for key in FEATURES if key != TOP]
    found = [row for number in range(3) for row in EpisodeRows(dataset, number).read(keys)]
    assert len(found) == sum(LENGTHS)
    np.testing.assert_array_equal(found[5]["action"], values(FEATURES, 5)["action"])


@pytest.mark.parametrize("oddity", ["language", "channels first", "no robot", "fps with a point"])
def test_oddities_are_kept_when_merged(sets: Sets, version: str, oddity: str, tmp_path: Path) -> None:
    root = sets(version, tmp_path / "set")
    ODDITIES[oddity][0](root)
    done = run_here("datasets", "merge", root, "--out", tmp_path / "new")
    assert done.returncode == 0, done.stderr
    old, new = dataset_contents(root), dataset_contents(tmp_path / "new")
    assert [(each.key, each.dtype, each.shape, each.texts) for each in new.features] == [
        (each.key, each.dtype, each.shape, each.texts) for each in old.features
    ]
    assert [(each.frames, each.task) for each in new.list] == [(each.frames, each.task) for each in old.list]


@pytest.mark.parametrize("oddity", ["no videos", "a missing video", "pointers to videos"])
def test_pictures_that_are_missing_are_an_error_where_they_are_needed(
    sets: Sets, version: str, oddity: str, tmp_path: Path
) -> None:
    root = sets(version, tmp_path / "set")
    ODDITIES[oddity][0](root)
    dataset = layout.existing_dataset(root)
    with pytest.raises(DatasetError, match=r"mp4: is missing; download the videos of the dataset too, or use a robot"):
        list(EpisodeRows(dataset, 0).read(FEATURES))
    done = run_here("datasets", "merge", root, "--out", tmp_path / "new")
    assert done.returncode == 2
    assert "mp4: is missing; download the videos of the dataset too" in done.stderr
    assert not (tmp_path / "new/meta").exists()


@pytest.mark.parametrize("pattern", ["meta/tasks.*", "data/*/*", "meta/info.json"])
def test_pointers_of_git_lfs_in_place_of_tables_name_the_remedy(
    sets: Sets, version: str, pattern: str, tmp_path: Path
) -> None:
    root = sets(version, tmp_path / "set")
    first, *_ = sorted(root.glob(pattern))
    pointer(first)
    done = run_here("datasets", "info", root)
    assert done.returncode == 2
    assert f"{first}: is a pointer of Git LFS, not the file, as are 0 more of " in done.stderr
    assert f"`git lfs pull` in {root} downloads them" in done.stderr


def test_episode_of_several_tasks(sets: Sets, version: str, tmp_path: Path) -> None:
    root = sets(version, tmp_path / "set")
    if version.startswith("v2"):
        lines = [json.loads(line) for line in (root / "meta/episodes.jsonl").read_text().splitlines()]
        lines[1]["tasks"] = ["task 1", "task 0"]
        jsonl(root / "meta/episodes.jsonl", lines)
        table = root / "data/chunk-000/episode_000001.parquet"
    else:
        rewritten(root / "meta/episodes/chunk-000/file-000.parquet", lambda found: found.set_column(
            found.schema.get_field_index("tasks"), "tasks", pa.array([["task 0"], ["task 1", "task 0"], ["task 0"]])
        ))  # fmt: skip
        table = root / "data/chunk-000/file-000.parquet"
    number = 3 if version.startswith("v2") else 7

    def second(found: pa.Table) -> pa.Table:
        tasks = found.column("task_index").to_pylist()
        tasks[number] = 0
        return found.set_column(found.schema.get_field_index("task_index"), "task_index", pa.array(tasks))

    rewritten(table, second)
    assert EpisodeRows(layout.existing_dataset(root), 1).tasks == ["task 1", "task 0"]
    assert run_here("datasets", "merge", root, "--out", tmp_path / "new").returncode == 0
    new = layout.existing_dataset(tmp_path / "new")
    assert EpisodeRows(new, 1).tasks == ["task 1", "task 0"]
    rows = pq.read_table(tmp_path / "new/data/chunk-000/file-000.parquet").column("task_index").to_pylist()
    assert [new.tasks[task] for task in rows[4:10]] == [*["task 1"] * 3, "task 0", *["task 1"] * 2]


@pytest.mark.parametrize("found", ["v1.6", "v3.1", "3", None])
def test_unknown_version_is_named_beside_all_that_can_be_read(sets: Sets, found: str | None, tmp_path: Path) -> None:
    root = sets("v3.0", tmp_path / "set")
    edit(root, lambda info: info.update(codebase_version=found))
    with pytest.raises(DatasetError, match=r"info.json: codebase_version: .* can: v2.0, v2.1, v3.0"):
        layout.existing_dataset(root)


@pytest.mark.parametrize("template", ["../{episode_index}.parquet", "/x/{episode_index}", "{other}", "{0}", "{", 3])
def test_paths_of_older_datasets_stay_in_them(sets: Sets, template: object, tmp_path: Path) -> None:
    root = sets("v2.1", tmp_path / "set")
    edit(root, lambda info: info.update(data_path=template))
    with pytest.raises(DatasetError, match=r"info.json: data_path: "):
        list(EpisodeRows(layout.existing_dataset(root), 0).read(["action"]))


@pytest.mark.parametrize("name", ["episodes.jsonl", "tasks.jsonl", "episodes_stats.jsonl"])
@pytest.mark.parametrize("line", ["{", "3", "[]", '{"x": 1}', "NaN"])
def test_broken_lines_are_named(sets: Sets, name: str, line: str, tmp_path: Path) -> None:
    root = sets("v2.1", tmp_path / "set")
    with (root / "meta" / name).open("a") as file:
        file.write(line + "\n")
    done = run_here("datasets", "info", root)
    if done.returncode:
        assert done.returncode == 2
        assert "a bug" not in done.stderr
        assert f"{name}:" in done.stderr or "is not a LeRobot dataset" in done.stderr
    merged = run_here("datasets", "merge", root, "--out", tmp_path / "new")
    assert (merged.returncode, "a bug" in merged.stderr) == (2, False), merged.stderr


def test_training_on_an_older_version_names_the_command_that_copies_it(sets: Sets, tmp_path: Path) -> None:
    root = sets("v2.1", tmp_path / "set")
    done = run_here("train", root, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert f"`ibrobot datasets merge {root} --out {root}-v3` copies it to v3.0" in done.stderr
