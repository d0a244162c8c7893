"""The entry point of `ibrobot`: while it starts, Ctrl-C ends it in one line, whatever it was about to import or read.

SIGTERM and SIGHUP do the same. This module imports next to nothing, so that it takes effect at once.
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
    """From here on Ctrl-C, SIGTERM and SIGHUP raise KeyboardInterrupt: for commands that put things in order then."""
    for number in _ENDING:
        if signal.getsignal(number) is _end:
            signal.signal(number, signal.default_int_handler)


def _end(number: int, frame: FrameType | None) -> None:
    """Nothing has begun that would have to be stopped; an exception could be swallowed, or printed in many lines."""
    os.write(2, b"error: stopped\n")
    os._exit(130)
