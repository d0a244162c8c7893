"""The report of `ibrobot identify` as sections, for `ibrobot ui`, and as one HTML file."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from ibrobot_provenance.files import replace_file
from ibrobot_provenance.report_page import as_page
from ibrobot_provenance.reports import Plots, ReportSection, Table, Text
from ibrobot_provenance.svg import Axis, axis_of, caption, grid_below, grid_beside, stroke, svg, tag

from ibrobot_core.api import DatasetError
from ibrobot_mujoco.identification.options import REPORT
from ibrobot_mujoco.parameters import ArmParameters, as_yaml

PARAMETERS = "parameters.yaml"
_DEGREES = 57.29577951308232
_WORDS = {"before": "before", "delay_lag_bias": "delay, lag and bias alone", "after": "identified"}
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 12, 22, 34
_WIDTH = 720


def write_report(out: Path, facts: Mapping[str, Any], parameters: ArmParameters) -> None:
    """Write the file of parameters, and the report as JSON and as one HTML file, into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    replace_file(out / PARAMETERS, as_yaml(parameters))
    replace_file(out / "report.html", as_page(out, f"Identification of {facts['robot']}", contents_of(facts)))
    replace_file(out / REPORT, json.dumps(facts) + "\n")


def contents_of(facts: Mapping[str, Any]) -> list[ReportSection]:
    """The report of the facts of an identification."""
    first, *more = facts["lines"]
    texts = [line for line in more if not line.startswith("Unknown: ")]
    errors = facts["held_out_rms_deg_by_joint"]
    joints = list(facts["course"]["joints"])
    rows = [(joint, *(f"{errors[name][joint]:.2f}" for name in _WORDS)) for joint in joints]
    rows.append(("all", *(f"{facts['held_out_rms_deg'][name]:.2f}" for name in _WORDS)))
    return [
        ReportSection(
            f"{facts['robot']}, from {facts['seconds'] / 60:.1f} minutes of recordings",
            (Text(first, "verdict"), *(Text(each) for each in texts)),
        ),
        ReportSection(
            "Error on recordings that the fit has not seen",
            (
                Text("Root of the mean square in degrees; the simulated arm gets the recorded commands alone.", "note"),
                Table(("joint", *_WORDS.values()), tuple(rows)),
                Plots((_bars(joints, errors),)),
            ),
        ),
        ReportSection(
            "Commanded, measured and simulated",
            (
                Text("Dashed: commanded. Dots: measured. Orange: simulated before. Blue: simulated now.", "note"),
                Plots(tuple(_courses(facts["course"]))),
            ),
        ),
        ReportSection(
            "Parameters",
            (
                Text(
                    "± is one standard deviation. Known: within 10 %. Rough: within 30 %. Unknown: the recordings "
                    "hardly changed the value from which the fit began, or the joint is simulated badly.",
                    "note",
                ),
                Table(("parameter", "joint", "value", "confidence"), tuple(_values(facts["parameters"]))),
                Plots((_gains(facts["parameters"]),)),
            ),
        ),
        ReportSection(
            "What the recordings could not tell",
            (
                (Table(("unknown", "how to find it"), tuple((each["what"], each["how"]) for each in facts["unknown"])),)
                if facts["unknown"]
                else (Text("They told everything."),)
            ),
        ),
    ]


def _values(parameters: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, ...]]:
    for each in parameters:
        factor, unit = (_DEGREES, "deg") if each["unit"] == "rad" else (1.0, each["unit"])
        value = f"{each['value'] * factor:.3g} ± {each['deviation'] * factor:.2g} {unit}".strip()
        yield each["name"], each["joint"], value, each["confidence"]


def _bars(joints: Sequence[str], errors: Mapping[str, Mapping[str, float]]) -> str:
    """Error of each joint before and now, as bars."""
    left, step = 24 + 7 * max(map(len, joints)), 34
    height = _TOP + step * len(joints) + _BOTTOM
    most = max(max(errors[name].values()) for name in _WORDS)
    axis = Axis(0, max(most, 1e-3), left, _WIDTH - _RIGHT)
    parts = grid_below(
        axis, _TOP, height - _BOTTOM, "error [deg rms]: orange before, blue identified; line: the baseline"
    )
    for number, joint in enumerate(joints):
        y = _TOP + step * number
        parts.append(caption(left - 10, y + 20, joint, "end"))
        for name, top, kind in (("before", 4, "bad-fill"), ("after", 16, "ok")):
            value = errors[name][joint]
            tip = tag("title", escape(f"{joint} {_WORDS[name]}: {value:.2f} deg"))
            shape = {"x": left, "y": y + top, "width": round(axis(value) - left, 1), "height": 11}
            parts.append(tag("rect", tip, **shape, class_=kind))
        x = axis(errors["delay_lag_bias"][joint])
        parts.append(stroke(x, y + 2, x, y + 29, "zero"))
    return svg(_WIDTH, height, parts, "Error of each joint")


def _courses(course: Mapping[str, Any]) -> Iterator[str]:
    """A plot of each joint over time."""
    times = course["times"]
    width, height = 350, 200
    for i, joint in enumerate(course["joints"]):
        columns = {
            name: [row[i] * _DEGREES for row in course[name]] for name in ("command", "measured", "before", "after")
        }
        across = Axis(times[0], times[-1], _LEFT, width - _RIGHT)
        every = [value for column in columns.values() for value in column]
        up = axis_of(every, height - _BOTTOM, _TOP)
        parts = [
            *grid_below(across, _TOP, height - _BOTTOM, "time [s]"), *grid_beside(up, _LEFT, width - _RIGHT),
            caption(_LEFT, 14, f"{joint} [deg]", "start"),
        ]  # fmt: skip
        for name, kind in (("command", "margin"), ("before", "bad"), ("after", "estimate")):
            points = [f"{across(t)},{up(value)}" for t, value in zip(times, columns[name], strict=True)]
            parts.append(tag("path", d=f"M{' L'.join(points)}", class_=kind, fill="none"))
        every_other = max(1, len(times) // 60)
        for t, value in list(zip(times, columns["measured"], strict=True))[::every_other]:
            parts.append(tag("circle", cx=across(t), cy=up(value), r=2, class_="faint"))
        yield svg(width, height, parts, f"{joint}: commanded, measured and simulated")


def _gains(parameters: Sequence[Mapping[str, Any]]) -> str:
    """The gain of each joint with twice its standard deviation."""
    gains = [each for each in parameters if each["name"] == "kp"]
    left, step = 24 + 7 * max(len(each["joint"]) for each in gains), 26
    height = _TOP + step * len(gains) + _BOTTOM
    most = max(each["value"] + 2 * each["deviation"] for each in gains)
    axis = Axis(0, min(most, 2 * max(each["value"] for each in gains)), left, _WIDTH - _RIGHT)
    parts = grid_below(axis, _TOP, height - _BOTTOM, "gain kp [Nm/rad], with two standard deviations")
    for number, each in enumerate(gains):
        y = _TOP + step * number + 13
        low, high = max(0.0, each["value"] - 2 * each["deviation"]), each["value"] + 2 * each["deviation"]
        tip = tag("title", escape(f"{each['joint']}: {each['value']:.3g} ± {each['deviation']:.2g} Nm/rad"))
        parts += [
            caption(left - 10, y + 4, each["joint"], "end"),
            stroke(axis(low), y, axis(min(high, axis.high)), y, "range"),
            tag("circle", tip, cx=axis(each["value"]), cy=y, r=4, class_="ok"),
        ]
    return svg(_WIDTH, height, parts, "Gain of each joint")


def lines_of(out: Path) -> Sequence[str]:
    """The result in a folder.

    Raises:
        DatasetError: if it is damaged.
    """
    return [str(each) for each in _read(out)["lines"]][:3]


def read_contents(out: Path) -> Sequence[ReportSection]:
    """Read the report in a folder.

    Raises:
        DatasetError: if it is damaged.
    """
    facts = _read(out)
    try:
        return contents_of(facts)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise DatasetError(f"{out / REPORT}: is not an identification: {error!r}") from None


def _read(out: Path) -> dict[str, Any]:
    try:
        facts = json.loads((out / REPORT).read_text(encoding="utf-8"))
        if not isinstance(facts, dict) or not isinstance(facts.get("lines"), list):
            raise ValueError("it has no lines")
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{out / REPORT}: cannot be read: {error}") from None
    return facts
