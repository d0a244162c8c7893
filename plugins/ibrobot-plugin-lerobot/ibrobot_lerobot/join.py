"""`ibrobot datasets merge`: joins datasets that `ibrobot convert` has made with the same settings."""

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
    """Write the episodes of `parts`, in their order, into a new dataset; returns their number.

    Raises:
        DatasetError: if the parts differ in contract, settings or features, or have an episode twice, or `out` exists.
    """
    with ExitStack() as stack:
        found = []
        for part in parts:
            stack.enter_context(reading(part, "is being merged"))
            found.append((part, _opened(part)))
        if layout.open_dataset(out) is not None or (out.exists() and any(out.iterdir())):
            raise DatasetError(f"{out}: exists already; choose a new folder")
        metadata = _joined(found)
        merge(out, parts, metadata)
        return sum(each.info["total_episodes"] for _, each in found)


def _opened(part: Path) -> OnDisk:
    there = layout.existing_dataset(part)
    if "episodes" not in there.metadata or "contract" not in there.metadata:
        raise DatasetError(f"{part}: was not made by ibrobot convert; lerobot-edit-dataset merges other datasets")
    return there


def _joined(found: Sequence[tuple[Path, OnDisk]]) -> dict[str, Any]:
    """The metadata of the whole, after checks that the parts fit."""
    first, one = found[0]
    for part, other in found[1:]:
        if other.metadata["fingerprint"] != one.metadata["fingerprint"]:
            contract = Contract.from_canonical(other.metadata["contract"])
            difference = contract.difference(one.metadata["contract"], names=(str(part), str(first)))
            raise DatasetError(f"{part}: its contract differs from that of {first}:\n{difference}")
        if other.metadata["conversion"] != one.metadata["conversion"]:
            raise DatasetError(
                f"{part}: was made with other settings than {first}: {other.metadata['conversion']}, not "
                f"{one.metadata['conversion']}"
            )
        for what, ours, theirs in (
            ("robot_type", one.metadata.get("robot_type"), other.metadata.get("robot_type")),
            ("frame rate", one.info["fps"], other.info["fps"]),
            ("features", one.features, other.features),
        ):
            if ours != theirs:
                raise DatasetError(f"{part}: its {what} is {theirs}; that of {first} is {ours}")
    _check_copies(found)
    metadata = dict(one.metadata)
    for name in ("episodes", "runs"):
        metadata[name] = [each for _, other in found for each in other.metadata.get(name, ())]
    for name in ("calibrations", "configs"):
        metadata[name] = {key: each for _, other in found for key, each in other.metadata.get(name, {}).items()}
    return metadata


def _check_copies(found: Sequence[tuple[Path, OnDisk]]) -> None:
    """Refuse an episode that two datasets have, under whatever name, or in two states."""
    seen: dict[str, tuple[Path, str]] = {}
    for part, other in found:
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
