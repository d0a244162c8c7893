"""Options of the engines, which stand in the YAML beside `execution_mode`."""

from __future__ import annotations

import attrs

from ibrobot_core.api import documented, option

_NEW_WEIGHTS = "go on, with a warning, when the {} comes back with other weights; else the arm holds"


@documented
@attrs.frozen
class ProcessOptions:
    """Of `execution_mode: process`."""

    hang_timeout: float = option(
        30.0, unit="s", gt=0, help="a model at work on one request for longer hangs, and is replaced"
    )
    accept_new_weights: bool = option(False, help=_NEW_WEIGHTS.format("process"))


@documented
@attrs.frozen
class DistributedOptions:
    """Of `execution_mode: distributed`."""

    server_model: str = option("", help="what the server calls the model, where that is not its name here")
    jpeg_quality: int | None = option(
        None, ge=1, le=100, help="send pictures to the server as JPEG: far fewer bytes, other pixels; null: as they are"
    )
    accept_new_weights: bool = option(False, help=_NEW_WEIGHTS.format("server"))
