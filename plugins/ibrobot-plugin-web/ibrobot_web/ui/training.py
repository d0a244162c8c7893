"""View: training by `ibrobot train`, and trained policies in robot YAMLs."""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import IbrobotError, option
from ibrobot_core.app import ConfigError, NoRequest, find_config, from_document, installed_plugins, parse_yaml
from ibrobot_web.model_edit import ModelEdit, with_model
from ibrobot_web.ui.context import Route, Ui
from ibrobot_web.ui.convert import parse_event
from ibrobot_web.ui.job_runner import Reader
from ibrobot_web.ui.recordings import find_recordings
from ibrobot_web.ui.robots import robot_of

_INSTALL = "pip install 'lerobot[dataset,training]>=0.6.1,<0.7'"
_POINTS = 400
"""Points of the loss that are kept."""
_MOST = 200
"""Checkpoints that are listed."""
_DEPTH = 7
_WORD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_DEVICE = re.compile(r"[a-z]+(:\d+)?")


@attrs.frozen
class Training:
    """What to train."""

    dataset: str = option(help="dataset to train on")
    out: str = option(help="folder of the checkpoints")
    steps: int = option(ge=1, le=100_000_000, help="number of steps")
    batch_size: int = option(ge=1, le=1_000_000, help="frames of a step")
    policy: str = option("small_act", help="type of the policy")
    device: str = option("auto", help="where it is trained, e.g. cuda:0")


@attrs.frozen
class Change:
    """A change of a robot YAML for a trained policy."""

    robot: str = option(help="name of a shipped robot, or path of its YAML")
    checkpoint: str = option(help="folder of the trained policy")
    target: str = option("", help="file to write; empty: the robot's own, or a new one")
    model: str = option("", help="name of the model in the YAML")
    mode: str = option("", help="name of the mode that runs it")


@attrs.frozen(kw_only=True)
class AgreedChange(Change):
    """A change that was shown."""

    digest: str = option(help="of the file for which it was shown")


def listing(ui: Ui, request: NoRequest) -> dict[str, Any]:
    """Datasets to train on, trained policies, and what is missing for training."""
    registry = installed_plugins()
    missing = "" if "train" in registry.commands else "pip install ibrobot-plugin-lerobot"
    if not missing and find_spec("lerobot") is None:
        missing = _INSTALL
    return {
        "missing": missing,
        "datasets": [ui.folders.name(path) for path in find_recordings(ui.folders.paths).datasets],
        "checkpoints": [_row(ui, path) for path in _checkpoints(ui)],
    }


def _checkpoints(ui: Ui) -> Iterator[Path]:
    """Folders with a trained policy, the newest first."""
    found = []
    for folder in ui.folders.paths:
        for parent, folders, names in folder.walk():
            depth = len(parent.relative_to(folder).parts)
            folders[:] = [each for each in folders if not each.startswith(".")] if depth < _DEPTH else []
            if parent.name == "pretrained_model" and "config.json" in names:
                found.append(parent)
                folders.clear()
    yield from sorted(found, key=lambda path: (path / "config.json").stat().st_mtime_ns, reverse=True)[:_MOST]


def _row(ui: Ui, path: Path) -> dict[str, Any]:
    return {"path": ui.folders.name(path), "changed_s": (path / "config.json").stat().st_mtime}


def start(ui: Ui, request: Training) -> dict[str, int]:
    """Begin a training."""
    dataset, out = ui.folders.find(request.dataset), ui.folders.find(request.out)
    policy, device = request.policy, request.device
    if _WORD.fullmatch(policy) is None or _DEVICE.fullmatch(device) is None:
        raise IbrobotError(f"policy {policy!r} and device {device!r} must be names, e.g. act and cuda:0")
    steps, batch_size = request.steps, request.batch_size
    arguments = [
        "train", "--events", f"--out={out}", f"--policy={policy}", f"--device={device}", f"--steps={steps}",
        f"--batch-size={batch_size}", str(dataset),
    ]  # fmt: skip
    known = {"dataset": ui.folders.name(dataset), "out": ui.folders.name(out), "points": [], "progress": 0.0}
    title = f"Train {policy} on {dataset.name}"
    return {"number": ui.jobs.start("train", title, arguments, facts=known, read=event_reader(ui)).number}


def event_reader(ui: Ui) -> Reader:
    """A function that reads the events of `ibrobot train --events`: progress, text, points of the loss, checkpoint."""
    points: list[tuple[int, float]] = []
    reports: list[tuple[int, float]] = []
    """The first report's step and time, before which LeRobot loads, and the newest one's."""

    def read(line: str) -> Mapping[str, Any] | None:
        event = parse_event(line)
        match event.get("event"):
            case "begin":
                goes_on = f"continues from step {event['step']} of" if event["step"] else "begins:"
                return {"steps": event["steps"], "text": f"{goes_on} {event['steps']} steps"}
            case "phase":
                return {"text": f"{event['text']} …"}
            case "progress":
                step, steps = int(event["step"]), int(event["steps"])
                points.append((step, float(event["loss"])))
                del points[:-_POINTS]
                reports[1:] = [(step, float(event["seconds"]))]
                left = f", {_left(reports, steps)} left" if len(reports) > 1 else ""
                return {
                    "progress": step / steps,
                    "points": list(points),
                    "text": f"step {step} of {steps}, loss {event['loss']:.4g}{left}",
                }
            case "report":
                checkpoint = ui.folders.name(Path(event["checkpoint"]).resolve())
                return {"progress": 1.0, "checkpoint": checkpoint, "text": f"trained: {checkpoint}"}
        return None

    return read


def _left(reports: Sequence[tuple[int, float]], steps: int) -> str:
    """The time left, from the rate since the first report."""
    (first, begin_s), (step, now_s) = reports
    left_s = (now_s - begin_s) / max(1, step - first) * (steps - step)
    return f"about {left_s / 60:.0f} min" if left_s >= 60 else "less than a minute"


def preview(ui: Ui, request: Change) -> dict[str, Any]:
    """The change of a robot YAML for a trained policy, as a diff, and where it would be written."""
    source, target, edit = _edited(ui, request)
    old = source.read_text(encoding="utf-8")
    names = (ui.folders.name(source) if target == source else source.name, ui.folders.name(target))
    diff = difflib.unified_diff(old.splitlines(), edit.text.splitlines(), *names, lineterm="", n=2)
    return {
        "diff": list(diff), "target": ui.folders.name(target), "new": target != source, "digest": _digest(old),
        "mode": edit.mode, "models": list(edit.models), "problems": _problems(edit.text, target),
    }  # fmt: skip


def apply(ui: Ui, request: AgreedChange) -> dict[str, str]:
    """Write the change that was shown."""
    source, target, edit = _edited(ui, request)
    if _digest(source.read_text(encoding="utf-8")) != request.digest:
        raise IbrobotError(f"{source.name} has changed since; look at the change again")
    if target != source and target.exists():
        raise IbrobotError(f"{ui.folders.name(target)} exists already; choose it as the robot, or another name")
    staged = target.with_name(f".{target.name}.new")
    try:
        staged.write_text(edit.text, encoding="utf-8")
        staged.replace(target)
    except OSError as error:
        raise IbrobotError(f"{ui.folders.name(target)}: cannot be written: {error.strerror}") from error
    return {"robot": ui.folders.name(target), "mode": edit.mode}


def _edited(ui: Ui, request: Change) -> tuple[Path, Path, ModelEdit]:
    """The robot's file, the file to write, and its new text. Files outside the opened folders are copied into them."""
    source = Path(find_config(robot_of(ui, request.robot), installed_plugins())).resolve()
    checkpoint = ui.folders.find(request.checkpoint)
    if not (checkpoint / "config.json").is_file():
        raise IbrobotError(f"{ui.folders.name(checkpoint)}: is not a trained policy: it has no config.json")
    inside = any(source.is_relative_to(folder) for folder in ui.folders.paths)
    target = source if inside else ui.folders.first / f"{source.stem}_trained.yaml"
    given = request.target
    if given and not inside:
        target = ui.folders.find(given)
    if target.suffix not in (".yaml", ".yml"):
        raise IbrobotError(f"{ui.folders.name(target)}: a robot's file must end with .yaml")
    model, mode = request.model, request.mode
    return source, target, with_model(source.read_text(encoding="utf-8"), str(checkpoint), model=model, mode=mode)


def _digest(content: str) -> str:
    return hashlib.sha256(content.encode()).hexdigest()


def _problems(content: str, target: Path) -> list[str]:
    """What the check of configurations says about the new text, without writing it."""
    try:
        document = parse_yaml(content, str(target))
        found = [problem for _, problem in document.problems]
        if not found:
            from_document(document.root, source=target, sim="simulation" in document.root)
    except ConfigError as error:
        found = list(error.problems)
    except IbrobotError as error:
        return [str(error)]
    return [f"{each.path}: {each.message}" for each in found]


ROUTES: dict[str, Route[Any]] = {
    "GET /list": Route(listing, NoRequest),
    "POST /start": Route(start, Training),
    "GET /preview": Route(preview, Change),
    "POST /apply": Route(apply, AgreedChange),
}
