"""What one plugin reads of another: the owner's declaration, and the checks that fail once it has another shape."""

from __future__ import annotations

import ast
import inspect
import queue
import re
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import SimpleNamespace
from typing import Any

import attrs
import ibrobot_web
import numpy as np
import pytest
from ibrobot_testing import declared_services, make_session
from ibrobot_web import messages
from ibrobot_web.commands import Commands
from ibrobot_web.messages import RunCommand, Sent

from ibrobot_core.api import Header, JointTrajectory, JointTrajectoryPoint
from ibrobot_core.app import Command, Service, fields, flag_of, installed_plugins

pytestmark = pytest.mark.integration
PAGE = Path(inspect.getfile(ibrobot_web)).parent
MOVES: tuple[RunCommand, ...] = (
    messages.Reset(),
    messages.Call("/set_mode", "web"),
    messages.Call("/record_episode/start", {"prompt": "pick", "wait": True}),
    messages.Call("/record_episode/stop", "failure"),
    messages.Call("/record_episode/discard"),
    messages.Call("/record_episode/redo"),
    messages.Call("/action_dispatcher/toggle_smoothing", False),
    messages.Call("/intervene", True),
    messages.Call("/planning/go_to", {"goal": "home"}),
    messages.Call("/planning/cancel"),
    messages.Call("/agent/arm", {"agent": "scout", "seconds": 60, "speed": 0.25, "by": "page"}),
    messages.Call("/agent/disarm"),
    messages.Preview("home"),
)
"""The commands of a page that call services of the run, with requests as its scripts write them."""


def changed(kind: type[Any], old: str, new: str) -> type[Any]:
    """A class with another name for one of its fields."""
    attrs.resolve_types(kind)
    kept = {field.name: attrs.field(default=field.default, metadata=field.metadata) for field in attrs.fields(kind)}
    kept[new] = kept.pop(old)
    made = attrs.make_class(kind.__name__, kept, frozen=True, kw_only=True)
    made.__annotations__ = {name: attrs.fields_dict(kind)[old if name == new else name].type for name in kept}
    return attrs.resolve_types(made)


# Services: each request of the page fits the owner's declaration, and the page reads fields that the answer has.


def check_services(services: Mapping[str, Service[Any, Any]]) -> None:
    """Send every command of a page to a run with these declarations."""
    session: Any = make_session()
    session.control = SimpleNamespace(stops=0, running=True, call=lambda do, **arguments: {})
    joint = session.config.robot.joint_names[0]
    for name, service in services.items():
        session.bus.unserve(name)
        session.bus.serve(service, lambda request, kind=service.answer: answer_of(kind, joint))
    replies: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
    failures: list[Exception] = []
    commands = Commands(session, lambda: None, replies.put, failures.append)
    try:
        for number, command in enumerate(MOVES):
            commands.take(Sent(number, 0, command))
        answers = {int(reply["reply"]): reply for reply in (replies.get(timeout=60) for _ in MOVES)}
    finally:
        commands.close(10.0)
    wrong = {str(MOVES[number]): reply["error"] for number, reply in answers.items() if "error" in reply}
    assert not wrong
    assert not failures


def answer_of(kind: Any, joint: str) -> Any:
    """An answer of a declared class."""
    if not (isinstance(kind, type) and attrs.has(kind)):
        return None
    known = {field.name: field for field in attrs.fields(attrs.resolve_types(kind))}
    zeros = {name: {int: 0, bool: False}.get(field.type) for name, field in known.items()}
    given: dict[str, Any] = {name: zeros[name] for name, field in known.items() if field.default is attrs.NOTHING}
    if "trajectory" in known:
        point = JointTrajectoryPoint(positions=np.array([0.1]), time_from_start_ns=1_000_000_000)
        given["trajectory"] = JointTrajectory(header=Header(0, ""), joint_names=(joint,), points=(point,))
    return kind(**given)


def test_the_page_calls_services_as_their_owners_declare_them() -> None:
    check_services(declared_services())


def test_every_service_that_pages_may_call_is_called() -> None:
    scripts = "".join(path.read_text(encoding="utf-8") for path in (PAGE / "static").rglob("*.js"))
    named = set(
        re.findall(r"[\"\'`](/(?:set_mode|intervene|agent/\w+|planning/\w+|action_dispatcher/\w+))[\"\'`]", scripts)
    )
    record = re.findall(
        r'button\((?:"[^"]+"|text), "\w", "(\w+)"', (PAGE / "static/record.js").read_text(encoding="utf-8")
    )
    named |= {f"/record_episode/{name}" for name in ("start", *record)}
    assert named == set(messages.SERVICES) == {each.service for each in MOVES if isinstance(each, messages.Call)}


@pytest.mark.parametrize(
    ("service", "part", "old"),
    [
        ("/record_episode/stop", "request", "outcome"),
        ("/record_episode/start", "request", "prompt"),
        ("/intervene", "request", "take"),
        ("/planning/go_to", "request", "goal"),
        ("/planning/plan", "request", "goal"),
        ("/planning/plan", "answer", "trajectory"),
    ],
)
def test_another_shape_of_a_service_fails(service: str, part: str, old: str) -> None:
    declared = declared_services()
    found = declared[service]
    other: Any = {part: changed(vars_of(found)[part], old, "renamed")}
    declared[service] = attrs.evolve(found, **other)
    with pytest.raises(AssertionError, match=r"unknown key|no attribute|unexpected"):
        check_services(declared)


def vars_of(found: Any) -> dict[str, Any]:
    return attrs.asdict(found, recurse=False)


def called_by_name() -> Iterator[tuple[str, str]]:
    """The services that code calls or asks for by their names, and the module that does."""
    for module in iter_modules():
        if not module.name.startswith("ibrobot_") or module.name == "ibrobot_testing":
            continue
        package = Path(inspect.getfile(import_module(module.name))).parent
        for path in package.rglob("*.py"):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            constants = dict(_constants(tree))
            for node in ast.walk(tree):
                match node:
                    case ast.Call(func=ast.Attribute(attr="call" | "serves" | "ask"), args=[name, *_]):
                        found = constants.get(name.id) if isinstance(name, ast.Name) else getattr(name, "value", None)
                        if isinstance(found, str) and found.startswith("/"):
                            yield found, path.name


def _constants(tree: ast.Module) -> Iterator[tuple[str, Any]]:
    """The constants of a module, and those that it imports."""
    for node in tree.body:
        match node:
            case ast.ImportFrom(module=str(module), names=names) if module.startswith("ibrobot_"):
                for each in names:
                    if each.name.isupper():
                        yield each.asname or each.name, getattr(import_module(module), each.name)
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Constant(value=value)):
                yield name, value
            case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
                yield from (
                    (ast.unparse(each), getattr(value, "value", None))
                    for each, value in zip(names, values, strict=True)
                )


_OF_ROSBRIDGE = "/rosapi/services"


def test_a_service_that_is_called_by_name_is_declared() -> None:
    found = set(called_by_name())
    assert {file for _, file in found} >= {"commands.py", "status.py", "objects.py", "performing.py", "client.py"}
    names = {name for name, _ in found} | set(messages.SERVICES)
    assert names - set(declared_services()) == {_OF_ROSBRIDGE}


def check_status(status: type[Any], judged: type[Any]) -> None:
    """Look for what the page's scripts read of a recording's state, or say of an episode, that its owner lacks."""
    script = (PAGE / "static/record.js").read_text(encoding="utf-8")
    taken = re.findall(r"(?:(?:words|controls)\(|const )\{(.*?)\}(?:, \{ redo|, ended\)|\)| = episode)", script)
    names = ",".join(taken).split(",")
    read = {*re.findall(r"\bepisode\.(\w+)", script), *(each.partition(":")[0].strip() for each in names)}
    assert len(read) >= 12
    assert read <= set(fields(status)), "record.js reads what the state of a recording does not have"
    cues = re.findall(
        r"(\w+):", *re.findall(r"WORDS = \{(.*?)\}", (PAGE / "static/cues.js").read_text(encoding="utf-8"))
    )
    assert {"", *cues} == set(fields(status)["cue"].metadata["choices"])
    said = set(re.findall(r'"stop", "(\w+)"', script))
    assert said
    assert said <= set(fields(judged)["outcome"].metadata["choices"]), "record.js says an unknown outcome"


def test_the_page_reads_the_state_of_a_recording_as_its_owner_declares_it() -> None:
    declared = declared_services()
    status, stop = declared["/record_episode/status"].answer, declared["/record_episode/stop"].request
    assert isinstance(status, type)
    check_status(status, stop)
    for old in ("saved", "elapsed_s", "free_bytes"):
        with pytest.raises(AssertionError, match="does not have"):
            check_status(changed(status, old, "renamed"), stop)


# Commands: each option that the page names is declared.


def used_options() -> Iterator[tuple[str, str]]:
    """The commands that the page runs by itself, and the options that it names."""
    for path in PAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.Call(func=ast.Name(id="run_command"), args=[_, ast.Constant(value=str(name)), *_]):
                    yield from ((name, word.arg) for word in node.keywords if word.arg is not None)
                case ast.Call(
                    func=ast.Name(id="choices_of"), args=[ast.Constant(value=str(name)), ast.Constant(value=option)]
                ):
                    yield name, str(option)


def check_options(declared: Mapping[str, Command]) -> None:
    """Look for options that the page names and no command has."""
    wrong = [f"{name}: {word}" for name, word in used_options() if word not in fields(declared[name].options)]
    assert not wrong


def test_the_page_names_options_that_their_commands_have() -> None:
    assert len(set(used_options())) >= 9
    check_options(dict(installed_plugins().commands))


@pytest.mark.parametrize(
    ("command", "old"), [("episodes trim", "begin_s"), ("episodes mark", "outcome"), ("datasets info", "dataset")]
)
def test_another_name_of_an_option_fails(command: str, old: str) -> None:
    declared = dict(installed_plugins().commands)
    options = changed(declared[command].options, old, "renamed")
    declared[command] = attrs.evolve(declared[command], does=options)
    with pytest.raises(AssertionError, match=f"{command}: {old}"):
        check_options(declared)


# Events: what the page's scripts read of the events of others are fields of these.

READ = {
    ("datasets info", "Contents"): ("datasets.js", r"\bfacts\.(\w+)"),
    ("episodes trash", "InTrash"): (
        "episodes.js",
        r"\beach\.(path|size_bytes|id|done)\b|restore\(\{ \w+, (\w+), (\w+) \}\)",
    ),
}
"""Command and class of its events -> the script that reads them, and how it writes their fields."""


def check_events(declared: Mapping[str, Command]) -> None:
    """Look for fields that a script reads and no event has."""
    for (command, event), (script, pattern) in READ.items():
        found = re.findall(pattern, (PAGE / "static/ui" / script).read_text(encoding="utf-8"))
        read = {name for each in found for name in ([each] if isinstance(each, str) else each) if name}
        kinds = [kind for kind in declared[command].events if kind.__name__ == event]
        assert kinds, f"{command} has no event {event}"
        assert read
        assert read <= set(fields(kinds[0])), f"{script} reads what {event} does not have"


def test_scripts_read_fields_that_events_have() -> None:
    check_events(dict(installed_plugins().commands))


@pytest.mark.parametrize(
    ("command", "event", "old"), [("datasets info", "Contents", "fps"), ("episodes trash", "InTrash", "size_bytes")]
)
def test_another_name_of_a_field_of_an_event_fails(command: str, event: str, old: str) -> None:
    declared = dict(installed_plugins().commands)
    events = tuple(
        changed(each, old, "renamed") if each.__name__ == event else each for each in declared[command].events
    )
    declared[command] = attrs.evolve(declared[command], events=events)
    with pytest.raises(AssertionError, match="does not have"):
        check_events(declared)


_FLAG = re.compile(r"(?<![\w.])--[a-z][a-z-]*(?![\w.-])")
TERMINAL = {
    "--shard": "parts of a work on several machines, which a terminal starts",
    "--to": "from a dataset to episodes, which no page does",
    "--episodes": "episodes of a dataset, with --to bag",
    "--names": "names of a dataset's elements, with --to bag",
    "--output": "a new episode, where a page replaces the old one",
    "--yes": "an answer in a terminal",
    "--open": "blinded trials, which need a terminal",
    "--reset": "blinded trials, which need a terminal",
}
"""Flags in errors that a page does not cause, and why."""


def flags_in_errors(package: Path) -> Iterator[tuple[str, str]]:
    """The flags in what a package raises, and where."""
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Raise):
                texts = [each.value for each in ast.walk(node) if isinstance(each, ast.Constant)]
                yield from (
                    (flag, path.name) for text in texts if isinstance(text, str) for flag in _FLAG.findall(text)
                )


def check_flags(declared: Mapping[str, Command]) -> None:
    """Look for flags in errors that a page cannot replace by the label of an option."""
    for module in ("ibrobot_data", "ibrobot_lerobot", "ibrobot_mcap", "ibrobot_eval"):
        package = Path(inspect.getfile(import_module(module))).parent
        named = {
            flag_of(name, field)
            for command in declared.values()
            if command.events and str(command.options.__module__).startswith(f"{module}.")
            for name, field in fields(command.options).items()
            if field.metadata["label"] is not None
        }
        found = {
            (flag, file) for flag, file in flags_in_errors(package) if not file.startswith("replay")
        }  # no page replays
        wrong = sorted((flag, file) for flag, file in found if flag not in named | set(TERMINAL))
        assert not wrong


def test_errors_name_options_that_a_page_has_labels_for() -> None:
    check_flags(dict(installed_plugins().commands))


def test_an_error_that_names_an_option_of_another_name_fails() -> None:
    declared = dict(installed_plugins().commands)
    options = changed(declared["convert"].options, "force_contract", "renamed")
    declared["convert"] = attrs.evolve(declared["convert"], does=options)
    with pytest.raises(AssertionError, match="--force-contract"):
        check_flags(declared)


def test_the_page_names_no_package() -> None:
    named = re.compile(r"ibrobot-plugin-|ibrobot\[|pip install|lerobot", re.IGNORECASE)
    paths = [path for path in PAGE.rglob("*") if path.suffix in (".py", ".js", ".html")]
    paths = [path for path in paths if path.parent.name != "words"]  # which translate what plugins say
    assert [path.name for path in paths if named.search(path.read_text(encoding="utf-8"))] == []


def test_every_command_and_event_explains_its_fields() -> None:
    for name, command in dict(installed_plugins().commands).items():
        for kind in (command.options, *command.events):
            bare = [key for key, field in fields(kind).items() if not field.metadata.get("help")]
            assert not bare, f"{name}: {kind.__name__} has fields without help"
