"""The report on a run as sections, for `ibrobot ui`, and as one HTML file."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from ibrobot_provenance.files import replace_file
from ibrobot_provenance.report_page import as_page
from ibrobot_provenance.reports import Case, Cases, Plots, ReportSection, Table, Text
from ibrobot_provenance.svg import axis_of, caption, grid_below, grid_beside, svg, tag

from ibrobot_core.api import DatasetError
from ibrobot_diagnose.options import REPORT
from ibrobot_diagnose.pictures import Shown, png
from ibrobot_diagnose.report import Explanation
from ibrobot_diagnose.window import Floats

_WIDTH, _HEIGHT = 360, 190
_POINTS = 240
_SPAN = 0.05
"""Least range of the angles of a plot [rad]."""

_PLAYER = """<script>
for (const player of document.querySelectorAll(".player")) {
  const pictures = [...player.querySelectorAll("img")], slider = player.querySelector("input");
  const show = () => pictures.forEach((each, i) => { each.hidden = i !== Number(slider.value); });
  slider.addEventListener("input", show);
  show();
}
</script>"""


def contents_of(facts: Mapping[str, Any], plots: Sequence[str], episode: Path | None) -> list[ReportSection]:
    """The report of an explanation's facts."""
    first, *others = facts["causes"] or [None]
    blocks: list[Text | Table | Plots | Cases] = [Text(facts["first"], "verdict")]
    if first is not None:
        blocks += _blocks(first)
    title = f"{Path(facts['episode']).name}: {facts['outcome']}"
    blocks.append(Cases((Case("The recording", f"{facts['seconds']:.1f} s", episode),)))
    sections = [ReportSection(title, tuple(blocks))]
    for number, cause in enumerate(others, 2):
        sections.append(ReportSection(f"{number}. {cause['text']}", tuple(_blocks(cause))))
    between = [Text(line) for line in facts["lines_between"]]
    if between or plots:
        note = Text("Thick lines are the arm, thin ones the commands, dashed ones what the model said.", "note")
        sections.append(ReportSection("Between the answers and the arm", (*between, note, Plots(tuple(plots)))))
    rows = tuple((each["name"], each["text"]) for each in facts["healthy"])
    if rows:
        sections.append(ReportSection(f"Tested and healthy ({len(rows)})", (Table(("cause", "what is so"), rows),)))
    rows = tuple((each["name"], each["why"]) for each in facts["untested"])
    if rows:
        sections.append(ReportSection(f"Not tested ({len(rows)})", (Table(("cause", "why"), rows),)))
    return sections


def _blocks(cause: Mapping[str, Any]) -> list[Text | Table | Plots | Cases]:
    since = f", from {cause['since_s']:.1f} s on" if cause["since_s"] is not None else ""
    details = [Text(detail, "note") for detail in cause["details"]]
    likely = Text(f"Likelihood {100 * cause['likelihood']:.0f} %{since} ({cause['name']}).", "note")
    return [likely, *details, Text("What to do", "title"), Text(cause.get("to_do") or cause["remedy"])]


def lines_of(out: Path) -> Sequence[str]:
    """The first line of the explanation in a folder.

    Raises:
        DatasetError: if it is damaged.
    """
    return [str(read_facts(out / REPORT)["first"])]


def read_contents(out: Path) -> Sequence[ReportSection]:
    """Read the report in a folder.

    Raises:
        DatasetError: if it is damaged.
    """

    def contents(facts: dict[str, Any]) -> Sequence[ReportSection]:
        pictures = Text(f"{out / 'report.html'} shows what the cameras saw, with the pictures of each finding.")
        sections = contents_of(facts, facts["plots"], Path(facts["path"]))
        return [*sections, ReportSection("Pictures", (pictures,))]

    return read_sections(out / REPORT, "an explanation", contents)


def read_facts(file: Path) -> dict[str, Any]:
    """Read the facts of a report.

    Raises:
        DatasetError: if it is damaged.
    """
    try:
        facts = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(facts, dict) or "first" not in facts:
            raise ValueError("it has no first line")
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{file}: cannot be read: {error}") from None
    return facts


def read_sections(
    file: Path, what: str, contents: Callable[[dict[str, Any]], Sequence[ReportSection]]
) -> Sequence[ReportSection]:
    """Read a report.

    Args:
        file: the file of its facts.
        what: what the file is, for the error.
        contents: the sections of the facts.

    Raises:
        DatasetError: if it is damaged.
    """
    facts = read_facts(file)
    try:
        return contents(facts)
    except KeyError as error:
        raise DatasetError(f"{file}: is not {what} of this version: it lacks {error}; make it again") from None
    except (IndexError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise DatasetError(f"{file}: is not {what}: {error!r}") from None


def write_report(out: Path, explanation: Explanation, episode: Path) -> None:
    """Write the report as JSON and as one HTML file into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    plots = list(_plots(explanation))
    between = explanation.lines_between()
    facts = {**explanation.facts(), "path": str(episode.absolute()), "lines_between": between, "plots": plots}
    sections = contents_of(facts, plots, episode.absolute())
    page = as_page(out, explanation.first, sections, more=_pictures(explanation) + _players(explanation))
    replace_file(out / "report.html", page)
    replace_file(out / REPORT, json.dumps(facts) + "\n")


def _plots(explanation: Explanation) -> Iterator[str]:
    """A plot of each joint: what the model said, what was commanded, and where the arm was."""
    window, course = explanation.window, explanation.course
    times = window.ticks_ns if course is None else course.times_ns
    at_s = np.array([window.since(t_ns) for t_ns in times.tolist()])
    tracks: dict[str, Floats] = {"state": window.state.at(times), "command": window.command.at(times)}
    if course is not None:
        tracks["answer"] = course.wanted
    for j, joint in enumerate(window.joints):
        known = np.concatenate([each[np.isfinite(each[:, j]), j] for each in tracks.values()])
        if len(known) < 2 or len(at_s) < 2:
            continue
        across = axis_of([float(at_s[0]), float(at_s[-1])], 44, _WIDTH - 8)
        low, high = float(known.min()), float(known.max())
        room = max(0.0, _SPAN - (high - low)) / 2  # an arm that stands still is no motion of micrometres
        down = axis_of([low - room, high + room], _HEIGHT - 36, 24)
        parts = [*grid_below(across, 24, _HEIGHT - 36, "s"), *grid_beside(down, 44, _WIDTH - 8)]
        parts.append(caption(44, 14, f"{joint} [rad]", "start"))
        classes = {"state": "range", "command": "zero", "answer": "margin"}
        for name, values in tracks.items():
            parts += [
                tag("polyline", points=points, fill="none", class_=classes[name])
                for points in _lines(at_s, values[:, j], across, down)
            ]
        yield svg(_WIDTH, _HEIGHT, parts, f"{joint} over time")


def _lines(at_s: Floats, values: Floats, across: Any, down: Any) -> Iterator[str]:
    """Points of the stretches in which a value is known."""
    chosen = np.unique(np.linspace(0, len(at_s) - 1, min(_POINTS, len(at_s))).round().astype(int))
    points: list[str] = []
    for i in chosen.tolist():
        if np.isfinite(values[i]):
            points.append(f"{across(float(at_s[i]))},{down(float(values[i]))}")
        elif points:
            yield " ".join(points)
            points = []
    if points:
        yield " ".join(points)


def _image(picture: Any, title: str, hidden: bool = False) -> str:
    source = f"data:image/png;base64,{base64.b64encode(png(picture)).decode()}"
    style = "width:100%;image-rendering:auto;border-radius:4px"
    return tag("img", src=source, alt=title, style=style, **({"hidden": ""} if hidden else {}))


def _pictures(explanation: Explanation) -> str:
    """The pictures of the findings, side by side."""
    shown = [each for finding in explanation.diagnosis.findings for each in finding.evidence.pictures]
    if explanation.reference.model is not None:
        shown += explanation.reference.model.looks
    return figures(shown)


def figures(shown: Sequence[Shown], title: str = "Pictures") -> str:
    """Pictures side by side, below a title if there is one."""
    shown = list({each.title: each for each in shown}.values())
    if not shown:
        return ""
    made = [
        tag("figure", _image(each.picture, each.title) + tag("figcaption", escape(each.title)), style="margin:0")
        for each in shown
    ]
    return (tag("h2", escape(title)) if title else "") + tag("div", "".join(made), class_="panels")


def _players(explanation: Explanation) -> str:
    """The pictures of each camera over the run, with a slider."""
    window, players = explanation.window, []
    for camera in window.cameras.values():
        if not camera.kept:
            continue
        times = [window.since(camera.times_ns[i]) for i in camera.kept]
        images = "".join(
            _image(picture, f"{camera.name} at {at_s:.1f} s", hidden=number > 0)
            for number, (picture, at_s) in enumerate(zip(camera.kept.values(), times, strict=True))
        )
        slider = tag(
            "input", type="range", min=0, max=len(times) - 1, value=0, style="width:100%",
            aria_label=f"time of the picture of {camera.name}",
        )  # fmt: skip
        players.append(tag("div", tag("h3", escape(camera.name)) + images + slider, class_="player failure"))
    return (
        tag("h2", "What the cameras saw") + tag("div", "".join(players), class_="panels") + _PLAYER if players else ""
    )
