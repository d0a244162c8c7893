"""`ibrobot datasets info`, `merge`, `push` and `pull`; `ibrobot export`."""

from __future__ import annotations

import sys
from pathlib import Path

import attrs
from ibrobot_terminal.plural import counted
from ibrobot_terminal.screen import Screen
from rich.table import Table

from ibrobot_core.api import option
from ibrobot_core.app import Emit, echo, wrong_input
from ibrobot_lerobot.contents import Contents, FeatureContents


@attrs.frozen(kw_only=True)
class ShowDataset:
    """Show the counts, features, units and statistics of a DATASET."""

    dataset: Path = option(typed="DATASET", names="dataset", help="the dataset")

    @wrong_input()
    def __call__(self, emit: Emit) -> Contents | None:
        from ibrobot_lerobot.read_contents import dataset_contents

        contents = dataset_contents(self.dataset)
        if emit is None:
            return contents
        emit(contents)
        return None

    def show(self, contents: Contents) -> None:
        """Print a table of the features."""
        console = Screen(width=None if sys.stdout.isatty() else 1000)
        console.print(
            f"{contents.path}: LeRobot {contents.version}, {counted(contents.episodes, 'episode')}, "
            f"{counted(contents.frames, 'frame')} at {contents.fps:g} Hz, {contents.seconds:.1f} s, "
            f"{contents.bytes / 1e6:.1f} MB",
            soft_wrap=True,
        )
        for note in contents.notes:
            console.print(f"note: {note}", soft_wrap=True)
        for task in contents.tasks:
            console.print(f"task: {task or '(empty)'}", soft_wrap=True)
        table = Table(box=None, padding=(0, 1))
        for heading in ("feature", "type", "shape", "unit", "value", "min", "mean", "max", "std"):
            table.add_column(heading, justify="right" if heading in ("min", "mean", "max", "std") else "left")
        for feature in contents.features:
            for row in _rows(feature):
                table.add_row(*row)
        console.print(table)
        for feature in contents.features:
            for text in feature.texts:
                console.print(f"{feature.key}: {text}", soft_wrap=True, markup=False)


@attrs.frozen(kw_only=True)
class Merge:
    """Join datasets, or copy an older one, to LeRobot v3.0.

    Those of `ibrobot convert --shard` become one. Datasets must have the same contract and settings, or the same
    features where other programs made them. A single one of v2.0 or v2.1 becomes v3.0. An episode that two of them
    have is an error. Nothing is encoded again.
    """

    parts: tuple[Path, ...] = option(typed="DATASET", help="the datasets")
    out: Path = option(help="folder of the whole dataset")

    @wrong_input()
    def __call__(self) -> None:
        from ibrobot_lerobot.join import join_datasets

        episodes = join_datasets(self.parts, self.out)
        echo(f"{counted(episodes, 'episode')} of {len(self.parts)} datasets -> {self.out}")


@attrs.frozen(kw_only=True)
class Push:
    """Upload DATASET to the Hugging Face Hub.

    The token is that of `hf auth login`, or HF_TOKEN. After an interruption, run the same command again.
    """

    dataset: Path = option(typed="DATASET", help="the dataset")
    repository: str = option(typed="OWNER/NAME", help="repository on the hub")
    private: bool = option(False, help="make a new repository private")

    @wrong_input()
    def __call__(self) -> None:
        from ibrobot_lerobot.hub import push as push_dataset

        echo(f"{self.dataset} -> {push_dataset(self.dataset, self.repository, private=self.private)}")


@attrs.frozen(kw_only=True)
class Pull:
    """Download a dataset from the Hugging Face Hub.

    After an interruption, run the same command again.
    """

    repository: str = option(typed="OWNER/NAME", help="repository on the hub")
    out: Path | None = option(None, help="folder of the dataset; by default datasets/NAME")
    revision: str | None = option(None, help="a branch, tag or commit; by default the newest")

    @wrong_input()
    def __call__(self) -> None:
        from ibrobot_lerobot.hub import pull as pull_dataset
        from ibrobot_lerobot.read_contents import dataset_contents

        out = self.out or Path("datasets") / self.repository.rpartition("/")[2]
        pull_dataset(self.repository, out, revision=self.revision)
        contents = dataset_contents(out)
        echo(
            f"{self.repository} -> {out}: {counted(contents.episodes, 'episode')}, "
            f"{counted(contents.frames, 'frame')} at {contents.fps:g} Hz"
        )


@attrs.frozen(kw_only=True)
class Export:
    """Convert CHECKPOINT, a folder of LeRobot, to run without torch.

    The new folder has the network as ONNX graphs and a manifest, with the contract and the statistics. A robot runs it
    with a model of type onnx. ACT, VQ-BeT and Diffusion can be converted.
    """

    checkpoint: Path = option(typed="CHECKPOINT", help="folder of LeRobot")
    format_: str = option(typed="--to", choices=["onnx"], help="format")
    out: Path | None = option(None, help="new folder; by default CHECKPOINT-onnx")

    @wrong_input()
    def __call__(self) -> None:
        from ibrobot_lerobot.export import export_onnx

        exported = export_onnx(
            self.checkpoint, self.out or self.checkpoint.with_name(f"{self.checkpoint.name}-{self.format_}")
        )
        echo(
            f"{exported.type}: {exported.bytes / 1e6:.1f} MB in {exported.seconds:.0f} s; outputs differ from "
            f"torch's by at most {exported.largest_difference:.1e}"
        )
        echo(f"exported: {exported.folder}")


def _rows(feature: FeatureContents) -> list[tuple[str, ...]]:
    """One row for each value of a feature."""
    head = (feature.key, feature.dtype, "x".join(map(str, feature.shape)), feature.unit)
    rows = []
    for i in range(len(feature.stats.get("mean", ())) or len(feature.names) or 1):
        name = feature.names[i] if i < len(feature.names) else ""
        values = [feature.stats[each][i] if each in feature.stats else None for each in ("min", "mean", "max", "std")]
        numbers = ["" if value is None else f"{value:.4g}" for value in values]
        rows.append((*(head if not i else ("", "", "", "")), name, *numbers))
    return rows
