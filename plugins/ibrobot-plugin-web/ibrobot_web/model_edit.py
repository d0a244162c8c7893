"""Puts a trained policy into a robot YAML by editing its text, so that comments and layout stay."""

from __future__ import annotations

import json
import re

import attrs
import yaml
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from ibrobot_core.api import IbrobotError

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
NEW_MODEL, NEW_MODE = "trained", "trained"


@attrs.frozen
class ModelEdit:
    """A robot YAML with a policy."""

    text: str
    mode: str
    """The control mode that runs the policy."""
    models: tuple[str, ...]
    """The models of the original whose path can be set."""


def with_model(text: str, path: str, type_: str, *, model: str = "", mode: str = "") -> ModelEdit:
    """The text of a robot YAML whose model has this path.

    A model that the YAML lacks is added, and a mode for it, with the executors of the default mode.

    Args:
        text: the YAML.
        path: folder of the trained policy.
        type_: the policy's type.
        model: the model; by default the first of this type, or else a new one.
        mode: the name of the mode if a new one is needed.

    Raises:
        IbrobotError: if the YAML has no mappings where the policy belongs, or a name cannot be used.
    """
    root = _parsed(text)
    models = _at(root, "models")
    known = tuple(name for name, each in _items(models) if _scalar(_at(each, "type")) == type_)
    model = model or (known[0] if known else NEW_MODEL)
    mode = mode or NEW_MODE
    for name in (model, mode):
        if _NAME.fullmatch(name) is None:
            raise IbrobotError(f"{name!r}: use letters, digits and _, e.g. pick_cube")
    entry = _at(models, model)
    if entry is not None and model not in known:
        raise IbrobotError(f"models.{model} is of another type; choose another name")
    old = _at(entry, "path")
    if old is not None:
        text = text[: old.start_mark.index] + json.dumps(path) + text[old.end_mark.index :]
    elif entry is not None:
        raise IbrobotError(f"models.{model} has no path; give it one in the file")
    else:
        text = _added(text, "models", model, f"{{type: {type_}, path: {json.dumps(path)}}}")
    root = _parsed(text)
    modes = _at(root, "control_modes")
    users = [name for name, each in _items(modes) if _scalar(_at(_at(each, "inference"), "model")) == model]
    if not users:
        if _at(modes, mode) is not None:
            raise IbrobotError(f"control_modes.{mode} exists already; choose another name")
        executors = _executors(root, modes)
        content = f"{{executors: [{', '.join(executors)}], inference: {{model: {model}}}}}"
        text = _added(text, "control_modes", mode, content)
        users = [mode]
    _check(text, model, path, users[0])
    return ModelEdit(text, users[0], known)


def _check(text: str, model: str, path: str, mode: str) -> None:
    """Check that the new text means what it should."""
    root = _parsed(text)
    set_to = _scalar(_at(_at(_at(root, "models"), model), "path"))
    used = _scalar(_at(_at(_at(_at(root, "control_modes"), mode), "inference"), "model"))
    if (set_to, used) != (path, model):
        raise IbrobotError(f"models.{model} cannot be set in this file without changing more; edit it by hand")


def _parsed(text: str) -> Node | None:
    try:
        return yaml.compose(text, yaml.SafeLoader)
    except (yaml.YAMLError, RecursionError) as error:
        raise IbrobotError(f"is not YAML: {error}") from None


def _items(node: Node | None) -> list[tuple[str, Node]]:
    if not isinstance(node, MappingNode):
        return []
    return [(str(key.value), value) for key, value in node.value]


def _at(node: Node | None, key: str) -> Node | None:
    return next((value for name, value in _items(node) if name == key), None)


def _scalar(node: Node | None) -> str | None:
    return str(node.value) if isinstance(node, ScalarNode) else None


def _executors(root: Node | None, modes: Node | None) -> list[str]:
    """The executors of the default mode, or of the first that follows setpoints."""
    default = _scalar(_at(root, "default_control_mode"))
    types = {name: _scalar(_at(each, "type")) for name, each in _items(_at(root, "executors"))}
    named = sorted(_items(modes), key=lambda item: item[0] != default)
    for _, mode in named:
        node = _at(mode, "executors")
        chosen = [str(each.value) for each in node.value] if isinstance(node, SequenceNode) else []
        if chosen and all(types.get(name) == "position" for name in chosen):
            return chosen
    return [name for name, type_ in types.items() if type_ == "position"]


def _added(text: str, section: str, name: str, content: str) -> str:
    """The text with another entry in a section, which is added if it is missing."""
    root = _parsed(text)
    node = _at(root, section)
    if not isinstance(node, MappingNode):
        if node is not None and _scalar(node) not in ("", "null", "~"):
            raise IbrobotError(f"{section} must be a mapping")
        if node is not None:
            raise IbrobotError(f"{section} is empty; remove the line, or give it entries")
        return f"{text.rstrip()}\n\n{section}:\n  {name}: {content}\n"
    if node.flow_style:
        end = node.end_mark.index - 1
        comma = ", " if node.value else ""
        return f"{text[:end]}{comma}{name}: {content}{text[end:]}"
    first = node.value[0][0].start_mark
    assert isinstance(root, MappingNode)
    key = next(each for each, _ in root.value if each.value == section)
    at = text.index("\n", key.end_mark.index) + 1  # below the section's own line, before comments on entries
    return f"{text[:at]}{' ' * first.column}{name}: {content}\n{text[at:]}"
