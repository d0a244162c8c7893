"""Joints and frames of URDF and MJCF models, read as plain XML, without the libraries that use the models."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from xml.parsers import expat

import attrs

_MAX_BYTES = 16 << 20
_PLACES = ("body", "frame", "replicate")
"""Elements of an MJCF that contain joints."""


class ModelError(ValueError):
    """A model cannot be read, e.g. since the file is not XML; the message names file and line."""


@attrs.frozen
class Limits:
    """Position limits of a joint in a model [rad, or m for a sliding joint]."""

    lower: float
    upper: float
    place: str
    """File and line of the joint."""


@attrs.frozen
class DescriptionModel:
    """The parts of a model that a robot YAML refers to."""

    limits: Mapping[str, Limits]
    """Joint -> limits, for joints with limits."""
    frames: tuple[str, ...]
    """Candidates for the tip: sites of an MJCF, links of a URDF."""
    frame: str
    """The word for such a frame: site or link."""
    joints: tuple[str, ...] = ()
    """All joints of an MJCF; none for a URDF, which may describe a part of the robot."""
    links: tuple[str, ...] = ()
    """Bodies of an MJCF, links of a URDF."""


@attrs.frozen
class XmlElement:
    """An XML element."""

    tag: str
    attributes: Mapping[str, str]
    file: Path
    line: int
    children: list[XmlElement] = attrs.field(factory=list)

    def error(self, message: str) -> ModelError:
        """An error that names the place of this element."""
        return ModelError(f"{self.file}:{self.line}: {message}")

    def numbers(self, name: str, default: str, count: int) -> list[float]:
        """The numbers in an attribute.

        Raises:
            ModelError: if they are not `count` finite numbers.
        """
        text = self.attributes.get(name, default)
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            numbers = []
        if len(numbers) != count or not all(map(math.isfinite, numbers)):
            raise self.error(f"{name} is {text!r}, must be {count} finite number{'s' if count > 1 else ''}")
        return numbers

    def below(self) -> Iterator[XmlElement]:
        """All descendants, in file order."""
        waiting = self.children[::-1]
        while waiting:
            element = waiting.pop()
            yield element
            waiting += element.children[::-1]


def read_xml(path: Path, root: str = "") -> XmlElement:
    """The root element of an XML file. Document types, and so entities, are refused.

    Args:
        path: the file.
        root: the tag of its root element; empty for any.

    Raises:
        ModelError: if it cannot be read, is not valid XML or has another root.
    """
    parser = expat.ParserCreate()
    opened = [XmlElement("", {}, path, 0)]

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = XmlElement(tag, attributes, path, parser.CurrentLineNumber)
        opened[-1].children.append(element)
        opened.append(element)

    def refuse(*_: object) -> None:
        raise ModelError(f"{path}:{parser.CurrentLineNumber}: has a document type (<!DOCTYPE …>): remove it")

    parser.StartElementHandler, parser.EndElementHandler = start, lambda _: opened.pop()
    parser.StartDoctypeDeclHandler = refuse
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
        if len(content) > _MAX_BYTES:
            raise ModelError(f"{path}: is larger than {_MAX_BYTES >> 20} MiB, which no robot model needs")
        parser.Parse(content, True)
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror}") from None
    except expat.ExpatError as error:
        raise ModelError(f"{path}:{error.lineno}: not valid XML: {expat.ErrorString(error.code)}") from None
    except (LookupError, ValueError) as error:
        raise error if isinstance(error, ModelError) else ModelError(f"{path}:1: unknown encoding: use UTF-8") from None
    top = opened[0].children[0]
    if root and top.tag != root:
        raise top.error(f"begins with <{top.tag}>, must be <{root}>")
    return top


def read_urdf(path: Path) -> DescriptionModel:
    """Read a URDF.

    Raises:
        ModelError: if it is not a URDF.
    """
    root = read_xml(path, "robot")
    limits = {}
    for joint in root.children:
        if joint.tag == "joint" and joint.attributes.get("type") in ("revolute", "prismatic"):
            for limit in (each for each in joint.children if each.tag == "limit"):
                lower, upper = (limit.numbers(name, "0", 1)[0] for name in ("lower", "upper"))
                limits[joint.attributes.get("name", "")] = Limits(lower, upper, f"{path.name}:{limit.line}")
    links = _names(root.children, "link")
    return DescriptionModel(limits, links, "link", links=links)


def read_mjcf(path: Path) -> DescriptionModel:
    """Read an MJCF with its includes; a joint without limits has those of its default class.

    Raises:
        ModelError: if it is not an MJCF.
    """
    root = read_xml(path, "mujoco")
    _include(root, path.parent)
    compilers = [element.attributes for element in root.children if element.tag == "compiler"]
    compiler = {name: value for each in compilers for name, value in each.items()}
    classes = _default_classes(root)
    limits: dict[str, Limits] = {}
    for joint, class_ in _mjcf_joints(root):
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
            limits[name] = Limits(lower * turn, upper * turn, f"{joint.file.name}:{joint.line}")
    sites, bodies = _names(root.below(), "site"), _names(root.below(), "body")
    return DescriptionModel(limits, sites, "site", _names((joint for joint, _ in _mjcf_joints(root)), "joint"), bodies)


READERS: Mapping[str, Callable[[Path], DescriptionModel]] = {"mjcf": read_mjcf, "urdf": read_urdf}
"""Key under `robot.description` -> reader of that model."""


def _names(elements: Iterable[XmlElement], tag: str) -> tuple[str, ...]:
    return tuple(each.attributes["name"] for each in elements if each.tag == tag and "name" in each.attributes)


def _include(root: XmlElement, folder: Path) -> None:
    """Replace includes by the content of the files, whose names are relative to the model's folder."""
    seen: set[Path] = set()
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
            seen.add(file)
            todo += read_xml(file).children[::-1]
        element.children[:] = children
        waiting += children


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


def _mjcf_joints(root: XmlElement) -> Iterator[tuple[XmlElement, str]]:
    """The joints below the world, each with its default class."""
    worlds = [element for element in root.children if element.tag == "worldbody"]
    waiting = [(world, world.attributes.get("childclass", "main")) for world in reversed(worlds)]
    while waiting:
        element, class_ = waiting.pop()
        joints = (child for child in element.children if child.tag == "joint")
        yield from ((child, child.attributes.get("class", class_)) for child in joints)
        inner = [child for child in element.children if child.tag in _PLACES]
        waiting += [(child, child.attributes.get("childclass", class_)) for child in reversed(inner)]
