"""The log of agents as a file, beside the recordings."""

from __future__ import annotations

import json
import os
import queue
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

from ibrobot_core.app import Authority, RunView


def authority_of(session: RunView) -> Authority:
    """What agents may do in a run."""
    authority = session.authority
    assert isinstance(authority, Authority)
    return authority


def audit_path(session: RunView) -> Path:
    """Where the log of a run is: in the dataset's folder, or in the user's folder for states without a recording."""
    recording = session.config.recording
    if recording is not None:
        return recording.folder / "agents.jsonl"
    states = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return states / "ibrobot" / "agents" / f"{session.config.robot.name}.jsonl"


class AuditFile:
    """Appends what agents do to a file, one JSON object in each line; each has the robot's name.

    Args:
        session: the run.
    """

    def __init__(self, session: RunView) -> None:
        self._robot = session.config.robot.name
        self._authority = authority_of(session)
        self._events: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
        self._authority.told.append(self._events.put)
        self._file: TextIO | None = None
        self.path = audit_path(session)

    def write(self) -> None:
        """Write what has come."""
        while not self._events.empty():
            if self._file is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._file = self.path.open("a", encoding="utf-8")
            self._file.write(json.dumps({"robot": self._robot, **self._events.get()}, default=str) + "\n")
            self._file.flush()

    def close(self) -> None:
        """Write what is left, and close the file."""
        self._authority.told.remove(self._events.put)
        self.write()
        if self._file is not None:
            self._file.close()
