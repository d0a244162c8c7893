"""Every benchmark guards a claim of a page, has its last figures, and is in the table of the benchmarks page."""

from __future__ import annotations

import ast
import runpy
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
RUN = runpy.run_path(str(ROOT / "benchmarks/run.py"), run_name="benchmarks")
CLAIMS = RUN["CLAIMS"]


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.name)
def test_the_page_of_a_claim_names_its_benchmark(claim: Any) -> None:
    text = (ROOT / claim.page).read_text(encoding="utf-8")
    assert claim.script.exists()
    assert f"benchmarks/{claim.script.name}" in text or "reference/benchmarks.md" in text


def test_every_benchmark_has_a_claim() -> None:
    """Those that report figures; the other files are their helpers."""
    reporting = {
        path.name
        for path in (ROOT / "benchmarks").glob("*.py")
        if path.name != "apparatus.py"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "report"
    }
    assert reporting == {claim.script.name for claim in CLAIMS}, "add a Claim to benchmarks/run.py"


def test_every_claim_has_its_last_figures() -> None:
    assert {name: list(entry) for name, entry in RUN["last"]().items()} == {
        claim.name: ["date", "commit", "machine", "figures"] for claim in CLAIMS
    }


def test_the_page_has_the_last_figures() -> None:
    page = RUN["PAGE"].read_text(encoding="utf-8")
    assert page == RUN["page"](), "run `python benchmarks/run.py --page`"


def test_figures_are_compared_with_the_last_ones() -> None:
    safety = next(claim for claim in CLAIMS if claim.name == "safety")
    last = RUN["last"]()["safety"]["figures"]["p50_us"]
    (row, new) = RUN["compared"](safety, {"p50_us": 2 * last, "another": 3.0})
    assert row.split() == ["safety", "p50_us", f"{last:g}", f"{2 * last:g}", "2.00"]
    assert new.split() == ["safety", "another", "-", "3", "-"]


def test_the_last_line_of_figures_counts(capsys: pytest.CaptureFixture[str]) -> None:
    from apparatus import report, reported

    report(p50=1.23456, missed=0)
    assert reported("noise\nfigures: {}\n" + capsys.readouterr().out) == {"p50": 1.235, "missed": 0.0}
    assert reported("noise\n") == {}
