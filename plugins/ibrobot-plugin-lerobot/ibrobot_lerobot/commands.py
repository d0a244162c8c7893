"""`ibrobot datasets info`: what a dataset contains."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import click
from rich.table import Table

from ibrobot_core.app import Screen, echo, wrong_input


@click.group()
def datasets() -> None:
    """Show LeRobot datasets."""


@datasets.command()
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print JSON, with all episodes.")
@wrong_input()
def info(dataset: Path, as_json: bool) -> None:
    """Show the counts, features, units and statistics of a DATASET."""
    from ibrobot_lerobot.dataset_facts import dataset_facts

    facts = dataset_facts(dataset)
    if as_json:
        echo(json.dumps(facts, indent=2))
        return
    console = Screen(width=None if sys.stdout.isatty() else 1000)
    console.print(
        f"{dataset}: {facts['episodes']} episodes, {facts['frames']} frames at {facts['fps']:g} Hz, "
        f"{facts['seconds']:.1f} s, {facts['bytes'] / 1e6:.1f} MB",
        soft_wrap=True,
    )
    for task in facts["tasks"]:
        console.print(f"task: {task or '(empty)'}", soft_wrap=True)
    table = Table(box=None, padding=(0, 1))
    for heading in ("feature", "type", "shape", "unit", "value", "min", "mean", "max", "std"):
        table.add_column(heading, justify="right" if heading in ("min", "mean", "max", "std") else "left")
    for feature in facts["features"]:
        for row in _rows(feature):
            table.add_row(*row)
    console.print(table)


def _rows(feature: dict[str, Any]) -> list[tuple[str, ...]]:
    """One row for each value of a feature."""
    stats = feature["stats"]
    size = len(stats.get("mean", ())) or 1
    head = (feature["key"], feature["dtype"], "x".join(map(str, feature["shape"])), feature["unit"])
    rows = []
    for i in range(size):
        name = feature["names"][i] if i < len(feature["names"]) else ""
        numbers = tuple(f"{stats[each][i]:.4g}" if each in stats else "" for each in ("min", "mean", "max", "std"))
        rows.append((*(head if not i else ("", "", "", "")), str(name), *numbers))
    return rows
