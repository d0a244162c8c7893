"""Source lines of core and of each plugin, by folder: without blank lines, comments and docstrings.

python tests/house/source_lines.py
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
_NO_SOURCE = (
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
)


def source_lines(text: str) -> int:
    """Lines of a module with code; a string that stands alone as a statement is none."""
    alone: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            alone |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_SOURCE:
            lines |= set(range(token.start[0], token.end[0] + 1))
    return len(lines - alone)


def count(package: Path) -> Counter[str]:
    """Folder within `package` -> lines; modules beside the folders count as `.`."""
    lines: Counter[str] = Counter()
    for path in package.rglob("*.py"):
        parts = path.relative_to(package).parts
        lines[parts[0] if len(parts) > 1 else "."] += source_lines(path.read_text(encoding="utf-8"))
    return lines


def main() -> None:
    """Print a table."""
    for package in (ROOT / "ibrobot_core", *sorted(ROOT.glob("plugins/*/*ibrobot*"))):
        lines = count(package)
        print(f"{lines.total():6} {package.name}")
        if package.name == "ibrobot_core":
            for folder, number in lines.most_common():
                print(f"{number:6}   {folder}")


if __name__ == "__main__":
    main()
