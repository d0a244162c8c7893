"""Pages, code and test names are in plain technical English: words that readers have to read twice are out."""

from __future__ import annotations

import ast
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    {
        *ROOT.glob("*.md"),
        *(page for page in (ROOT / "docs").glob("*/*.md") if page.parent.name != "plugins"),
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "plugins").glob("*/README.md"),
    }
    - {ROOT / f"docs/reference/{name}.md" for name in ("cli", "config", "options", "plugins")}
)
"""Written pages; the generated ones take their words from the code."""
CODE = sorted(
    {
        *(ROOT / "ibrobot_core").rglob("*.py"),
        *(path for package in (ROOT / "plugins").glob("*/*ibrobot*") for path in package.rglob("*.py")),
    }
)
TESTS = sorted({*(ROOT / "tests").rglob("test_*.py"), *(ROOT / "plugins").glob("*/tests/**/test_*.py"), *CODE})

OUT = {
    r"\b(?:is|are|was|were|be|been|being) told\b": "reports, prints, names, receives",
    r"\btold (?:of|by)\b": "reported, named",
    r"\banew\b": "again",
    r"\bthat there (?:is|are)\b": "available, installed",
    r"\bthere (?:is|are):": "available:",
    r"\bwith those\b": "together with the",
    r"(?<!Unix\x20)\bepochs?\b(?! time)": "generation; epoch means a pass over a dataset",
    r"\bFeeders?\b|\bWatchers?\b|\bDesks?\b": "the name that the code has now",
    r"\blooks? after\b": "manages, inspects",
    r"\b(?:bags?|datasets?|messages|commands) of others\b": "foreign bags",
    r"\bsomebody\b": "a person, a peer, an operator",
    r"\bcomes? to be\b": "is made, becomes",
    r"\bso soon\b": "as soon as",
    r"\bseen to\b|\b[Ss]ees? to it\b": "ensures",
    r"\bSee that\b": "Check that",
    r"\bafresh\b": "again",
    r"\buntold\b|\b[Tt]old (?:so|apart)\b": "reported; distinguished",
    r"\bthat there (?:is|are) not\b": "unknown, missing",
    r"(?<![Tt]here\x20)\bis no (?:URDF|MJCF|MCAP|file|folder|joint|number|episode|certificate)\b": "is not a",
    r"\bwhich that is\b|\bwho that is\b": "name it",
    r"\b[Ww]hoever\b": "the caller, the user",
    r"\bnobody waits\b|\bwaits? (?:for )?any more\b": "no longer needed, no longer queued",
    r"\bof no known\b": "unknown",
    r"\bso many \w+ at a time\b": "at most N at once",
    r"\b[Ll]ead(?:s|ing)? over\b|\bled over\b": "lead-in, transition",
    r"\bas (?:it|he) is asked\b|\bas it is told\b": "as configured, as requested",
    r"\b[Dd]o what .* if it fails\b": "run a step; log its failure",
    r"\bof which .* is said\b": "name it: the outcome of the episode",
    r"\bfor what (?:the|an|a) (?:user|operator|caller)\b": "made from the flag, from the text",
    r"\bdiffer in no\b": "near-duplicates, equal",
    r"\bwith it ends what\b|\bwhat others record\b": "external recordings",
    r"\bnothing of what\b": "none of the messages, no complete message",
    r"\bof the same memory\b": "a reused buffer",
    r"\bbut for\b": "except; or a table",
    r"\bthat binds?\b|\bread no more\b": "limits; no longer read",
    r"\bof what it (?:works on|acts on)\b": "of its input",
    r"\bby which (?:its|his) \w+ \w+ \w+": "name the motion: a retreat",
    r"\bthose that are (?:believed|trusted|taken)\b": "plausible, accepted",
    r"\b(?:transport|engine|pool) .{1,12} that is none\b": "the no-op",
    r"\bis an error of its own\b": "fails alone",
    r"\bfor the second ones\b|\bthe (?:first|second) bounds\b": "outer and inner bounds",
    r"\bFrom when until when\b|\bUntil when a\b": "start and end of the time",
    r"\bWhat (?:has )?(?:became|become) of\b": "the state, the fate, the outcome of",
    r"\bwhat else is to be known\b": "notes",
}
"""Pattern -> what to write."""
ANY = re.compile("|".join(f"(?:{pattern})" for pattern in OUT).replace(" ", r"\s+"))
"""Any of them: most texts have none."""


def _prose(text: str) -> str:
    """The text without code, which quotes programs as they are; line numbers stay."""
    text = re.sub(
        r"^( *)```.*?^\1```", lambda block: re.sub(r"[^\n]", "", block[0]), text, flags=re.MULTILINE | re.DOTALL
    )
    text = re.sub(r"^    .*$", "", text, flags=re.MULTILINE)
    return re.sub(r"`[^`\n]*`", "", text)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_page_uses_plain_words(page: Path) -> None:
    found = []
    text = _prose(page.read_text(encoding="utf-8"))
    for pattern, instead in OUT.items():
        for match in re.finditer(pattern.replace(" ", r"\s+"), text):
            line = text.count("\n", 0, match.start()) + 1
            found.append(f"{page.relative_to(ROOT)}:{line}: {match[0]!r}: write {instead}")
    assert found == []


@pytest.mark.parametrize("text", ["An error is\ntold once.", "An epoch begins.", "The modes that there are."])
def test_words_that_are_out_are_found(text: str) -> None:
    assert any(re.search(pattern.replace(" ", r"\s+"), _prose(text)) for pattern in OUT)


def test_code_may_use_any_word() -> None:
    assert "told" not in _prose("Run `is told`:\n\n```text\nis told\n```\n\n    is told\n")


def _texts(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of each docstring, comment and string of a file."""
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type in (tokenize.STRING, tokenize.COMMENT, tokenize.FSTRING_MIDDLE):
                yield token.start[0], re.sub(r"`[^`\n]*`", lambda code: " " * len(code[0]), token.string)


def _test_names(path: Path) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if name := re.match(r" *(?:async )?def (test_\w+)", line):
            yield number, name[1].replace("_", " ")


def _faults(path: Path, texts: Iterator[tuple[int, str]]) -> list[str]:
    found = []
    for start, text in texts:
        if not ANY.search(text):
            continue
        for pattern, instead in OUT.items():
            for match in re.finditer(pattern.replace(" ", r"\s+"), text):
                line = start + text.count("\n", 0, match.start())
                found.append(f"{path.relative_to(ROOT)}:{line}: {match[0]!r}: write {instead}")
    return found


def test_code_uses_plain_words_in_docstrings_comments_and_messages() -> None:
    assert [fault for path in CODE for fault in _faults(path, _texts(path))] == []


def test_test_names_use_plain_words() -> None:
    assert [fault for path in TESTS for fault in _faults(path, _test_names(path))] == []


def _vague_names(text: str) -> list[int]:
    """Lines that assign a variable or declare an argument named `found`, which does not tell what it holds.

    The columns of reports may have that name: fields of classes, e.g. of `Check`.
    """
    if not re.search(r"\bfound\b", text):
        return []
    tree = ast.parse(text)
    fields = {
        id(each.target)
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        for each in node.body
        if isinstance(each, ast.AnnAssign)
    }
    return [
        node.lineno
        for node in ast.walk(tree)
        if (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id == "found")
        or (isinstance(node, ast.arg) and node.arg == "found")
        if id(node) not in fields
    ]


def test_variables_are_named_after_what_they_hold() -> None:
    vague = [f"{path.relative_to(ROOT)}:{n}" for path in CODE for n in _vague_names(path.read_text(encoding="utf-8"))]
    assert vague == [], "name `found` after what it holds, e.g. episodes, match, by_topic"


def test_vague_names_are_seen() -> None:
    text = "class A:\n    found: str\n\ndef f(found):\n    if (found := 1):\n        found: int = 2\n"
    assert _vague_names(text) == [4, 5, 6]


@pytest.mark.parametrize(
    "text",
    [
        "Do what the run survives if it fails.",
        "The outcome, of which success is said.",
        "The override for what the user typed.",
        "The first of those that differ in no joint.",
        "Send the rest: with it ends what others record.",
        "Nothing; nothing of what came was a message.",
        "Bytes, usually of the same memory as before.",
        "Channels, JSON but for pictures.",
        "After the view of what it works on.",
        "Motion by which its fixed jaw leaves.",
        "Readings: those that are believed.",
        "An engine and transport local, that is none.",
        "A job is an error of its own.",
        "It brakes for the second ones.",
    ],
)
def test_sentences_that_readers_stumbled_over_are_found(text: str) -> None:
    assert any(re.search(pattern.replace(" ", r"\s+"), text) for pattern in OUT)


def test_words_in_code_are_found_with_their_lines(tmp_path: Path) -> None:
    path = tmp_path / "test_one.py"
    path.write_text(
        '"""Fine.\n\nErrors are told."""\nx = f"drawn {1} anew"  # somebody\n\n\ndef test_it_is_told(): ...\n'
    )
    lines = [line + text.count("\n") for line, text in _texts(path) for p in OUT if re.search(p, text)]
    assert lines == [3, 4, 4]
    assert list(_test_names(path)) == [(7, "test it is told")]
