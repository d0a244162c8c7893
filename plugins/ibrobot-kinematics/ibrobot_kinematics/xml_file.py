"""XML files of robots, read with the line of every element."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.parsers import expat

import attrs

from ibrobot_kinematics.errors import KinematicsError

_MAX_BYTES = 16 << 20


@attrs.frozen
class XmlElement:
    """An XML element."""

    tag: str
    attributes: Mapping[str, str]
    file: Path
    line: int
    children: list[XmlElement] = attrs.field(factory=list)

    def error(self, message: str) -> KinematicsError:
        """An error that names the place of this element."""
        return KinematicsError(f"{self.file}:{self.line}: {message}")

    def required(self, attribute: str) -> str:
        """An attribute that this element must have.

        Raises:
            KinematicsError: if it is missing or empty.
        """
        value = self.attributes.get(attribute, "").strip()
        if not value:
            raise self.error(f"<{self.tag}> has no {attribute}")
        return value

    def numbers(self, name: str, default: str, count: int) -> tuple[float, ...]:
        """The numbers in an attribute.

        Raises:
            KinematicsError: if they are not `count` finite numbers.
        """
        text = self.attributes.get(name, default)
        try:
            numbers = tuple(float(word) for word in text.split())
        except ValueError:
            numbers = ()
        if len(numbers) != count or not all(map(math.isfinite, numbers)):
            raise self.error(f"{name} is {text!r}, must be {count} finite number{'s' if count > 1 else ''}")
        return numbers

    def child(self, tag: str) -> XmlElement | None:
        """The first child with a tag."""
        return next(self.tagged(tag), None)

    def tagged(self, tag: str) -> Iterator[XmlElement]:
        """The children with a tag."""
        return (child for child in self.children if child.tag == tag)

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
        KinematicsError: if it cannot be read, is not valid XML or has another root.
    """
    parser = expat.ParserCreate()
    opened = [XmlElement("", {}, path, 0)]

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = XmlElement(tag, attributes, path, parser.CurrentLineNumber)
        opened[-1].children.append(element)
        opened.append(element)

    def refuse(*_: object) -> None:
        raise KinematicsError(f"{path}:{parser.CurrentLineNumber}: has a document type (<!DOCTYPE …>): remove it")

    parser.StartElementHandler, parser.EndElementHandler = start, lambda _: opened.pop()
    parser.StartDoctypeDeclHandler = refuse
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
        if len(content) > _MAX_BYTES:
            raise KinematicsError(f"{path}: is larger than {_MAX_BYTES >> 20} MiB, which no robot model needs")
        parser.Parse(content, True)
    except OSError as error:
        raise KinematicsError(f"{path}: cannot be read: {error.strerror}") from None
    except expat.ExpatError as error:
        raise KinematicsError(f"{path}:{error.lineno}: not valid XML: {expat.ErrorString(error.code)}") from None
    except (LookupError, ValueError):
        raise KinematicsError(f"{path}:1: unknown encoding: use UTF-8") from None
    top = opened[0].children[0]
    if root and top.tag != root:
        raise top.error(f"begins with <{top.tag}>, must be <{root}>")
    return top
