"""`ibrobot episodes plot`: plots an overview of an episode as PNG."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import (
    NS_PER_S,
    Contract,
    Float64MultiArray,
    Image,
    JointState,
    RecorderError,
    how_to_install,
    option,
)
from ibrobot_core.app import echo, wrong_input

_THUMBNAILS = 8


@attrs.frozen(kw_only=True)
class Plot:
    """Plot an EPISODE.

    It shows joints and actions over time, rates and gaps of every topic, and some images.
    """

    episode: Path = option(typed="EPISODE", names="episodes", help="the episode")
    output: Path | None = option(None, typed="-o", help="a .png file; by default NAME.png")

    @wrong_input()
    def __call__(self) -> None:
        try:
            import matplotlib as mpl
        except ImportError:
            raise RecorderError(f"plot needs matplotlib: {how_to_install('ibrobot-plugin-mcap[plot]')}") from None
        mpl.use("Agg")
        output = self.output or Path(f"{self.episode.name}.png")
        _draw(PlotData(self.episode), output)
        echo(str(output))


class PlotData:
    """The data of an episode to plot."""

    def __init__(self, episode: Path) -> None:
        from ibrobot_mcap.commands.export import pixels_of
        from ibrobot_mcap.commands.find_episodes import opened

        self.name = episode.name
        self.stamps: dict[str, list[int]] = defaultdict(list)
        self.joints: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
        """Topic and joint -> positions."""
        self.vectors: dict[str, list[tuple[float, list[float]]]] = defaultdict(list)
        self.pictures: dict[str, dict[int, tuple[float, np.ndarray[Any, Any]]]] = defaultdict(dict)
        """Topic -> position in the episode, from 0 -> image."""
        newest: dict[str, tuple[float, Image]] = {}
        with opened(episode) as reader:
            self.summary = summary = reader.summary()
            start_ns, span_ns = summary.start_ns, max(1, summary.end_ns - summary.start_ns)
            for topic, why in reader.unreadable.items():
                echo(f"note: {topic} is not shown: {why}", err=True)
            for item in reader.messages(reader.source.types.keys() - reader.unreadable.keys()):
                at_s = (item.received_ns - start_ns) / NS_PER_S
                self.stamps[item.topic].append(item.received_ns)
                message = item.message
                if isinstance(message, JointState):
                    # A sender may omit the positions.
                    for joint, position in zip(message.name, message.position.tolist(), strict=False):
                        self.joints[item.topic, joint].append((at_s, position))
                elif isinstance(message, Float64MultiArray):
                    self.vectors[item.topic].append((at_s, message.data.tolist()))
                elif isinstance(message, Image):
                    shown, newest[item.topic] = self.pictures[item.topic], (at_s, message)
                    place = (item.received_ns - start_ns) * (_THUMBNAILS - 1) // span_ns
                    if place not in shown and place < _THUMBNAILS - 1:
                        shown[place] = (at_s, pixels_of(message))
        for topic, (at_s, message) in newest.items():  # the last images show the outcome
            self.pictures[topic][_THUMBNAILS - 1] = (at_s, pixels_of(message))
        self.actions = actions_of(self.summary.metadata, self.vectors)


def actions_of(metadata: Mapping[str, str], topics: Collection[str]) -> dict[str, tuple[str, ...]]:
    """Topic of an action -> joints, from the recorded contract or else from the names of controllers."""
    contract = Contract.of_episode(metadata)
    if contract is not None:
        return {part.topic: part.joints for part in contract.action_parts}
    return {topic: () for topic in topics if topic.endswith("/commands")}


def _draw(data: PlotData, output: Path) -> None:
    from matplotlib import pyplot as plt
    from matplotlib.ticker import LogFormatter

    summary = data.summary
    heights = [3.0, 3.0, 3.0, *[1.6] * len(data.pictures)]
    figure = plt.figure(figsize=(14, sum(heights)), layout="constrained")
    grid = figure.add_gridspec(len(heights), _THUMBNAILS, height_ratios=heights)
    state = summary.outcome if summary.finished else "unfinished"
    prompt = summary.metadata.get("prompt", "")
    figure.suptitle(f"{data.name}: {state}" + (f", “{prompt}”" if prompt else ""))
    joints = figure.add_subplot(grid[0, :])
    colours: dict[str, Any] = {}
    several = len({topic for topic, _ in data.joints}) > 1
    for (topic, joint), points in data.joints.items():
        (line,) = joints.plot(*zip(*points, strict=True), label=f"{topic} {joint}" if several else joint, linewidth=1)
        colours.setdefault(joint, line.get_color())
    joints.set(title="joints", ylabel="rad")
    actions = figure.add_subplot(grid[1, :], sharex=joints)
    for topic, names in data.actions.items():
        values = data.vectors.get(topic, [])
        for index in range(max((len(vector) for _, vector in values), default=0)):
            points = [(at, vector[index]) for at, vector in values if index < len(vector)]
            name = names[index] if index < len(names) else f"{topic} {index}"
            actions.plot(*zip(*points, strict=True), label=name, color=colours.get(name), linewidth=1)
    actions.set(title="actions: commanded positions", ylabel="rad")
    for axes in (joints, actions):
        if axes.lines:
            axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    gaps = figure.add_subplot(grid[2, :], sharex=joints)
    for topic, stamps in data.stamps.items():
        if len(stamps) > 2:
            ms = np.diff(stamps) / 1e6
            at_s = (np.array(stamps[1:]) - summary.start_ns) / NS_PER_S
            known = summary.topics.get(topic)
            lost = f", {known.dropped} lost" if known is not None and known.dropped else ""
            label = f"{topic}: {1e3 / ms.mean():.1f} Hz, longest {ms.max():.0f} ms{lost}"
            gaps.plot(at_s, ms, ".", markersize=2, label=label)
    gaps.set(title="time between messages", ylabel="ms", xlabel="s", yscale="log")
    gaps.yaxis.set_major_formatter(LogFormatter())
    gaps.yaxis.set_minor_formatter(LogFormatter())
    if data.stamps:
        gaps.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, markerscale=4)
    for row, (topic, pictures) in enumerate(data.pictures.items(), 3):
        first = min(pictures)
        for column, (at, pixels) in pictures.items():
            axes = figure.add_subplot(grid[row, column])
            axes.imshow(pixels, cmap="viridis" if pixels.ndim == 2 else None)
            axes.set_axis_off()
            axes.set_title(f"{topic}\n{at:.1f} s" if column == first else f"{at:.1f} s", fontsize="small", loc="left")
    try:
        figure.savefig(output, dpi=80, format=output.suffix[1:] or "png")  # savefig would add a suffix
    except (OSError, ValueError) as error:
        raise RecorderError(f"{output}: cannot be written: {error}") from error
    finally:
        plt.close(figure)
