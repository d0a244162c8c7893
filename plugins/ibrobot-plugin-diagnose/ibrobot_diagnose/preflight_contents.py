"""The report of `ibrobot preflight` as sections, for `ibrobot ui`, and as one HTML file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ibrobot_provenance.files import replace_file
from ibrobot_provenance.report_page import as_page
from ibrobot_provenance.reports import Case, Cases, ReportSection, Table, Text
from ibrobot_terminal.plural import measured

from ibrobot_diagnose.cause import Finding
from ibrobot_diagnose.contents import read_facts, read_sections
from ibrobot_diagnose.options import PREFLIGHT
from ibrobot_diagnose.pictures import png

_MOST_PICTURES = 100
_VERDICTS = {"cannot tell": "uncertain"}
"""Verdicts that have another name on the page, as in the first line."""
_COLUMNS = ("verdict", "what", "how it is", "number", "warns from", "fails from")


def write_preflight(out: Path, facts: Mapping[str, Any], findings: Sequence[Finding]) -> None:
    """Write the comparison of a rig as JSON, as one HTML file, and its pictures, into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    bad = (each.evidence for each in findings if each.evidence.verdict in ("fail", "warn"))
    shown = list({each.title: each for evidence in bad for each in evidence.pictures}.values())[:_MOST_PICTURES]
    for number, each in enumerate(shown):
        replace_file(out / _file(number), png(each.picture))
    written = {**facts, "pictures": [each.title for each in shown]}
    replace_file(out / "report.html", as_page(out, facts["first"], contents_of(written, out)))
    replace_file(out / PREFLIGHT, json.dumps(written) + "\n")


def _file(number: int) -> str:
    return f"picture_{number:02}.png"


def contents_of(facts: Mapping[str, Any], out: Path) -> list[ReportSection]:
    """The report of the facts of a preflight, with the pictures in its folder."""
    blocks: list[Text | Table | Cases] = [Text(facts["first"], "verdict")]
    for each in facts["lines"]:
        if each["verdict"] in ("fail", "warn"):
            blocks += [Text(each["text"], "title"), *(Text(detail, "note") for detail in each["details"])]
            blocks.append(Text(f"What to do: {each['remedy']}"))
    sections = [ReportSection(facts["robot"], tuple(blocks))]
    titles = facts["pictures"][:_MOST_PICTURES]
    if pictures := tuple(Case(title, "", None, picture=out / _file(i)) for i, title in enumerate(titles)):
        sections.append(ReportSection("Pictures", (Cases(pictures),)))
    rows = tuple(
        (
            _VERDICTS.get(each["verdict"], each["verdict"]), each["name"], each["text"],
            measured(each["number"], each["unit"]),
            f"{each['threshold']:.3g}", "" if each["fails"] is None else f"{each['fails']:.3g}",
        )
        for each in facts["lines"]
    )  # fmt: skip
    sections.append(ReportSection("What was compared", (Table(_COLUMNS, rows),)))
    if untested := tuple((each["name"], each["why"]) for each in facts["untested"]):
        sections.append(ReportSection(f"Not tested ({len(untested)})", (Table(("cause", "why"), untested),)))
    if facts["notes"]:
        sections.append(ReportSection("Notes", tuple(Text(note) for note in facts["notes"])))
    return sections


def lines_of(out: Path) -> Sequence[str]:
    """The result in a folder.

    Raises:
        DatasetError: if it is damaged.
    """
    return [str(read_facts(out / PREFLIGHT)["first"])]


def read_contents(out: Path) -> Sequence[ReportSection]:
    """Read the report in a folder.

    Raises:
        DatasetError: if it is damaged.
    """
    return read_sections(out / PREFLIGHT, "a preflight", partial(contents_of, out=out))
