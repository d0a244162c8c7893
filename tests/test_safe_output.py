"""Text from outside is never markup, a control character or a secret, wherever it is shown."""

from __future__ import annotations

import ast
import json
import logging
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core import safe_output
from ibrobot_core.safe_output import LogFormatter, echo, printable

ROOT = Path(__file__).parents[1]
HOSTILE = st.lists(
    st.sampled_from(
        ["[/x]", "[red]", "[link=http://x]", ":warning:", "\x1b[2J", "\x1b]0;x\x07", "\x9b", "\r", "\u202e", "\u061c"]
    )
    | st.text(max_size=5),
    max_size=8,
).map("".join)
UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u202a-\u202e\ud800-\udfff]")
UNSEEN = "\u00ad\u034f\u115f\u200b\u200d\u2060\u2800\u3164\ufe0f\ufeff\uffa0\U000e0041"
"""Some of the characters that terminals and pages show as nothing; several of them are letters to Unicode."""


@given(HOSTILE)
def test_nothing_unprintable_comes_through(hostile: str):
    assert not UNPRINTABLE.search(printable(hostile))


@pytest.mark.parametrize("unseen", UNSEEN)
def test_names_that_look_the_same_are_not_shown_the_same(unseen: str):
    shown = printable(f"cl{unseen}aude")
    assert shown.isascii()
    assert ast.literal_eval(f"'{shown}'") == f"cl{unseen}aude"


@given(
    st.text(st.characters(exclude_categories=["C", "M", "Zl", "Zp"], exclude_characters=UNSEEN + "\u1160"), max_size=50)
    .filter(lambda each: "://" not in each)
)  # fmt: skip
def test_ordinary_text_stays_as_it_is(ordinary: str):
    assert printable(ordinary) == ordinary


@given(HOSTILE)
def test_json_says_the_same(hostile: str):
    """What a program reads is the text itself, but for credentials."""
    hostile = hostile.replace("/", "")
    assert json.loads(printable(json.dumps(hostile))) == json.loads(json.dumps(hostile))


@given(HOSTILE)
def test_a_log_line_cannot_look_like_another(hostile: str):
    record = logging.LogRecord("ibrobot", logging.INFO, "", 0, "from %s", (f"{hostile}\nE a lie",), None)
    first, *later = LogFormatter("%(levelname).1s %(message)s").format(record).split("\n")
    assert first.startswith("I from ")
    assert later
    assert all(line.startswith("  ") for line in later)
    assert not UNPRINTABLE.search("".join([first, *later]))


def test_echo(capsys: pytest.CaptureFixture[str]):
    echo("a\x1b[2Jb\tc")
    echo("rtsp://me:pw@cam/1", err=True)
    printed = capsys.readouterr()
    assert printed.out == "a\\u001b[2Jb\tc\n"
    assert printed.err == "rtsp://***@cam/1\n"


def test_a_remembered_secret_is_hidden_in_every_form(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(safe_output, "_secrets", set())
    safe_output.remember_secret("p@ss'word")
    for printed in ("p@ss'word", "p%40ss%27word", repr("p@ss'word")):
        assert "word" not in printable(f"it is {printed}!"), printed
    safe_output.remember_secret("so10")
    assert printable("error: so101.yaml:3: no such file") == "error: so101.yaml:3: no such file"


def sources() -> Iterator[Path]:
    yield from (ROOT / "ibrobot_core").rglob("*.py")
    for package in (ROOT / "plugins").glob("*/*ibrobot*"):
        yield from package.rglob("*.py")


_RICH = {
    "Console": "Screen of ibrobot_terminal.screen",
    "Text": "styled of ibrobot_terminal.screen",
    "print": "echo",
    "markup": "nothing",
    "escape": "nothing",
    "Prompt": "click.prompt",
    "inspect": "echo",
    "pretty": "echo",
}
_SUSPECT = re.compile(r"\b(?:rich|click\.s?echo|print|logging\.Formatter|TextColumn|Panel)\b")
"""What a file has that shows text by another way; parsing all files takes seconds."""
_ONE_WAY = {Path("ibrobot_core/safe_output.py"), Path("plugins/ibrobot-terminal/ibrobot_terminal/screen.py")}


def ways_around(tree: ast.AST) -> Iterator[str]:
    """What a module does that shows text by another way than `echo`, `LogFormatter` and `Screen`."""
    types_only = {
        each
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for each in ast.walk(node)
    }
    of_rich = {
        name.asname or name.name: name.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rich")
        for name in node.names
    }
    for node in ast.walk(tree):
        if node in types_only:
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "rich":
            yield from (f"rich's {each.name}: use {_RICH[each.name]}" for each in node.names if each.name in _RICH)
        elif isinstance(node, ast.Import):
            yield from ("import rich" for each in node.names if each.name.partition(".")[0] == "rich")
        elif isinstance(node, ast.Call):
            called, given = ast.unparse(node.func), {word.arg: word.value for word in node.keywords}
            if called in ("click.echo", "click.secho", "print", "logging.Formatter"):
                yield f"{called}: use echo or LogFormatter"
            elif of_rich.get(called) in ("Live", "Progress") and "console" not in given:
                yield f"{called} without console=: its own takes markup"
            elif called == "TextColumn" and "markup" not in given:
                yield "TextColumn without markup=False"
            elif called == "Panel":
                for title in ("title", "subtitle"):
                    if title in given and not isinstance(given[title], ast.Constant | ast.Call):
                        yield f"Panel({title}=…): takes markup, give text(…)"


def test_all_text_goes_one_way():
    found = {
        str(path.relative_to(ROOT)): list(ways_around(ast.parse(text))) if _SUSPECT.search(text) else []
        for path in sources()
        if path.relative_to(ROOT) not in _ONE_WAY
        for text in [path.read_text(encoding="utf-8")]
    }
    assert len(found) > 100
    assert {path: ways for path, ways in found.items() if ways} == {}


@pytest.mark.parametrize(
    "code",
    [
        "from rich.console import Console",
        "import rich",
        "from rich import print",
        "click.echo(1)",
        "print(1)",
        "from rich.live import Live\nLive(a)",
        "TextColumn('{task.description}')",
        "Panel(a, title=name)",
        "from rich.text import Text",
    ],
)
def test_the_check_finds_ways_around(code: str):
    assert _SUSPECT.search(code)
    assert list(ways_around(ast.parse(code)))


@pytest.mark.parametrize("depth", [None, "1"])
def test_commands_in_texts_are_as_the_shell_finds_them(depth: str | None) -> None:
    """`uv run` puts the environment's programs on the path of what it starts, not on that of the shell."""
    code = "from ibrobot_core.safe_output import echo; echo('an ibrobot: run `ibrobot doctor`, then `ibrobot ui`')"
    environ = {**os.environ, **({"UV_RUN_RECURSION_DEPTH": depth} if depth else {})}
    ran = subprocess.run([sys.executable, "-c", code], env=environ, check=True, capture_output=True, text=True)
    program = "uv run ibrobot" if depth else "ibrobot"
    assert ran.stdout == f"an ibrobot: run `{program} doctor`, then `{program} ui`\n"
