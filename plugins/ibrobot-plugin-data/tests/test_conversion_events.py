"""What the events of `ibrobot convert` and `ibrobot record` show."""

from __future__ import annotations

from pathlib import Path

import attrs
import pytest
from ibrobot_data.conversion import EVENTS, Begin, Progress, Report
from ibrobot_data.recording_session import Session
from ibrobot_data.request import EpisodeReport
from ibrobot_data.request import Report as Conversion
from ibrobot_provenance.asking import read_event

from ibrobot_core.app import Shown
from ibrobot_core.events import encode_event


def report(*episodes: EpisodeReport) -> Report:
    return Report(**Conversion(Path("datasets/pick"), episodes, 2_000_000, 1.5, 0).summary())


def test_progress_has_its_share_and_names_episodes_that_are_left_out() -> None:
    assert Begin(2).shown() == Shown("0 of 2 episodes", 0.0)
    progress = Progress(done=1, of=2, frames=50, total_frames=200, seconds=1.2, episode="pick/1", error="no contract")
    assert progress.shown() == Shown("1 of 2 episodes, 50 frames, 1 s", 0.25, "pick/1 is left out: no contract")
    assert attrs.evolve(progress, total_frames=0).shown().progress == 1.0


def test_the_result_counts_episodes_and_ticks_left_out() -> None:
    found = report(
        EpisodeReport("a", frames=50, skipped=3, prompt="pick"),
        EpisodeReport("b", error="no contract"),
        EpisodeReport("c", passed_over="outcome failure"),
    )
    text = "1 episode, 50 frames, left out 1, passed over 1, ticks skipped 3; the dataset has 2.0 MB"
    assert found.shown() == Shown(text, 1.0, made={"dataset": "datasets/pick"})
    assert report(EpisodeReport("b", error="no contract")).shown().made == {}, "nothing was made"


@pytest.mark.parametrize(
    ("session", "shown"),
    [
        (Session(folder="e/p", saved=0, wanted=4, state="waiting"), Shown("waiting · 0 of 4 episodes saved", 0.0)),
        (
            Session(folder="e/p", saved=1, wanted=None, state="recording"),
            Shown("recording · 1 episode saved", made={"episodes": "e/p"}),
        ),
    ],
)
def test_a_session_tells_how_many_episodes_are_saved(session: Session, shown: Shown) -> None:
    assert session.shown() == shown


@pytest.mark.parametrize("event", [Begin(2), report(), Session(folder="a", saved=0, wanted=None, state="waiting")])
def test_events_are_read_as_they_were_written(event: Begin | Report | Session) -> None:
    assert read_event(encode_event(event), (*EVENTS, Session)) == event
