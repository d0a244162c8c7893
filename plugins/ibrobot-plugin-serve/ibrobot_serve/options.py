"""Options of the engines; in the YAML they stand beside `execution_mode`."""

from __future__ import annotations

import attrs

from ibrobot_core.api import Options, documented, option

_NEW_WEIGHTS = "continue, with a warning, if the {} restarts with other weights; otherwise the arm holds"


@documented
@attrs.frozen
class ProcessOptions(Options):
    """Options of `execution_mode: process`."""

    hang_timeout: float = option(
        30.0, unit="s", gt=0, help="a model that works on one request for longer counts as hanging, and is replaced"
    )
    accept_new_weights: bool = option(False, help=_NEW_WEIGHTS.format("process"))


@documented
@attrs.frozen
class DistributedOptions(Options):
    """Options of `execution_mode: distributed`."""

    server_model: str = option("", help="name of the model on the server, if different")
    jpeg_quality: int | None = option(
        None, ge=1, le=100, help="quality of images sent as JPEG, which is smaller but lossy; null: raw images"
    )
    accept_new_weights: bool = option(False, help=_NEW_WEIGHTS.format("server"))
    canary: bool = option(True, help="try other weights if a server is started with --canary and draws this robot")
