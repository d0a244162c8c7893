"""Stand-ins for the services of other plugins."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, override

import attrs

from ibrobot_core.app import NoRequest, Service


@attrs.frozen(eq=False)
class _StandIn(Service[Any, Any]):
    @override
    def read(self, request: Any, files: Callable[[str], Path] | None = None) -> Any:
        return request


def stand_in(name: str) -> Service[Any, Any]:
    """A service whose handler gets requests as they are, for tests of its callers.

    Args:
        name: its name.
    """
    return _StandIn(name, NoRequest, object)
