"""The converting processes end on request, or are killed."""

from __future__ import annotations

import multiprocessing
import signal
import time
from multiprocessing.connection import Connection

import pytest
from ibrobot_data import run


def _deaf(ready: Connection) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    ready.send(None)
    time.sleep(600)


def test_a_process_that_ignores_its_end_is_killed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(run, "_END_S", 0.1)
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_deaf, args=(theirs,))
    process.start()
    assert ours.poll(60)
    ours.recv()
    run.end_processes([process])
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    process.close()
    ours.close()
    theirs.close()
