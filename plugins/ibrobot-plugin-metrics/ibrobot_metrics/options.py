"""The section `metrics`."""

from __future__ import annotations

import attrs

from ibrobot_core.api import Options, documented, option


@documented
@attrs.frozen
class MetricsOptions(Options):
    """Options of the section `metrics`."""

    port: int = option(ge=0, le=65535, help="port of 127.0.0.1 for /metrics, /healthz and /readyz; 0: any free port")
