"""Whether a browser can be opened on this machine."""

from __future__ import annotations

import os
import sys


def has_desktop() -> bool:
    """Whether a browser can be opened on this machine for the person who started the command."""
    if "SSH_CONNECTION" in os.environ or "CI" in os.environ:
        return False
    return sys.platform == "darwin" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))
