"""Messages do not count `1 episodes`: a number beside a noun is written by `counted`, or stands after the noun."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NOUNS = (
    "cameras changes demonstrations differences episodes errors failures frames images joints messages motors objects "
    "outputs pauses pictures poses problems readings requests restarts robots servos squares steps topics trainings "
    "trials videos views warnings waypoints"
)
NOUN = re.compile(rf" ({NOUNS.replace(' ', '|')})\b")
_SUSPECT = re.compile(rf"[\"'}}] ?({NOUNS.replace(' ', '|')})\b")
"""What a source has in which a number stands before a noun; parsing all takes seconds."""
_DIAGNOSE = "plugins/ibrobot-plugin-diagnose/ibrobot_diagnose"
NEVER_ONE = {
    "plugins/ibrobot-plugin-damiao/ibrobot_damiao/bus.py": "motors",
    "plugins/ibrobot-plugin-detect/ibrobot_detect/finder.py": "objects",
    "plugins/ibrobot-plugin-eval/ibrobot_eval/report.py": "episodes",
    "plugins/ibrobot-plugin-feetech/ibrobot_feetech/commands/setup_motors.py": "servos",
    "plugins/ibrobot-plugin-mcap/ibrobot_mcap/commands/verify.py": "problems",
    "plugins/ibrobot-plugin-mujoco/ibrobot_mujoco/identification/identify.py": "joints",
    "plugins/ibrobot-plugin-mcap/ibrobot_mcap/commands/export.py": "images",
    "plugins/ibrobot-terminal/ibrobot_terminal/hand_moved.py": "pauses",
    "plugins/ibrobot-provenance/ibrobot_provenance/dataset_suite.py": "episodes",
    f"{_DIAGNOSE}/causes/data.py": "demonstrations",
    f"{_DIAGNOSE}/report.py": "changes",
}
"""Files, each with a noun that is counted there only if there are several."""


def wrong_counts(source: str) -> Iterator[tuple[int, str]]:
    """The lines of f-strings with a whole number before a plural, each with the noun."""
    for node in ast.walk(ast.parse(source)) if _SUSPECT.search(source) else ():
        if isinstance(node, ast.JoinedStr):
            for value, text in zip(node.values, node.values[1:], strict=False):
                if not isinstance(value, ast.FormattedValue) or not isinstance(text, ast.Constant):
                    continue
                noun = NOUN.match(str(text.value))
                if noun and not _is_fraction(value) and not _is_constant(value.value):
                    yield value.lineno, noun[1]


def _is_fraction(value: ast.FormattedValue) -> bool:
    match value.format_spec:
        case ast.JoinedStr(values=[*_, ast.Constant(value=str(layout))]):
            return layout[-1] in "efg%"
    return False


def _is_constant(value: ast.expr) -> bool:
    """Whether it is a constant of a module, which its writer knows."""
    return re.fullmatch(r"(\w+\.)*_?[A-Z][A-Z_0-9]*", ast.unparse(value)) is not None


SOURCES = sorted([*ROOT.glob("ibrobot_core/**/*.py"), *ROOT.glob("plugins/*/ibrobot_*/**/*.py")])


def test_no_message_counts_with_a_plural() -> None:
    assert len(SOURCES) > 500
    found, several = [], set()
    for path in SOURCES:
        name = str(path.relative_to(ROOT))
        for line, noun in wrong_counts(path.read_text(encoding="utf-8")):
            if noun == NEVER_ONE.get(name):
                several.add(name)
            else:
                found.append(f"{name}:{line}: {noun}")
    assert found == [], "use ibrobot_terminal.plural.counted, or write `episodes: 1`"
    assert NEVER_ONE.keys() == several, "no longer counted there"


@pytest.mark.parametrize(
    ("source", "nouns"),
    [
        ('f"{n} episodes"', ["episodes"]),
        ('f"saved {n} of {m} episodes, {k:d} frames"', ["episodes", "frames"]),
        ("f\"{n:.1f} frames, {MOST} joints, {a.MOST} runs, {counted(n, 'step')}\"", []),
        ('f"{n} episode, episodes: {n}, {name} stepsize"', []),
    ],
)
def test_wrong_counts_are_found(source: str, nouns: list[str]) -> None:
    assert [noun for _, noun in wrong_counts(source)] == nouns
