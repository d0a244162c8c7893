"""Puts the mount of a camera into a robot YAML by editing its text, so that comments and layout stay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import yaml
from yaml.nodes import MappingNode, Node, SequenceNode

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import parse_yaml

_KEY = "transform"


def with_transform(text: str, camera: str, values: Mapping[str, str | Sequence[float]]) -> str:
    """The text of a robot YAML with the mount of a camera.

    Args:
        text: the YAML.
        camera: name of the peripheral.
        values: key of its `transform` -> value, as `parent`, `xyz` and `rpy`.

    Raises:
        IbrobotError: if the YAML has no such peripheral, or cannot be edited without changing more.
    """
    changed = text
    if _transform(changed, camera) is None:
        flow = ", ".join(f"{key}: {_text(value)}" for key, value in values.items())
        changed = _added(changed, _peripheral(changed, camera), _KEY, f"{{{flow}}}")
    else:
        for key, value in values.items():
            mount = _transform(changed, camera)
            assert mount is not None
            node = _value(mount, key)
            if node is not None:
                end = node.end_mark.index if node.value or not isinstance(node.value, str) else node.start_mark.index
                changed = changed[: node.start_mark.index] + _text(value) + changed[end:]
            else:
                changed = _added(changed, mount, key, _text(value))
    _check(text, changed, camera, values)
    return changed


def _text(value: str | Sequence[float]) -> str:
    return value if isinstance(value, str) else f"[{', '.join(f'{each:g}' for each in value)}]"


def _peripheral(text: str, camera: str) -> MappingNode:
    try:
        root = yaml.compose(text, yaml.SafeLoader)
    except (yaml.YAMLError, RecursionError) as error:
        raise IbrobotError(f"is not YAML: {error}") from None
    items = _value(root, "peripherals")
    for item in items.value if isinstance(items, SequenceNode) else ():
        name = _value(item, "name")
        if name is not None and name.value == camera and isinstance(item, MappingNode):
            return item
    raise IbrobotError(f"has no peripheral {camera!r} under `peripherals` in this file; put the mount there by hand")


def _transform(text: str, camera: str) -> MappingNode | None:
    node = _value(_peripheral(text, camera), _KEY)
    if node is not None and not isinstance(node, MappingNode):
        raise IbrobotError(f"peripherals.{camera}.{_KEY} must be a mapping")
    return node


def _value(node: Node | None, key: str) -> Node | None:
    pairs = node.value if isinstance(node, MappingNode) else ()
    return next((value for name, value in pairs if name.value == key), None)


def _added(text: str, node: MappingNode, key: str, value: str) -> str:
    """The text with another key at the end of a mapping."""
    if node.flow_style:
        end = node.end_mark.index - 1
        comma = ", " if node.value else ""
        while text[end - 1] in " \n\t" and not text[:end].rpartition("\n")[2].lstrip().startswith("#"):
            end -= 1
        return f"{text[:end]}{comma}{key}: {value}{text[end:]}"
    first, last = node.value[0][0], node.value[-1][1]
    at = text.find("\n", _end(last))
    head, tail = (text + "\n", "") if at < 0 else (text[: at + 1], text[at + 1 :])
    return f"{head}{' ' * first.start_mark.column}{key}: {value}\n{tail}"


def _end(node: Node) -> int:
    """Where the last scalar or flow collection of a node ends: a block's own mark is where the next key begins."""
    while isinstance(node, MappingNode | SequenceNode) and not node.flow_style and node.value:
        last = node.value[-1]
        node = last[1] if isinstance(last, tuple) else last
    return int(node.end_mark.index)


def _check(before: str, after: str, camera: str, values: Mapping[str, str | Sequence[float]]) -> None:
    """Check that the new text differs in the mount alone."""
    old, new = (parse_yaml(text, "", expands=False) for text in (before, after))
    for document in (old, new):
        for item in document.root["peripherals"]:
            if item.get("name") == camera:
                mount = item.pop(_KEY, None)
    expected = {
        key: value if isinstance(value, str) else [float(f"{each:g}") for each in value]
        for key, value in values.items()
    }
    if old.root != new.root or any(mount.get(key) != value for key, value in expected.items()):
        raise IbrobotError(
            f"the mount of {camera} cannot be set in this file without changing more; put it there by hand"
        )
