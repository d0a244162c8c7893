"""Resources of agents: the robot's YAML, its services, and the recorded episodes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import mcp_types as types
from ibrobot_provenance.option_schemas import OptionSchemas

from ibrobot_core.api import IbrobotError, seconds
from ibrobot_core.app import RequestError, RunView, dump_yaml

_MOST = 500
"""Most episodes in the list, the newest ones."""


class Resources:
    """The resources of a run.

    Args:
        session: the run.
    """

    def __init__(self, session: RunView) -> None:
        self._session = session
        self._known: Mapping[str, tuple[str, str, Callable[[], str]]] = {
            "ibrobot://robot": ("application/yaml", "the robot YAML, without secrets", self._robot),
            "ibrobot://services": ("application/json", "the services of the run, with their requests", self._services),
            "ibrobot://episodes": ("application/json", "the recorded episodes", self._episodes),
        }

    def all(self) -> list[types.Resource]:
        """The resources."""
        return [
            types.Resource(uri=uri, name=uri.rpartition("/")[2], description=about, mime_type=kind)
            for uri, (kind, about, _) in self._known.items()
        ]

    def read(self, uri: str) -> tuple[str, str]:
        """MIME type and text of a resource.

        Raises:
            RequestError: if there is no such resource.
        """
        if uri not in self._known:
            raise RequestError(f"there is no resource {uri[:80]!r}; the resources are: {', '.join(self._known)}")
        kind, _, text = self._known[uri]
        return kind, text()

    def _robot(self) -> str:
        return dump_yaml(self._session.config.document)

    def _services(self) -> str:
        served = self._session.bus.services().items()
        return json.dumps({
            name: {
                "help": each.help, "request": OptionSchemas().of_class(each.request), "reads": each.reads,
                "persons": each.persons,
            }
            for name, each in served
        }, default=str)  # fmt: skip

    def _episodes(self) -> str:
        recording = self._session.config.recording
        if recording is None:
            return json.dumps({"episodes": [], "why": "the robot YAML has no section `recording`"})
        folder = recording.folder / "episodes"
        paths = sorted(folder.iterdir())[-_MOST:] if folder.is_dir() else []
        return json.dumps({"folder": str(recording.folder), "episodes": [self._episode(each) for each in paths]})

    def _episode(self, path: Path) -> Mapping[str, object]:
        try:
            reader = self._session.registry.open_episode(path)
            try:
                summary = reader.summary()
            finally:
                reader.close()
        except (IbrobotError, OSError) as error:
            return {"path": str(path), "unreadable": str(error)}
        duration_s = round(seconds(summary.end_ns - summary.start_ns), 2)
        prompt = summary.metadata.get("prompt", "")
        return {"path": str(path), "duration_s": duration_s, "outcome": summary.outcome, "prompt": prompt}
