"""Datasets of others that are damaged or hostile: each is refused by an error with its name, and nothing is written."""

from __future__ import annotations

import itertools
import json
import random
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from ibrobot_lerobot import layout
from ibrobot_lerobot.join import join_datasets
from ibrobot_lerobot.read_contents import dataset_contents
from ibrobot_lerobot.rows import EpisodeRows

from ibrobot_core.api import DatasetError

from .test_versions import TOP, current, older

VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 3, 2**31, 2**63, 10**400, 1.5, float("nan"), float("inf"), "", "x", "../../../away", "/away",
    "a\0b", "{0.__class__}", "{x:>999999999}", [], [[]], [1, 2], [-3], ["x"], {}, {"x": 1}, {"dtype": "video"},
)  # fmt: skip
"""In place of any value."""


FILES = {
    "v3.0": ("meta/info.json", "data/*/*.parquet", "meta/episodes/*/*.parquet", "meta/tasks.parquet"),
    "v3.0 pictures": ("meta/info.json", "data/*/*.parquet"),
    "v2.1": (
        "meta/info.json", "meta/episodes.jsonl", "meta/tasks.jsonl", "meta/episodes_stats.jsonl", "data/*/*.parquet",
    ),
    "v2.0": ("meta/info.json",),
}  # fmt: skip
"""Of each kind of dataset, those that are attacked."""


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("sets")
    return {
        "v3.0": current(root / "new", codec="h264"),
        "v3.0 pictures": current(root / "pictures", videos=False),
        "v2.1": older("v2.1", root / "old", codec="h264"),
        "v2.0": older("v2.0", root / "oldest", codec="h264"),
    }


def use(root: Path, out: Path) -> None:
    """All that is done with datasets of others."""
    dataset_contents(root)
    dataset = layout.existing_dataset(root)
    keys = [key for key, each in dataset.features.items() if layout.is_numeric(each)]
    for row in dataset.episodes():
        for _ in EpisodeRows(dataset, row["episode_index"], row).read(keys):
            pass
    join_datasets([root], out)


def files(folder: Path) -> set[Path]:
    """All, without locks."""
    return {path for path in folder.rglob("*") if path.name != ".merge.lock"}


def places(document: Any) -> Iterator[tuple[Any, ...]]:
    """Where a document has values."""
    items = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in items:
        yield (key,)
        if isinstance(value, dict | list):
            yield from ((key, *rest) for rest in places(value))


def changed(document: Any, place: tuple[Any, ...], value: Any) -> Any:
    """A copy with another value; no value at all if it is `...`."""
    copy = json.loads(json.dumps(document))
    holder = copy
    for key in place[:-1]:
        holder = holder[key]
    if value is ...:
        del holder[place[-1]]
    else:
        holder[place[-1]] = value
    return copy


def attack(good: Path, tmp_path: Path, damage: Callable[[Path], object]) -> str:
    """The error of a damaged copy; empty if it is read after all."""
    shutil.rmtree(tmp_path, ignore_errors=True)
    root = tmp_path / "inner/set"
    shutil.copytree(good, root)
    damage(root)
    before = files(tmp_path)
    said = ""
    try:
        use(root, tmp_path / "inner/out")
    except DatasetError as error:
        said = str(error)
    assert not said or str(tmp_path) in said, said
    shutil.rmtree(tmp_path / "inner/out", ignore_errors=True)
    assert files(tmp_path) == before, "something was written elsewhere"
    return said


def writes(name: Any, content: bytes) -> Callable[[Path], object]:
    return lambda root: (root / name).write_bytes(content)


def stores(name: Any, table: pa.Table) -> Callable[[Path], object]:
    return lambda root: pq.write_table(table, root / name)


def of_json(good: Path, name: str) -> Iterator[tuple[str, Callable[[Path], object]]]:
    """Every value of a JSON file in turn, in place of it every other."""
    text = (good / name).read_text(encoding="utf-8")
    lines = text.splitlines() if name.endswith("l") else [text]
    document = json.loads(lines[0])
    for place, value in itertools.product(places(document), (*VALUES, ...)):
        content = "\n".join([json.dumps(changed(document, place, value)), *lines[1:]])
        yield f"{name} {place}: {value!r}"[:150], writes(name, content.encode())


def of_tables(good: Path, pattern: str, cuts: int) -> Iterator[tuple[str, Callable[[Path], object]]]:
    """Each column of a table without a value, of other types, or gone; and the file cut and with other bytes."""
    path = sorted(good.glob(pattern))[0]
    name, table = path.relative_to(good), pq.read_table(path)
    for at, column in enumerate(table.column_names):
        others: dict[str, Any] = {
            "no": None, "null": pa.nulls(len(table)), "text": pa.array(["x"] * len(table)),
            "half": pa.array([1.0] * len(table)).cast(pa.float16()), "large": pa.array([2**62] * len(table)),
            "negative": pa.array([-1] * len(table)), "short": pa.array([3] * len(table), pa.int16()),
            "ragged": pa.array([[1.0] * (i % 3) for i in range(len(table))]),
            "lists": pa.array([[1.0]] * len(table), pa.large_list(pa.float32())),
            "struct": pa.array([{"bytes": b"x"}] * len(table)), "nested": pa.array([[[1.0]]] * len(table)),
        }  # fmt: skip
        for what, other in others.items():
            changed = table.remove_column(at) if other is None else table.set_column(at, column, other)
            yield f"{name} {column} {what}", stores(name, changed)
    content, rng = path.read_bytes(), random.Random(0)
    for _ in range(cuts):
        length = rng.randrange(len(content))
        yield f"{name} cut at {length}", writes(name, content[:length])
        start = rng.randrange(len(content) - 8)
        noise = content[:start] + rng.randbytes(8) + content[start + 8 :]
        yield f"{name} noise at {start}", writes(name, noise)


def attacks(good: Path, names: tuple[str, ...]) -> Iterator[tuple[str, Callable[[Path], object]]]:
    for name in names:
        yield from of_tables(good, name, 50) if name.endswith("parquet") else of_json(good, name)


def attacked(sets: dict[str, Path], tmp_path: Path, kind: str, step: int) -> tuple[int, int]:
    """Number of attacks, and of those that were refused; a sample of all, the same each time."""
    every = list(attacks(sets[kind], FILES[kind]))
    random.Random(1).shuffle(every)
    refused = 0
    for what, damage in every[::step]:
        try:
            refused += bool(attack(sets[kind], tmp_path / "work", damage))
        except Exception as error:
            error.add_note(what)
            raise
    return len(every[::step]), refused


@pytest.mark.parametrize("kind", FILES)
def test_damaged_datasets_are_refused_by_name(sets: dict[str, Path], kind: str, tmp_path: Path) -> None:
    """A sample of all."""
    count, refused = attacked(sets, tmp_path, kind, 300)
    assert refused > count / 4


@pytest.mark.long
@pytest.mark.parametrize("kind", FILES)
def test_more_damaged_datasets_are_refused_by_name(sets: dict[str, Path], kind: str, tmp_path: Path) -> None:
    count, refused = attacked(sets, tmp_path, kind, 10)
    assert count > 200
    assert refused > count / 4


def info(**changes: Any) -> Callable[[Path], object]:
    def damage(root: Path) -> None:
        path = root / "meta/info.json"
        path.write_text(json.dumps(json.loads(path.read_bytes()) | changes))

    return damage


def renamed(root: Path) -> None:
    """A camera whose name leads out of the dataset, where a merge would write its video."""
    path = root / "meta/info.json"
    document = json.loads(path.read_bytes())
    document["features"]["../../../away"] = document["features"].pop(TOP)
    path.write_text(json.dumps(document))
    for episodes in root.glob("meta/episodes/*/*.parquet"):
        table = pq.read_table(episodes)
        pq.write_table(table.rename_columns([n.replace(TOP, "../../../away") for n in table.column_names]), episodes)
    shutil.copytree(root / "videos" / TOP, root.parent / "away")


def no_unit(root: Path) -> None:
    path = root / "meta/info.json"
    document = json.loads(path.read_bytes())
    document["features"][TOP] |= {"dtype": "image", "info": {"is_depth_map": True}}
    path.write_text(json.dumps(document))


def other_tasks(root: Path) -> None:
    path = root / "data/chunk-000/episode_000000.parquet"
    table = pq.read_table(path)
    at = table.schema.get_field_index("task_index")
    pq.write_table(table.set_column(at, "task_index", pa.array([-1] * len(table))), path)


@pytest.mark.parametrize(
    ("kind", "damage", "words"),
    [
        ("v3.0", renamed, "info.json: features: '../../../away': the name leads out of the dataset"),
        ("v2.1", info(data_path="{episode_index:>999999999}"), "data_path: .* is no path of an episode"),
        ("v2.1", info(video_path="{episode_index.__class__}"), "video_path: .* is no path of an episode"),
        ("v2.1", lambda root: (root / "meta/tasks.jsonl").write_text('{"task_index": 4503599627370496, "task": "x"}'),
         "task_index: 4503599627370496 is not a number of a task"),
        ("v2.1", lambda root: (root / "meta/info.json").write_text('{"codebase_version": ' + "[" * 100_000),
         "is not a LeRobot dataset"),
        ("v2.1", other_tasks, "episode_000000.parquet: .*task_index from -1 to -1, of 2 in all"),
        ("v3.0 pictures", info(fps=0), "info.json: fps: 0 is not a frame rate"),
        ("v3.0", no_unit, "depth_unit: None is none of mm, m"),
    ],
)  # fmt: skip
def test_hostile_values_are_named(
    sets: dict[str, Path], tmp_path: Path, kind: str, damage: Callable[[Path], object], words: str
) -> None:
    assert re.search(words, attack(sets[kind], tmp_path / "work", damage))
