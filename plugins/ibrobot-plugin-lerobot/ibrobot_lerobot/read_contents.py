"""Reads the contents of a dataset: counts, features with units, statistics, and episodes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ibrobot_core.api import DatasetError
from ibrobot_lerobot import layout
from ibrobot_lerobot.contents import Contents, EpisodeContents, FeatureContents

_UNITS = {"radians": "rad", "degrees": "°", "range_m100_100": "% of the range, -100 to 100"}
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
        return Contents(
            path=str(root), robot_type=info.get("robot_type") or "", fps=float(info["fps"]),
            episodes=info["total_episodes"], frames=info["total_frames"],
            seconds=info["total_frames"] / info["fps"], tasks=tuple(dataset.tasks), norm_mode=norm_mode,
            bytes=sum(file.stat().st_size for file in root.rglob("*") if file.is_file()),
            fingerprint=str(own.get("fingerprint", "")),
            features=tuple(
                _feature(key, entry, norm_mode, dataset.stats.get(key) or {})
                for key, entry in info["features"].items() if key not in layout.COUNTERS
            ),
            list=_episodes(dataset, own),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise DatasetError(f"{root}: is not a LeRobot dataset: {error!r}") from error


def _feature(key: str, entry: Mapping[str, Any], norm_mode: str, stats: Mapping[str, Any]) -> FeatureContents:
    """A feature with its unit, and statistics of each value or colour."""
    picture = entry["dtype"] in ("video", "image")
    names = entry.get("names") or []
    values = {name: np.ravel(stats[name]).astype(float) for name in _SHOWN if name in stats}
    return FeatureContents(
        key=key,
        dtype=entry["dtype"],
        shape=tuple(entry["shape"]),
        names=() if picture else tuple(str(name) for name in names),
        unit=_unit(entry, norm_mode, names),
        stats={name: tuple(float(x) if np.isfinite(x) else None for x in each) for name, each in values.items()},
        picture=picture,
    )


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
