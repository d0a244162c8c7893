"""`ibrobot plugins new`: a package that works, for an author to change."""

from __future__ import annotations

import inspect
import re
import shutil
import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import attrs
from jinja2 import Environment, PackageLoader, StrictUndefined

from ibrobot_core.api import option
from ibrobot_core.app import RequestError, echo, installed_plugins
from ibrobot_kit.excerpt import excerpt

FAKES = {
    "hardware": "control:FakeRealHardware",
    "camera": "host:FakeSensor",
    "sensor": "host:FakeImu",
    "teleop": "host:FakeTeleop",
    "policy": "host:FakePolicy",
    "engine": "host:FakeEngine",
    "executor": "control:FakeExecutor",
    "recorder": "storage:FakeRecorder",
    "transport": "transport:FakeTransport",
    "viewer": "host:FakeViewer",
}
"""Kind, or `camera` for a sensor of pictures -> the fake from which its package begins.

It is the smallest implementation that passes the suite of the kind."""
FILES = {
    "pyproject.toml": "pyproject.toml",
    "README.md": "README.md",
    "module.py": "{module}/__init__.py",
    "implementation.py": "{module}/{kind}.py",
    "test.py": "tests/test_{name}.py",
    "robot.yaml": "{name}.yaml",
    "ci.yml": ".github/workflows/test.yml",
}
"""Template -> file in the package."""


@attrs.frozen
class NewPlugin:
    """Write a package with a plugin of KIND, called NAME.

    The package works as it is: it has options, a small implementation, the conformance suite of its kind, and a robot
    YAML that runs. Change what it does, and keep its tests green.
    """

    kind: str = option(typed="KIND", choices=tuple(FAKES), help="the kind of the plugin; camera: a sensor of pictures")
    name: str = option(typed="NAME", help="the type in robot YAMLs, e.g. my_arm")
    out: Path = option(Path(), typed="--out FOLDER", help="the folder in which the package lands")

    def __call__(self) -> dict[str, Any]:
        """Write it, completely or not at all."""
        if not re.fullmatch(r"[a-z][a-z0-9_]*", self.name):
            raise RequestError(f"NAME is {self.name!r}: use lower-case letters, digits and _, e.g. my_arm")
        folder = self.out / f"ibrobot-plugin-{self.name.replace('_', '-')}"
        if self.out.exists() and not self.out.is_dir():
            raise RequestError(f"--out {self.out}: is not a folder")
        if folder.exists():
            raise RequestError(f"{folder} exists; choose another name, or move it away")
        files = render(self.kind, self.name)
        self.out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self.out, prefix=".ibrobot-new-") as drafted:
            for path, text in files.items():
                file = Path(drafted, "package", path)
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text, encoding="utf-8")
            shutil.move(Path(drafted, "package"), folder)
        return {"folder": str(folder), "files": sorted(files)}

    def show(self, made: dict[str, Any]) -> None:
        """Print what comes next."""
        echo(f"{made['folder']}: {len(made['files'])} files")
        echo(f'next: cd {made["folder"]} && pip install -e ".[test]" && pytest')
        echo(f"then: ibrobot launch {self.name}.yaml --sim --headless --duration 2")


def render(kind: str, name: str) -> dict[str, str]:
    """The files of a package: path -> text."""
    place, _, fake = FAKES[kind].partition(":")
    title = "".join(word.capitalize() for word in name.split("_"))
    module = import_module(f"ibrobot_testing.fakes.{place}")
    imports, body = excerpt(module, fake)
    for old, new in (
        (fake, title),
        ("FakeHardware", "FakeArm"),
        ("_HoldingExecutor", "_Holding"),
        ("the fake hardware", "the arm"),
        ("the fake device", "the device"),
        ('"a fake"', f'"{name}"'),
        ('"fake"', f'"{name}"'),
        ("/fake/", f"/{name}/"),
    ):
        body = body.replace(old, new)
    options = [*_options(getattr(module, fake))]
    interface = "sensor" if kind == "camera" else kind
    context = ["ctx"] if "self, ctx: Context" in body[body.index(f"class {title}(") :] else []
    facts = {
        "kind": kind,
        "name": name,
        "title": title,
        "imports": imports,
        "body": body,
        "options": options,
        "module": f"ibrobot_{name}",
        "package": f"ibrobot-plugin-{name.replace('_', '-')}",
        "hook": installed_plugins().all_kinds[interface],
        "descriptor": f"{interface.capitalize()}Descriptor",
        "suite": f"{interface.capitalize()}Suite",
        "arguments": ", ".join([*context, *(f"{each['name']}=options.{each['name']}" for each in options)]),
        "summary": (getattr(module, fake).__doc__ or "").partition("\n")[0].rstrip(".").replace("`", ""),
    }
    templates = Environment(
        loader=PackageLoader("ibrobot_kit"), undefined=StrictUndefined, keep_trailing_newline=True,
        trim_blocks=True, lstrip_blocks=True, autoescape=False,
    )  # fmt: skip
    files = {
        target.format(**facts): templates.get_template(f"{source}.jinja").render(facts)
        for source, target in FILES.items()
    }
    return {**files, f"ibrobot_{name}/py.typed": ""}


def _options(fake: type[Any]) -> Iterator[dict[str, Any]]:
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
