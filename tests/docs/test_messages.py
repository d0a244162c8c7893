"""The commands that messages of programs name exist, with their options: as those of the pages."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import attrs
import click
import pytest

from ibrobot_core.cli.main import cli

from .test_pages import OF_OTHERS, all_options, check_span

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[2]
SOURCES = sorted([*ROOT.glob("ibrobot_core/**/*.py"), *ROOT.glob("plugins/*/*ibrobot*/**/*.py")])
FOREIGN = OF_OTHERS | {"--upgrade", "--reload", "--no-deps", "--version", "--help", "--user"}
"""Options of other programs, e.g. pip, and those that each command has."""
KNOWN = tuple(cli.list_commands(click.Context(cli)))


@attrs.frozen
class Text:
    """A text of a program; what it fills in is `X`."""

    file: Path
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.file.relative_to(ROOT)}:{self.line}"


def _texts(file: Path) -> Iterator[Text]:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    within = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [each.value if isinstance(each, ast.Constant) else "X" for each in node.values]
            yield Text(file, node.lineno, "".join(map(str, parts)))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in within:
            yield Text(file, node.lineno, node.value)


TEXTS = [text for file in SOURCES for text in _texts(file) if "ibrobot" in text.text or "--" in text.text]


def _commands(text: str) -> Iterator[str]:
    """The commands in a text, in backquotes or not: up to what ends the sentence or the command."""
    for match in re.finditer(r"(?<![\w./-])ibrobot ([a-z][\w-]*)(?=[\s`'\",;:.)]|$)([^`;,:()\n\"]*)", text):
        if match[1] in KNOWN:
            ends = re.split(
                r"\. | [|] |\.$|'| (?:and|or|for|of|in|is|if|has|to|with|which|by|below|from|then) ", match[2]
            )
            yield f"ibrobot {match[1]}{ends[0]}"


@pytest.mark.parametrize("text", [text for text in TEXTS if [*_commands(text.text)]], ids=str)
def test_a_command_in_a_message_exists(text: Text) -> None:
    for command in _commands(text.text):
        try:
            check_span(command)
        except AssertionError as error:
            raise AssertionError(f"{text}: {command!r}: {error}") from None


@pytest.mark.parametrize("text", [text for text in TEXTS if "ibrobot " in text.text and " --" in text.text], ids=str)
def test_an_option_beside_a_command_in_a_message_exists(text: Text) -> None:
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text.text))
    assert named - FOREIGN <= set(all_options(cli, click.Context(cli))), text


def test_a_made_up_option_and_command_are_found() -> None:
    for wrong in (
        "`ibrobot convert --robot-type`",
        "see ibrobot datasets hush PATH",
        "ibrobot launch X --simm; or not",
    ):
        (command,) = _commands(wrong)
        with pytest.raises(AssertionError):
            check_span(command)
