"""Makes pages of the site from Markdown that reads well without it, e.g. in a clone: no page has a directive.

A line that is only a link to a source file becomes its documentation or its code. The pages that come from code have a
short text of their own in the repository. Contents come from the links of an index.
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from furo.navigation import get_navigation_tree
from sphinx.application import Sphinx
from sphinx.builders.html import StandaloneHTMLBuilder
from sphinx.environment import BuildEnvironment
from sphinx.environment.adapters.toctree import global_toctree_for_doc

Page = Callable[[], Iterator[str]]
_SOURCE = re.compile(r'^\[`([\w./-]+)`\]\(((?:\.\./)+\S+?\.(?:py|toml))(?: "(.*)")?\)$', re.MULTILINE)
"""A line such as [`ibrobot_core.bus.Bus`](../../ibrobot_core/bus.py "members: publish"): an object or file, its source,
and options of the directive."""
_INCLUDED = re.compile(r"^\[[^\]]+\]\((\.\./\.\./[A-Z]+\.md)\)$", re.MULTILINE)
_TESTED = re.compile(r"^<!-- doctest -->\n```pycon$", re.MULTILINE)
_LINK = re.compile(r"\]\(([\w-]+(?:/index|\.zh)?)\.md\)")
SPLIT = ("reference/interfaces", "reference/testing")
"""Pages whose sections on one source file each are pages of their own on the site."""
_ENTRY = re.compile(r'^<li class="([^"]*)"><a class="reference internal" href="([^"]*)"(.*)$', re.MULTILINE)
_UNFOLDED = '<ul class="current">'
_TERM = re.compile(r"^- \*\*(.+)\*\*: ", re.MULTILINE)


def connect(app: Sphinx, generated: Mapping[str, Page], *, are_read: bool = False) -> None:
    """Let Sphinx read pages this way.

    Args:
        app: Sphinx.
        generated: name -> what a page of the repository becomes.
        are_read: another builder has just read them.
    """

    def read(app: Sphinx, name: str, source: list[str]) -> None:
        if name in generated:
            source[0] = "\n".join(generated[name]())
        else:
            source[0] = site_markdown(name, source[0])

    def outdated(app: Sphinx, env: BuildEnvironment, *names: set[str]) -> list[str]:
        return [] if are_read else [*generated, *SPLIT]  # they come from code, which Sphinx does not watch

    app.connect("source-read", read)
    app.connect("env-get-outdated", outdated)


def make_navigation_once(app: Sphinx) -> None:
    """Give each page the navigation that Furo makes of all titles, with its own links and marks, made once for all.

    Without this, Sphinx and Furo build the whole navigation again for each page, which takes half of a build's time.
    The pages do not change.
    """
    made: list[str] = []

    def leave_out(app: Sphinx, name: str, template: str, context: dict[str, Any], doctree: object) -> None:
        del context["toctree"]

    def page(app: Sphinx, name: str, template: str, context: dict[str, Any], doctree: object) -> None:
        if not made:
            made.append(_navigation(app))
        context["furo_navigation_tree"] = _navigation_on(app, name, made[0])

    app.connect("html-page-context", leave_out, priority=400)  # before Furo
    app.connect("html-page-context", page, priority=600)


def _navigation(app: Sphinx) -> str:
    """The navigation as the first page of the site has it: a line for each page."""
    assert isinstance(app.builder, StandaloneHTMLBuilder)
    tree = global_toctree_for_doc(
        app.env, app.config.root_doc, app.builder, tags=app.tags, maxdepth=-1, titles_only=True
    )
    return get_navigation_tree(app.builder.render_partial(tree)["fragment"])


def _navigation_on(app: Sphinx, name: str, navigation: str) -> str:
    """The navigation with links from a page, which is marked and unfolded with all above it."""
    parents = {below: above for above, names in app.env.toctree_includes.items() for below in names}
    marked, page = {}, name
    while page in parents:
        marked[app.builder.get_target_uri(page)] = page
        page = parents[page]

    def line(match: re.Match[str]) -> str:
        level, target, rest = match.groups()
        link = app.builder.get_relative_uri(name, target.removesuffix(".html"))
        if target not in marked:
            return f'<li class="{level}"><a class="reference internal" href="{link}"{rest}'
        level = level.replace(" ", " current ", 1) if " " in level else f"{level} current"
        rest = rest.replace(' class="toctree-checkbox"', ' checked="" class="toctree-checkbox"')
        if marked[target] == name:
            return f'<li class="{level} current-page"><a class="current reference internal" href="#"{rest}'
        return f'<li class="{level}"><a class="reference internal" href="{link}"{rest.replace("<ul>", _UNFOLDED)}'

    whole = _ENTRY.sub(line, navigation)
    return whole.replace("<ul>", _UNFOLDED, 1) if marked else whole


def site_markdown(name: str, text: str) -> str:
    """The text of a page with the directives of the site."""
    if name in SPLIT:
        text, _ = sections_apart(name.removeprefix("reference/"), text)
    text = _SOURCE.sub(lambda match: _documented(*match.groups()), text)
    text = _INCLUDED.sub(r"```{include} \1\n```", text)
    text = _TESTED.sub("```{doctest}", text)
    if name == "reference/glossary":
        return _glossary(text)
    if name == "index" or name.endswith("/index"):
        return text + _contents(name, text)
    return text


def sections_apart(name: str, text: str) -> tuple[str, dict[str, str]]:
    """A page of the site whose sections on one source file each are pages of their own, and these: name -> text."""
    head, *sections = re.split(r"^## ", text, flags=re.MULTILINE)
    parts, links = {}, []
    for section in sections:
        title, _, body = section.partition("\n")
        found = _SOURCE.fullmatch(body.strip())
        if found is None:
            head += f"## {section}"
            continue
        part = re.sub(r"\W+", "-", title.lower())
        first = (importlib.import_module(found[1]).__doc__ or "").strip().splitlines()[0]
        links.append(f"- [{title}]({name}/{part}.md): {first}")
        parts[part] = f"# {title}\n\n{body.strip().replace('](', '](../')}"
    contents = ["", "```{toctree}", ":hidden:", "", *(f"{name}/{part}" for part in parts), "```", ""]
    return "\n".join([head, *links, *contents]), parts


def _documented(name: str, path: str, options: str | None) -> str:
    lines = [f":{each.strip()}" for each in (options or "").split(";") if each]
    if "." not in name or name.endswith(Path(path).name):
        language = "toml" if path.endswith(".toml") else "python"
        shown = [] if "." in name else [f":pyobject: {name}"]
        return "\n".join([f"```{{literalinclude}} {path}", f":language: {language}", *shown, "```"])
    directive = f".. auto{_kind(name)}:: {name}"
    return "\n".join(["```{eval-rst}", directive, *(f"   {line}" for line in lines), "```"])


def _kind(name: str) -> str:
    """What a dotted name is of: module, class or function."""
    try:
        importlib.import_module(name)
    except ModuleNotFoundError:
        module, _, attribute = name.rpartition(".")
        return "class" if inspect.isclass(getattr(importlib.import_module(module), attribute)) else "function"
    return "module"


def _glossary(text: str) -> str:
    """A list of `- **term**: text`, in which *term* means an entry, as a glossary."""
    terms = _TERM.findall(text)
    head, _, entries = text.partition("\n- **")
    entries = _TERM.sub(r"\n\1\n  ", f"- **{entries}").lstrip()
    known = "|".join(re.escape(term) for term in terms)
    entries = re.sub(rf"(?<!\*)\*({known})(s?)\*(?!\*)", r"{term}`\1\2 <\1>`", entries)
    return f"{head}\n```{{glossary}}\n{entries}```\n"


def _contents(name: str, text: str) -> str:
    """The table of contents of an index: the pages below it that it links, in order."""
    if name == "index":
        pages = [f"{folder}/index" for folder in ("tutorials", "how-to", "explanation", "reference", "decisions")]
        pages.append("plugins/index")
    elif name == "decisions/index":
        pages = ["0*"]
    else:
        pages = list(dict.fromkeys(page for page in _LINK.findall(text) if page != "index"))
    depth = 2 if name == "index" else 1
    return "\n".join(["", "```{toctree}", ":hidden:", ":glob:", f":maxdepth: {depth}", "", *pages, "```", ""])
