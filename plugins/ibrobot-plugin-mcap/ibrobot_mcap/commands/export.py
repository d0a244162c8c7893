"""`ibrobot episodes export`."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from ibrobot_terminal.plural import counted

from ibrobot_core.api import Image, Message, RecorderError, option
from ibrobot_core.app import echo, wrong_input

_TO_RGB = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2, 3), "bgra8": (2, 1, 0, 3)}
"""Encoding -> its channels in PNG order."""


@attrs.frozen(kw_only=True)
class Export:
    """Export a TOPIC of an EPISODE to CSV or PNG files.

    Numbers and texts become a CSV file, images PNG files and a CSV file of their stamps.
    """

    episode: Path = option(typed="EPISODE", names="episodes", help="the episode")
    topic: str = option(typed="TOPIC", help="the topic")
    output: Path = option(typed="-o", help="a .csv file, or a folder for images")

    @wrong_input()
    def __call__(self) -> None:
        from ibrobot_mcap.commands.find_episodes import opened

        with opened(self.episode) as reader:
            topics = reader.summary().topics
            if self.topic not in topics:
                raise RecorderError(f"{self.episode}: has no topic {self.topic!r}; available: {', '.join(topics)}")
            if self.output.exists():
                raise RecorderError(f"{self.output}: exists already")
            items = ((item.received_ns, item.message) for item in reader.messages({self.topic}))
            making = self.output.with_name(f".{self.output.name}.making")
            _remove(making)
            try:
                count = (_pictures if topics[self.topic].type == Image.ros_type else _rows)(items, making)
                making.rename(self.output)
            except OSError as error:
                raise RecorderError(f"{self.output}: cannot be written: {error.strerror}") from error
            finally:
                _remove(making)
        echo(f"{self.output}: {counted(count, 'message')} of {self.topic}")


def _remove(making: Path) -> None:
    """Remove an incomplete export."""
    if making.is_dir():
        shutil.rmtree(making)
    else:
        making.unlink(missing_ok=True)


def _rows(items: Iterator[tuple[int, Message]], output: Path) -> int:
    count = 0
    with output.open("x", newline="", encoding="utf-8") as file:
        writer = None
        for received_ns, message in items:
            row = {"received_ns": received_ns, **dict(_flat(message))}
            if writer is None:
                writer = csv.DictWriter(file, list(row))
                writer.writeheader()
            if row.keys() - set(writer.fieldnames):
                raise RecorderError(f"message {count} has other fields than the first: they do not fit into one table")
            writer.writerow(row)
            count += 1
    return count


def _flat(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted paths and values of a message's numbers and texts; arrays by index, joints by name."""
    if attrs.has(type(value)):
        names = getattr(value, "name", None) if isinstance(getattr(value, "name", None), tuple) else None
        for field in attrs.fields(type(value)):
            part = getattr(value, field.name)
            if names and isinstance(part, np.ndarray) and len(part) == len(names):
                yield from ((f"{field.name}.{name}", number) for name, number in zip(names, part.tolist(), strict=True))
            elif not (names and field.name == "name"):
                yield from _flat(part, f"{path}{field.name}.")
    elif isinstance(value, np.ndarray | tuple | list):
        for index, part in enumerate(value.tolist() if isinstance(value, np.ndarray) else value):
            yield from _flat(part, f"{path}{index}.")
    else:
        yield path.rstrip("."), value


def _pictures(items: Iterator[tuple[int, Message]], output: Path) -> int:
    output.mkdir(parents=True)
    count = 0
    with (output / "stamps.csv").open("x", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("file", "stamp_ns", "received_ns"))
        for received_ns, message in items:
            assert isinstance(message, Image)
            name = f"{count:06d}.png"
            save_png(message, output / name)
            writer.writerow((name, message.header.stamp_ns, received_ns))
            count += 1
    return count


def save_png(image: Image, path: Path) -> None:
    """Save an image without loss; depth as 16-bit grey.

    Raises:
        RecorderError: if PNG does not support the encoding.
    """
    from PIL import Image as Png

    Png.fromarray(pixels_of(image)).save(path)


def pixels_of(image: Image) -> np.ndarray[Any, Any]:
    """An image as (H, W) grey or depth, or (H, W, C) RGB.

    Raises:
        RecorderError: if PNG does not support the encoding.
    """
    rows = image.data.reshape(image.height, image.step)
    if image.encoding in ("16UC1", "mono16"):
        return np.ascontiguousarray(rows[:, : 2 * image.width]).view(np.uint16)
    if image.encoding == "mono8":
        return rows[:, : image.width]
    if image.encoding not in _TO_RGB:
        raise RecorderError(f"{image.encoding} images cannot be saved as PNG")
    order = _TO_RGB[image.encoding]
    return rows[:, : len(order) * image.width].reshape(image.height, image.width, len(order))[:, :, order]
