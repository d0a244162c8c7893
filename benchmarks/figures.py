"""The last line of a benchmark: its figures, which `run.py` compares with the last ones."""

from __future__ import annotations

import json

PREFIX = "figures: "


def report(**figures: float) -> None:
    """Print the figures of a benchmark, rounded to four digits."""
    print(PREFIX + json.dumps({name: float(f"{value:.4g}") for name, value in figures.items()}), flush=True)


def reported(output: str) -> dict[str, float]:
    """The figures in what a benchmark printed; empty if there are none."""
    lines = [line for line in output.splitlines() if line.startswith(PREFIX)]
    figures: dict[str, float] = json.loads(lines[-1].removeprefix(PREFIX)) if lines else {}
    return figures
