"""The report of `ibrobot datasets check` as sections, for `ibrobot ui`, and as one HTML file."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ibrobot_provenance.files import replace_file
from ibrobot_provenance.report_page import as_page
from ibrobot_provenance.reports import Case, Cases, Fix, ReportSection, Table, Text
from ibrobot_provenance.svg import tag
from ibrobot_terminal.plural import counted

from ibrobot_diagnose.contents import figures, read_facts, read_sections
from ibrobot_diagnose.options import CHECK
from ibrobot_diagnose.pictures import Shown

_ROOM_S = 0.2
"""Time that stays before the motion begins, and after it ends [s]."""
_BEYOND_S = 1.0
"""A trim until so long after the last tick keeps the end [s]."""


def write_check(
    out: Path, checked: Mapping[str, Any], lines: Sequence[str], shown: Mapping[str, Sequence[Shown]]
) -> None:
    """Write the report as JSON and as one HTML file into a folder.

    Args:
        out: the folder.
        checked: the facts of `ibrobot datasets check`.
        lines: the same in words.
        shown: episode -> its pictures.
    """
    out.mkdir(parents=True, exist_ok=True)
    paths = [str(Path(each["episode"]).absolute()) for each in checked["listed"]]
    facts = {**checked, "first": lines[-1], "paths": paths, "folders": [_number_of(Path(each)) for each in paths]}
    more = "".join(
        tag("h2", f"{number}. {Path(each['episode']).name}") + figures(shown[each["episode"]], "")
        for number, each in enumerate(checked["listed"], 1)
        if shown.get(each["episode"])
    )
    replace_file(out / "report.html", as_page(out, lines[-1], contents_of(facts), more=more))
    replace_file(out / CHECK, json.dumps(facts) + "\n")


def contents_of(facts: Mapping[str, Any]) -> list[ReportSection]:
    """The report of the facts of a check."""
    cases = tuple(
        _case(i, each, Path(facts["paths"][i]), facts["folders"][i]) for i, each in enumerate(facts["listed"])
    )
    verdict = facts["first"].partition(": ")[0] if cases else facts["first"]  # a table below has the counts
    blocks: list[Text | Table | Cases] = [Text(verdict, "verdict")]
    if cases:
        blocks.append(Text("The worst come first. What a click does can be undone.", "note"))
        blocks.append(Cases(cases))
    sections = [ReportSection(f"{facts['dataset']}: {counted(facts['episodes'], 'episode')}", tuple(blocks))]
    if facts["counts"]:
        rows = tuple((name, str(count)) for name, count in facts["counts"].items())
        sections.append(ReportSection("What was found", (Table(("cause", "episodes"), rows),)))
    if untested := tuple((each["name"], each["why"]) for each in facts.get("untested", ())):
        sections.append(ReportSection("Not tested", (Table(("cause", "why"), untested),)))
    if facts["unreadable"]:
        sections.append(ReportSection("Unreadable", tuple(Text(each) for each in facts["unreadable"])))
    return sections


def _number_of(episode: Path) -> int:
    """The number of a recording's folder, which is another one after a trim; 0 for an episode of a LeRobot dataset."""
    return episode.stat().st_ino if episode.exists() else 0


def _case(number: int, each: Mapping[str, Any], path: Path, checked: int) -> Case:
    first, *others = each["causes"]
    is_same = _number_of(path) == checked  # the times of what was trimmed since are no longer right
    lines = [first["text"]]
    lines += [f"Also: {', '.join(other['name'] for other in others)}."] if others else []
    lines += [first["remedy"], *([] if is_same else ["It has changed since the check."])]
    text = "\n".join(lines)
    fixes = tuple(_fixes(each)) if is_same and checked else ()
    return Case(f"{number + 1}. {path.name}", text, path, at_s=first["since_s"] or 0.0, fixes=fixes)


def _fixes(each: Mapping[str, Any]) -> Iterator[Fix]:
    """What mends a recorded episode, the likeliest first."""
    causes = {cause["mends"]: cause for cause in reversed(each["causes"])}
    seconds = float(each["seconds"])
    begin, end = 0.0, seconds + _BEYOND_S
    if "trim start" in causes:
        begin = max(0.0, causes["trim start"]["number"] - _ROOM_S)
    if "trim end" in causes:
        end = causes["trim end"]["since_s"] + _ROOM_S
    cuts = [f"the first {begin:.1f} s"] * (begin > 0) + [f"the last {seconds - end:.1f} s"] * (end < seconds)
    trim = Fix(f"Cut {' and '.join(cuts)}", "trim", each["outcome"] if end < seconds else "", begin, end)
    judge = [Fix(f"Judge {outcome}", "mark", outcome) for outcome in ("success", "failure")]
    drop = Fix("Drop", "delete")
    if cuts:
        yield trim
    if "judge" in causes:
        yield from judge
    yield drop
    if "judge" not in causes:
        yield from (fix for fix in judge if fix.outcome != each["outcome"])


def lines_of(out: Path) -> Sequence[str]:
    """The counts of the check in a folder.

    Raises:
        DatasetError: if it is damaged.
    """
    return [str(read_facts(out / CHECK)["first"])]


def read_contents(out: Path) -> Sequence[ReportSection]:
    """Read the report in a folder.

    Raises:
        DatasetError: if it is damaged.
    """
    return read_sections(out / CHECK, "a check of a dataset", contents_of)
