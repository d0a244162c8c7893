"""The log of agents as a file, beside the recordings."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ibrobot_terminal.authority import authority_of

from ibrobot_core.api import HardwareError
from ibrobot_core.app import RunView

LATE_S = 5.0
"""How long an entry may wait to be written [s]."""
_AGAIN_S = 1.0
"""Time after which a write that failed is tried again [s]."""


def audit_path(session: RunView) -> Path:
    """Where the log of a run is: in the dataset's folder, or in the user's folder for states without a recording."""
    recording = session.config.recording
    if recording is not None:
        return recording.folder / "agents.jsonl"
    return states_folder() / f"{session.config.robot.name}.jsonl"


def states_folder() -> Path:
    """The user's folder for what agents did in runs without a recording."""
    states = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return states / "ibrobot" / "agents"


class AuditFile:
    """Appends what agents do to a file, one JSON object in each line; each has the robot's name.

    A thread writes, so that a slow disk delays nobody. What cannot be written waits, and is tried again; meanwhile no
    agent has authority, since what moved would be lost if the run ended.

    Args:
        session: the run.
    """

    def __init__(self, session: RunView) -> None:
        self._session = session
        self._robot = session.config.robot.name
        self._authority = authority_of(session)
        self._waiting: deque[tuple[float, bytes]] = deque()
        """When each entry came, by `time.monotonic` [s], and its line; the first ones are being written."""
        self._came = threading.Event()
        self._ending = threading.Event()
        self._failure = ""
        self.path = audit_path(session)
        self._thread = threading.Thread(target=self._write_on, name="log of agents", daemon=True)
        self._thread.start()
        self._authority.told.append(self._take)

    @property
    def trouble(self) -> str:
        """Why the log cannot be relied on; empty if it can."""
        if self._failure:
            return f"the log of agents cannot be written: {self._failure}"
        with contextlib.suppress(IndexError):  # none waits
            if time.monotonic() - self._waiting[0][0] > LATE_S:
                return f"the log of agents has not been written for {LATE_S:g} s: {self.path}"
        return ""

    def close(self) -> None:
        """Write what is left, and close the file; say what could not be written."""
        self._authority.told.remove(self._take)
        self._ending.set()
        self._came.set()
        self._thread.join(LATE_S)
        if self._waiting:
            lost = f"{len(self._waiting)} entries of the log of agents were not written"
            self._session.log.error("%s: %s", lost, self._failure or self.path)

    def _take(self, entry: Mapping[str, Any]) -> None:
        line = json.dumps({"robot": self._robot, **entry}, default=str) + "\n"
        self._waiting.append((time.monotonic(), line.encode()))
        self._came.set()
        if entry["event"] == "armed" and (trouble := self.trouble):
            self._authority.end(trouble)
            raise HardwareError(f"{trouble}; nothing was granted")

    def _write_on(self) -> None:
        with contextlib.ExitStack() as stack:
            descriptor = -1
            left = b""
            while self._waiting or not self._ending.is_set():
                if not self._waiting:
                    self._came.wait()
                    self._came.clear()
                    continue
                left = left or self._waiting[0][1]
                try:
                    if descriptor >= 0 and not os.fstat(descriptor).st_nlink:  # removed: what follows would be lost
                        stack.close()
                        descriptor, left = -1, self._waiting[0][1]
                    if descriptor < 0:
                        descriptor = self._open(stack)
                        left = b"\n" * _is_torn(descriptor) + left
                    left = left[os.write(descriptor, left) :]
                except OSError as error:
                    self._fails(error)
                    if self._ending.wait(_AGAIN_S):
                        return
                    continue
                if not left:
                    self._waiting.popleft()
                    self._failure = ""

    def _open(self, stack: contextlib.ExitStack) -> int:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        stack.callback(os.close, descriptor)
        return descriptor

    def _fails(self, error: OSError) -> None:
        failure = f"{self.path}: {error.strerror}"
        if failure != self._failure:
            self._failure = failure
            self._session.log.error("%s; no agent has authority until it can", self.trouble)


def _is_torn(descriptor: int) -> bool:
    """Whether the last line of a file lacks its end, as a full disk leaves it."""
    size = os.fstat(descriptor).st_size
    return size > 0 and os.pread(descriptor, 1, size - 1) != b"\n"
