"""Settings of all tests here: an example may take as long as it takes, since the machine may be busy; Ctrl-C works."""

from __future__ import annotations

import signal

from hypothesis import settings

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # As a shell's background job has it; children would inherit it, and Ctrl-C could end none of them.
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")
