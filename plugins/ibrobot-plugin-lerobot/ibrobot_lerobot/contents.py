"""Event of `ibrobot datasets info`: the contents of a dataset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import override

import attrs
from ibrobot_terminal.plural import counted

from ibrobot_core.api import option
from ibrobot_core.app import Event, Shown


@attrs.frozen(kw_only=True)
class FeatureContents:
    """A feature of a dataset."""

    key: str = option(help="its name")
    dtype: str = option(help="type of its values")
    shape: tuple[int, ...] = option(help="shape of a value")
    names: tuple[str, ...] = option(help="names of the values; empty for pictures")
    unit: str = option(help="unit of the values; empty if the dataset does not say")
    stats: Mapping[str, tuple[float | None, ...]] = option(
        help="min, max, mean, std, q01 and q99 of each value or colour; null if not finite"
    )
    picture: bool = option(help="whether it is a picture")
    texts: tuple[str, ...] = option((), help="its first different texts, if it has no numbers")


@attrs.frozen(kw_only=True)
class EpisodeContents:
    """An episode of a dataset."""

    number: int = option(help="its number, from 0")
    frames: int = option(help="number of frames")
    seconds: float = option(unit="s", help="length")
    task: str = option(help="its task")
    source: str = option(help="the recording it is from; empty if unknown")
    outcome: str = option(help="how it went; empty if unknown")


@attrs.frozen(kw_only=True)
class Contents(Event):
    """The contents of a dataset."""

    path: str = option(help="the dataset")
    robot_type: str = option(help="the type of the robot; empty if unknown")
    fps: float = option(unit="Hz", help="frames per second")
    episodes: int = option(help="number of episodes")
    frames: int = option(help="number of frames")
    seconds: float = option(unit="s", help="length")
    tasks: tuple[str, ...] = option(help="the tasks")
    norm_mode: str = option(help="unit of the joints; empty if the dataset does not say")
    bytes: int = option(unit="bytes", help="size")
    fingerprint: str = option(help="fingerprint of the contract; empty if unknown")
    features: tuple[FeatureContents, ...] = option(help="the features")
    version: str = option(help="version of the format, e.g. v3.0")
    notes: tuple[str, ...] = option(help="what is not as it should be, but can be read")
    list: tuple[EpisodeContents, ...] = option(help="the episodes")

    @override
    def shown(self) -> Shown:
        return Shown(f"{self.path}: {counted(self.episodes, 'episode')}, {counted(self.frames, 'frame')}")
