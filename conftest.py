"""Settings of all tests here: no deadlines, since the machine may be busy; signals work; remedies name pip."""

from __future__ import annotations

import gc
import os
import signal

from hypothesis import settings

# A shell's background job ignores Ctrl-C, and one of nohup a hangup: what tests start would inherit that.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

os.environ["IBROBOT_INSTALLER"] = "pip install"  # in remedies, whatever installed what runs here
os.environ.pop("UV_RUN_RECURSION_DEPTH", None)  # with it, the commands in messages begin with `uv run`

gc.disable()  # what collecting tests makes stays: no garbage is looked for in it, now or later


def pytest_collection_finish() -> None:
    """Called by pytest."""
    gc.freeze()
    gc.enable()


settings.register_profile("untimed", deadline=None)
settings.register_profile("few", deadline=None, max_examples=5)  # where another run looks for rare examples
settings.load_profile("untimed")
