"""`benchmarks/guard.py` in miniature: commands for an SO-101, judged by MuJoCo's collision detection."""

from __future__ import annotations

from pathlib import Path

import guard_trials
import pytest
from guard_trials import Judge, Station

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Station, Judge]:
    folder: Path = tmp_path_factory.mktemp("arms")
    station = guard_trials.stations(folder)["so101"]
    return station, Judge(station)


def test_no_command_leads_into_contact(judged) -> None:
    station, judge = judged
    result = guard_trials.commanded(station, judge, 0, 120, guarded=True)
    assert (result.commands, result.touched) == (120, 0)
    assert result.kept > -0.001, result.worst


def test_an_operator_gets_out(judged) -> None:
    station, judge = judged
    assert guard_trials.backs_out(station, judge, 0) == ""
