"""Sphinx configuration. Pages are Markdown; the sections follow Diátaxis."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from sphinx.application import Sphinx

from ibrobot_core import __version__

sys.path.insert(0, str(Path(__file__).parent))

import generate

generate.write(Path(__file__).parent / "reference")

project = "ibrobot"
author = "the ibrobot authors"
project_copyright = "2026, the ibrobot authors"
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.doctest", "sphinx.ext.napoleon"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "ibrobot"
html_static_path = ["_static"]
html_css_files = ["wide.css"]

default_role = "code"  # `--sim` in a docstring is code, not a title with a dash
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
# Names of other projects, of type parameters, and of what has no page of its own.
nitpick_ignore = [("py:class", "ibrobot_core.interfaces.planner.Goal")]  # a type alias, which autodoc leaves out
nitpick_ignore_regex = [("py:.*", r"(?!ibrobot_core\.interfaces\.\w+\.[A-Z]).*")]


def _keep_colons(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Begin docstrings of attributes with an empty comment, since Napoleon takes text before a colon for a type."""
    if what in ("attribute", "data", "property"):
        lines[:0] = ["..", ""]


def _types_beside_names(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Show the type of an attribute beside its name, where Napoleon adds it as a field below the text."""
    attribute = 0
    for number, line in enumerate(lines):
        if line.startswith(".. attribute::"):
            attribute = number
        elif attribute and re.match(r" {3}:type: ", line):
            lines[attribute] += f"\n{line}"
            lines[number] = ""
    lines[:] = "\n".join(lines).split("\n")


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", _keep_colons, priority=400)
    app.connect("autodoc-process-docstring", _types_beside_names, priority=600)


# An annotation such as `type[Any]` is taken for an attribute of that name, of which there are several.
suppress_warnings = ["ref.python"]
