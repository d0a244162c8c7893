"""Resources of agents: robot YAML, services, episodes, datasets, evaluations, and the documentation of packages."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Any

import mcp_types as types
from ibrobot_provenance.option_schemas import OptionSchemas
from ibrobot_provenance.reports import ReportDescriptor, kinds_of_reports

from ibrobot_core.api import IbrobotError, seconds
from ibrobot_core.app import RequestError, RunView, dump_yaml, installed_plugins
from ibrobot_mcp.work import Places, report_lines, unreadable

_MOST = 500
"""Most episodes in the list, the newest ones."""
_MOST_FOLDERS = 200
"""Most datasets, and most results, in a list."""
_LARGEST_INFO = 1_000_000
"""Largest description of a dataset that is read [bytes]."""
_INFO = Path("meta") / "info.json"
DOCUMENTATION, EVALUATIONS = "ibrobot://documentation", "ibrobot://evaluations"


class Resources:
    """The resources of a run.

    Args:
        session: the run.
    """

    def __init__(self, session: RunView) -> None:
        self._session = session
        self._places = Places(session)
        self._known: Mapping[str, tuple[str, str, Callable[[], str]]] = {
            "ibrobot://robot": ("application/yaml", "the robot YAML, without secrets", self._robot),
            "ibrobot://services": ("application/json", "the services of the run, with their requests", self._services),
            "ibrobot://episodes": ("application/json", "the recorded episodes", self._episodes),
            "ibrobot://datasets": ("application/json", "the datasets beside them", self._datasets),
            EVALUATIONS: ("application/json", "evaluations and other kept results, with their outcome", self._results),
            DOCUMENTATION: ("application/json", "the installed packages, with what each is for", self._packages),
        }
        self._parts: Mapping[str, tuple[str, str, Callable[[str], str]]] = {
            EVALUATIONS: ("text/plain", "the report of one of the evaluations", self._result),
            DOCUMENTATION: ("text/markdown", "the documentation of a package", self._package),
        }

    def all(self) -> list[types.Resource]:
        """The resources."""
        return [
            types.Resource(uri=uri, name=uri.rpartition("/")[2], description=about, mime_type=kind)
            for uri, (kind, about, _) in self._known.items()
        ]

    def templates(self) -> list[types.ResourceTemplate]:
        """The resources of which there are several."""
        return [
            types.ResourceTemplate(
                uri_template=f"{uri}/{{name}}",
                name=f"{uri.rpartition('/')[2]} by name",
                description=about,
                mime_type=kind,
            )
            for uri, (kind, about, _) in self._parts.items()
        ]

    def read(self, uri: str) -> tuple[str, str]:
        """MIME type and text of a resource.

        Raises:
            RequestError: if there is no such resource.
        """
        if uri in self._known:
            kind, _, text = self._known[uri]
            return kind, text()
        for top, (kind, _, read) in self._parts.items():
            if uri.startswith(f"{top}/"):
                return kind, read(uri.removeprefix(f"{top}/"))
        known = ", ".join([*self._known, *(f"{each}/NAME" for each in self._parts)])
        raise RequestError(f"there is no resource {uri[:80]!r}; the resources are: {known}")

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

    def _datasets(self) -> str:
        tops = [self._places.results, *([] if self._places.root is None else [self._places.root])]
        folders = [each for top in tops for where in (top, top / "datasets") for each in _folders(where)]
        known = [each for each in dict.fromkeys(folders) if (each / _INFO).is_file() or (each / "episodes").is_dir()]
        return json.dumps({"datasets": [_dataset(each) for each in known[-_MOST_FOLDERS:]]})

    def _kept(self) -> Iterator[tuple[Path, ReportDescriptor]]:
        """The results that are kept, each with what reads it."""
        kinds = kinds_of_reports().values()
        for top in self._places.kept():
            for folder in list(_folders(top))[-_MOST_FOLDERS:]:
                yield from ((folder, each) for each in kinds if each.reads(folder))

    def _results(self) -> str:
        rows: list[Mapping[str, Any]] = []
        for folder, kind in self._kept():
            try:
                why = unreadable(folder)
                facts: Mapping[str, Any] = {"unreadable": why} if why else {"lines": list(kind.lines(folder))}
            except (IbrobotError, OSError) as error:
                facts = {"unreadable": str(error)}
            rows.append({"name": folder.name, "kind": kind.type, "path": str(folder), **facts})
        return json.dumps({"evaluations": rows})

    def _result(self, name: str) -> str:
        known = {folder.name: (folder, kind) for folder, kind in self._kept()}
        if name not in known:
            raise RequestError(f"there is no evaluation {name[:80]!r}; these are: {', '.join(known) or 'none'}")
        folder, kind = known[name]
        return "\n".join(report_lines(kind.type, folder))

    def _packages(self) -> str:
        return json.dumps({"packages": {name: metadata(name)["Summary"] for name in self._installed()}})

    def _package(self, name: str) -> str:
        if name not in (known := self._installed()):
            raise RequestError(f"there is no documentation of {name[:80]!r}; there is of: {', '.join(known)}")
        about = metadata(name)
        return str(about["Description"] if "Description" in about else about["Summary"])

    def _installed(self) -> list[str]:
        """The packages of this program that are installed."""
        known = []
        for name in sorted(installed_plugins().versions()):
            try:
                metadata(name)
            except PackageNotFoundError:  # a plugin of a folder
                continue
            known.append(name)
        return known


def _folders(top: Path) -> list[Path]:
    try:
        return sorted(each for each in top.iterdir() if each.is_dir() and not each.name.startswith("."))
    except OSError:
        return []


def _dataset(folder: Path) -> Mapping[str, Any]:
    """What a dataset has: one of LeRobot's, or recorded episodes."""
    file = folder / _INFO
    if not file.is_file():
        episodes = sum(1 for each in (folder / "episodes").iterdir() if each.is_dir())
        return {"path": str(folder), "kind": "recordings", "episodes": episodes}
    try:
        with file.open("rb") as opened:
            info = json.loads(opened.read(_LARGEST_INFO))
        facts = {"episodes": info["total_episodes"], "fps": info["fps"], "features": sorted(info["features"])}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        return {"path": str(folder), "kind": "lerobot", "unreadable": repr(error)}
    return {"path": str(folder), "kind": "lerobot", **facts}
