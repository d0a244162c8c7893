"""The converting processes end on request, or are killed."""

from __future__ import annotations

import multiprocessing
import signal
import sys
import threading
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


def _keep_the_lock(job: int) -> int:
    """Job 1 passes its result to the pool, but then keeps the lock for results, until the process is terminated."""
    if job == 1:
        frame = sys._getframe()
        while "result_queue" not in frame.f_locals:
            assert frame.f_back is not None
            frame = frame.f_back
        writer = frame.f_locals["result_queue"]._writer
        send = writer.send_bytes

        def send_and_stay(data: bytes) -> None:
            send(data)
            time.sleep(600)

        writer.send_bytes = send_and_stay
    return job


def _interrupt(done: int, report: object) -> None:
    if report is not None:
        raise KeyboardInterrupt


def test_ctrl_c_ends_it_even_if_a_process_is_terminated_with_a_lock(monkeypatch: pytest.MonkeyPatch, fork_server: None):
    monkeypatch.setattr(run, "_convert_in_process", _keep_the_lock)
    interrupted = threading.Event()

    def convert() -> None:
        with pytest.raises(KeyboardInterrupt):
            list(run._run_in_processes([1, 2], 1, _interrupt))  # type: ignore[list-item]
        interrupted.set()

    thread = threading.Thread(target=convert, daemon=True)
    thread.start()
    try:
        assert interrupted.wait(60)
    finally:
        for process in multiprocessing.active_children():
            process.kill()
        thread.join(60)
