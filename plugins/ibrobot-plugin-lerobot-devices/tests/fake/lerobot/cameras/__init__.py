"""Cameras."""

# mypy: disable-error-code="misc"

from dataclasses import dataclass

import draccus


@dataclass(kw_only=True)
class CameraConfig(draccus.ChoiceRegistry):
    """Base of the configs."""

    fps: int | None = None
    width: int | None = None
    height: int | None = None
