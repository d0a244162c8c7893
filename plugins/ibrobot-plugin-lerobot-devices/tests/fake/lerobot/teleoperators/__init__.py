"""Teleoperators."""

# mypy: disable-error-code="misc"

from dataclasses import dataclass
from pathlib import Path

import draccus


@dataclass(kw_only=True)
class TeleoperatorConfig(draccus.ChoiceRegistry):
    """Base of the configs."""

    id: str | None = None
    calibration_dir: Path | None = None
