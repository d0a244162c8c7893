"""The section `metrics`."""

from __future__ import annotations

import attrs

from ibrobot_core.api import documented, option


@documented
@attrs.frozen
class MetricsOptions:
    """Where the metrics are."""

    port: int = option(ge=0, le=65535, help="of 127.0.0.1, where /metrics, /healthz and /readyz are; 0: any free one")
