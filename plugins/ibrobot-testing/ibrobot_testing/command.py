"""The command `ibrobot`, for tests that run it in a separate process."""

from __future__ import annotations

import sys


def ibrobot_command(before: str = "") -> tuple[str, ...]:
    """The beginning of a command line that runs `ibrobot` with this interpreter; append its arguments.

    Args:
        before: Python source that the process runs first.
    """
    return sys.executable, "-c", f"{before}\nfrom ibrobot_core.cli.main import main\nmain()\n"
