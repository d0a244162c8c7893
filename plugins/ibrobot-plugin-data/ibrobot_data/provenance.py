"""Provenance of a dataset, stored in its metadata; the readers of dataset plugins read it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import attrs
from ibrobot_provenance.datasets import DatasetSummary

from ibrobot_core.api import Contract
from ibrobot_data.episode import Unit
from ibrobot_data.request import ConversionRequest

_KEPT_ONCE = ("contract", "fingerprint", "config", "calibration", "prompt")
"""Keys of an episode's metadata that the dataset stores elsewhere."""


def conversion(request: ConversionRequest) -> dict[str, Any]:
    """The settings that must be equal for all episodes of a dataset."""
    settings = {
        "writer": request.type,
        "options": attrs.asdict(request.options),
        "norm_mode": request.norm_mode,
        "success": request.success,
        "missing": request.missing,
    }
    given = {"labels": request.labels, "units": request.units}
    return settings | {name: value for name, value in given.items() if value}


def provenance(
    request: ConversionRequest, old: DatasetSummary | None, units: Sequence[Unit], failed: Sequence[str]
) -> dict[str, Any]:
    """Provenance of the dataset: contract, robots, calibrations, the source of each episode, and what was left out."""
    before: Mapping[str, Any] = old.metadata if old is not None else {}
    calibrations, configs = dict(before.get("calibrations", {})), dict(before.get("configs", {}))
    episodes = list(before.get("episodes", ()))
    for unit in units:
        report = attrs.asdict(unit.report)
        kept = {name: value for name, value in report.items() if name not in ("error", "passed_over")}
        kept["recorded"] = {name: value for name, value in unit.recorded.items() if name not in _KEPT_ONCE}
        kept["calibration"] = _file(calibrations, unit.calibration)
        kept["config"] = _file(configs, unit.document)
        cuts = kept.pop("cuts")
        last = unit.report.frames if request.only == "all" else None
        episodes += [
            kept | {"stretch": [first, count], "cuts": _cuts_within(cuts, first, count, last)}
            for first, count in kept.pop("stretches")
        ]
    contract = before.get("contract", units[0].contract)
    run = {
        "episodes": len(episodes) - len(before.get("episodes", ())),
        "only": request.only,
        "context": request.context,
        "outcomes": list(request.outcomes),
        "prompt": request.prompt,
        "calibration": _file(calibrations, request.calibration or {}),
        "failed": list(failed),
    }
    return {
        "robot_type": before.get("robot_type", units[0].robot_type), "contract": contract,
        "fingerprint": Contract.from_canonical(contract).fingerprint(), "conversion": conversion(request),
        "runs": [*before.get("runs", ()), run], "calibrations": calibrations, "configs": configs, "episodes": episodes,
    }  # fmt: skip


def _cuts_within(cuts: Sequence[Sequence[int]], first: int, count: int, last: int | None) -> list[list[int]]:
    """The cuts within a stretch of a recording's rows, with the row numbers of the stretch.

    Those before the first row of the recording, and after its last one, number `last`, belong to the stretch there.
    """
    inside = range(first + 1, first + count)
    return [[row - first, ticks] for row, ticks in cuts if row in inside or row == 0 == first or row == last]


def _file(kept: dict[str, Any], document: Mapping[str, Any]) -> str:
    """Store a document once, under a hash of its content, and return this name; empty for an empty document."""
    if not document:
        return ""
    name = hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:12]
    kept[name] = document
    return name
