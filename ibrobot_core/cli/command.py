"""The entry point of `ibrobot`. During the start, Ctrl-C ends it with one line, at any import or read.

SIGTERM and SIGHUP do the same. This module imports almost nothing, so that it takes effect at once.
"""

import os
import signal
from types import FrameType

_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def main() -> None:
    """Run the command line."""
    for number in _ENDING:
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:  # nohup ignores SIGHUP
            signal.signal(number, _end)
    from ibrobot_core.cli.main import main as run

    run()


def let_interrupts_raise() -> None:
    """Let Ctrl-C, SIGTERM and SIGHUP raise KeyboardInterrupt from now on, for commands that clean up."""
    for number in _ENDING:
        if signal.getsignal(number) is _end:
            signal.signal(number, signal.default_int_handler)


def _end(number: int, frame: FrameType | None) -> None:
    """Exit at once: nothing needs cleanup yet, and an exception could be swallowed or printed in many lines."""
    os.write(2, b"error: stopped\n")
    os._exit(130)
