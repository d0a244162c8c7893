"""The reference pages on the robot YAML and on the options of plugins, from the classes that loading uses."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from typing import Any, get_args

import attrs
from ibrobot_terminal.describe import described, type_name
from ibrobot_testing import declared_services

from ibrobot_core.component_config import ComponentConfig
from ibrobot_core.convert import is_mapping, is_sequence
from ibrobot_core.options import fields
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.schema import RobotConfig


def config_page() -> Iterator[str]:
    """Lines of the page on the robot YAML."""
    yield "# The robot YAML\n"
    yield "Every section, its keys, units and defaults. Unknown keys are errors. A section with a `type` also takes the"
    yield "[options of that plugin](options.md).\n"
    yield "`${NAME:default}` is replaced from the environment, `~` by the home directory, and `package://PACKAGE/path`"
    yield "by where that Python package is.\n"
    yield "| section | | contents |"
    yield "|---|---|---|"
    for name, field in RobotConfig.sections().items():
        required = "required" if field.default is attrs.NOTHING else ""
        target = next((f"[`{name}`](#{_anchor(kind)})" for _, kind in _classes(name, field.type)), f"`{name}`")
        yield f"| {target} | {required} | {flags_as_code(field.metadata['help'])} |"
    registry = installed_plugins()
    for name in registry.types("section"):
        yield f"| [`{name}`](#{_options_anchor('section', name)}) | | {registry.find('section', name).summary} |"
    yield ""
    shown: set[type] = set()
    for name, field in RobotConfig.sections().items():
        for path, kind in _classes(name, field.type):
            yield from _class_lines(path, kind, shown)


def options_page() -> Iterator[str]:
    """Lines of the page on the options of plugins."""
    registry = installed_plugins()
    yield "# Options of plugins\n"
    yield "The options of every type that core and the plugins of the repository offer, on one page for each kind. For"
    yield "the types installed on your machine, `ibrobot plugins show TYPE` prints them.\n"
    yield "| kind | types |"
    yield "|---|---|"
    for kind in _kinds():
        types = ", ".join(f"[`{type_}`](#{_options_anchor(kind, type_)})" for type_ in registry.types(kind))
        yield f"| [{kind}](options/{kind}.md) | {types} |"
    yield "\n```{toctree}\n:hidden:\n"
    yield from (f"options/{kind}" for kind in _kinds())
    yield "```\n"


def options_of_kinds() -> dict[str, Iterator[str]]:
    """Kind -> lines of the page on the options of its types."""
    return {kind: _kind_page(kind) for kind in _kinds()}


def _kinds() -> list[str]:
    """The kinds of which a type is installed."""
    return [kind for kind in installed_plugins().all_kinds if installed_plugins().types(kind)]


def _kind_page(kind: str) -> Iterator[str]:
    registry = installed_plugins()
    yield f"# Options: {kind}\n"
    for type_ in registry.types(kind):
        entry = registry.entries[kind, type_]
        descriptor = entry.descriptor
        yield f"({_options_anchor(kind, descriptor.type)})=\n"
        yield f"## {kind}: `{descriptor.type}`\n"
        yield f"From `{entry.package}`: {descriptor.summary}.\n"
        if fields(descriptor.options):
            yield from _class_tables(descriptor.options)
        else:
            yield "It has no options.\n"


def jobs_page() -> Iterator[str]:
    """Lines of the page on the commands that programs run: their options and events."""
    yield "# Commands for programs\n"
    yield "With `--events`, these commands print what they do as lines of JSON: `event` is the name of the event, the"
    yield "other keys are its fields. A command that ends with an error prints `failed` at last, with the `error`."
    yield "A plugin declares the options and events of its command; command line, forms and checks derive from that. A"
    yield "program in Python reads a line with `read_event` of `ibrobot_provenance.asking`.\n"
    registry = installed_plugins()
    for name, command in sorted(registry.commands.items()):
        if not command.events:
            continue
        yield f"## `ibrobot {name}`\n"
        yield f"From `{registry.command_packages[name]}`: {command.summary}\n"
        if fields(command.options):
            yield from _table(command.options, links=False)
        for event in command.events:
            yield f"Event `{event.__name__.lower()}`: {_first_line(event)}\n"
            yield from _table(event, links=False)


def services_page() -> Iterator[str]:
    """Lines of the page on services."""
    yield "# Services\n"
    yield "What a run offers to programs, pages and other machines, each while something serves it. A request"
    yield "is plain data with these keys. `ibrobot service show NAME` prints the same for a running robot, and"
    yield "[Share topics and services](../how-to/share-topics.md) calls them over the network.\n"
    for name, service in declared_services().items():
        yield f"## `{name}`\n"
        yield f"{service.help}\n"
        if fields(service.request):
            yield from _class_tables(service.request)
        else:
            yield "It needs no request.\n"
        if service.alone:
            yield f"A request without keys is its `{service.alone}`.\n"
        answer = service.answer
        if isinstance(answer, type) and attrs.has(answer):
            yield f"Answer: {_first_line(answer)}\n"
            yield from _table(answer, links=False)
        else:
            yield f"Answer: `{type_name(answer)}`.\n"


def _class_lines(path: str, kind: type[Any], shown: set[type]) -> Iterator[str]:
    """The part of the page on a class and those within it, each class once."""
    if kind in shown:
        return
    shown.add(kind)
    yield f"({_anchor(kind)})=\n"
    yield f"## `{path}`\n"
    yield _first_line(kind) + "\n"
    yield from _table(kind)
    if issubclass(kind, ComponentConfig):
        yield from _types(kind)
    for name, field in fields(kind).items():
        for inner_path, inner in _classes(f"{path}.{name}", field.type):
            yield from _class_lines(inner_path, inner, shown)


def _types(kind: type[ComponentConfig]) -> Iterator[str]:
    registry = installed_plugins()
    found = [each for each in registry.of_kind(kind.plugin_kind) if each.fits(kind)]
    links = [f"[`{each.type}`](#{_options_anchor(kind.plugin_kind, each.type)})" for each in found]
    yield f"`{kind.type_key()}` is one of {', '.join(links)}, each with options of its own.\n"


def _class_tables(kind: type[Any]) -> Iterator[str]:
    """The options of a plugin, and the keys of those that are mappings themselves."""
    yield from _table(kind, links=False)
    for name, field in fields(kind).items():
        for path, inner in _classes(name, field.type):
            yield f"Keys of `{path}`:\n"
            yield from _table(inner, links=False)


def _table(kind: type[Any], *, links: bool = True) -> Iterator[str]:
    yield "| key | type | unit | default | allowed | meaning |"
    yield "|---|---|---|---|---|---|"
    for each in described(kind):
        inner = [(path, found) for path, found in _classes(each.name, fields(kind)[each.name].type) if links]
        keys = "".join(f"; keys of [`{path}`](#{_anchor(found)})" for path, found in inner)
        cells = (
            f"`{each.name}`",
            f"`{each.type}`",
            each.unit,
            _default(each.default),
            each.allowed,
            flags_as_code(each.help) + keys,
        )
        yield _row(cells)
    yield ""


def flags_as_code(help_text: str) -> str:
    """A text with its flags, e.g. --sim, as code; otherwise they get a dash for their two hyphens."""
    return re.sub(r"`[^`]*`|(?<!\S)--\w[\w-]*", lambda found: f"`{found[0].strip('`')}`", help_text)


def _row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def _default(value: Any) -> str:
    if value == "(required)":
        return "required"
    return "" if isinstance(value, dict) and value else f"`{json.dumps(value, ensure_ascii=False)}`"


def _classes(path: str, kind: Any) -> Iterator[tuple[str, type[Any]]]:
    """The classes in a type annotation, each with the path of its values in the YAML."""
    if isinstance(kind, type) and attrs.has(kind):
        yield path, kind
        return
    for member in get_args(kind):
        alone = isinstance(member, type) and issubclass(member, ComponentConfig) and member.may_be_alone
        if is_sequence(kind):
            yield from _classes(f"{path}[]", member)
        elif is_mapping(kind) and not alone:
            yield from _classes(f"{path}.NAME", member)
        else:
            yield from _classes(path, member)


def _first_line(kind: type[Any]) -> str:
    return (kind.__doc__ or "").strip().splitlines()[0]


def _anchor(kind: type[Any]) -> str:
    return f"keys-{kind.__name__.lower()}"


def _options_anchor(kind: str, type_: str) -> str:
    return f"options-{kind}-{type_}"
