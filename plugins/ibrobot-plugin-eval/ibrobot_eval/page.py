"""The report of an evaluation as one HTML file, which needs nothing else and no network."""

from __future__ import annotations

import base64
import itertools
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

from ibrobot_eval import plots
from ibrobot_eval.plots import tag
from ibrobot_eval.report import (
    COMPARISON_HEAD,
    NOTE,
    SUMMARY_HEAD,
    Episode,
    Report,
    comparison_row,
    summary_row,
)

_STYLE = """
:root { color-scheme: light dark; --bg: #fff; --fg: #1c1e21; --muted: #5a6068; --grid: #e2e5e9; --card: #f5f6f8;
  --ok: #1f6fb2; --bad: #c04a00; --band: #1f6fb226; }
@media (prefers-color-scheme: dark) { :root { --bg: #15171a; --fg: #e8eaed; --muted: #a2a9b1; --grid: #33383e;
  --card: #1f2327; --ok: #6fb4ec; --bad: #ff9b5c; --band: #6fb4ec33; } }
body { margin: 0 auto; max-width: 1100px; padding: 1.5rem; background: var(--bg); color: var(--fg);
  font: 15px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
.verdict { font-size: 1.15rem; font-weight: 600; margin: .3rem 0; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: left; min-width: 5.5em; padding: .35rem .8rem .35rem 0; border-bottom: 1px solid var(--grid);
  vertical-align: top; }
th { color: var(--muted); font-weight: 600; } .note, .label { color: var(--muted); fill: var(--muted); }
svg { width: 100%; height: auto; font: 12px system-ui, sans-serif; fill: var(--fg); display: block; margin: .5rem 0; }
svg .grid { stroke: var(--grid); } svg .ok { fill: var(--ok); } svg .bad { stroke: var(--bad); stroke-width: 2; }
svg .bad-fill { fill: var(--bad); } svg .range { stroke: var(--ok); stroke-width: 2; }
svg .faint { fill: var(--ok); fill-opacity: .45; } svg .band { fill: var(--band); }
svg .estimate { stroke: var(--ok); stroke-width: 2; fill: none; } svg .zero { stroke: var(--fg); }
svg .margin { stroke: var(--muted); stroke-dasharray: 4 4; }
.panels { display: grid; grid-template-columns: repeat(auto-fill, minmax(320px, 1fr)); gap: 1rem; }
.failure { background: var(--card); border-radius: 8px; padding: .8rem; min-width: 0; }
.failure h3 { margin: 0 0 .4rem; font-size: 1rem; } video { width: 100%; border-radius: 4px; background: #000; }
code { font: 12.5px/1.4 ui-monospace, monospace; overflow-wrap: anywhere; }
a { color: var(--ok); } p { max-width: 75ch; }
"""
_AXES = (("_x", "_y"), (".x", ".y"))


def as_page(out: Path, report: Report) -> str:
    """The page; videos are those in the folder of the evaluation."""
    body = "".join(_body(out, report))
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Evaluation of {escape(', '.join(each.label for each in report.summaries))}</title>"
        f"<style>{_STYLE}</style>"
    )
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>{body}</body></html>\n'


def _body(out: Path, report: Report) -> Iterator[str]:
    yield tag("h1", "Evaluation")
    for each in report.comparisons:
        yield tag("p", escape(each.words) + ".", class_="verdict")
    yield _table(SUMMARY_HEAD, [summary_row(each) for each in report.summaries])
    yield plots.rates([(each.label, each.successes, each.episodes) for each in report.summaries])
    if report.comparisons:
        yield tag("h2", "Comparison")
        yield _table(COMPARISON_HEAD, [comparison_row(each) for each in report.comparisons])
        yield tag("p", escape(NOTE), class_="note")
        for each in report.comparisons:
            title = f"{each.first} minus {each.second}: difference of success rates [points] over the episodes"
            yield tag("h3", escape(title))
            yield plots.course(each.course, each.margin, title)
        yield tag(
            "p", "The band is the interval that is valid at all times; dashed lines are the margin.", class_="note"
        )
    yield tag("h2", "Episodes")
    by_policy = [(each.label, _episodes(report, each.label)) for each in report.summaries]
    yield plots.strips(
        [(label, [(e.result.seed, e.result.success, e.result.time_s) for e in found]) for label, found in by_policy]
    )
    yield tag("p", "Tall marks are failures.", class_="note")
    successes = [
        (label, [(e.result.seed, e.result.time_s) for e in found if e.result.success]) for label, found in by_policy
    ]
    if any(found for _, found in successes):
        yield plots.times(successes)
    yield from _factors(report)
    yield from _failures(out, report)


def _episodes(report: Report, label: str) -> list[Episode]:
    return [each for each in report.episodes if each.policy == label]


def _factors(report: Report) -> Iterator[str]:
    """Plots of the outcomes over what the scene has drawn."""
    values_of = {name: {each.result.factors.get(name) for each in report.episodes} for name in report.factors}
    names = [name for name, values in values_of.items() if len(values) > 1]
    if not names:
        return
    yield tag("h2", "Where it succeeds and fails")
    yield tag("p", "Dots are successes, crosses failures. Bars are 95 % intervals.", class_="note")
    ends = [(x, x.removesuffix(a) + b) for a, b in _AXES for x in names if x.endswith(a)]
    pairs = [(x, y) for x, y in ends if y in names]
    panels = []
    for summary in report.summaries:
        results = [each.result for each in _episodes(report, summary.label)]
        for x, y in pairs:
            points = [
                (each.factors[x], each.factors[y], each.success, f"seed {each.seed}")
                for each in results
                if x in each.factors and y in each.factors
            ]
            if points:
                panels.append(plots.map_of(points, (x, y), summary.label))
    others = [name for name in names if not any(name in pair for pair in pairs)]
    for name, summary in itertools.product(others, report.summaries):
        results = [each.result for each in _episodes(report, summary.label)]
        values = [(each.factors[name], each.success) for each in results if name in each.factors]
        if len({value for value, _ in values}) > 1:
            panels.append(plots.by_factor(values, name, summary.label))
    yield tag("div", "".join(panels), class_="panels")


def _failures(out: Path, report: Report) -> Iterator[str]:
    """Video, recording, seed and command of each failure."""
    failures = report.failures
    yield tag("h2", f"Failures ({len(failures)})")
    cards = []
    for each in failures:
        lines = [tag("h3", escape(f"{each.policy}, seed {each.result.seed}"))]
        video = out / each.video
        if each.video and video.is_file():
            content = base64.b64encode(video.read_bytes()).decode()
            lines.append(
                tag("video", "", src=f"data:video/mp4;base64,{content}", controls="", muted="", preload="metadata")
            )
        ended = "; ".join(each.result.faults) or f"no success within {each.result.time_s:.1f} s"
        lines.append(tag("div", escape(ended)))
        lines.append(tag("div", tag("a", escape(each.recording), href=each.recording)))
        if each.command:
            lines.append(tag("code", escape(each.command)))
        cards.append(tag("div", "".join(lines), class_="failure"))
    yield tag("div", "".join(cards), class_="panels") if cards else tag("p", "None.")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    top = tag("tr", "".join(tag("th", escape(cell)) for cell in head))
    body = "".join(tag("tr", "".join(tag("td", escape(cell)) for cell in row)) for row in rows)
    return tag("div", tag("table", top + body), class_="scroll")
