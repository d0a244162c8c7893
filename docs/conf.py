"""Sphinx configuration. Pages are Markdown; the sections follow Diátaxis."""

from __future__ import annotations

import gc
import inspect
import re
import sys
from pathlib import Path

from docutils.nodes import Element
from sphinx.application import Sphinx
from sphinx.util import logging

from ibrobot_core import __version__

sys.path.insert(0, str(Path(__file__).parent))

import generate
import site_pages
from option_pages import flags_as_code

# The trees of pages hold millions of objects, hardly one of which goes before the end. To look for garbage among them
# took half of the time of a build.
gc.disable()
generate.write(Path(__file__).parent)

project = "ibrobot"
author = "the ibrobot authors"
project_copyright = "2026, the ibrobot authors"
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.doctest",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
copybutton_prompt_text = "$ "
copybutton_line_continuation_character = "\\"
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "ibrobot"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_split_index = True  # one page for each letter: whole, the index is 29,000 pixels tall

default_role = "code"  # `--sim` in a docstring is code, not a title with a dash
autodoc_member_order = "bysource"
python_maximum_signature_line_length = 140
python_use_unqualified_type_names = True
autodoc_default_options = {"members": True, "show-inheritance": True}
# Names of other projects, of type parameters, and of what has no page of its own.
nitpick_ignore = [("py:class", "ibrobot_planning.planner.Goal")]  # a type alias, which autodoc leaves out
nitpick_ignore_regex = [("py:.*", r"(?!ibrobot_core\.interfaces\.(?!run\b|run_state\b)\w+\.[A-Z]).*")]


def _keep_colons(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Begin docstrings of attributes with an empty comment, since Napoleon takes text before a colon for a type."""
    if what in ("attribute", "data", "property"):
        lines[:0] = ["..", ""]


def _types_beside_names(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Show the type of an attribute beside its name, where Napoleon adds it as a field below the text.

    Flags such as --sim in the help texts of options become code.
    """
    attribute = 0
    for number, line in enumerate(lines):
        if line.startswith(".. attribute::"):
            attribute = number
        elif attribute and re.match(r" {3}:type: ", line):
            lines[attribute] += "\n" + re.sub(r"\b(collections\.abc|pathlib)\.", "", line)
            lines[number] = ""
        elif attribute:
            lines[number] = flags_as_code(line)
    lines[:] = "\n".join(lines).split("\n")


def _require_docstring(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Warn of a constant without a docstring, for which autodoc shows that of its type."""
    borrowed = [inspect.cleandoc(each.__doc__) for each in (obj, type(obj)) if isinstance(each.__doc__, str)]
    if what in ("attribute", "data") and lines and any(text.startswith(lines[0]) for text in borrowed):
        logging.getLogger(__name__).warning("%s has no docstring", name)


def _readable_defaults(
    app: Sphinx, what: str, name: str, obj: object, options: object, signature: str | None, returns: str | None
) -> tuple[str, str | None] | None:
    """Shorten defaults that are no Python, which also keep Sphinx from linking the types."""
    if signature is None:
        return None
    signature = re.sub(r"<function [\w.]*<lambda>>|\bNOTHING\b", "...", signature)
    return re.sub(r"<class '(?:\w+\.)*(\w+)'>", r"\1", signature), returns


def _drop_plain_bases(app: Sphinx, domain: str, kind: str, content: Element) -> None:
    """Drop the line on bases from a class that has none of note."""
    if content.children and content[0].astext() in ("Bases: object", "Bases: ABC", "Bases: Generic"):
        content.pop(0)


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    site_pages.connect(app, generate.PAGES, are_read="read" in app.tags)
    site_pages.make_navigation_once(app)
    app.connect("autodoc-process-docstring", _require_docstring, priority=300)
    app.connect("autodoc-process-docstring", _keep_colons, priority=400)
    app.connect("autodoc-process-docstring", _types_beside_names, priority=600)
    app.connect("autodoc-process-signature", _readable_defaults)
    app.connect("object-description-transform", _drop_plain_bases)


# An annotation such as `type[Any]` is taken for an attribute of that name, of which there are several.
suppress_warnings = ["ref.python"]
