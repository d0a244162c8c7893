"""View: trained policies, which are put into robot YAMLs."""

from __future__ import annotations

import difflib
import hashlib
from pathlib import Path
from typing import Any

from ibrobot_provenance.files import replace_file

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import ConfigError, find_config, from_document, installed_plugins, parse_yaml
from ibrobot_web.model_edit import ModelEdit, with_model
from ibrobot_web.ui.context import Routes, Ui
from ibrobot_web.ui.recordings import find_policies, policy_type
from ibrobot_web.ui.robots import robot_of


def listing(ui: Ui) -> list[dict[str, Any]]:
    """The trained policies in the opened folders, the newest first."""
    return [
        {"path": ui.folders.name(path), "type": type_, "changed_s": path.stat().st_mtime}
        for path, type_ in find_policies(ui)
    ]


def preview(ui: Ui, robot: str, checkpoint: str, target: str = "", model: str = "", mode: str = "") -> dict[str, Any]:
    """The change of a robot YAML for a trained policy, as a diff, and where it would be written."""
    source, written, edit = _edited(ui, robot, checkpoint, target, model, mode)
    old = source.read_text(encoding="utf-8")
    names = (ui.folders.name(source) if written == source else source.name, ui.folders.name(written))
    diff = difflib.unified_diff(old.splitlines(), edit.text.splitlines(), *names, lineterm="", n=2)
    return {
        "diff": list(diff), "target": ui.folders.name(written), "new": written != source, "digest": _digest(old),
        "mode": edit.mode, "models": list(edit.models), "problems": _problems(edit.text, written),
    }  # fmt: skip


def apply(
    ui: Ui, digest: str, robot: str, checkpoint: str, target: str = "", model: str = "", mode: str = ""
) -> dict[str, str]:
    """Write the change that was shown, for a file with this digest."""
    source, written, edit = _edited(ui, robot, checkpoint, target, model, mode)
    if _digest(source.read_text(encoding="utf-8")) != digest:
        raise IbrobotError(f"{source.name} has changed since; look at the change again")
    if written != source and written.exists():
        raise IbrobotError(f"{ui.folders.name(written)} exists already; choose it as the robot, or another name")
    try:
        replace_file(written, edit.text)
    except OSError as error:
        raise IbrobotError(f"{ui.folders.name(written)}: cannot be written: {error.strerror}") from error
    return {"robot": ui.folders.name(written), "mode": edit.mode}


def _edited(ui: Ui, robot: str, checkpoint: str, target: str, model: str, mode: str) -> tuple[Path, Path, ModelEdit]:
    """The robot's file, the file to write, and its new text. Files outside the opened folders are copied into them.

    Args:
        ui: the page's server.
        robot: name of a shipped robot, or path of its YAML.
        checkpoint: folder of the trained policy.
        target: file to write; empty: the robot's own, or a new one.
        model: name of the model in the YAML.
        mode: name of the mode that runs it.
    """
    source = Path(find_config(robot_of(ui, robot), installed_plugins())).resolve()
    policy = ui.folders.find(checkpoint)
    inside = any(source.is_relative_to(folder) for folder in ui.folders.paths)
    written = source if inside else ui.folders.first / f"{source.stem}_trained.yaml"
    if target and not inside:
        written = ui.folders.find(target)
    if written.suffix not in (".yaml", ".yml"):
        raise IbrobotError(f"{ui.folders.name(written)}: a robot's file must end with .yaml")
    type_ = policy_type(policy)
    if type_ is None:
        raise IbrobotError(f"{ui.folders.name(policy)}: is not a trained policy of an installed plugin")
    text = source.read_text(encoding="utf-8")
    return source, written, with_model(text, str(policy), type_, model=model, mode=mode)


def _digest(content: str) -> str:
    return hashlib.sha256(content.encode()).hexdigest()


def _problems(content: str, target: Path) -> list[str]:
    """What the check of configurations says about the new text, without writing it."""
    try:
        document = parse_yaml(content, str(target))
        problems = [problem for _, problem in document.problems]
        if not problems:
            from_document(document.root, source=target, sim="simulation" in document.root)
    except ConfigError as error:
        problems = list(error.problems)
    except IbrobotError as error:
        return [str(error)]
    return [f"{each.path}: {each.message}" for each in problems]


ROUTES: Routes = {
    "GET /list": listing,
    "GET /preview": preview,
    "POST /apply": apply,
}
