"""Reads the contents of a dataset: counts, features with units, statistics, and episodes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from ibrobot_terminal.plural import counted

from ibrobot_core.api import DatasetError
from ibrobot_lerobot import layout
from ibrobot_lerobot.contents import Contents, EpisodeContents, FeatureContents
from ibrobot_lerobot.plausible import is_content

_UNITS = {"radians": "rad", "degrees": "°", "range_m100_100": "% of the range, -100 to 100"}
_TEXTS = 5
_SHOWN = ("min", "max", "mean", "std", "q01", "q99")


def dataset_contents(root: Path) -> Contents:
    """The contents of the dataset at `root`.

    Raises:
        DatasetError: if there is no dataset, or it cannot be read.
    """
    dataset = layout.existing_dataset(root)
    info, own = dataset.info, dataset.metadata
    norm_mode = str((own.get("conversion") or {}).get("norm_mode", ""))
    try:
        with np.errstate(all="ignore"):  # what makes no sense is shown as it is
            dataset = attrs.evolve(dataset, stats=dataset.stats or _joined_stats(dataset))
        return Contents(
            path=str(root), robot_type=info.get("robot_type") or "", fps=float(info["fps"]),
            episodes=info["total_episodes"], frames=info["total_frames"],
            seconds=info["total_frames"] / info["fps"], tasks=tuple(dataset.tasks), norm_mode=norm_mode,
            bytes=sum(file.stat().st_size for file in root.rglob("*") if file.is_file()),
            fingerprint=str(own.get("fingerprint", "")), version=str(info["codebase_version"]), notes=_notes(dataset),
            features=tuple(
                _feature(dataset, key, entry, norm_mode)
                for key, entry in info["features"].items() if key not in layout.COUNTERS
            ),
            list=_episodes(dataset, own),
        )  # fmt: skip
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, OSError, pa.ArrowException) as error:
        raise DatasetError(f"{root}: is not a LeRobot dataset: {error!r}") from error


def _feature(dataset: layout.OnDisk, key: str, entry: Mapping[str, Any], norm_mode: str) -> FeatureContents:
    """A feature with its unit, and statistics of each value or colour, or its first texts."""
    picture = entry["dtype"] in ("video", "image")
    feature, stats = dataset.features[key], dataset.stats.get(key) or {}
    values = {name: np.ravel(stats[name]).astype(float) for name in _SHOWN if name in stats}
    return FeatureContents(
        key=key,
        dtype=entry["dtype"],
        shape=feature.shape,
        names=() if picture else feature.names,
        unit=_unit(entry, norm_mode, feature.names),
        stats={name: tuple(float(x) if np.isfinite(x) else None for x in each) for name, each in values.items()},
        picture=picture,
        texts=() if picture or layout.is_numeric(feature) else _texts(dataset, key),
    )


def _joined_stats(dataset: layout.OnDisk) -> dict[str, dict[str, Any]]:
    """Minimum, maximum, mean and deviation of all episodes, from those of each: v2.1 has no others."""
    episodes: dict[str, list[dict[str, Any]]] = {}
    for row in dataset.episodes():
        for key, each in layout.row_stats(dataset.root, row).items():
            if each.keys() >= {"min", "max", "mean", "std", "count"}:
                episodes.setdefault(key, []).append(each)
    joined = {}
    for key, rows in episodes.items():
        low, high, mean, std = (
            np.stack([np.ravel(row[name]) for row in rows]) for name in ("min", "max", "mean", "std")
        )
        share = np.stack([row["count"][:1] for row in rows])
        share = share / share.sum()
        middle = (share * mean).sum(0)
        spread = np.sqrt((share * (std**2 + (mean - middle) ** 2)).sum(0))
        joined[key] = {"min": low.min(0), "max": high.max(0), "mean": middle, "std": spread}
    return joined


def _texts(dataset: layout.OnDisk, key: str) -> tuple[str, ...]:
    """The first different texts of a feature that has no numbers."""
    texts: dict[str, None] = {}
    for path in dataset.tables():
        with pq.ParquetFile(path) as file:
            for batch in file.iter_batches(1000, columns=[key]) if key in file.schema_arrow.names else ():
                for value in batch.column(0).to_pylist():
                    texts.setdefault(value if isinstance(value, str) else json.dumps(value, ensure_ascii=False))
                    if len(texts) > _TEXTS:
                        return (*list(texts)[:_TEXTS], "…")
    return tuple(texts)


def _notes(dataset: layout.OnDisk) -> tuple[str, ...]:
    """What of a dataset is not as it should be, but can be read."""
    rows = list(dataset.episodes())
    totals = {"total_episodes": len(rows), "total_frames": sum(row["length"] for row in rows)}
    notes = [
        f"{layout.INFO} says {name}: {dataset.info[name]}, its episodes have {count}"
        for name, count in totals.items()
        if dataset.info[name] != count
    ]
    tables = [path for path in dataset.tables() if path.exists()]
    stored = sum(pq.ParquetFile(path).metadata.num_rows for path in tables)
    if stored != totals["total_frames"]:
        notes.append(f"the tables have {stored} rows, the episodes {totals['total_frames']}")
    for key in dataset.videos:
        wanted = {dataset.video(row, key) for row in rows}
        if missing := [path for path in sorted(wanted) if not is_content(path)]:
            notes.append(f"{key}: missing {len(missing)} of {counted(len(wanted), 'video')}, e.g. {missing[0]}")
    if not dataset.is_current:
        notes.append(
            "an older version, which is read only; `ibrobot datasets merge DATASET --out NEW` copies it to v3.0"
        )
    return tuple(notes)


def _unit(entry: Mapping[str, Any], norm_mode: str, names: Any) -> str:
    """The unit of a feature; empty if unknown."""
    if entry["dtype"] in ("video", "image"):
        return str((entry.get("info") or {}).get("depth_unit", "")) or "colour, 0 to 1 in the statistics"
    joints = bool(names) and all(str(name).endswith(".pos") for name in names)
    return _UNITS.get(norm_mode, "") if joints else ""


def _episodes(dataset: layout.OnDisk, own: Mapping[str, Any]) -> tuple[EpisodeContents, ...]:
    recorded = own.get("episodes") or []
    rows = []
    for row in dataset.episodes():
        number = int(row["episode_index"])
        known = recorded[number] if number < len(recorded) else {}
        rows.append(EpisodeContents(
            number=number, frames=int(row["length"]), seconds=int(row["length"]) / dataset.info["fps"],
            task="; ".join(row["tasks"]), source=known.get("source", ""), outcome=known.get("outcome", ""),
        ))  # fmt: skip
    return tuple(rows)
