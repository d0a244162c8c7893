"""Real-time settings of this process, as far as the machine permits them."""

from __future__ import annotations

import ctypes
import gc
import os
import threading

_MCL_CURRENT_AND_FUTURE = 3


def go_real_time(priority: int) -> list[str]:
    """Set SCHED_FIFO for every thread, lock memory, and disable garbage collection.

    Args:
        priority: priority for SCHED_FIFO, 1..99.

    Returns:
        One line for each refused setting, with the remedy; empty if all were granted.
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
