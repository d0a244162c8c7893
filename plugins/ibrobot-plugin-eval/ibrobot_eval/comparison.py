"""Summaries of single policies, and comparisons of pairs of policies with a verdict in words."""

from __future__ import annotations

import itertools
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence

import attrs
from ibrobot_terminal.plural import counted

from ibrobot_eval.episodes import Result
from ibrobot_eval.statistics import (
    ALPHA,
    Interval,
    PairedTest,
    Pairs,
    agreeing,
    clopper_pearson,
    corrected,
    episodes_to_decide,
    level_of,
    mcnemar_exact,
    tango,
    wilson,
)

BETTER, WORSE, SAME, UNDECIDED = "better", "worse", "no more different", "undecided"
_POINTS = 200


@attrs.frozen
class Summary:
    """Results of one policy."""

    label: str
    episodes: int
    successes: int
    wilson: Interval
    exact: Interval
    median_time_s: float | None
    """Median time to success [s]; None without a success."""
    interventions: Mapping[str, int]
    """Kind of intervention of the safety layer -> number over all episodes."""
    disturbed: int
    """Number of episodes with a fault."""
    errors: int
    """Number of episodes that ended in an error; they count as failures."""

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
            sum(bool(each.faults) for each in results), sum(each.is_error for each in results),
        )  # fmt: skip


@attrs.frozen
class Comparison:
    """Two policies on the same episodes."""

    first: str
    second: str
    pairs: Pairs
    fixed_interval: Interval
    """Interval of the difference, valid if the number of episodes was fixed beforehand."""
    mcnemar_p: float
    """p-value of McNemar's exact test, valid under the same condition; corrected for the number of pairs."""
    interval: Interval
    """Interval of the difference, valid however often one looks and whenever one stops."""
    p_value: float
    """p-value, valid under the same conditions as `interval`; corrected for the number of pairs."""
    verdict: str
    """Whether the first policy is `better`, `worse`, `no more different` than the margin, or `undecided`."""
    more_episodes: int | None
    """If undecided, a projection of the number of further episodes that decide; None above 100,000."""
    margin: float
    course: tuple[tuple[int, float, float, float], ...]
    """At most 200 points: number of episodes, and the difference and the ends of `interval` after them."""

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
        return f"undecided between {first} and {second}; about {counted(about, 'more episode')} of each would decide"


def _rounded(number: int) -> int:
    """Round a projection up to two digits."""
    size = int(10 ** max(0, len(str(number)) - 2))
    return -(-number // size) * size


def compare(results: Mapping[str, Sequence[Result]], margin: float) -> list[Comparison]:
    """Compare each pair of policies on their common seeds, in the order of the seeds.

    Args:
        results: label -> results, in the order of their seeds.
        margin: a difference below it counts as none.
    """
    couples = list(itertools.combinations(results, 2))
    level = level_of(len(couples))
    tests, courses = [], []
    for first, second in couples:
        test, looks = PairedTest(level), [(0, 0.0, -1.0, 1.0)]
        for a, b in zip(results[first], results[second], strict=False):
            test.add(a.success, b.success)
            looks.append((test.pairs.episodes, test.pairs.difference, test.interval.low, test.interval.high))
        tests.append(test)
        courses.append((*looks[: -1 : len(looks) // _POINTS + 1], looks[-1]))
    comparisons = []
    for couple, test, course in zip(couples, tests, courses, strict=True):
        pairs, verdict = test.pairs, _verdict(test, level, margin)
        p_value, fixed_p = (corrected(p, len(couples)) for p in (test.p_value, mcnemar_exact(pairs)))
        more = episodes_to_decide(pairs, margin, level) if verdict == UNDECIDED and pairs.episodes else None
        interval = agreeing(test.interval, verdict in (BETTER, WORSE), test.sign)
        fixed = agreeing(tango(pairs, level), fixed_p <= ALPHA, pairs.difference)
        comparisons.append(Comparison(*couple, pairs, fixed, fixed_p, interval, p_value, verdict, more, margin, course))
    return comparisons


def _verdict(test: PairedTest, level: float, margin: float) -> str:
    if test.p_value <= level:
        return BETTER if test.sign > 0 else WORSE
    within = -margin < test.interval.low and test.interval.high < margin
    return SAME if within else UNDECIDED


class Decision:
    """Finds the smallest number of episodes after which every pair of policies is decided.

    The result does not depend on the order in which processes finish the episodes.

    Attributes:
        after: that number; None while some pair is undecided.
    """

    def __init__(self, labels: Sequence[str], margin: float) -> None:
        couples = list(itertools.combinations(labels, 2))
        self._level = level_of(len(couples))
        self._tests = {couple: PairedTest(self._level) for couple in couples}
        self._margin = margin
        self._episodes = 0
        self.after: int | None = None

    def look(self, results: Mapping[str, Sequence[Result]]) -> None:
        """Add episodes that all policies have finished.

        Args:
            results: label -> results, in the order of their seeds.
        """
        while self._tests and self.after is None and self._episodes < min(map(len, results.values())):
            for (first, second), test in self._tests.items():
                test.add(results[first][self._episodes].success, results[second][self._episodes].success)
            self._episodes += 1
            if all(_verdict(test, self._level, self._margin) != UNDECIDED for test in self._tests.values()):
                self.after = self._episodes
