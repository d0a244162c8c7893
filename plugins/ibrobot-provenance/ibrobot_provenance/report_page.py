"""A report as one HTML file that needs no other file and no network."""

from __future__ import annotations

import base64
import os
from collections.abc import Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from ibrobot_provenance.reports import Case, Cases, Plots, ReportSection, Table, Text
from ibrobot_provenance.svg import tag

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
.panels { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(320px, 100%), 1fr)); gap: 1rem; }
.failure { background: var(--card); border-radius: 8px; padding: .8rem; min-width: 0; }
.failure h3 { margin: 0 0 .4rem; font-size: 1rem; }
video, .failure img { width: 100%; border-radius: 4px; background: #000; }
code { font: 12.5px/1.4 ui-monospace, monospace; } h1, h2, h3, code, p, a, .text { overflow-wrap: anywhere; }
a { color: var(--ok); } p { max-width: 75ch; }
"""


def as_page(out: Path, title: str, sections: Sequence[ReportSection], *, more: str = "") -> str:
    """Render the page.

    Args:
        out: folder of the report, to which its links are relative.
        title: of the window.
        sections: the report.
        more: HTML at its end.
    """
    body = ""
    for number, section in enumerate(sections):
        body += tag("h2" if number else "h1", escape(section.title))
        body += "".join(_block(out, block) for block in section.blocks)
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style>"
    )
    page = f'<!doctype html>\n<html lang="en"><head>{head}</head><body>{body}{more}</body></html>\n'
    return page.encode("utf-8", "backslashreplace").decode()  # names of files may have bytes that are no text


def _block(out: Path, block: Text | Table | Plots | Cases) -> str:
    match block:
        case Text(text, "title"):
            return tag("h3", escape(text))
        case Text(text, role):
            return tag("p", escape(text), class_=role)
        case Table(columns, rows):
            top = tag("tr", "".join(tag("th", escape(cell)) for cell in columns))
            body = "".join(tag("tr", "".join(tag("td", escape(cell)) for cell in row)) for row in rows)
            return tag("div", tag("table", top + body), class_="scroll")
        case Plots((picture,)):
            return tag("div", picture, class_="scroll", tabindex=0)
        case Plots(pictures):
            return tag("div", "".join(pictures), class_="panels")
        case Cases(cases):
            return tag("div", "".join(_case(out, each) for each in cases), class_="panels")


def _case(out: Path, case: Case) -> str:
    """Render the video, recording, seed and command of a failure or an error."""
    lines = [tag("h3", escape(case.title))]
    if case.video is not None:
        source = f"data:video/mp4;base64,{base64.b64encode(case.video.read_bytes()).decode()}"
        lines.append(tag("video", "", src=source, controls="", muted="", preload="metadata"))
    if case.picture is not None:
        kind = "png" if case.picture.suffix == ".png" else "jpeg"
        source = f"data:image/{kind};base64,{base64.b64encode(case.picture.read_bytes()).decode()}"
        lines.append(tag("img", src=source, alt=case.title))
    lines.append(tag("div", escape(case.text), class_="text"))
    if case.episode is not None:
        recording = str(case.episode.relative_to(out) if case.episode.is_relative_to(out) else case.episode)
        lines.append(tag("div", tag("a", escape(recording), href=quote(os.fsencode(recording)))))
    if case.command:
        lines.append(tag("code", escape(case.command)))
    return tag("div", "".join(lines), class_="failure")
