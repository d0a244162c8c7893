"""Names and limits of an MJCF, read as plain XML: checks of a robot YAML do not wait for MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import attrs

from ibrobot_kinematics.read_once import read_once
from ibrobot_kinematics.xml_file import XmlElement, read_xml

_PLACES = ("body", "frame", "replicate")
"""Elements that contain joints."""


@attrs.frozen(slots=False)
class MjcfNames:
    """Joints, bodies and sites of an MJCF."""

    files: tuple[Path, ...]
    """The file and those that it includes."""
    joints: tuple[str, ...]
    bodies: tuple[str, ...]
    sites: tuple[str, ...]
    limits: Mapping[str, tuple[float, float]]
    """Joint -> lower and upper limit [rad or m], for joints with limits."""
    places: Mapping[str, str]
    """Joint -> file and line."""


@read_once(lambda names: names.files)
def read_names(path: Path) -> MjcfNames:
    """Read an MJCF with its includes; a joint without limits has those of its default class.

    Raises:
        KinematicsError: if it is not an MJCF.
    """
    root = read_xml(path, "mujoco")
    files = (path, *_include(root, path.parent))
    compiler = {name: value for each in root.tagged("compiler") for name, value in each.attributes.items()}
    classes = _default_classes(root)
    limits: dict[str, tuple[float, float]] = {}
    joints = list(_joints(root))
    for joint, class_ in joints:
        name = joint.attributes.get("name")
        if class_ not in classes:
            raise joint.error(f"joint {name!r}: no default class {class_!r}; the classes are: {', '.join(classes)}")
        given = {**classes[class_], **joint.attributes}
        kind = given.get("type", "hinge")
        limited = given.get("limited", "auto")
        if limited == "auto":
            limited = compiler.get("autolimits", "true") if "range" in given else "false"
        if name is not None and kind in ("hinge", "slide") and limited == "true":
            lower, upper = attrs.evolve(joint, attributes=given).numbers("range", "0 0", 2)
            turn = math.pi / 180 if kind == "hinge" and compiler.get("angle", "degree") == "degree" else 1.0
            limits[name] = lower * turn, upper * turn
    places = {each.attributes.get("name", ""): f"{each.file.name}:{each.line}" for each, _ in joints}
    sites, bodies = _names(root.below(), "site"), _names(root.below(), "body")
    return MjcfNames(files, _names((joint for joint, _ in joints), "joint"), bodies, sites, limits, places)


def _names(elements: Iterable[XmlElement], tag: str) -> tuple[str, ...]:
    return tuple(each.attributes["name"] for each in elements if each.tag == tag and "name" in each.attributes)


def _include(root: XmlElement, folder: Path) -> list[Path]:
    """Replace includes by the content of the files, whose names are relative to the model's folder; returns these."""
    seen: list[Path] = []
    waiting = [root]
    while waiting:
        element = waiting.pop()
        children: list[XmlElement] = []
        todo = element.children[::-1]
        while todo:
            child = todo.pop()
            if child.tag != "include":
                children.append(child)
                continue
            file = folder / child.attributes.get("file", "")
            if file in seen:
                raise child.error(f"includes {file.name} a second time, which MuJoCo refuses")
            seen.append(file)
            todo += read_xml(file).children[::-1]
        element.children[:] = children
        waiting += children
    return seen


def _default_classes(root: XmlElement) -> dict[str, dict[str, str]]:
    """Default class -> attributes of its joints; joints without a class have class `main`."""
    classes: dict[str, dict[str, str]] = {"main": {}}
    waiting = [(element, "main") for element in reversed(root.children) if element.tag == "default"]
    while waiting:
        element, parent = waiting.pop()
        name = element.attributes.get("class", parent)
        own = dict(classes[parent])
        for child in element.children:
            own.update(child.attributes if child.tag == "joint" else {})
        classes[name] = own
        waiting += [(child, name) for child in reversed(element.children) if child.tag == "default"]
    return classes


def _joints(root: XmlElement) -> Iterator[tuple[XmlElement, str]]:
    """The joints below the world, each with its default class."""
    worlds = list(root.tagged("worldbody"))
    waiting = [(world, world.attributes.get("childclass", "main")) for world in reversed(worlds)]
    while waiting:
        element, class_ = waiting.pop()
        yield from ((child, child.attributes.get("class", class_)) for child in element.tagged("joint"))
        inner = [child for child in element.children if child.tag in _PLACES]
        waiting += [(child, child.attributes.get("childclass", class_)) for child in reversed(inner)]
