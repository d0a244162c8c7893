"""`ibrobot plugins check`: a report on a package, for its author and for its users."""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from importlib.metadata import Distribution, PackageNotFoundError, distribution, entry_points, version
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import attrs
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from ibrobot_core.api import MESSAGE_TYPES, Check, Descriptor, Late, MessageDescriptor, how_to_install, option
from ibrobot_core.app import Registry, RequestError, Unsuccessful, echo, installed_plugins

HEAVY = ("av", "cv2", "lerobot", "mujoco", "numpy", "pinocchio", "pyarrow", "scipy", "torch")
"""Libraries that take long to import, and that each `ibrobot` command would import if a plugin did at discovery."""
_CORE = "ibrobot-core"
_HOOK = re.compile(r"SKIPPED .*: override (\w+) to have")
"""What the suites say of a check that needs a hook."""
_WEIGHED = """
import importlib, json, sys
from dis import get_instructions

_, module, heavy, *required = sys.argv
for each in required:
    importlib.import_module(each)
before, own, lines = set(sys.modules), module.partition(".")[0], {}


class Watch:
    def find_spec(self, name, path=None, target=None):
        frame = sys._getframe(1)
        while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] != own:
            frame = frame.f_back
        if frame is not None and name not in lines:
            # `from ibrobot_core.api import NAME` imports what NAME needs.
            here = (each for each in get_instructions(frame.f_code) if each.offset == frame.f_lasti)
            needs = "".join(f", for {each.argval}" for each in here if each.opname == "IMPORT_FROM")
            lines[name] = f"{frame.f_code.co_filename}:{frame.f_lineno}{needs}"


sys.meta_path.insert(0, Watch())
importlib.import_module(module)
loaded = [name for name in json.loads(heavy) if name in sys.modules and name not in before]
print("\\nloaded", json.dumps({name: lines.get(name, "") for name in loaded}))
"""
"""Imports a module, and prints which heavy packages that imports, each with the line of the module's package that
brings it."""
_IMPORT_S, _TESTS_S = 60.0, 600.0
_NAMED = 8
"""How many tests that fail are named."""


@attrs.frozen
class CheckPlugin:
    """Check the installed package PACKAGE as a plugin: what it offers, how it is discovered, and its tests.

    What cannot be checked is listed, too. Exits with 1 if a check fails.
    """

    package: str = option(typed="PACKAGE", help="the name by which it is installed, e.g. ibrobot-plugin-wave")

    def __call__(self) -> list[Check]:
        """Check it."""
        checks = [*examine(self.package, installed_plugins())]
        if any(check.matters and not check.ok for check in checks):
            raise Unsuccessful(checks)
        return checks

    def show(self, checks: list[Check]) -> None:
        """Print them."""
        for check in checks:
            word = "ok  " if check.ok else ("FAIL" if check.matters else "note")
            echo(f"{word}  {check.name}: {check.found}")
            if not check.ok and check.remedy:
                echo(f"      {check.remedy}")


def examine(package: str, registry: Registry) -> Iterator[Check]:
    """All checks of a package.

    Raises:
        RequestError: if it is not installed, or is not a plugin.
    """
    try:
        installed = distribution(package)
    except PackageNotFoundError:
        raise RequestError(f"{package} is not installed in this environment") from None
    points = [each for each in installed.entry_points if each.group.partition(".")[0] == "ibrobot"]
    if not points:
        others = ", ".join(sorted({each.group for each in installed.entry_points}))
        raise RequestError(
            f"{package} {installed.version} has no entry point in the group `ibrobot`"
            f"{f', only in {others}' if others else ''}, so it is not a plugin: add "
            f"[project.entry-points.ibrobot] to its pyproject.toml, and install it again by {how_to_install('-e', '.')}"
        )
    failures = [failure for failure in registry.failures if failure.package == installed.name]
    for failure in failures:
        yield Check("discovery", False, str(failure), "nothing, or not all, of what it offers is used")
    entries = [entry for entry in registry.entries.values() if entry.package == installed.name]
    offered = ", ".join(f"{entry.kind} {entry.descriptor.type}" for entry in entries)
    if not failures:
        yield Check("discovery", True, offered or "commands, events or other things without a type")
    yield from _versions(installed)
    for point in points:
        yield _weight(point.module, _required(installed))
    for entry in entries:
        yield from _described(f"{entry.kind} {entry.descriptor.type}", entry.descriptor)
    modules = {point.module.partition(".")[0] for point in points}
    for each in registry.messages.values():
        if each.message.place.partition(":")[0].partition(".")[0] in modules:
            yield _message(each)
    yield from _tests(installed)


def _versions(package: Distribution) -> Iterator[Check]:
    """Which versions of core it permits."""
    core = [each for each in _requirements(package) if canonicalize_name(each.name) == _CORE]
    if not core:
        yield Check("versions", False, f"it does not require {_CORE}", f'add "{_CORE}>=0.1,<0.2" to its dependencies')
        return
    has, asked = version(_CORE), ", ".join(map(str, core))
    fits = all(each.specifier.contains(has, prereleases=True) for each in core)
    yield Check("versions", fits, f"{asked}; {has} is installed", f"install a version of {_CORE} that it permits")
    if not any(each.operator in ("<", "<=", "==", "~=") for one in core for each in one.specifier):
        remedy = "interfaces change between minor versions before 1.0: add an upper bound, e.g. <0.2"
        yield Check("versions", False, f"{asked} permits all later versions", remedy, matters=False)


def _requirements(package: Distribution) -> list[Requirement]:
    """What it requires on this machine, without its extras."""
    every = [Requirement(each) for each in package.requires or ()]
    return [each for each in every if each.marker is None or each.marker.evaluate({"extra": ""})]


def _required(package: Distribution) -> list[str]:
    """The modules of the plugins that it requires, which discovery imports all the same."""
    names = {canonicalize_name(each.name) for each in _requirements(package)}
    points = entry_points(group="ibrobot")
    return sorted(each.module for each in points if each.dist and canonicalize_name(each.dist.name) in names)


def _weight(module: str, required: Sequence[str]) -> Check:
    """Check which heavy packages discovery imports because of `module`, beyond those of `required`; name the lines."""
    command = [sys.executable, "-c", _WEIGHED, module, json.dumps(HEAVY), *required]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", check=False,
            timeout=_IMPORT_S,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return Check("weight", False, f"{module} cannot be imported alone: it did not end within {_IMPORT_S:g} s")
    told_of = [line for line in done.stdout.splitlines() if line.startswith("loaded {")]
    if done.returncode or not told_of:
        lines = done.stderr.strip().splitlines() or ["it ended without a word"]
        return Check("weight", False, f"{module} cannot be imported alone: {lines[-1]}")
    loaded: dict[str, str] = json.loads(told_of[-1].removeprefix("loaded "))
    told = ", ".join(f"{name} ({line})" if line else name for name, line in loaded.items())
    remedy = (
        'each ibrobot command imports that: import it in `make`, e.g. by Late("MODULE:NAME"), '
        "or under `if TYPE_CHECKING:` if only annotations use it"
    )
    return Check("weight", not loaded, f"{module} imports {told or 'nothing heavy'}", remedy)


def _described(name: str, descriptor: Descriptor[Any]) -> Iterator[Check]:
    """What a descriptor says of its type."""
    options = attrs.fields(descriptor.options)
    silent = [field.alias for field in options if not field.metadata.get("help")]
    remedy = "ibrobot plugins show and forms show it: write help=…"
    if silent:
        yield Check(name, False, f"options without help: {', '.join(silent)}", remedy)
    else:
        yield Check(name, True, "options have help" if options else "it has no options")
    if not descriptor.summary:
        yield Check(name, False, "it has no summary", "lists of plugins show it")
    if inspect.isclass(descriptor.make):
        yield _made(name, f"{descriptor.make.__module__}:{descriptor.make.__qualname__}", descriptor.make)
        return
    places = _places(descriptor.make)
    if not places:
        yield Check(name, False, "make is a function: what it makes was not looked at", matters=False)
    for late in places:
        try:
            made: Any = late.load()
        except Exception as error:  # noqa: BLE001 - whatever the plugin raises
            text = f"{late.place} cannot be imported: {error}"
            yield Check(name, False, text, _remedy(error, late.place.partition(".")[0]))
        else:
            yield _made(name, late.place, made)


def _made(name: str, place: str, made: Any) -> Check:
    """Whether what a descriptor makes is complete."""
    lacking = sorted(made.__abstractmethods__) if inspect.isabstract(made) else []
    text = f"{made.__name__} lacks {', '.join(lacking)}" if lacking else f"{place} is there"
    return Check(name, not lacking, text, "define these methods")


def _remedy(error: Exception, own: str) -> str:
    """What to do about a place in the module `own` that cannot be imported."""
    lacking = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else own
    return "correct the name" if lacking == own else f"add the package with {lacking} to dependencies in pyproject.toml"


def _places(make: Any) -> list[Late]:
    """The places that `make` is or, as a function, uses: `lambda options, ctx: make(ctx)`."""
    if isinstance(make, Late):
        return [make]
    used = inspect.getclosurevars(make).nonlocals.values() if inspect.isfunction(make) else ()
    return [each for each in used if isinstance(each, Late)]


def _message(descriptor: MessageDescriptor) -> Check:
    """Whether a message type is used, and is one."""
    name = f"message {descriptor.type}"
    try:
        if MESSAGE_TYPES[descriptor.type] is not descriptor.load():
            return Check(name, False, "core has this type, so that yours is not used", "give it a name of its own")
    except Exception as error:  # noqa: BLE001 - whatever the plugin raises
        return Check(name, False, f"{descriptor.message.place}: {error}", "name a class that is derived from Message")
    return Check(name, True, f"{descriptor.message.place} is there")


def _tests(package: Distribution) -> Iterator[Check]:
    """Run its tests, if its source is here, and name what they could not check."""
    folder = _source(package)
    if folder is None:
        remedy = how_to_install("-e", "FOLDER")
        yield Check("tests", False, f"not run: wheels have no tests; install its source by {remedy}", matters=False)
        return
    tests = folder / "tests"
    texts = [file.read_text(encoding="utf-8") for file in sorted(tests.rglob("test_*.py"))] if tests.is_dir() else []
    if not any("Suite)" in text for text in texts):
        yield Check(
            "tests", False, f"{tests} has no conformance suite", "subclass the suite of its kind, of ibrobot_testing"
        )
        return
    command = [sys.executable, "-m", "pytest", "-q", "-rsfE", "-p", "no:cacheprovider", "tests"]
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, errors="replace", check=False, timeout=_TESTS_S
        )
    except subprocess.TimeoutExpired:
        yield Check("tests", False, f"did not end within {_TESTS_S:g} s", f"cd {folder} && pytest")
        return
    lines = done.stdout.strip().splitlines() or done.stderr.strip().splitlines() or ["no output"]
    failed = [line for line in lines if line.startswith(("FAILED ", "ERROR "))]
    more = [f"and {len(failed) - _NAMED} more"] if len(failed) > _NAMED else []
    told = "; ".join([lines[-1].strip("= "), *failed[:_NAMED], *more])
    yield Check("tests", done.returncode == 0, told, f"cd {folder} && pytest")
    if hooks := sorted(set(_HOOK.findall(done.stdout))):
        remedy = "how-to/test-a-plugin says what each makes the device do"
        yield Check("not checked", False, f"the suite overrides no {', '.join(hooks)}", remedy, matters=False)


def _source(package: Distribution) -> Path | None:
    """The folder from which it is installed, if it is an editable one."""
    told = package.read_text("direct_url.json")
    facts = json.loads(told) if told else {}
    if not facts.get("dir_info", {}).get("editable"):
        return None
    return Path(unquote(urlsplit(facts["url"]).path))
