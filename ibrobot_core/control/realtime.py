"""Real-time settings of this process, where the machine permits them, and what it did not permit."""

from __future__ import annotations

import ctypes
import gc
import os
import threading

_MCL_CURRENT_AND_FUTURE = 3


def go_real_time(priority: int) -> list[str]:
    """SCHED_FIFO for every thread, locked memory, no garbage collection in the loop.

    Args:
        priority: of SCHED_FIFO, 1..99.

    Returns:
        What was refused, with the remedy, a line each; empty where all was granted.
    """
    refused = []
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        for thread in threading.enumerate():
            os.sched_setscheduler(thread.native_id or 0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError) as error:
        refused.append(
            f"no real-time priority ({error}): under load the loop may be milliseconds late and pictures missing; "
            f"allow it with `@{os.environ.get('USER', 'user')} - rtprio 95` in /etc/security/limits.conf"
        )
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(_MCL_CURRENT_AND_FUTURE) != 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    except (AttributeError, OSError) as error:
        refused.append(f"memory is not locked ({error}): allow it with `memlock unlimited` in the same file")
    return refused
