"""The dataset writer: the conformance suite, and what is on disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, override

import numpy as np
import pyarrow.parquet as pq
from ibrobot_lerobot import ibrobot_datasets
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_lerobot.writer import LeRobotDatasetWriter
from numpy.typing import NDArray

from ibrobot_core.interfaces import Context
from ibrobot_core.testing import DatasetSuite


class TestLeRobotDatasetWriter(DatasetSuite):
    @override
    def make(self, ctx: Context) -> LeRobotDatasetWriter:
        [descriptor] = ibrobot_datasets()
        writer = descriptor.make(LeRobotOptions(), ctx)
        assert isinstance(writer, LeRobotDatasetWriter)
        return writer

    @override
    def read_back(self, root: Path) -> Sequence[Mapping[str, NDArray[np.generic]]]:
        saved = sorted(p for p in (root / ".episodes").glob("*") if not p.suffix)
        return [frames for path in (saved or [root]) for frames in tables(path)]


def tables(root: Path) -> list[dict[str, NDArray[Any]]]:
    """The episodes of a dataset: column -> rows."""
    rows = [row for path in sorted(root.glob("data/*/*.parquet")) for row in pq.read_table(path).to_pylist()]
    episodes = sorted({row["episode_index"] for row in rows})
    return [
        {key: np.array([row[key] for row in rows if row["episode_index"] == episode], np.float32) for key in rows[0]}
        for episode in episodes
    ]
