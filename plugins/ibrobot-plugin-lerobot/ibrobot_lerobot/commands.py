"""`ibrobot datasets info`, `merge`, `push` and `pull`; `ibrobot export`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import attrs
import click
from rich.table import Table

from ibrobot_core.app import Screen, declared, echo, emit, wrong_input
from ibrobot_lerobot import INFO
from ibrobot_lerobot.contents import FeatureContents, InfoOptions


@click.group()
def datasets() -> None:
    """Show, join, upload and download LeRobot datasets."""


@datasets.command()
@declared(INFO)
@click.option("--json", "as_json", is_flag=True, help="Print JSON, with all episodes.")
@wrong_input()
def info(options: InfoOptions, as_json: bool, events: bool) -> None:
    """Show the counts, features, units and statistics of a DATASET."""
    from ibrobot_lerobot.read_contents import dataset_contents

    contents = dataset_contents(options.dataset)
    if events:
        emit(INFO, contents)
        return
    if as_json:
        echo(json.dumps(attrs.asdict(contents), indent=2))
        return
    console = Screen(width=None if sys.stdout.isatty() else 1000)
    console.print(
        f"{contents.path}: LeRobot {contents.version}, {contents.episodes} episodes, {contents.frames} frames at "
        f"{contents.fps:g} Hz, {contents.seconds:.1f} s, {contents.bytes / 1e6:.1f} MB",
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


@datasets.command()
@click.argument("parts", nargs=-1, required=True, metavar="DATASET...", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder of the whole dataset.")
@wrong_input()
def merge(parts: tuple[Path, ...], out: Path) -> None:
    """Join datasets, or copy an older one, to LeRobot v3.0.

    Those of `ibrobot convert --shard` become one. Datasets must have the same contract and settings, or the same
    features where other programs made them. A single one of v2.0 or v2.1 becomes v3.0. An episode that two of them
    have is an error. Nothing is encoded again.
    """
    from ibrobot_lerobot.join import join_datasets

    episodes = join_datasets(parts, out)
    echo(f"{episodes} episodes of {len(parts)} datasets -> {out}")


@datasets.command()
@click.argument("dataset", type=click.Path(path_type=Path))
@click.argument("repository", metavar="OWNER/NAME")
@click.option("--private", is_flag=True, help="Make a new repository private.")
@wrong_input()
def push(dataset: Path, repository: str, private: bool) -> None:
    """Upload DATASET to the Hugging Face Hub.

    The token is that of `hf auth login`, or HF_TOKEN. After an interruption, run the same command again.
    """
    from ibrobot_lerobot.hub import push as push_dataset

    echo(f"{dataset} -> {push_dataset(dataset, repository, private=private)}")


@datasets.command()
@click.argument("repository", metavar="OWNER/NAME")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the dataset; by default datasets/NAME.")
@click.option("--revision", help="A branch, tag or commit; by default the newest.")
@wrong_input()
def pull(repository: str, out: Path | None, revision: str | None) -> None:
    """Download a dataset from the Hugging Face Hub.

    After an interruption, run the same command again.
    """
    from ibrobot_lerobot.hub import pull as pull_dataset
    from ibrobot_lerobot.read_contents import dataset_contents

    out = out or Path("datasets") / repository.rpartition("/")[2]
    pull_dataset(repository, out, revision=revision)
    contents = dataset_contents(out)
    echo(f"{repository} -> {out}: {contents.episodes} episodes, {contents.frames} frames at {contents.fps:g} Hz")


@click.command()
@click.argument("checkpoint", metavar="CHECKPOINT", type=click.Path(path_type=Path))
@click.option("--to", "format_", required=True, type=click.Choice(["onnx"]), help="Format.")
@click.option("--out", type=click.Path(path_type=Path), help="New folder; by default CHECKPOINT-onnx.")
@wrong_input()
def export(checkpoint: Path, format_: str, out: Path | None) -> None:
    """Convert CHECKPOINT, a folder of LeRobot, to run without torch.

    The new folder has the network as ONNX graphs and a manifest, with the contract and the statistics. A robot runs it
    with a model of type onnx. ACT, VQ-BeT and Diffusion can be converted.
    """
    from ibrobot_lerobot.export import export_onnx

    exported = export_onnx(checkpoint, out or checkpoint.with_name(f"{checkpoint.name}-{format_}"))
    echo(
        f"{exported.type}: {exported.bytes / 1e6:.1f} MB in {exported.seconds:.0f} s; outputs differ from torch's by "
        f"at most {exported.largest_difference:.1e}"
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
