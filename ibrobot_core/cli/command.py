"""The entry point of `ibrobot`: while it starts, Ctrl-C ends it in one line, whatever it was about to import or read.

This module imports next to nothing, so that there is hardly a moment before it.
"""

import os
import signal
from types import FrameType


def main() -> None:
    """Run the command line."""
    signal.signal(signal.SIGINT, _end)
    from ibrobot_core.cli.main import main as run

    run()


def let_interrupts_raise() -> None:
    """From here on Ctrl-C raises KeyboardInterrupt: for commands that put things in order then."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(number: int, frame: FrameType | None) -> None:
    """Nothing has begun that would have to be stopped; an exception could be swallowed, or told in many lines."""
    os.write(2, b"error: stopped\n")
    os._exit(130)
