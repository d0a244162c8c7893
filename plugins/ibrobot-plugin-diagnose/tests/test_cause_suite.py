"""The cause suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

from typing import ClassVar

import attrs
import numpy as np
import pytest
from ibrobot_diagnose.cause import Evidence
from ibrobot_diagnose.testing import Answer, CauseSuite, FakeCause, make_window
from ibrobot_testing import checks, failed_checks


def swaying(turns_per_s, **given):
    """Four seconds in which the second joint is commanded to and fro."""
    times = np.arange(120) / 30
    commands = np.column_stack([0.1 * times, 0.2 * np.sin(np.pi * turns_per_s * times)])
    return make_window(commands, name=f"{turns_per_s} turns per second", **given)


class TestFake(CauseSuite):
    kind = FakeCause

    def make(self, ctx):
        return self.kind()

    def accused(self):
        return [swaying(6.0), swaying(10.0)]

    def healthy(self):
        return [swaying(0.0), swaying(2.5)]


class Nameless(FakeCause):
    name = "To and fro"


class TitleIsASentence(FakeCause):
    title = "No joint is commanded to and fro."


class RemedyWithoutAFullStop(FakeCause):
    remedy = "Look at what commands the joint"


class NeedsWhatIsNot(FakeCause):
    needs = frozenset({"comands"})


class NeedsAText(FakeCause):
    needs = "commands"  # type: ignore[assignment]


class NeedsAModel(FakeCause):
    needs = frozenset({"model"})


class SeesNothing(FakeCause):
    def test(self, window, reference):
        return None


class NumberOfNothing(FakeCause):
    def test(self, window, reference):
        found = super().test(window, reference)
        return found and attrs.evolve(found, number=float("nan"))


class CertainBeyondOne(FakeCause):
    def test(self, window, reference):
        found = super().test(window, reference)
        return found and attrs.evolve(found, likelihood=100 * found.likelihood)


class AccusesAlways(FakeCause):
    def test(self, window, reference):
        return Evidence("Somebody is to blame.", 9.0, "1/s", 4.0, 0.9)


class SinceTheEpoch(FakeCause):
    def test(self, window, reference):
        found = super().test(window, reference)
        return found and attrs.evolve(found, since_s=window.start_ns / 1e9)


class Remembers(FakeCause):
    worst = 0.0

    def test(self, window, reference):
        found = super().test(window, reference)
        self.worst = max(self.worst, found.number if found else 0.0)
        return found and attrs.evolve(found, details=(f"worst so far: {self.worst}",))


class OfAllObjects(FakeCause):
    tested: ClassVar[list[float]] = []

    def test(self, window, reference):
        found = super().test(window, reference)
        self.tested.append(0.0)
        return found and attrs.evolve(found, number=found.number + 1e-6 * len(self.tested))


class WritesIntoTheWindow(FakeCause):
    def test(self, window, reference):
        found = super().test(window, reference)
        window.commands[:] -= window.commands.mean(axis=0)
        return found


class TakesTheLongForGranted(FakeCause):
    def test(self, window, reference):
        window.commands[4]
        return super().test(window, reference)


class TakesGapsForMotion(FakeCause):
    def test(self, window, reference):
        known = attrs.evolve(window, command=attrs.evolve(window.command, values=np.nan_to_num(window.command.values)))
        return super().test(known, reference)


WRONG = {
    Nameless: "says_what_it_is",
    TitleIsASentence: "says_what_it_is",
    RemedyWithoutAFullStop: "says_what_it_is",
    NeedsWhatIsNot: "says_what_it_is",
    NeedsAText: "says_what_it_is",
    NeedsAModel: "is_tested_on_all_windows",
    SeesNothing: "is_accused_where_it_is_at_work",
    NumberOfNothing: "is_accused_where_it_is_at_work",
    CertainBeyondOne: "is_accused_where_it_is_at_work",
    AccusesAlways: "is_not_accused_where_all_is_well",
    SinceTheEpoch: "since_lies_in_the_window",
    Remembers: "equal_windows_give_equal_evidence",
    OfAllObjects: "equal_windows_give_equal_evidence",
    WritesIntoTheWindow: "changes_nothing",
    TakesTheLongForGranted: "takes_gaps_and_short_windows",
    TakesGapsForMotion: "takes_gaps_and_short_windows",
}


def test_needs_of_another_type_say_how_to_write_them():
    class Suite(TestFake):
        kind = NeedsAText

    with pytest.raises(AssertionError, match="needs is 'commands': write it as frozenset"):
        Suite().test_says_what_it_is()


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestFake):
        kind = wrong

    assert caught_by in failed_checks(Suite, tmp_path)


def test_every_check_catches_something():
    assert checks(CauseSuite) == set(WRONG.values())


def test_window_has_what_was_given():
    pictures = {"top": np.arange(3 * 4 * 6 * 3, dtype=np.uint8).reshape(3, 4, 6, 3)}
    answer = Answer(1, np.full((5, 2), 0.5), latency=0.02)
    document = {"robot": {"joints": [{"name": "pan", "lower": -1.0, "upper": 1.0}]}}
    states = np.array([[0.0, 1.0], [0.1, 1.1], [0.2, 1.2]])
    window = make_window(
        states, states + 0.5, joints=("pan", "tilt"), rate_hz=25.0, answers=[answer], pictures=pictures,
        document=document, outcome="success",
    )  # fmt: skip
    np.testing.assert_array_equal(window.states, states)
    np.testing.assert_array_equal(window.commands, states + 0.5)
    assert (window.joints, window.outcome) == (("pan", "tilt"), "success")
    assert window.seconds == pytest.approx(0.08)
    assert (window.limits[0].lower, window.limits[1].lower) == (-1.0, -np.inf)
    np.testing.assert_array_equal(window.asked[0].chunk, answer.chunk)
    assert window.asked[0].answer.latency_ms == pytest.approx(20.0)
    assert window.streams >= {"state", "commands", "answers", "chunks", "pictures", "outcome", "motion"}
    assert "demonstration" not in window.streams
    (camera,) = window.cameras.values()
    assert (camera.key, camera.size, len(camera.pictures)) == ("observation.images.top", (4, 6), 3)


@pytest.mark.parametrize("commands", [np.zeros((2, 2)), np.zeros(3), np.zeros((3, 1))])
def test_arrays_that_do_not_fit_are_an_error(commands):
    with pytest.raises(ValueError, match="must have one shape"):
        make_window(np.zeros((3, 2)), commands)
