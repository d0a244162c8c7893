"""The size of core; `python tests/house/source_lines.py` shows that of each plugin, too."""

from source_lines import ROOT, count

LIMIT = 11_820


def test_core_stays_small():
    lines = count(ROOT / "ibrobot_core")
    table = "\n".join(f"{number:6} {folder}" for folder, number in lines.most_common())
    assert lines.total() <= LIMIT, (
        f"{lines.total()} source lines, at most {LIMIT}; move or simplify something:\n{table}"
    )
