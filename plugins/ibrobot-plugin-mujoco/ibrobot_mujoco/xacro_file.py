"""Expand xacro files, with the file and line of every element, and of every error."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any
from xml.dom.minidom import Element
from xml.parsers import expat

from ibrobot_core.api import HardwareError, did_you_mean, how_to_install
from ibrobot_mujoco.ros_packages import Packages

PLACE = "ibrobot-place"
"""Attribute with FILE:LINE that each element of an expanded file has."""
_ARGUMENT = re.compile(r"\$\(arg\s+([^)\s]+)\s*\)|xacro\.arg\(\s*'([^']+)'|<xacro:arg[^>]*\sname\s*=\s*[\"']([^\"']+)")
_INSTALL = how_to_install("ibrobot-plugin-mujoco[urdf]")


def expand_xacro(path: Path, packages: Packages, arguments: Mapping[str, str]) -> str:
    """The URDF that a xacro file describes.

    Args:
        path: the xacro file.
        packages: where `$(find PACKAGE)` is.
        arguments: values of the file's arguments.

    Raises:
        HardwareError: if the file or one that it includes has a fault; names file, line, and what to give.
    """
    try:
        import xacro
    except ImportError:
        raise HardwareError(f"{path} is a xacro file: {_INSTALL}") from None
    files: list[Path] = []
    with _patched(xacro, packages, files):
        try:
            text: str = xacro.process_file(str(path), mappings=dict(arguments)).toxml()
        except Exception as fault:  # xacro evaluates expressions in Python, which can raise anything
            raise _error(fault, path, files) from fault
    known = sorted({name for each in files for groups in _ARGUMENT.findall(_text(each)) for name in groups if name})
    for name in arguments:
        if name not in known:
            raise HardwareError(f"{path} has no argument {name!r}{did_you_mean(name, known, 'it has')}")
    return text


@contextlib.contextmanager
def _patched(xacro: Any, packages: Packages, files: list[Path]) -> Iterator[None]:
    """Let xacro find packages without ROS, and keep the places of elements."""
    from xacro import substitution_args

    def parse(document: Any, filename: str | None = None) -> Any:
        parsed = original(document, filename)
        if filename is not None:
            file = Path(os.path.abspath(filename))
            files.append(file)
            _stamp(parsed, file)
        return parsed

    def find(package: str) -> str:
        return str(packages.find(package))

    original, original_find = xacro.parse, substitution_args._eval_find
    xacro.parse, substitution_args._eval_find = parse, find
    substitution_args._eval_dict["find"] = find
    try:
        yield
    finally:
        xacro.parse, substitution_args._eval_find = original, original_find
        substitution_args._eval_dict["find"] = original_find


def _stamp(document: Any, file: Path) -> None:
    """Note the place of each element; those of xacro itself may have no further attribute."""
    lines: list[int] = []
    parser = expat.ParserCreate()
    parser.StartElementHandler = lambda *_: lines.append(parser.CurrentLineNumber)
    parser.Parse(file.read_bytes(), True)
    for element, line in zip(document.getElementsByTagName("*"), lines, strict=True):
        element.ibrobot_place = f"{file}:{line}"
        if not element.tagName.startswith("xacro:"):
            element.setAttribute(PLACE, f"{file}:{line}")


def _error(fault: Exception, path: Path, files: list[Path]) -> HardwareError:
    place = _place(fault.__traceback__) or str(files[-1] if files else path)
    causes = list(_causes(fault))
    package = next((each for each in causes if isinstance(each, HardwareError)), None)
    if package is not None:
        return HardwareError(f"{place}: {package}")
    syntax = next((each for each in causes if isinstance(each, expat.ExpatError)), None)
    if syntax is not None:
        file = _open_file(path)
        return HardwareError(f"{file}:{syntax.lineno}: not valid XML: {expat.ErrorString(syntax.code)}")
    missing = next((each for each in causes if type(each).__name__ == "ArgException"), None)
    if missing is not None:
        return HardwareError(f"{place}: the argument {missing} has no default: give --xacro-arg {missing}=VALUE")
    file_error = next((each for each in causes if isinstance(each, OSError) and each.filename), None)
    if file_error is not None:
        return HardwareError(f"{place}: {file_error.filename} cannot be read: {file_error.strerror}")
    if isinstance(fault, RecursionError):
        return HardwareError(f"{place}: includes or macros that call themselves without end")
    text = " ".join(str(fault).split()) or type(fault).__name__
    return HardwareError(f"{place}: xacro cannot expand it: {text}")


def _causes(fault: BaseException | None) -> Iterator[BaseException]:
    """An error and those that it came from, as xacro and Python note them."""
    import xacro

    seen: set[int] = set()
    waiting = [fault]
    while waiting:
        each = waiting.pop(0)
        if each is not None and id(each) not in seen:
            seen.add(id(each))
            yield each
            inner = each.exc if isinstance(each, xacro.XacroException) else None
            waiting += [inner if isinstance(inner, BaseException) else None, each.__cause__, each.__context__]


def _place(traceback: TracebackType | None) -> str:
    """The place of the innermost element that xacro was at."""
    place = ""
    while traceback is not None:
        for name in ("node", "elt", "elem"):
            element = traceback.tb_frame.f_locals.get(name)
            if isinstance(element, Element):
                place = vars(element).get("ibrobot_place") or element.getAttribute(PLACE) or place
        traceback = traceback.tb_next
    return place


def _open_file(path: Path) -> str:
    """The file that xacro had open last."""
    import xacro

    return str(xacro.filestack[-1] if xacro.filestack else path)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
