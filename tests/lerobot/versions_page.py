"""Writes the row of a LeRobot version into `docs/reference/lerobot-versions.md`, from a report of its tests.

    python tests/lerobot/versions_page.py VERSION REPORT.xml

`nox -s lerobot_versions` calls it.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

from ibrobot_lerobot.versions import TESTED

PAGE = Path(__file__).parents[2] / "docs/reference/lerobot-versions.md"
COLUMNS = {
    "recorded": "its datasets",
    "dataset": "our datasets in it",
    "policy": "its checkpoints",
    "feetech_bus": "its motors and calibration",
    "devices": "its devices in a run",
}
"""File of tests, without `test_` -> heading."""
BEGIN, END = "<!-- versions begin -->", "<!-- versions end -->"
HEAD = f"| LeRobot | {' | '.join(COLUMNS.values())} | minutes | what differs |\n|---|{'---|' * (len(COLUMNS) + 2)}"


def row_of(version: str, report: Path) -> str:
    """The row of a version."""
    passed, failed, notes, seconds = Counter[str](), Counter[str](), dict[str, None](), 0.0
    for case in ElementTree.parse(report).getroot().iter("testcase"):
        file = case.attrib["classname"].split(".")[2].removeprefix("test_")
        seconds += float(case.attrib["time"])
        skipped = case.find("skipped")
        if skipped is not None:
            reason = skipped.attrib.get("message", "")
            if reason.startswith("LeRobot before"):
                notes.setdefault(reason)
        elif case.find("failure") is not None or case.find("error") is not None:
            failed[file] += 1
        else:
            passed[file] += 1
    known = [TESTED[version]] if TESTED.get(version) else []
    cells = [f"{passed[name]} of {passed[name] + failed[name]}" for name in COLUMNS]
    return f"| {version} | {' | '.join(cells)} | {seconds / 60:.0f} | {'; '.join([*known, *notes])} |"


def main() -> None:
    """Replace the row of the version."""
    version, report = sys.argv[1], Path(sys.argv[2])
    text = PAGE.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    old, _, after = rest.partition(END)
    rows = {
        line.split("|")[1].strip(): line
        for line in old.splitlines()
        if line.startswith("| ") and "| LeRobot |" not in line
    }
    rows[version] = row_of(version, report)
    table = "\n".join([HEAD, *(rows[each] for each in sorted(rows))])
    PAGE.write_text(f"{before}{BEGIN}\n{table}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
