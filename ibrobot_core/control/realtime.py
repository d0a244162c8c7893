"""Real-time settings of this process, as far as the machine permits them."""

from __future__ import annotations

import ctypes
import gc
import os
import threading

PERMIT = r"printf '%s - rtprio 95\n%s - memlock unlimited\n' $USER $USER | sudo tee /etc/security/limits.d/ibrobot.conf"
"""The shell command that permits both settings to the user, from the next login on."""
_MCL_CURRENT_AND_FUTURE = 3


def go_real_time(priority: int) -> list[str]:
    """Set SCHED_FIFO for every thread, lock memory, and disable garbage collection.

    Args:
        priority: priority for SCHED_FIFO, 1..99.

    Returns:
        One line with the refused settings and the remedy; empty if all were granted.
    """
    refused = []
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        for thread in threading.enumerate():
            os.sched_setscheduler(thread.native_id or 0, os.SCHED_FIFO, os.sched_param(priority))
    except AttributeError:
        return ["this system has no real-time priority: under load the loop may be milliseconds late"]
    except OSError as error:
        refused.append(f"no real-time priority ({error.strerror})")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT_AND_FUTURE) != 0:
        refused.append(f"memory is not locked ({os.strerror(ctypes.get_errno())})")
    if not refused:
        return []
    effect = "under load the loop may be milliseconds late and pictures missing"
    return [f"{', '.join(refused)}: {effect}; to permit it, run this and log in again: {PERMIT}"]
