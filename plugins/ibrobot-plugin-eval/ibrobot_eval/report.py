"""Report of an evaluation as JSON, CSV and Markdown. Equal results give equal bytes."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs

from ibrobot_eval.comparison import Comparison, Summary, compare
from ibrobot_eval.episodes import Place, Result, write
from ibrobot_eval.options import REPORT
from ibrobot_eval.policies import Policy
from ibrobot_eval.statistics import ALPHA, Interval

LEVEL = f"{100 * (1 - ALPHA):g} %"


@attrs.frozen
class Episode:
    """An episode in the report."""

    policy: str
    result: Result
    recording: str
    """Path of its recording, relative to the folder of the evaluation."""
    video: str
    """Path of its video, relative likewise; empty if there is none."""
    command: str
    """The command that repeats it; empty for a trial on a real arm."""


@attrs.frozen
class Report:
    """The results of an evaluation."""

    summaries: tuple[Summary, ...]
    comparisons: tuple[Comparison, ...]
    episodes: tuple[Episode, ...]
    margin: float
    until_decided: bool

    @classmethod
    def of(
        cls, results: Mapping[str, Sequence[Result]], episodes: Sequence[Episode], margin: float, *, until_decided: bool
    ) -> Report:
        """Make a report.

        Args:
            results: label -> results in the order of their seeds.
            episodes: the episodes to list.
            margin: a difference below it counts as none.
            until_decided: whether the evaluation ended with a decision.
        """
        summaries = tuple(Summary.of(label, found) for label, found in results.items())
        return cls(summaries, tuple(compare(results, margin)), tuple(episodes), margin, until_decided)

    @classmethod
    def of_simulation(
        cls, policies: Sequence[Policy], results: Mapping[str, Sequence[Result]], margin: float, *, until_decided: bool
    ) -> Report:
        """Make a report on episodes in simulation, each with the command that repeats it."""
        episodes = []
        for each in policies:
            for result in results[each.label]:
                place = Place.of(Path(), each, result.seed)
                command = each.command(result.seed)
                episodes.append(Episode(each.label, result, str(place.episode), str(place.video), command))
        return cls.of(results, episodes, margin, until_decided=until_decided)

    @classmethod
    def read(cls, file: Path) -> Report:
        """Read a report from a file with `facts`.

        Raises:
            OSError: if the file cannot be read.
            ValueError, KeyError, TypeError: if the file is not a report.
        """
        facts = json.loads(file.read_text(encoding="utf-8"))
        results: dict[str, list[Result]] = {each["label"]: [] for each in facts["policies"]}
        episodes = []
        for each in facts["episodes"]:
            result = Result(**{field.name: each[field.name] for field in attrs.fields(Result)})
            results[each["policy"]].append(result)
            episodes.append(Episode(each["policy"], result, each["recording"], each["video"], each["command"]))
        return cls.of(results, episodes, facts["margin"], until_decided=facts["until_decided"])

    @property
    def factors(self) -> list[str]:
        """Names of the episodes' factors, in the order of the scene."""
        return list(dict.fromkeys(name for each in self.episodes for name in each.result.factors))

    @property
    def failures(self) -> list[Episode]:
        """The episodes that failed."""
        return [each for each in self.episodes if not each.result.success]

    def facts(self) -> dict[str, Any]:
        """The report as a JSON object."""
        return {
            "margin": self.margin,
            "until_decided": self.until_decided,
            "lines": self.lines(),
            "policies": [attrs.asdict(each) for each in self.summaries],
            "comparisons": [{**attrs.asdict(each), "words": each.words} for each in self.comparisons],
            "episodes": [_flat(each) for each in self.episodes],
        }

    def as_csv(self) -> str:
        """One line for each episode."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        head = ("policy", "seed", "success", "time_s", "interventions", "faults")
        writer.writerow([*head, *self.factors, "recording", "command"])
        for each in self.episodes:
            result = each.result
            values = (each.policy, result.seed, int(result.success), result.time_s, sum(result.interventions.values()))
            factors = (result.factors.get(name, "") for name in self.factors)
            writer.writerow([*values, "; ".join(result.faults), *factors, each.recording, each.command])
        return text.getvalue()

    def as_markdown(self) -> str:
        """Tables of policies, comparisons and failures."""
        lines = ["# Evaluation", "", *(f"**{each.words}.**  " for each in self.comparisons)]
        lines += [""] if self.comparisons else []
        lines += table(SUMMARY_HEAD, [summary_row(each) for each in self.summaries])
        if self.comparisons:
            lines += ["", *table(COMPARISON_HEAD, [comparison_row(each) for each in self.comparisons]), "", NOTE]
        if failures := self.failures:
            lines += ["", "## Failures", ""]
            rows = [
                (each.policy, str(each.result.seed), f"`{each.command}`" if each.command else "", each.recording)
                for each in failures
            ]
            lines += table(("policy", "seed", "command that repeats it", "recording"), rows)
        return "\n".join(lines) + "\n"

    def lines(self) -> list[str]:
        """The report for a terminal."""
        width = max(len(each.label) for each in self.summaries)
        lines = []
        for each in self.summaries:
            time = f", median {each.median_time_s:.1f} s" if each.median_time_s is not None else ""
            lines.append(
                f"{each.label:{width}}  {each.successes} of {each.episodes} succeeded, "
                f"{LEVEL} interval {percent(each.wilson)}{time}"
            )
        return [*lines, *(each.words for each in self.comparisons)]


def _flat(episode: Episode) -> dict[str, Any]:
    """An episode as a JSON object, with the fields of its result in place of the result."""
    fields = attrs.asdict(episode)
    return {"policy": fields.pop("policy"), **fields.pop("result"), **fields}


SUMMARY_HEAD = (
    "policy", "successes", "rate", f"{LEVEL} interval (Wilson)", "exact interval", "median time to success",
    "interventions per episode", "episodes with faults",
)  # fmt: skip
COMPARISON_HEAD = (
    "policies", "only the first", "only the second", "difference", f"{LEVEL} interval", "p",
    f"{LEVEL} interval, fixed number", "p, fixed number (McNemar)", "verdict",
)  # fmt: skip
NOTE = (
    "The difference is the first policy's success rate minus the second's, on the same seeds. The first interval and p "
    "stay valid however often one looks and whenever one stops, and the verdict is read off them. Those for a fixed "
    "number are valid only if the number of episodes was chosen beforehand. With more than two policies all are "
    "corrected for the number of pairs."
)


def summary_row(each: Summary) -> tuple[str, ...]:
    """A policy as a row of the table."""
    rate = f"{100 * each.successes / each.episodes:.1f} %" if each.episodes else ""
    time = f"{each.median_time_s:.2f} s" if each.median_time_s is not None else "none"
    interventions = sum(each.interventions.values()) / each.episodes if each.episodes else 0.0
    return (
        each.label, f"{each.successes} of {each.episodes}", rate, percent(each.wilson), percent(each.exact), time,
        f"{interventions:.1f}", str(each.disturbed),
    )  # fmt: skip


def comparison_row(each: Comparison) -> tuple[str, ...]:
    """Two policies as a row of the table."""
    return (
        f"{each.first}, {each.second}", str(each.pairs.first), str(each.pairs.second),
        f"{100 * each.pairs.difference:+.1f} points", points(each.interval), p_value(each.p_value),
        points(each.fixed_interval), p_value(each.mcnemar_p), each.words,
    )  # fmt: skip


def percent(interval: Interval) -> str:
    """Format an interval of a rate, in percent."""
    return f"{100 * interval.low:.1f} to {100 * interval.high:.1f} %"


def points(interval: Interval) -> str:
    """Format an interval of a difference of rates, in percentage points."""
    return f"{100 * interval.low:+.1f} to {100 * interval.high:+.1f}"


def p_value(value: float) -> str:
    """Format a p-value."""
    return f"{value:.3f}" if value >= 0.001 else "< 0.001"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table in Markdown."""
    cells = [[cell.replace("|", "\\|") for cell in row] for row in (head, ["---"] * len(head), *rows)]
    return [f"| {' | '.join(row)} |" for row in cells]


def write_report(out: Path, report: Report) -> None:
    """Write the report into the folder of its evaluation."""
    write(out / REPORT, json.dumps(report.facts(), indent=1) + "\n")
    write(out / "report.csv", report.as_csv())
    write(out / "report.md", report.as_markdown())
