"""`ibrobot plugins new`: a package that works, for an author to change."""

from __future__ import annotations

import inspect
import keyword
import re
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from importlib.metadata import distribution, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import attrs
from jinja2 import Environment, PackageLoader, StrictUndefined

from ibrobot_core import api
from ibrobot_core.api import Descriptor, Late, did_you_mean, how_to_install, option
from ibrobot_core.app import Registry, RequestError, echo, installed_plugins
from ibrobot_kit.excerpt import excerpt
from ibrobot_kit.imports import arranged
from ibrobot_kit.repository import Repository

SAMPLE = "sample"
"""The kind of what packages begin with, with the hook `ibrobot_samples`.

A sample's type is the kind of plugin (or `camera`, for a sensor of pictures). Its `make` is the place of a class or
function: the smallest implementation, which passes the suite of its kind. The package of that place has a template
`new/TYPE.jinja`, whose macros replace those of `templates/kind.jinja`.
"""
FOLDER = "new"
_YAML_WORDS = ("null", "true", "false", "yes", "no", "on", "off")
"""What YAML takes for something else than text."""


@attrs.frozen
class NewPlugin:
    """Write a package with a plugin of KIND, called NAME.

    The package works as it is: it has options, a small implementation, the conformance suite of its kind, and a robot
    YAML that runs. Change what it does, and keep its tests green.

    KIND is arm_view, camera, cause, command, config, dataset, decoder, detector, device_pose, engine, executor,
    feature, guard, guide, hardware, message, panel, planner, policy, pool, reader, recorder, report, scene,
    section, sensor, source, teleop, terminal, transport, units or viewer. Some come with the package that defines them.
    """

    kind: str = option(
        typed="KIND", choices=tuple(installed_plugins().types("sample")), open=True,
        help="the kind of the plugin; camera: a sensor of pictures",
    )  # fmt: skip
    name: str = option(typed="NAME", help="the type in robot YAMLs, e.g. my_arm")
    out: Path = option(Path(), typed="--out FOLDER", help="the folder in which the package lands")

    def __call__(self) -> dict[str, Any]:
        """Write it, completely or not at all."""
        if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", self.name):
            raise RequestError(f"NAME is {self.name!r}: use lower-case letters, digits and _, e.g. my_arm")
        is_word = self.name in _YAML_WORDS or keyword.iskeyword(self.name) or keyword.iskeyword(self.name.capitalize())
        if is_word or find_spec(f"ibrobot_{self.name}") is not None:
            taken = "a word of Python or of YAML" if is_word else f"ibrobot_{self.name}, which is installed"
            raise RequestError(f"NAME is {self.name!r}: that is {taken}; choose another")
        folder = self.out / f"ibrobot-plugin-{self.name.replace('_', '-')}"
        if self.out.exists() and not self.out.is_dir():
            raise RequestError(f"--out {self.out}: is not a folder")
        if folder.exists():
            raise RequestError(f"{folder} exists; choose another name, or move it away")
        repository = Repository.around(self.out)
        files = render(self.kind, self.name, outside=repository is None)
        lists = {} if repository is None else repository.entered(folder.name, f"the {self.kind} `{self.name}`")
        self.out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self.out, prefix=".ibrobot-new-") as drafted:
            for path, text in files.items():
                file = Path(drafted, "package", path)
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text, encoding="utf-8")
            shutil.move(Path(drafted, "package"), folder)
        for file, text in lists.items():
            file.write_text(text, encoding="utf-8")
        root = repository.root if repository is not None else Path()
        listed = [str(file.relative_to(root)) for file in lists]
        robot = next(text for path, text in files.items() if path.endswith(f"{self.name}.yaml"))
        command = robot.partition("\n")[0].partition(": ")[2]  # at the top of the file
        made = {"folder": str(folder), "files": sorted(files), "entered": listed, "command": command}
        return made | ({"root": str(root)} if listed else {})

    def show(self, made: dict[str, Any]) -> None:
        """Print what comes next."""
        echo(f"{made['folder']}: {len(made['files'])} files")
        if made["entered"]:
            echo(f"entered in {', '.join(made['entered'])}")
            root = shlex.quote(made["root"])
            echo(f"next: cd {root} && uv sync --group cluster && uv run python tests/house/official_plugins.py")
            lists = "tests/test_distributions.py tests/house/test_names.py tests/docs/test_entrances_listed.py"
            echo(f"then: uv run pytest plugins/{Path(made['folder']).name}/tests {lists}")
            return
        here = Path(sys.executable)
        python = "python" if Path(shutil.which("python") or "").parent == here.parent else shlex.quote(str(here))
        echo(f"next: cd {made['folder']} && {how_to_install('-e', '.[test]')} && {python} -m pytest")
        echo(f"then: `{made['command']}`")


def render(kind: str, name: str, *, outside: bool = True) -> dict[str, str]:
    """The files of a package: path -> text.

    Args:
        kind: the type of the sample.
        name: the type of the plugin.
        outside: whether the package has a repository of its own.

    Raises:
        RequestError: if there is no sample of this kind, with the available ones; or if the name is taken.
        PluginNotInstalled: if another package has the sample; names it.
    """
    registry = installed_plugins()
    place = _begun(registry, kind)
    source, _, begun = place.place.partition(":")
    module = import_module(source)
    title = "".join(word.capitalize() for word in name.split("_"))
    imports, body = excerpt(module, begun)
    if {title, name} & {line.split()[-1] for line in imports}:
        raise RequestError(
            f"NAME is {name!r}, which the package needs for something else; choose another, e.g. my_{name}"
        )
    made = getattr(module, begun)
    new = title if isinstance(made, type) else name
    options = [*_options(made)]
    facts: dict[str, Any] = {
        "sample": kind, "name": name, "title": title, "new": new,
        "module": f"ibrobot_{name}", "package": f"ibrobot-plugin-{name.replace('_', '-')}",
        "fields": options, "body": _renamed(body, begun, new, name),
        "summary": _summary(_renamed(inspect.getdoc(made) or "", begun, new, name)),
        "takes": [each for each in inspect.signature(made).parameters if each in ("ctx", "session", "robot", "jobs")],
    }  # fmt: skip
    facts["place"] = f"{facts['module']}.{kind}:{new}"
    facts["given"] = ", ".join(f"{each['name']}=options.{each['name']}" for each in options)
    environment = Environment(
        loader=PackageLoader("ibrobot_kit"), undefined=StrictUndefined, keep_trailing_newline=True,
        trim_blocks=True, lstrip_blocks=True, autoescape=False,
    )  # fmt: skip
    of_kinds = environment.overlay(loader=PackageLoader(source.partition(".")[0], FOLDER))
    of_kind = of_kinds.get_template(f"{kind}.jinja")
    templates = (environment.get_template("kind.jinja"), of_kind)
    parts = _parts(templates, facts, "interface", "described", "needs", "test_needs")
    interface = parts["interface"] or kind
    facts |= _offered(registry, interface, parts["described"])
    _check_free(registry, interface, name, facts)
    package = registry.entries[SAMPLE, kind].package
    needed = [package] if package != "ibrobot-testing" else []
    facts["core"] = _compatible("ibrobot-core")
    facts["requirements"] = [_compatible(each) for each in (*needed, *parts["needs"].split())]
    facts["test_requirements"] = [_compatible(each) for each in ("ibrobot-testing", *parts["test_needs"].split())]
    facts |= _parts(templates, facts)
    own = facts["module"]
    late = ["from ibrobot_core.api import Late"] if "Late(" in facts["offer"] + facts["above"] else []
    option_names = ["Options", *(["option"] if options else [])] if facts["options"] else []
    facts["hook_imports"] = arranged(
        [
            "from collections.abc import Iterable", *(["import attrs"] if facts["options"] else []), *late,
            *(f"from ibrobot_core.api import {each}" for each in (*option_names, "hookimpl")),
            *(["from typing import Any"] if "[Any]" in facts["yields"] else []),
            f"from {facts['descriptor_module']} import {facts['descriptor']}", *_lines(facts["hook_imports"]),
        ],
        own,
    )  # fmt: skip
    suite = facts["suite"].partition(":")
    of_suite = [f"from {suite[0]} import {suite[2]}"] if suite[2] else []
    of_suite += [f"from {own} import {title}Options"] if suite[2] and facts["options"] else []
    facts["suite"] = suite[2]
    facts["test_imports"] = arranged(
        [*_lines(facts["test_imports"]), *of_suite, f"from {own} import {facts['hook']}"], own
    )
    facts["imports"] = arranged(imports, own)
    checked = f"class Test{title}({suite[2]}):\n{facts['attributes']}{facts['make']}{facts['methods']}"
    shown = (facts["helpers"], checked if suite[2] else "", facts["tests"])
    facts["tests"] = "\n\n\n".join(each.strip("\n") for each in shown if each.strip())
    facts["gap"], facts["body_gap"] = (_gap(facts[each]) for each in ("tests", "body"))
    files = {
        "pyproject.toml": "pyproject.toml", "README.md": "README.md", "module.py": f"{own}/__init__.py",
        "implementation.py": f"{own}/{kind}.py", "test.py": f"tests/test_{name}.py", "robot.yaml": facts["robot_file"],
        **({"ci.yml": ".github/workflows/test.yml", "gitignore": ".gitignore"} if outside else {}),
    }  # fmt: skip
    facts["outside"] = outside
    made_files = {path: environment.get_template(f"{each}.jinja").render(facts) for each, path in files.items()}
    return {**made_files, f"{own}/py.typed": "", "LICENSE": _license()}


def _begun(registry: Registry, kind: str) -> Late:
    """The place of what a package of a kind begins with."""
    if (SAMPLE, kind) not in registry.entries:
        if kind in registry.official(SAMPLE):
            raise registry.not_found(SAMPLE, kind)
        raise RequestError(f"KIND is {kind!r}{did_you_mean(kind, registry.types(SAMPLE), 'kinds')}")
    place = registry.find(SAMPLE, kind).make
    assert isinstance(place, Late)
    return place


def _check_free(registry: Registry, kind: str, name: str, facts: Mapping[str, Any]) -> None:
    """Check that no other package offers the type.

    Raises:
        RequestError: if one does; names it.
    """
    offered = registry.entries.get((kind, name))
    package = registry.command_packages.get(name, "") if kind == "command" else offered.package if offered else ""
    if package:
        raise RequestError(f"NAME is {name!r}: {package} has the {kind} already; choose another, e.g. my_{name}")
    descriptor = Late(f"{facts['descriptor_module']}:{facts['descriptor']}").load()
    if not issubclass(descriptor, Descriptor):
        return
    if {each.name for each in attrs.fields(descriptor) if each.default is attrs.NOTHING} <= {"type", "make", "summary"}:
        for mistake in descriptor(name, make=Late(facts["place"]), summary=facts["summary"]).mistakes():
            raise RequestError(f"NAME is {name!r}: {mistake}")


def _summary(text: str) -> str:
    """The first line of a docstring, for a list."""
    return text.partition("\n")[0].rstrip(".").replace("`", "")


def _renamed(text: str, begun: str, new: str, name: str) -> str:
    """A text of a fake, for what is called `new`, of the type `name`."""
    text = re.sub(rf"\b{begun}\b", new, text)
    text = text.replace("FakeHardware", "FakeArm").replace("_HoldingExecutor", "_Holding")
    text = text.replace("the fake hardware", "the arm").replace('"a fake"', f'"{name}"')
    text = re.sub(r"\b(the|a) fake (?=\w)", r"\1 ", text)
    title = "".join(word.capitalize() for word in name.split("_"))
    text = re.sub(r"\bFake(?!Arm\b)(?=[A-Z])", title, text)
    return re.sub(r"(?<![A-Za-z])fake(?![A-Za-z])", name, text)


def _parts(templates: Iterable[Any], facts: Mapping[str, Any], *names: str) -> dict[str, str]:
    """What the templates of a kind say: name of each of their macros and variables, or of these, -> text."""
    modules = [template.make_module(dict(facts)) for template in templates]
    named = {each: getattr(module, each) for module in modules for each in vars(module) if not each.startswith("_")}
    return {each: str(part() if callable(part) else part) for each, part in named.items() if each in (names or named)}


def _gap(text: str) -> str:
    """The empty lines that the formatter wants between imports and a text: two only above functions and classes."""
    return "\n" * (1 + text.startswith(("def ", "class ", "@")))


def _lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if line]


def _offered(registry: Registry, kind: str, named: str) -> dict[str, str]:
    """The hook of a kind, and the class of what it yields; `named` if it is not called as the kind."""
    if kind in registry.kinds:
        defined = registry.kinds[kind]
        hook, descriptor = defined.hook, defined.descriptor
    else:
        hook = registry.all_kinds.get(kind, f"ibrobot_{kind}s")
        name = named or f"{kind.capitalize()}Descriptor"
        descriptor = Late(f"{_home(name)}:{name}").load()
    name, place = descriptor.__name__, descriptor.__module__
    return {
        "hook": hook, "descriptor": name, "yields": f"{name}[Any]" if descriptor.__type_params__ else name,
        "descriptor_module": _home(name) if place.startswith("ibrobot_core.") else place,
    }  # fmt: skip


def _home(name: str) -> str:
    """The public module of core that has a name."""
    return "ibrobot_core.api" if name in api.__all__ else "ibrobot_core.app"


def _compatible(package: str) -> str:
    """A requirement of a package of ibrobot that permits what is compatible with core: all have its version."""
    major, minor = version("ibrobot-core").split(".")[:2]
    return f"{package}>={major}.{minor},<{major}.{int(minor) + 1}"


def _license() -> str:
    """The licence of ibrobot, as it is installed with core."""
    files = distribution("ibrobot-core").files or ()
    return next(file for file in files if file.name == "LICENSE").read_text(encoding="utf-8")


def _options(fake: Any) -> Iterator[dict[str, Any]]:
    """The arguments of a fake that it describes and that have a default, as options."""
    described = dict(re.findall(r"^\s+(\w+): (.*)\.$", inspect.getdoc(fake) or "", re.MULTILINE))
    for argument in inspect.signature(fake).parameters.values():
        if argument.default is not inspect.Parameter.empty and argument.name in described:
            text, _, unit = described[argument.name].rstrip("]").partition(" [")
            given = f'unit="{unit}", ' if unit else ""
            yield {
                "name": argument.name, "type": type(argument.default).__name__, "default": repr(argument.default),
                "unit": given, "help": text,
            }  # fmt: skip
