"""View: trained policies, which are put into robot YAMLs."""

from __future__ import annotations

import difflib
import hashlib
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import IbrobotError, option, replace_file
from ibrobot_core.app import ConfigError, NoRequest, find_config, from_document, installed_plugins, parse_yaml
from ibrobot_web.model_edit import ModelEdit, with_model
from ibrobot_web.ui.context import Route, Ui
from ibrobot_web.ui.recordings import find_policies, policy_type
from ibrobot_web.ui.robots import robot_of


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


def listing(ui: Ui, request: NoRequest) -> list[dict[str, Any]]:
    """The trained policies in the opened folders, the newest first."""
    return [
        {"path": ui.folders.name(path), "type": type_, "changed_s": path.stat().st_mtime}
        for path, type_ in find_policies(ui)
    ]


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
    try:
        replace_file(target, edit.text)
    except OSError as error:
        raise IbrobotError(f"{ui.folders.name(target)}: cannot be written: {error.strerror}") from error
    return {"robot": ui.folders.name(target), "mode": edit.mode}


def _edited(ui: Ui, request: Change) -> tuple[Path, Path, ModelEdit]:
    """The robot's file, the file to write, and its new text. Files outside the opened folders are copied into them."""
    source = Path(find_config(robot_of(ui, request.robot), installed_plugins())).resolve()
    checkpoint = ui.folders.find(request.checkpoint)
    inside = any(source.is_relative_to(folder) for folder in ui.folders.paths)
    target = source if inside else ui.folders.first / f"{source.stem}_trained.yaml"
    given = request.target
    if given and not inside:
        target = ui.folders.find(given)
    if target.suffix not in (".yaml", ".yml"):
        raise IbrobotError(f"{ui.folders.name(target)}: a robot's file must end with .yaml")
    type_ = policy_type(checkpoint)
    if type_ is None:
        raise IbrobotError(f"{ui.folders.name(checkpoint)}: is not a trained policy of an installed plugin")
    text = source.read_text(encoding="utf-8")
    return source, target, with_model(text, str(checkpoint), type_, model=request.model, mode=request.mode)


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
    "GET /preview": Route(preview, Change),
    "POST /apply": Route(apply, AgreedChange),
}
