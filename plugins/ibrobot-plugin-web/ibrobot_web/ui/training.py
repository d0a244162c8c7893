"""View: training by `ibrobot train`, and trained policies in robot YAMLs."""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ibrobot_core.api import ConfigError, IbrobotError, find_config, from_document, installed_plugins, parse_yaml
from ibrobot_web.model_edit import ModelEdit, with_model
from ibrobot_web.ui.context import Handler, Ui, integer, text
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


def listing(ui: Ui, facts: Mapping[str, Any]) -> dict[str, Any]:
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


def start(ui: Ui, facts: Mapping[str, Any]) -> dict[str, int]:
    """Begin a training."""
    dataset, out = ui.folders.find(text(facts, "dataset")), ui.folders.find(text(facts, "out"))
    policy, device = text(facts, "policy", "small_act"), text(facts, "device", "auto")
    if _WORD.fullmatch(policy) is None or _DEVICE.fullmatch(device) is None:
        raise IbrobotError(f"policy {policy!r} and device {device!r} must be names, e.g. act and cuda:0")
    steps, batch_size = integer(facts, "steps", least=1), integer(facts, "batch_size", least=1)
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


def preview(ui: Ui, facts: Mapping[str, Any]) -> dict[str, Any]:
    """The change of a robot YAML for a trained policy, as a diff, and where it would be written."""
    source, target, edit = _edited(ui, facts)
    old = source.read_text(encoding="utf-8")
    names = (ui.folders.name(source) if target == source else source.name, ui.folders.name(target))
    diff = difflib.unified_diff(old.splitlines(), edit.text.splitlines(), *names, lineterm="", n=2)
    return {
        "diff": list(diff), "target": ui.folders.name(target), "new": target != source, "digest": _digest(old),
        "mode": edit.mode, "models": list(edit.models), "problems": _problems(edit.text, target),
    }  # fmt: skip


def apply(ui: Ui, facts: Mapping[str, Any]) -> dict[str, str]:
    """Write the change that was shown."""
    source, target, edit = _edited(ui, facts)
    if _digest(source.read_text(encoding="utf-8")) != text(facts, "digest"):
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


def _edited(ui: Ui, facts: Mapping[str, Any]) -> tuple[Path, Path, ModelEdit]:
    """The robot's file, the file to write, and its new text. Files outside the opened folders are copied into them."""
    source = Path(find_config(robot_of(ui, facts), installed_plugins())).resolve()
    checkpoint = ui.folders.find(text(facts, "checkpoint"))
    if not (checkpoint / "config.json").is_file():
        raise IbrobotError(f"{ui.folders.name(checkpoint)}: is not a trained policy: it has no config.json")
    inside = any(source.is_relative_to(folder) for folder in ui.folders.paths)
    target = source if inside else ui.folders.first / f"{source.stem}_trained.yaml"
    given = text(facts, "target", "")
    if given and not inside:
        target = ui.folders.find(given)
    if target.suffix not in (".yaml", ".yml"):
        raise IbrobotError(f"{ui.folders.name(target)}: a robot's file must end with .yaml")
    model, mode = text(facts, "model", ""), text(facts, "mode", "")
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


ROUTES: dict[str, Handler] = {
    "GET /list": listing,
    "POST /start": start,
    "GET /preview": preview,
    "POST /apply": apply,
}
