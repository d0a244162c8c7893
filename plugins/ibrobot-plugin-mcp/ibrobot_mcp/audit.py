"""The log of agents as a file, beside the recordings."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TextIO

from ibrobot_core.api import String
from ibrobot_core.app import AGENT_LOG, RunView

_KEPT = 1000


def audit_path(session: RunView) -> Path:
    """Where the log of a run is: in the dataset's folder, or in the user's folder for states without a recording."""
    recording = session.config.recording
    if recording is not None:
        return recording.folder / "agents.jsonl"
    states = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return states / "ibrobot" / "agents" / f"{session.config.robot.name}.jsonl"


class AuditFile:
    """Appends what is on `/agent/log` to a file, one JSON object in each line; each has the robot's name.

    Args:
        session: the run.
    """

    def __init__(self, session: RunView) -> None:
        self._session = session
        self._events = session.bus.subscribe(AGENT_LOG, _KEPT, String)
        self._file: TextIO | None = None
        self.path = audit_path(session)

    def write(self) -> None:
        """Write what has come."""
        events = self._events.drain()
        if not events:
            return
        if self._file is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("a", encoding="utf-8")
        for each in events:
            assert isinstance(each.message, String)
            entry = {"robot": self._session.config.robot.name, **json.loads(each.message.data)}
            self._file.write(json.dumps(entry) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Write what is left, and close the file."""
        self.write()
        self._events.close()
        if self._file is not None:
            self._file.close()
