"""The descriptor of guards, the kind of `control.guard`."""

from __future__ import annotations

from typing import Any

import attrs

from ibrobot_core.api import Descriptor


@attrs.frozen
class GuardDescriptor(Descriptor[Any]):
    """A guard, the section `control.guard`; it is made in the control process."""
