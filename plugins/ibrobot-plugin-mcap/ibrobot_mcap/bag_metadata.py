"""Metadata of a bag: `metadata.yaml`, or the equivalent record in an MCAP file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import yaml

from ibrobot_core.api import RecorderError
from ibrobot_mcap.metadata import INFORMATION, METADATA, quoted, write_metadata

_PER_TOPIC = "topics_with_message_count"
_PLAIN = (str, int, float)
_LARGEST = 16 * 1024 * 1024
"""Largest `metadata.yaml` that is read [bytes]; those of recordings have some KB."""


@attrs.frozen
class BagInfo:
    """Metadata of a bag."""

    files: tuple[str, ...] = ()
    counts: Mapping[str, int] = attrs.field(factory=dict)
    """Topic -> number of messages, including copies in later files."""
    types: Mapping[str, str] = attrs.field(factory=dict)
    """Topic -> type."""
    encodings: Mapping[str, str] = attrs.field(factory=dict)
    """Topic -> serialisation, where it is stated."""
    custom: Mapping[str, str] = attrs.field(factory=dict)
    """`custom_data`."""
    compressed: str = ""
    """`message`, `file`, or empty if neither is compressed. Each chunk states its own compression."""


def read_bag_info(path: Path) -> BagInfo | None:
    """Read a `metadata.yaml`; None if there is none.

    Raises:
        RecorderError: if it cannot be read.
    """
    try:
        if not path.exists():
            return None
        if not path.is_file():  # a device has no end, and a pipe none that comes
            raise RecorderError(f"{path}: is not a file")
        with path.open("rb") as file:
            content = file.read(_LARGEST + 1)
        if len(content) > _LARGEST:
            raise RecorderError(f"{path}: is larger than {_LARGEST >> 20} MiB, too large for a bag's metadata")
        return parse_bag_info(content.decode(), path)
    except (OSError, UnicodeDecodeError) as error:
        raise RecorderError(f"{path}: cannot be read: {error}") from error


def parse_bag_info(text: str, path: Path) -> BagInfo:
    """Parse metadata from YAML.

    Args:
        text: the whole document, or the part below its first key.
        path: the file, for errors.

    Raises:
        RecorderError: if it is not metadata of a rosbag2.
    """
    try:
        document = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        content: Mapping[str, Any] = document.get(INFORMATION, document)
        counts: dict[str, int] = {}
        types: dict[str, str] = {}
        encodings: dict[str, str] = {}
        for each in content.get(_PER_TOPIC) or ():
            topic = _text(each["topic_metadata"]["name"])
            counts[topic] = counts.get(topic, 0) + _count(each["message_count"])
            types[topic] = _text(each["topic_metadata"]["type"])
            if stated := each["topic_metadata"].get("serialization_format"):
                encodings[topic] = _text(stated)
        return BagInfo(
            tuple(Path(_text(name)).name for name in content.get("relative_file_paths") or ()),
            counts,
            types,
            encodings,
            {_text(key): _text(value) for key, value in dict(content.get("custom_data") or {}).items()},
            _compressed(content),
        )
    except (yaml.YAMLError, AttributeError, LookupError, TypeError, ValueError, RecursionError) as error:
        raise RecorderError(f"{path}: is not metadata of a rosbag2: {error}") from error


def custom_beside(file: Path) -> Mapping[str, str]:
    """`custom_data` of the `metadata.yaml` that lists a file, with an outcome set by hand; empty without one.

    Raises:
        RecorderError: if it cannot be read.
    """
    info = read_bag_info(file.with_name(METADATA))
    return info.custom if info is not None and file.name in info.files else {}


def set_custom(directory: Path, values: Mapping[str, str]) -> None:
    """Set keys of `custom_data` in the `metadata.yaml` of a bag, without changing anything else.

    Raises:
        RecorderError: if it cannot be read or written.
    """
    path = directory / METADATA
    info = read_bag_info(path)
    if info is None:
        raise RecorderError(f"{directory}: has no {METADATA}")
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
        content = document.get(INFORMATION, document)
        write_metadata(directory, {**content, "custom_data": quoted({**info.custom, **values})})
    except OSError as error:
        raise RecorderError(f"{path}: cannot be written: {error.strerror}") from error


def _compressed(content: Mapping[str, Any]) -> str:
    mode = _text(content.get("compression_mode") or "").lower()
    format_ = _text(content.get("compression_format") or "")
    if mode not in ("message", "file"):
        return ""
    if format_ != "zstd":
        raise ValueError(f"compression_format {format_!r} is not supported; use zstd")
    return mode


def _text(value: object) -> str:
    if not isinstance(value, _PLAIN):
        raise TypeError(f"{value!r:.80} must be text")
    return str(value)


def _count(value: object) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"message_count {value!r:.80} must be a number of messages")
    return value
