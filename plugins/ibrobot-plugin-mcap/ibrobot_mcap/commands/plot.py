"""`ibrobot episodes plot`: an episode at a glance, as one PNG."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import click
import numpy as np

from ibrobot_core.errors import RecorderError
from ibrobot_core.messages import Float64MultiArray, Image, JointState
from ibrobot_core.units import NS_PER_S

_THUMBNAILS = 8


@click.command()
@click.argument("episode", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="A .png; NAME.png when left out.")
def plot(episode: Path, output: Path | None) -> None:
    """Draw an EPISODE: joints and actions over time, rates and gaps of every topic, pictures along it."""
    try:
        import matplotlib as mpl
    except ImportError:
        raise RecorderError("plot needs matplotlib: pip install 'ibrobot-plugin-mcap[plot]'") from None
    mpl.use("Agg")
    output = output or Path(f"{episode.name}.png")
    _draw(_Facts(episode), output)
    click.echo(str(output))


class _Facts:
    """All of an episode that the picture shows."""

    def __init__(self, episode: Path) -> None:
        from ibrobot_mcap.commands.export import pixels_of
        from ibrobot_mcap.commands.found import opened

        self.name = episode.name
        self.stamps: dict[str, list[int]] = defaultdict(list)
        self.joints: dict[str, list[tuple[float, float]]] = defaultdict(list)
        self.vectors: dict[str, list[tuple[float, list[float]]]] = defaultdict(list)
        self.pictures: dict[str, list[tuple[float, np.ndarray[Any, Any]]]] = defaultdict(list)
        with opened(episode) as reader:
            self.summary = summary = reader.summary()
            start_ns, span_ns = summary.start_ns, max(1, summary.end_ns - summary.start_ns)
            for item in reader.messages():
                at_s = (item.received_ns - start_ns) / NS_PER_S
                self.stamps[item.topic].append(item.received_ns)
                message = item.message
                if isinstance(message, JointState):
                    for joint, position in zip(message.name, message.position.tolist(), strict=True):
                        self.joints[joint].append((at_s, position))
                elif isinstance(message, Float64MultiArray):
                    self.vectors[item.topic].append((at_s, message.data.tolist()))
                elif isinstance(message, Image):
                    shown = self.pictures[item.topic]
                    if (item.received_ns - start_ns) * _THUMBNAILS >= len(shown) * span_ns and len(shown) < _THUMBNAILS:
                        shown.append((at_s, pixels_of(message)))


def _draw(facts: _Facts, output: Path) -> None:
    from matplotlib import pyplot as plt

    summary = facts.summary
    heights = [3.0, 3.0, 3.0, *[1.6] * len(facts.pictures)]
    figure = plt.figure(figsize=(14, sum(heights)), layout="constrained")
    grid = figure.add_gridspec(len(heights), _THUMBNAILS, height_ratios=heights)
    state = summary.outcome if summary.finished else "unfinished"
    prompt = summary.metadata.get("prompt", "")
    figure.suptitle(f"{facts.name}: {state}" + (f", “{prompt}”" if prompt else ""))
    joints = figure.add_subplot(grid[0, :])
    for joint, points in facts.joints.items():
        joints.plot(*zip(*points, strict=True), label=joint, linewidth=1)
    joints.set(title="joints", ylabel="rad")
    if facts.joints:
        joints.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    actions = figure.add_subplot(grid[1, :], sharex=joints)
    for topic, values in facts.vectors.items():
        if topic.endswith("/commands"):
            table = np.array([vector for _, vector in values])
            actions.plot([at for at, _ in values], table, linewidth=1)
    actions.set(title="actions", ylabel="rad")
    gaps = figure.add_subplot(grid[2, :], sharex=joints)
    for topic, stamps in facts.stamps.items():
        if len(stamps) > 2:
            ms = np.diff(stamps) / 1e6
            at_s = (np.array(stamps[1:]) - summary.start_ns) / NS_PER_S
            gaps.plot(
                at_s, ms, ".", markersize=2, label=f"{topic}: {1e3 / ms.mean():.1f} Hz, longest {ms.max():.0f} ms"
            )
    gaps.set(title="time between messages", ylabel="ms", xlabel="s", yscale="log")
    if facts.stamps:
        gaps.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, markerscale=4)
    for row, (topic, pictures) in enumerate(facts.pictures.items(), 3):
        for column, (at, pixels) in enumerate(pictures):
            axes = figure.add_subplot(grid[row, column])
            axes.imshow(pixels, cmap="viridis" if pixels.ndim == 2 else None)
            axes.set_axis_off()
            axes.set_title(f"{at:.1f} s" if column else f"{topic}\n{at:.1f} s", fontsize="small", loc="left")
    try:
        figure.savefig(output, dpi=80)
    except (OSError, ValueError) as error:
        raise RecorderError(f"{output}: cannot be written: {error}") from error
    finally:
        plt.close(figure)
