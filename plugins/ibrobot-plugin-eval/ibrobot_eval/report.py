"""Report of an evaluation as JSON, CSV and Markdown. Equal results give equal bytes."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
from ibrobot_terminal.plural import counted

from ibrobot_eval.comparison import Comparison, Summary, compare
from ibrobot_eval.episodes import Place, Result, write
from ibrobot_eval.options import REPORT
from ibrobot_eval.policies import Policy
from ibrobot_eval.statistics import ALPHA, Interval

_MOST_LINES = 5
"""Number of errors listed at a terminal."""
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
    notes: tuple[str, ...] = ()
    """Notes, e.g. on videos that were not made, or of a drift over time."""

    @classmethod
    def of(
        cls, results: Mapping[str, Sequence[Result]], episodes: Sequence[Episode], margin: float, *,
        until_decided: bool, notes: Sequence[str] = (),
    ) -> Report:  # fmt: skip
        """Make a report.

        Args:
            results: label -> results in the order of their seeds.
            episodes: the episodes to list.
            margin: a difference below it counts as none.
            until_decided: whether the evaluation ended with a decision.
            notes: to print, e.g. on videos that were not made.
        """
        summaries = tuple(Summary.of(label, of_policy) for label, of_policy in results.items())
        return cls(summaries, tuple(compare(results, margin)), tuple(episodes), margin, until_decided, tuple(notes))

    @classmethod
    def of_simulation(
        cls, policies: Sequence[Policy], results: Mapping[str, Sequence[Result]], margin: float, *,
        until_decided: bool, notes: Sequence[str] = (),
    ) -> Report:  # fmt: skip
        """Make a report on episodes in simulation, each with the command that repeats it."""
        episodes = []
        for each in policies:
            for result in results[each.label]:
                place = Place.of(Path(), each, result.seed)
                command = each.command(result.seed)
                recording = "" if result.error and not result.acting else str(place.episode)
                episodes.append(Episode(each.label, result, recording, str(place.video), command))
        return cls.of(results, episodes, margin, until_decided=until_decided, notes=notes)

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
            result = Result(**{"error": ""} | {f.name: each[f.name] for f in attrs.fields(Result) if f.name in each})
            results[each["policy"]].append(result)
            episodes.append(Episode(each["policy"], result, each["recording"], each["video"], each["command"]))
        notes = facts.get("notes", ())
        return cls.of(results, episodes, facts["margin"], until_decided=facts["until_decided"], notes=notes)

    @property
    def factors(self) -> list[str]:
        """Names of the episodes' factors, in the order of the scene."""
        return list(dict.fromkeys(name for each in self.episodes for name in each.result.factors))

    @property
    def errors(self) -> list[str]:
        """A line for each error of a policy, with the number of episodes that ended in it, most first."""
        counts = Counter((each.policy, each.result.error) for each in self.episodes if each.result.is_error)
        return [
            f"{policy}: {count} {'episode' if count == 1 else 'episodes'} ended in an error: {error}"
            for (policy, error), count in counts.most_common()
        ]

    @property
    def failures(self) -> list[Episode]:
        """The episodes that failed without an error."""
        return [each for each in self.episodes if not (each.result.success or each.result.is_error)]

    @property
    def broken(self) -> list[Episode]:
        """The episodes that ended in an error."""
        return [each for each in self.episodes if each.result.is_error]

    @property
    def verdicts(self) -> list[str]:
        """The results in words: policies without any result, and the comparisons."""
        empty = [each for each in self.summaries if each.episodes and each.errors == each.episodes]
        which = {1: "its only episode", 2: "both episodes"}
        return [
            f"{each.label}: {which.get(each.episodes, f'all {each.episodes} episodes')} ended in an error, so this is "
            "no evaluation of it"
            for each in empty
        ] + [each.words for each in self.comparisons]

    def facts(self) -> dict[str, Any]:
        """The report as a JSON object."""
        return {
            "margin": self.margin,
            "until_decided": self.until_decided,
            "lines": self.lines(),
            "notes": list(self.notes),
            "policies": [attrs.asdict(each) for each in self.summaries],
            "comparisons": [{**attrs.asdict(each), "words": each.words} for each in self.comparisons],
            "episodes": [_flat(each) for each in self.episodes],
        }

    def as_csv(self) -> str:
        """One line for each episode."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        head = ("policy", "seed", "success", "time_s", "interventions", "faults", "error")
        writer.writerow([*head, *self.factors, "recording", "command"])
        for each in self.episodes:
            result = each.result
            values = (each.policy, result.seed, int(result.success), result.time_s, sum(result.interventions.values()))
            factors = (result.factors.get(name, "") for name in self.factors)
            writer.writerow([*values, "; ".join(result.faults), result.error, *factors, each.recording, each.command])
        return text.getvalue()

    def as_markdown(self) -> str:
        """Tables of policies, comparisons and failures."""
        lines = ["# Evaluation", "", *(f"**{each}.**  " for each in self.verdicts)]
        lines += [""] if self.verdicts else []
        lines += table(SUMMARY_HEAD, [summary_row(each) for each in self.summaries])
        lines += ["", COUNTED] if self.broken else []
        if self.comparisons:
            lines += ["", *table(COMPARISON_HEAD, [comparison_row(each) for each in self.comparisons]), "", NOTE]
        for title, said, cases in (
            ("Errors", self.errors, self.broken), ("Notes", self.notes, []), ("Failures", [], self.failures),
        ):  # fmt: skip
            lines += ["", f"## {title}"] if said or cases else []
            lines += ["", *(f"- {line}" for line in said)] if said else []
            lines += ["", *table(CASE_HEAD, [_case_row(each) for each in cases])] if cases else []
        return "\n".join(lines) + "\n"

    def lines(self) -> list[str]:
        """The report for a terminal."""
        width = max(len(each.label) for each in self.summaries)
        lines = []
        for each in self.summaries:
            time = f", median {each.median_time_s:.1f} s" if each.median_time_s is not None else ""
            lines.append(
                f"{each.label:{width}}  {each.successes} of {each.episodes} succeeded, {_errors_of(each)}"
                f"{LEVEL} interval {percent(each.exact)}{time}"
            )
        errors = self.errors
        more = [f"and {counted(len(errors) - _MOST_LINES, 'other error')}"] if len(errors) > _MOST_LINES else []
        return [*lines, *(each.words for each in self.comparisons), *errors[:_MOST_LINES], *more, *self.notes]


def _flat(episode: Episode) -> dict[str, Any]:
    """An episode as a JSON object, with the fields of its result in place of the result."""
    fields = attrs.asdict(episode)
    return {"policy": fields.pop("policy"), **fields.pop("result"), **fields}


def _errors_of(each: Summary) -> str:
    return f"{each.errors} {'error' if each.errors == 1 else 'errors'}, " if each.errors else ""


SUMMARY_HEAD = (
    "policy", "successes", "rate", f"{LEVEL} interval (exact)", "Wilson's interval", "median time to success",
    "safety interventions per episode", "episodes with faults", "episodes with errors",
)  # fmt: skip
COMPARISON_HEAD = (
    "policies", "only the first", "only the second", "difference", f"{LEVEL} interval", "p",
    f"{LEVEL} interval, fixed number", "p, fixed number (McNemar)", "verdict",
)  # fmt: skip
NOTE = (
    "The difference is the first policy's success rate minus the second's, on the same seeds. The first interval and p "
    "stay valid however often one looks and whenever one stops, and the verdict is read off them. Those for a fixed "
    "number are valid only if the number of episodes was chosen beforehand. With more than two policies all are "
    "corrected for the number of pairs, by Bonferroni's method, so that an interval excludes 0 exactly if its p is at "
    "most 0.05."
)
COUNTED = "Episodes that ended in an error of the policy count as failures in the rates and comparisons."
CASE_HEAD = ("policy", "seed", "command that repeats it", "recording")


def summary_row(each: Summary) -> tuple[str, ...]:
    """A policy as a row of the table."""
    rate = f"{100 * each.successes / each.episodes:.1f} %" if each.episodes else ""
    time = f"{each.median_time_s:.2f} s" if each.median_time_s is not None else "none"
    interventions = sum(each.interventions.values()) / each.episodes if each.episodes else 0.0
    return (
        each.label, f"{each.successes} of {each.episodes}", rate, percent(each.exact), percent(each.wilson), time,
        f"{interventions:.1f}", str(each.disturbed), str(each.errors),
    )  # fmt: skip


def _case_row(each: Episode) -> tuple[str, ...]:
    """A failure, or an error, as a row of the table."""
    return each.policy, str(each.result.seed), f"`{each.command}`" if each.command else "", each.recording


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
