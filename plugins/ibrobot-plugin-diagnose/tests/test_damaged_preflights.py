"""Files of preflights from anywhere: each is shown as a report, or refused by name."""

from __future__ import annotations

from pathlib import Path

from damaged_documents import texts
from ibrobot_diagnose.preflight_contents import lines_of, read_contents
from ibrobot_provenance.reports import ReportSection

from ibrobot_core.api import DatasetError

LINE = {
    "name": "loop_slow", "text": "The loop is slow.", "number": 20.0, "unit": "%", "threshold": 5.0, "fails": 15.0,
    "likelihood": 0.9, "since_s": None, "details": ["20 Hz"], "remedy": "Close programs.", "mends": "",
    "verdict": "fail", "unclear": "",
}  # fmt: skip
FACTS = {
    "robot": "arm", "verdict": "fail", "first": "arm is not fit to be used", "lines": [LINE], "notes": ["a note"],
    "untested": [{"name": "leader_apart", "why": "no leader"}], "pictures": [], "taken": "", "lines_of_text": ["a"],
}  # fmt: skip


def test_each_damaged_preflight_is_refused_by_name_or_shown(tmp_path: Path) -> None:
    shown, said = 0, list[str]()
    for where, text in texts(FACTS):
        (tmp_path / "preflight.json").write_text(text)
        try:
            lines_of(tmp_path)
            sections = read_contents(tmp_path)
        except DatasetError as error:
            said.append(str(error))
            continue
        assert all(isinstance(each, ReportSection) for each in sections), where
        shown += 1
    assert [each for each in said if not each.startswith(f"{tmp_path / 'preflight.json'}: ")] == []
    assert min(shown, len(said)) > 100, (shown, len(said))
