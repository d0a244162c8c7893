"""`ibrobot datasets merge`: joins datasets of `ibrobot convert` with the same settings, or those of other programs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ibrobot_core.api import Contract, DatasetError
from ibrobot_lerobot import layout
from ibrobot_lerobot.layout import OnDisk
from ibrobot_lerobot.merge import merge, reading


def join_datasets(parts: Sequence[Path], out: Path) -> int:
    """Write the episodes of `parts`, in their order, into a new dataset of v3.0; returns their number.

    Raises:
        DatasetError: if the parts differ in contract, settings or features, or have an episode twice, or `out` exists,
            or only some are from `ibrobot convert`.
    """
    with ExitStack() as stack:
        sources = []
        for part in parts:
            stack.enter_context(reading(part, "is being merged"))
            sources.append((part, layout.existing_dataset(part)))
        if layout.open_dataset(out) is not None or (out.exists() and any(out.iterdir())):
            raise DatasetError(f"{out}: exists already; choose a new folder")
        metadata = _joined(sources)
        merge(out, parts, metadata)
        return sum(each.info["total_episodes"] for _, each in sources)


def _joined(sources: Sequence[tuple[Path, OnDisk]]) -> dict[str, Any]:
    """The metadata of the whole, after checks that the parts fit."""
    first, one = sources[0]
    for part, other in sources[1:]:
        if _is_ours(other) != _is_ours(one):
            ours, theirs = (part, first) if _is_ours(other) else (first, part)
            raise DatasetError(f"{theirs}: was not made by ibrobot convert, as {ours} was; they cannot be one dataset")
        _compare_settings(part, other, first, one)
    if not _is_ours(one):
        return {}
    _check_copies(sources)
    metadata = dict(one.metadata)
    for name in ("episodes", "runs"):
        metadata[name] = [each for _, other in sources for each in other.metadata.get(name, ())]
    for name in ("calibrations", "configs"):
        metadata[name] = {key: each for _, other in sources for key, each in other.metadata.get(name, {}).items()}
    return metadata


def _is_ours(dataset: OnDisk) -> bool:
    """Whether `ibrobot convert` has made a dataset."""
    return "episodes" in dataset.metadata and "contract" in dataset.metadata


def _compare_settings(part: Path, other: OnDisk, first: Path, one: OnDisk) -> None:
    if _is_ours(one):
        if other.metadata["fingerprint"] != one.metadata["fingerprint"]:
            contract = Contract.from_canonical(other.metadata["contract"])
            difference = contract.difference(one.metadata["contract"], names=(str(part), str(first)))
            raise DatasetError(f"{part}: its contract differs from that of {first}:\n{difference}")
        if other.metadata["conversion"] != one.metadata["conversion"]:
            raise DatasetError(
                f"{part}: was made with other settings than {first}: {other.metadata['conversion']}, not "
                f"{one.metadata['conversion']}"
            )
    robots = [each.info.get("robot_type") or "" for each in (one, other)]
    for what, ours, theirs in (
        ("robot_type", *(robots if all(robots) else ("", ""))),
        ("frame rate", one.info["fps"], other.info["fps"]),
        ("features", one.features, other.features),
    ):
        if ours != theirs:
            raise DatasetError(f"{part}: its {what} is {theirs}; that of {first} is {ours}")


def _check_copies(sources: Sequence[tuple[Path, OnDisk]]) -> None:
    """Refuse an episode that two datasets have, under whatever name, or in two states."""
    seen: dict[str, tuple[Path, str]] = {}
    for part, other in sources:
        mine: dict[str, tuple[Path, str]] = {}
        for episode in other.metadata["episodes"]:
            for mark in _marks(episode):
                if mark in seen:
                    where, source = seen[mark]
                    raise DatasetError(f"{part}: its episode {episode['source']} is in {where}, too, as {source}")
                mine[mark] = part, episode["source"]
        seen |= mine


def _marks(episode: Mapping[str, Any]) -> Iterator[str]:
    """What identifies an episode, and the recording that it is a state of."""
    if identity := episode.get("identity"):
        yield f"identity {identity}"
        if uuid := episode.get("recorded", {}).get("uuid"):
            yield f"uuid {uuid}"
    else:  # of a dataset from before episodes had identities
        yield f"{episode['source']} {episode['start_ns']}"
