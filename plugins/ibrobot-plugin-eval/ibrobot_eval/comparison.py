"""What the results of an evaluation say: each policy by itself, and each pair of policies in words."""

from __future__ import annotations

import itertools
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence

import attrs

from ibrobot_eval.episodes import Result
from ibrobot_eval.statistics import (
    ALPHA,
    Interval,
    PairedTest,
    Pairs,
    clopper_pearson,
    episodes_to_decide,
    holm,
    mcnemar_exact,
    tango,
    wilson,
)

BETTER, WORSE, SAME, UNDECIDED = "better", "worse", "no more different", "undecided"
_POINTS = 200


@attrs.frozen
class Summary:
    """A policy by itself."""

    label: str
    episodes: int
    successes: int
    wilson: Interval
    exact: Interval
    median_time_s: float | None
    """Median time to success [s]; None without a success."""
    interventions: Mapping[str, int]
    """Interventions of the safety layer, in all episodes together."""
    disturbed: int
    """Number of episodes with a fault."""

    @classmethod
    def of(cls, label: str, results: Sequence[Result]) -> Summary:
        """Summarise the results of a policy."""
        times = [each.time_s for each in results if each.success]
        interventions: Counter[str] = Counter()
        for each in results:
            interventions.update(each.interventions)
        count = len(results)
        return cls(
            label, count, len(times), wilson(len(times), count), clopper_pearson(len(times), count),
            statistics.median(times) if times else None, dict(sorted(interventions.items())),
            sum(bool(each.faults) for each in results),
        )  # fmt: skip


@attrs.frozen
class Comparison:
    """Two policies on the same episodes."""

    first: str
    second: str
    pairs: Pairs
    fixed_interval: Interval
    """Of the difference, valid if the number of episodes was fixed beforehand."""
    mcnemar_p: float
    """Of the exact test, valid likewise; corrected for the number of pairs."""
    interval: Interval
    """Of the difference, valid however often one looks and whenever one stops."""
    p_value: float
    """Valid likewise; corrected for the number of pairs."""
    verdict: str
    """Whether the first policy is `better`, `worse`, `no more different` than the margin, or `undecided`."""
    more_episodes: int | None
    """If undecided, about how many more episodes decide; None if that exceeds 100,000."""
    margin: float
    course: tuple[tuple[int, float, float, float], ...]
    """Number of episodes, difference, and the ends of `interval` after them; at most 200 of them."""

    @property
    def words(self) -> str:
        """The verdict as a sentence."""
        first, second, points = self.first, self.second, f"{100 * self.margin:g} points"
        if self.verdict in (BETTER, WORSE):
            return f"{first} is {self.verdict} than {second}"
        if self.verdict == SAME:
            return f"{first} and {second} differ by no more than {points}"
        if self.more_episodes is None:
            return f"undecided between {first} and {second}; more than 100,000 episodes would decide"
        about = _rounded(self.more_episodes)
        return f"undecided between {first} and {second}; about {about} more episodes of each would decide"


def _rounded(number: int) -> int:
    """A projection to two digits, since it is an estimate."""
    size = int(10 ** max(0, len(str(number)) - 2))
    return -(-number // size) * size


def compare(results: Mapping[str, Sequence[Result]], margin: float) -> list[Comparison]:
    """Compare each pair of policies on the seeds that both have, in the order of the seeds.

    Args:
        results: label -> results, in the order of their seeds.
        margin: a difference below it counts as none.
    """
    couples = list(itertools.combinations(results, 2))
    level = ALPHA / max(1, len(couples))
    tests, courses = [], []
    for first, second in couples:
        test, looks = PairedTest(level), [(0, 0.0, -1.0, 1.0)]
        for a, b in zip(results[first], results[second], strict=False):
            test.add(a.success, b.success)
            looks.append((test.pairs.episodes, test.pairs.difference, test.interval.low, test.interval.high))
        tests.append(test)
        courses.append((*looks[: -1 : len(looks) // _POINTS + 1], looks[-1]))
    fixed = [mcnemar_exact(test.pairs) for test in tests]
    adjusted, fixed_adjusted = holm([test.p_value for test in tests]), holm(fixed)
    found = []
    for (first, second), test, course, p_value, mcnemar_p in zip(
        couples, tests, courses, adjusted, fixed_adjusted, strict=True
    ):
        verdict = _verdict(test, p_value, margin)
        undecided = verdict == UNDECIDED and test.pairs.episodes > 0
        more = episodes_to_decide(test.pairs, margin, level) if undecided else None
        fixed_interval = tango(test.pairs, level)
        outcome = (test.pairs, fixed_interval, mcnemar_p, test.interval, p_value, verdict, more, margin, course)
        found.append(Comparison(first, second, *outcome))
    return found


def _verdict(test: PairedTest, p_value: float, margin: float) -> str:
    if p_value <= ALPHA:
        return BETTER if test.sign > 0 else WORSE
    within = -margin < test.interval.low and test.interval.high < margin
    return SAME if within else UNDECIDED


class Decision:
    """Finds the smallest number of episodes after which every pair of policies is decided.

    It checks every episode, in the order of the seeds, whatever the order in which processes finish them.

    Attributes:
        after: that number; None if some pair is undecided so far.
    """

    def __init__(self, labels: Sequence[str], margin: float) -> None:
        couples = list(itertools.combinations(labels, 2))
        self._tests = {couple: PairedTest(ALPHA / len(couples)) for couple in couples}
        self._margin = margin
        self._episodes = 0
        self.after: int | None = None

    def look(self, results: Mapping[str, Sequence[Result]]) -> None:
        """Add the episodes that all policies have by now: label -> results, in the order of their seeds."""
        while self._tests and self.after is None and self._episodes < min(map(len, results.values())):
            for (first, second), test in self._tests.items():
                test.add(results[first][self._episodes].success, results[second][self._episodes].success)
            self._episodes += 1
            adjusted = holm([test.p_value for test in self._tests.values()])
            verdicts = [_verdict(t, p, self._margin) for t, p in zip(self._tests.values(), adjusted, strict=True)]
            if UNDECIDED not in verdicts:
                self.after = self._episodes
