"""What the documentation tells a reader to type is true: commands, options, YAML. Nothing is executed."""

from __future__ import annotations

import re
import shlex
import textwrap
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import attrs
import click
import pytest

from ibrobot_core.cli.main import cli
from ibrobot_core.config import from_document
from ibrobot_core.config.yaml_nodes import parse_yaml
from ibrobot_core.errors import ConfigError
from ibrobot_core.plugins import installed_plugins

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[2]
GENERATED = {ROOT / f"docs/reference/{name}.md" for name in ("cli", "config", "options", "plugins")}
PAGES = [
    page
    for page in (
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *sorted(page for page in (ROOT / "docs").glob("*/*.md") if page.parent.name != "plugins"),
        *sorted((ROOT / "plugins").glob("*/README.md")),
    )
    if page not in GENERATED and page.parent.name != "decisions"
]
OF_OTHER_PROGRAMS = {
    "CONTRIBUTING.md", "come-from-lerobot.md", "lerobot-versions.md", "use-ibrobot-from-lerobot.md",
}  # fmt: skip
"""Pages with options of nox and of LeRobot."""
OF_OTHERS = {"--cap-add", "--ulimit", "--pause", "--find-links", "--save", "--teleop"}
"""Options in the running text that are of other programs."""
NOT_CHECKED = {"of two arms", "of another program", "needs the plugin of this page"}
"""Notes above YAML blocks that no robot YAML here can hold."""


@attrs.frozen
class Snippet:
    """Something on a page, with its place."""

    page: Path
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def _found(page: Path, pattern: str) -> Iterator[tuple[int, re.Match[str]]]:
    text = page.read_text(encoding="utf-8")
    for match in re.finditer(pattern, text, re.MULTILINE | re.DOTALL):
        yield text.count("\n", 0, match.start()) + 1, match


def _commands(page: Path) -> Iterator[Snippet]:
    """Command lines of console blocks, `\\` at the end joining lines."""
    for line, match in _found(page, r"^ *(?:\$ (?:uv run )?)?(ibrobot [a-z][^\n]*?(?:\\\n[^\n]*?)*)$"):
        yield Snippet(page, line, match[1].replace("\\\n", " "))


def _spans(page: Path) -> Iterator[Snippet]:
    """Commands within the running text."""
    for line, match in _found(page, r"(?<!`)`(ibrobot [a-z][^`]*)`(?!`)"):
        yield Snippet(page, line, match[1].replace("\n", " "))


@cache
def _below(group: click.Group, word: str) -> click.Command | None:
    """The command of a group; one that was made serves all lines that name it."""
    return group.get_command(click.Context(group), word)


def _command(arguments: list[str]) -> tuple[click.Command, click.Context, list[str]]:
    """The command that the words name, and the words after it."""
    command: click.Command = cli
    context = click.Context(cli)
    while isinstance(command, click.Group) and arguments and not arguments[0].startswith("-"):
        found = _below(command, arguments[0])
        if found is None and command.invoke_without_command:
            break
        assert found is not None, f"no command {arguments[0]!r}"
        command, context, arguments = found, click.Context(found, parent=context), arguments[1:]
    return command, context, arguments


def _check_command(text: str) -> None:
    """That click takes it as it is: options, their values, and as many arguments as there must be."""
    text, *_ = re.split(" [>|] ", text)  # a redirection is the shell's
    command, context, arguments = _command(shlex.split(text, comments=True)[1:])
    alone = not isinstance(command, click.Group) or command.invoke_without_command
    assert alone, "a command of the group is missing"
    values, rest, _ = command.make_parser(context).parse_args(arguments)
    assert not rest, f"too many arguments: {rest}"
    for parameter in command.params:
        value = values.get(parameter.name)
        given = parameter.name in values and isinstance(value, str | tuple | list)
        if parameter.required:
            assert value not in (None, "", ()), f"{parameter.name} is missing"
        if given and not isinstance(parameter.type, click.Path | click.File):
            parameter.type_cast_value(context, value)


def check_span(text: str) -> None:
    """That the command and the options exist; `list|show` are two commands, and arguments may be left out."""
    words = text.replace("…", " ").replace("\\|", "|").split()[1:]
    alternatives = next((word for word in words if re.fullmatch(r"[a-z]+(\|[a-z]+)+", word)), "")
    for chosen in alternatives.split("|"):
        command, _, rest = _command([chosen if word == alternatives else word for word in words])
        known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        unknown = {word.split("=")[0] for word in rest if word.startswith("-")} - known - {"--help"}
        assert not unknown, f"no option {unknown}"
        alone = not isinstance(command, click.Group) or command.invoke_without_command
        assert alone or not rest, f"no command {rest}"


@pytest.mark.parametrize("snippet", [s for page in PAGES for s in _commands(page)], ids=str)
def test_every_command_line_parses(snippet: Snippet) -> None:
    _check_command(snippet.text)


@pytest.mark.parametrize("snippet", [s for page in PAGES for s in _spans(page)], ids=str)
def test_every_command_in_the_text_exists(snippet: Snippet) -> None:
    check_span(snippet.text)


def all_options(command: click.Command, context: click.Context) -> Iterator[str]:
    for parameter in command.params:
        yield from (*parameter.opts, *parameter.secondary_opts)
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            inner = command.get_command(context, name)
            assert inner is not None
            yield from all_options(inner, click.Context(inner, parent=context))


def test_every_option_in_the_text_exists() -> None:
    programs = (*(ROOT / "benchmarks").glob("*.py"), *(ROOT / "tests/shared").glob("*.py"))
    scripts = "".join(path.read_text(encoding="utf-8") for path in programs)
    own = re.findall(r'"(--[a-z][a-z-]*)"', scripts)
    known = {*all_options(cli, click.Context(cli)), *OF_OTHERS, *own, "--help"}
    named = [
        (option, f"{page.relative_to(ROOT)}:{line}")
        for page in PAGES
        if page.name not in OF_OTHER_PROGRAMS
        for line, match in _found(page, r"(?<!`)`(--[a-z][^`\n]*)`")
        for option in re.findall(r"(?<!\S)--[a-z-]+", match[1])
    ]
    assert [(option, place) for option, place in named if option not in known] == []


@attrs.frozen
class Excerpt(Snippet):
    """A YAML block, with the comment `<!-- yaml: … -->` above that says what it is an excerpt of."""

    note: str

    def load(self) -> Any:
        """Its values, below the keys that the note names."""
        document = parse_yaml(
            re.sub(r"\$\{\w+(?::([^}]*))?\}", lambda match: match[1] or "value-of-a-variable", self.text), str(self)
        )
        document.raise_problems()
        values = document.root
        for key in reversed(self.note.removeprefix("under ").split(".") if self.note.startswith("under ") else ()):
            values = {key: values}
        return values


def _excerpts() -> Iterator[Excerpt]:
    for page in PAGES:
        for line, match in _found(page, r"(?:<!-- yaml: ([^\n]+) -->\s+)?^( *)```yaml\n(.*?)^\2```"):
            yield Excerpt(page, line, textwrap.dedent(match[3]), match[1] or "")


def _merged(base: Any, excerpt: Any) -> Any:
    """The excerpt over the base: mappings by key, lists of cameras by their name, all else replaced.

    Nothing stays of a component of another `type`, since it has other options.
    """
    if (
        isinstance(base, dict)
        and isinstance(excerpt, dict)
        and base.get("type") == excerpt.get("type", base.get("type"))
    ):
        return base | {key: _merged(base.get(key), value) for key, value in excerpt.items()}
    if isinstance(base, list) and isinstance(excerpt, list):
        for key in ("name", "peripheral"):
            if all(isinstance(item, dict) and key in item for item in excerpt):
                replaced = {item[key] for item in excerpt}
                return [*(item for item in base if item.get(key) not in replaced), *excerpt]
    return excerpt


CONFIG = ROOT / "configs/so101.yaml"


LOG = "time_s,shoulder_pan,shoulder_lift,elbow_flex,wrist_flex,wrist_roll,gripper\n0,0,0,0,0,0,0\n1,0,0,0,0,0,0\n"


def _robot() -> Any:
    """The robot that the pages speak of: that of the README, with a policy."""
    robot = parse_yaml(CONFIG.read_text(encoding="utf-8"), "so101.yaml").root
    robot["models"]["pick_cube_act"] = {"type": "lerobot", "path": "outputs/pick_cube_act"}
    return robot


def _check_excerpt(values: Any, folder: Path, *, sim: bool) -> None:
    """Check a whole robot, in a folder with the files that pages name; a model on a server uses its transport."""
    (folder / "logs").mkdir(exist_ok=True)
    for name in ("wave.csv", "logs/wave.csv"):
        (folder / name).write_text(LOG)
    for name in ("robot.pem", "robot.key"):
        (folder / name).touch()
    if "transport" in values:
        served = {"control_modes": {"model_inference": {"inference": {"execution_mode": "distributed"}}}}
        values = _merged(values, served)
    from_document(values, source=folder / "robot.yaml", sim=sim)


def test_every_robot_yaml_passes_the_check(tmp_path: Path) -> None:
    from ibrobot_data.config_metadata import load_contract
    from ibrobot_planning.tasks.reading import read_task

    for name in ("robot1", "gpu.lab"):  # made by `ibrobot certs` on the same pages
        (tmp_path / name).mkdir()
        for file in ("ca.pem", "certificate.pem", "key.pem", "robots.txt"):
            (tmp_path / name / file).touch()
    wrong = []
    robot = last = _robot()
    for excerpt in _excerpts():
        if excerpt.note in NOT_CHECKED:
            continue
        try:
            if excerpt.note == "contract alone":
                (tmp_path / "contract.yaml").write_text(excerpt.text)
                load_contract(tmp_path / "contract.yaml")
                continue
            if excerpt.note == "a task":
                read_task(excerpt.text, "task.yaml")
                continue
            whole = excerpt.note == "a robot"
            last = excerpt.load() if whole else _merged(last if excerpt.note == "goes on" else robot, excerpt.load())
            _check_excerpt(last, tmp_path, sim="type: mujoco" in excerpt.text)
        except ConfigError as error:
            wrong.append(f"{excerpt}: {error}")
    assert wrong == [], "\n".join(wrong)


def test_an_excerpt_is_checked_where_it_stands(tmp_path: Path) -> None:
    excerpt = Excerpt(ROOT / "README.md", 1, "dispatch: {watermrk: 3}", "under control_modes.model_inference")
    with pytest.raises(ConfigError, match=r"control_modes.model_inference.dispatch.watermrk: unknown key"):
        _check_excerpt(_merged(_robot(), excerpt.load()), tmp_path, sim=False)


OPTION_TABLE = r"^\| option \|[^\n]*\n\|[-|]+\n(.*?)(?=^[^|]|\Z)"


def test_every_table_of_options_names_options_that_exist() -> None:
    """Those with the heading `option`."""
    offered = [entry.descriptor.options for entry in installed_plugins().entries.values()]
    known = {field.name for options in offered for field in attrs.fields(options)}
    named = [
        (option, f"{page.relative_to(ROOT)}:{line}")
        for page in PAGES
        for line, match in _found(page, OPTION_TABLE)
        for option in re.findall(r"^\| ([^|]*)\|", match[1], re.MULTILINE)
        for option in re.findall(r"`(\w+)`", option)
    ]
    assert named
    assert [(option, place) for option, place in named if option not in known] == []


def _groups(group: click.Group, context: click.Context) -> Iterator[click.Context]:
    yield context
    for name in group.list_commands(context):
        inner = group.get_command(context, name)
        if isinstance(inner, click.Group):
            yield from _groups(inner, click.Context(inner, parent=context, info_name=name, terminal_width=80))


def test_summaries_of_commands_fit_into_a_line_of_the_terminal() -> None:
    listed = [
        f"{context.command_path}: {line.strip()}"
        for context in _groups(cli, click.Context(cli, info_name="ibrobot", terminal_width=80, **cli.context_settings))
        for line in context.get_help().splitlines()
    ]
    assert len(listed) > 100
    assert [line for line in listed if line.endswith("...") and "[" not in line] == []


def test_readme_names_every_command() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"^## Commands$(.*?)^## ", text, re.MULTILINE | re.DOTALL)
    names = cli.list_commands(click.Context(cli))
    assert [name for name in names if not re.search(rf"`(?:ibrobot )?{name}`", table)] == []
