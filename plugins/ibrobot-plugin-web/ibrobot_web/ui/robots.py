"""View: robots. Lists robot YAMLs, checks one, and launches it."""

from __future__ import annotations

import itertools
import re
import threading
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ibrobot_terminal.guide import installed_guides

from ibrobot_core.api import IbrobotError, option
from ibrobot_core.app import ConfigError, RobotConfig, find_config, installed_plugins, load_config, notes_of
from ibrobot_web.modes import modes_json
from ibrobot_web.ui.context import Routes, Ui
from ibrobot_web.ui.copying import variables_of, write_copy
from ibrobot_web.ui.recordings import Episodes, find_policies, find_recordings

_ROBOT = re.compile(r"^robot:", re.MULTILINE)
_SUMMARY = re.compile(r"\A(?:#[^\n]*\n)+")
_DEPTH = 4
"""Depth of folders in which robot YAMLs are found."""
_MOST = 200
"""Robot YAMLs that are listed."""
_HEAD = 1 << 16
"""Bytes of a file in which `robot:` is found."""
_SKIPPED = ("episodes", "datasets", "outputs")
_PAGE = re.compile(r"viewer: (?P<url>https?://\S+)(?:\s+\(to watch only: (?P<watch_url>\S+)\))?")
RUN_DONE = (0, 3)
"""Exit codes of runs that ended as they should; 3: not all episodes or goals succeeded."""
_checking = threading.Lock()


def listing(ui: Ui) -> list[dict[str, str]]:
    """The robots to choose from: `robot`, its summary, and where it is from."""
    robots = []
    plugins = {config.name: config.summary for config in installed_plugins().configs}
    for name, path in installed_plugins().shipped_configs().items():
        source = "plugin" if name in plugins else "ibrobot"
        robots.append({"robot": name, "source": source, "summary": plugins.get(name) or _summary(_head(path))})
    for path in _yamls(ui):
        robots.append({"robot": ui.folders.name(path), "source": "folder", "summary": _summary(_head(path))})
    return robots


def robot_names(ui: Ui) -> list[str]:
    """The robots to choose from, as requests name them: one's own first."""
    return [*(ui.folders.name(path) for path in _yamls(ui)), *installed_plugins().shipped_configs()]


def _yamls(ui: Ui) -> Iterator[Path]:
    """The robot YAMLs of the opened folders: not those that come with ibrobot, nor those within source packages."""
    shipped = {path.resolve() for path in installed_plugins().shipped_configs().values()}
    yamls = (path for path in _files(ui) if path.suffix in (".yaml", ".yml") and ui.folders.has(path))
    own = (path for path in yamls if path.resolve() not in shipped and _ROBOT.search(_head(path)))
    return itertools.islice(own, _MOST)


def _files(ui: Ui) -> Iterator[Path]:
    for parent, folders, names in ui.folders.walk(_DEPTH, _SKIPPED):
        if "pyproject.toml" in names:  # of its sources, only an opened folder is looked through, without its tests
            kept = set(folders) - {"tests"} if parent in ui.folders.paths else set()
            folders[:] = [each for each in folders if each in kept]
        yield from (parent / name for name in sorted(names))


def _head(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(_HEAD).decode(errors="replace")
    except OSError:
        return ""


def _summary(content: str) -> str:
    """The first sentence of the comment at a file's begin."""
    comment = _SUMMARY.match(content)
    words = " ".join(line.strip("# ") for line in comment[0].splitlines()) if comment is not None else ""
    return re.split(r"(?<=[.:]) ", words, maxsplit=1)[0].rstrip(".:")


def check(ui: Ui, robot: str, sim: bool = False) -> dict[str, Any]:
    """What `ibrobot config check` reports about a robot, and its modes and devices."""
    named = robot_of(ui, robot)
    registry = installed_plugins()
    with _checking:
        try:
            path = find_config(named, registry)
            config = load_config(path, sim=sim, registry=registry)
        except ConfigError as error:
            return {"problems": [_problem(ui, each) for each in error.problems]}
        except IbrobotError as error:
            return {"problems": [{"file": named, "line": 0, "path": "", "message": str(error)}]}
        notes = notes_of(config, registry)
    return {"problems": [], "notes": notes, **_facts(config)}


def _problem(ui: Ui, problem: Any) -> dict[str, Any]:
    file = str(problem.file)
    shown = ui.folders.name(Path(file)) if file.startswith("/") else file
    return {"file": shown, "line": problem.line, "path": problem.path, "message": problem.message}


def _facts(config: RobotConfig) -> dict[str, Any]:
    """What a page shows of a robot YAML without problems."""
    hardware = {} if config.simulated else config.hardware
    devices = {
        f"{name}: {what}": device for name, each in hardware.items() for what, device in each.options.devices().items()
    }
    modes = modes_json(config, installed_plugins(), terminal=False)
    recording = config.recording
    return {
        "name": config.robot.name, "simulated": config.simulated, "joints": list(config.robot.joint_names),
        "modes": modes, "mode": _mode_for_page(modes, config.default_control_mode), "devices": devices,
        "cameras": [name for name, each in config.peripherals.items() if each.kind == "camera"],
        "has_simulation": config.simulation is not None, "has_hardware": bool(config.hardware),
        "dataset": recording.dataset if recording is not None else "default",
        "max_duration_s": config.contract.max_duration_s,
    }  # fmt: skip


def _mode_for_page(modes: Iterable[Mapping[str, Any]], default: str) -> str:
    """The mode that a page chooses first: one that only the page drives, the default, or one that it can run."""
    available = [mode for mode in modes if not mode["unavailable"]]
    own = [mode["name"] for mode in available if mode["jogs"] and not mode["policy"]]
    names = [mode["name"] for mode in available]
    return next(iter(own), default if default in names or not names else names[0])


def overview(ui: Ui) -> dict[str, Any]:
    """What the opened folders contain, for a first look: counts, and the newest episodes."""
    recordings = find_recordings(ui.folders)
    rows = [ui.keep(Episodes).row(ui, path) for path in recordings.episodes]
    newest = sorted(rows, key=lambda row: row["began_s"] or 0.0, reverse=True)
    return {
        "robots": [{"robot": ui.folders.name(path), "summary": _summary(_head(path))} for path in _yamls(ui)],
        "episodes": len(rows),
        "unjudged": sum(row["outcome"] == "unknown" for row in rows),
        "newest": [{name: row[name] for name in ("path", "task", "outcome", "began_s")} for row in newest[:3]],
        "datasets": list(map(ui.folders.name, recordings.datasets)),
        "policies": sorted({ui.folders.name(_training_of(path)) for path, _ in find_policies(ui)}),
        "reports": sum(map(len, recordings.reports.values())),
    }


def _training_of(policy: Path) -> Path:
    """The folder of the training whose checkpoint a policy is, or of the policy itself."""
    return next((each.parent for each in policy.parents if each.name == "checkpoints"), policy)


def launch(ui: Ui, robot: str, sim: bool = False, mode: str = "") -> dict[str, int]:
    """Launch a robot with its page."""
    title = f"{Path(robot).stem}{' in simulation' if sim else ''}"
    arguments = ["launch", *run_arguments(ui, robot, sim, mode)]
    job = ui.jobs.start("run", title, arguments, read=read_address, done_codes=RUN_DONE)
    return {"number": job.number}


def copying(ui: Ui, robot: str) -> dict[str, Any]:
    """Values that a copy of a robot YAML may change: its name, and variables with the devices connected here.

    A variable such as `IBROBOT_LEADER_PORT` is offered what the guides' question `port` offers.
    """
    source = find_config(robot_of(ui, robot), installed_plugins())
    variables: dict[str, tuple[str, ...]] = {}
    for guide in installed_guides():
        for question in guide.questions():
            variables.setdefault(question.name, tuple(each for each in question.choices if "/" in each))
    return {
        "file": f"my_{source.stem}.yaml",
        "variables": [
            {"name": name, "default": default, "found": variables.get(name.rpartition("_")[2].lower(), ())}
            for name, default in variables_of(source).items()
        ],
    }


def copy(ui: Ui, robot: str, file: str, values: Mapping[str, str] = option(factory=dict)) -> dict[str, str]:
    """Copy a robot YAML into an opened folder, as `ibrobot config copy` does; `values` are its defaults."""
    target = ui.folders.find(file)
    if target.suffix not in (".yaml", ".yml"):
        raise IbrobotError(f"{file}: the name of a robot YAML ends with .yaml")
    source = find_config(robot_of(ui, robot), installed_plugins())
    write_copy(source, target, {name: value for name, value in values.items() if value})
    return {"robot": ui.folders.name(target)}


def robot_of(ui: Ui, name: str) -> str:
    """The robot that a request names: the name of a shipped one, or the path of a file in an opened folder.

    Raises:
        IbrobotError: if it is outside the opened folders.
    """
    return name if name in installed_plugins().shipped_configs() else str(ui.folders.find(name))


def run_arguments(ui: Ui, robot: str, sim: bool, mode: str) -> list[str]:
    """The arguments of a run: robot, body, mode and page."""
    return [
        robot_of(ui, robot),
        *(["--sim"] if sim else []),
        *([f"--mode={mode}"] if mode else []),
        *ui.run_options,
    ]


def read_address(line: str) -> Mapping[str, Any] | None:
    """The addresses of a run's page, from a line of its output."""
    match = _PAGE.search(line)
    return match.groupdict() if match is not None else None


ROUTES: Routes = {
    "GET /list": listing,
    "GET /overview": overview,
    "GET /check": check,
    "GET /copying": copying,
    "POST /copy": copy,
    "POST /launch": launch,
}
