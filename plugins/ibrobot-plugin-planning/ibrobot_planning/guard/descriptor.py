"""The descriptor of guards, the kind of `control.guard`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import attrs

from ibrobot_core.api import Descriptor

if TYPE_CHECKING:
    pass


@attrs.frozen
class GuardDescriptor(Descriptor["Guard"]):
    """A guard, the section `control.guard`; it is made in the control process."""
