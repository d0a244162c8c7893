"""Contents of an evaluation's report, for its HTML file and for `ibrobot ui`."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from ibrobot_provenance.reports import Case, Cases, Plots, ReportSection, Table, Text

from ibrobot_core.api import DatasetError
from ibrobot_eval import plots
from ibrobot_eval.episodes import Result
from ibrobot_eval.options import REPORT
from ibrobot_eval.report import (
    COMPARISON_HEAD,
    COUNTED,
    NOTE,
    SUMMARY_HEAD,
    Episode,
    Report,
    comparison_row,
    summary_row,
)

_AXES = (("_x", "_y"), (".x", ".y"))


def lines_of(out: Path) -> Sequence[str]:
    """The result of an evaluation, as lines for a terminal.

    Raises:
        DatasetError: if its report is damaged.
    """
    file = out / REPORT
    if not file.exists():
        return ["not finished; start the same evaluation again to continue"]
    try:
        return [str(each) for each in json.loads(file.read_text(encoding="utf-8"))["lines"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{file}: is not a report of an evaluation: {error}") from None


def read_contents(out: Path) -> Sequence[ReportSection]:
    """Read the contents of the report in the folder of an evaluation.

    Raises:
        DatasetError: if the report is missing or damaged.
    """
    file = out / REPORT
    if not file.exists():
        raise DatasetError(f"{out}: has no report yet; start the same evaluation again to continue it")
    try:
        return contents_of(out, Report.read(file))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DatasetError(f"{file}: is not a report of an evaluation: {error}") from None


def contents_of(out: Path, report: Report) -> list[ReportSection]:
    """Contents of a report, with the videos in the folder of the evaluation."""
    rates = [(each.label, each.successes, each.episodes) for each in report.summaries]
    verdicts = (Text(f"{each}.", "verdict") for each in report.verdicts)
    table = Table(SUMMARY_HEAD, tuple(map(summary_row, report.summaries)))
    counted = (Text(COUNTED, "note"),) if report.broken else ()
    sections = [ReportSection("Evaluation", (*verdicts, table, *counted, Plots((plots.rates(rates),))))]
    if report.comparisons:
        sections.append(_comparison(report))
    sections.append(_outcomes(report))
    if panels := list(_panels(report)):
        left_out = " Errors are left out." if report.broken else ""
        note = Text(f"Dots are successes, crosses failures. Bars are 95 % intervals.{left_out}", "note")
        sections.append(ReportSection("Where it succeeds and fails", (note, Plots(tuple(panels)))))
    if report.notes:
        sections.append(ReportSection("Notes", tuple(map(Text, report.notes))))
    if report.broken:
        title = f"Errors of policies ({len(report.broken)})"
        sections.append(ReportSection(title, (*map(Text, report.errors), _cases(out, report.broken))))
    failures = report.failures
    shown = _cases(out, failures) if failures else Text("None.")
    sections.append(ReportSection(f"Failures ({len(failures)})", (shown,)))
    return sections


def _cases(out: Path, episodes: Sequence[Episode]) -> Cases:
    return Cases(tuple(_case(out, each) for each in episodes))


def _comparison(report: Report) -> ReportSection:
    """Compare the pairs of policies: a table, and the differences over the episodes."""
    blocks: list[Text | Table | Plots] = [
        Table(COMPARISON_HEAD, tuple(map(comparison_row, report.comparisons))),
        Text(NOTE, "note"),
    ]
    for each in report.comparisons:
        title = f"{each.first} minus {each.second}: difference of success rates [points] over the episodes"
        blocks += [Text(title, "title"), Plots((plots.course(each.course, each.margin, title),))]
    note = "The band is the interval that is valid at all times; dashed lines are the margin."
    return ReportSection("Comparison", (*blocks, Text(note, "note")))


def _outcomes(report: Report) -> ReportSection:
    """Plot outcomes and times by seed."""
    by_policy = [(each.label, _episodes(report, each.label)) for each in report.summaries]
    outcomes = [
        (label, [(e.result.seed, e.result.success, e.result.time_s, e.result.error) for e in episodes])
        for label, episodes in by_policy
    ]
    times = [
        (label, [(e.result.seed, e.result.time_s) for e in episodes if e.result.success])
        for label, episodes in by_policy
    ]
    errors = " Marks at the top alone are errors of the policy." if report.broken else ""
    blocks: list[Text | Plots] = [Plots((plots.strips(outcomes),)), Text(f"Tall marks are failures.{errors}", "note")]
    if any(episodes for _, episodes in times):
        blocks.append(Plots((plots.times(times),)))
    return ReportSection("Episodes", tuple(blocks))


def _episodes(report: Report, label: str) -> list[Episode]:
    return [each for each in report.episodes if each.policy == label]


def _acted(report: Report, label: str) -> list[Result]:
    """Results of the episodes in which the policy acted without an error."""
    return [each.result for each in _episodes(report, label) if not each.result.is_error]


def _panels(report: Report) -> Iterator[str]:
    """Plot outcomes over the scene's random factors."""
    values_of = {name: {each.result.factors.get(name) for each in report.episodes} for name in report.factors}
    names = [name for name, values in values_of.items() if len(values) > 1]
    ends = [(x, x.removesuffix(a) + b) for a, b in _AXES for x in names if x.endswith(a)]
    pairs = [(x, y) for x, y in ends if y in names]
    for summary in report.summaries:
        results = _acted(report, summary.label)
        for x, y in pairs:
            points = [
                (each.factors[x], each.factors[y], each.success, f"seed {each.seed}")
                for each in results
                if x in each.factors and y in each.factors
            ]
            if points:
                yield plots.map_of(points, (x, y), summary.label)
    others = [name for name in names if not any(name in pair for pair in pairs)]
    for name, summary in itertools.product(others, report.summaries):
        results = _acted(report, summary.label)
        values = [(each.factors[name], each.success) for each in results if name in each.factors]
        if len({value for value, _ in values}) > 1:
            yield plots.by_factor(values, name, summary.label)


def _case(out: Path, episode: Episode) -> Case:
    """A failure or an error: its reason, recording and video if any, and the command that repeats it."""
    result = episode.result
    ended = result.error or "; ".join(result.faults) or f"no success within {result.time_s:.1f} s"
    video = out / episode.video
    shown = video if episode.video and video.is_file() else None
    recording = out / episode.recording if episode.recording else None
    return Case(f"{episode.policy}, seed {result.seed}", ended, recording, shown, episode.command)
