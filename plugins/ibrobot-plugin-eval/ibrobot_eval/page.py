"""The report of an evaluation as one HTML file that needs no other file and no network."""

from __future__ import annotations

from pathlib import Path

from ibrobot_provenance.report_page import as_page as render

from ibrobot_eval.contents import contents_of
from ibrobot_eval.episodes import write
from ibrobot_eval.report import Report, write_report


def as_page(out: Path, report: Report) -> str:
    """Render the page, with the videos in the folder of the evaluation."""
    title = f"Evaluation of {', '.join(each.label for each in report.summaries)}"
    return render(out, title, contents_of(out, report))


def write_all(out: Path, report: Report) -> None:
    """Write a report and its page into the folder of the evaluation."""
    write_report(out, report)
    write(out / "report.html", as_page(out, report))
