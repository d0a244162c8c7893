"""Statistics of an evaluation: intervals of success rates, and tests of two policies on the same episodes.

Sources:
- Wilson's and Clopper and Pearson's intervals: Brown, Cai and DasGupta, "Interval estimation for a binomial
  proportion", Statistical Science 16 (2001).
- The exact test of McNemar: Fagerland, Lydersen and Laake, "The McNemar test for binary matched-pairs data", BMC
  Medical Research Methodology 13 (2013).
- The score interval of a paired difference: Tango, "Equivalence test and confidence interval for the difference in
  proportions for the paired-sample design", Statistics in Medicine 17 (1998).
- Permutation tests: Good, "Permutation, parametric and bootstrap tests of hypotheses" (2005).
- Betting against a mean: Waudby-Smith and Ramdas, "Estimating means of bounded random variables by betting", JRSS B 86
  (2024). On mixtures of bets as martingales, whose inverse is a p-value at all times: Robbins,
  "Statistical methods related to the law of the iterated logarithm", Annals of Mathematical Statistics 41 (1970);
  Ramdas, Grünwald, Vovk and Shafer, "Game-theoretic statistics and safe anytime-valid inference", Statistical Science
  38 (2023).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cache

import attrs
import numpy as np
from numpy.typing import NDArray

ALPHA = 0.05
"""Probability of a wrong statement: intervals have a level of 95 %."""
_NODES = 256
"""Number of bets in the mixture."""
_EDGE = 1e-9
_TOLERANCE = 1e-6
"""Accuracy of the ends of intervals."""
_MOST = 100_000
"""Maximum number of episodes in projections."""
_SHUFFLES = 9_999

Array = NDArray[np.float64]


@attrs.frozen
class Interval:
    """A confidence interval."""

    low: float
    high: float


@attrs.frozen
class Pairs:
    """Outcomes of two policies on the same episodes."""

    first: int
    """Number of episodes in which only the first policy succeeded."""
    second: int
    """Number of episodes in which only the second policy succeeded."""
    same: int
    """Number of episodes in which both succeeded, or both failed."""

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return self.first + self.second + self.same

    @property
    def difference(self) -> float:
        """Success rate of the first policy minus that of the second; 0 without episodes."""
        return (self.first - self.second) / self.episodes if self.episodes else 0.0


def wilson(successes: int, episodes: int, alpha: float = ALPHA) -> Interval:
    """Wilson's interval of a success rate. Its level is nominal on average; at some rates it is lower."""
    from scipy.stats import binomtest

    if episodes == 0:
        return Interval(0.0, 1.0)
    low, high = binomtest(successes, episodes).proportion_ci(1 - alpha, "wilson")
    return Interval(float(low), float(high))


def clopper_pearson(successes: int, episodes: int, alpha: float = ALPHA) -> Interval:
    """The exact interval of a success rate, of Clopper and Pearson. Its level is at least nominal at every rate."""
    from scipy.stats import beta

    failures = episodes - successes
    low = beta.ppf(alpha / 2, successes, failures + 1) if successes else 0.0
    high = beta.isf(alpha / 2, successes + 1, failures) if failures else 1.0
    return Interval(float(low), float(high))


def mcnemar_exact(pairs: Pairs) -> float:
    """p-value of the exact test of McNemar. Valid for one look, after a number of episodes fixed beforehand."""
    from scipy.stats import binomtest

    differing = pairs.first + pairs.second
    return float(binomtest(pairs.first, differing).pvalue) if differing else 1.0


def tango(pairs: Pairs, alpha: float = ALPHA) -> Interval:
    """The score interval of the difference of two success rates on the same episodes, of Tango.

    Valid for one look, after a number of episodes fixed beforehand; its level is close to nominal. `agreeing` fits it
    to the exact test of McNemar.
    """
    from scipy.optimize import brentq
    from scipy.stats import norm

    n, b, c = pairs.episodes, pairs.first, pairs.second
    if n == 0:
        return Interval(-1.0, 1.0)
    quantile = float(norm.isf(alpha / 2))

    def score(difference: float) -> float:
        """Standardised distance between the observed and a supposed difference."""
        # Maximum-likelihood rate of episodes that only the second policy wins, given the supposed difference.
        linear = -b - c + (2 * n - b + c) * difference
        square = linear**2 + 8 * n * c * difference * (1 - difference)
        rate = (math.sqrt(max(square, 0.0)) - linear) / (4 * n)
        variance = n * (2 * rate + difference * (1 - difference))
        distance = b - c - n * difference
        if abs(distance) < _EDGE:
            return 0.0
        return distance / math.sqrt(variance) if variance > 0 else math.copysign(math.inf, distance)

    def end(side: float, near: float, far: float) -> float:
        beyond = [side * score(each) - quantile for each in (near, far)]
        return far if beyond[1] <= 0 else float(brentq(lambda x: min(side * score(x) - quantile, 1e6), near, far))

    edge = 1.0 - _EDGE
    estimate = min(max(pairs.difference, -edge), edge)
    low = end(1.0, estimate, -edge) if estimate > -edge else -1.0
    high = end(-1.0, estimate, edge) if estimate < edge else 1.0
    return Interval(-1.0 if low == -edge else low, 1.0 if high == edge else high)


def level_of(pairs: int) -> float:
    """The level of each of several tests, by which at most `ALPHA` of all evaluations have a wrong statement.

    Bonferroni's: it holds for tests and intervals alike, so that both say the same of each pair.
    """
    return ALPHA / max(1, pairs)


def corrected(p_value: float, pairs: int) -> float:
    """A p-value, corrected for the number of tests: at most `ALPHA` exactly if it is at most `level_of(pairs)`."""
    return min(1.0, p_value * max(1, pairs))


def agreeing(interval: Interval, decided: bool, difference: float) -> Interval:
    """An interval of a difference that excludes zero exactly if a test has decided.

    An exact test and an interval, or two ways of rounding, may disagree at the edge. Where the test has not decided,
    zero is added, which makes the interval only safer. Where it has, the differences up to zero are cut off: the test
    refutes all of them at least as strongly as zero.
    """
    if not decided:
        return Interval(min(interval.low, 0.0), max(interval.high, 0.0))
    if difference > 0:
        return Interval(max(interval.low, _EDGE), max(interval.high, _EDGE))
    return Interval(min(interval.low, -_EDGE), min(interval.high, -_EDGE))


def drift(outcomes: Iterable[Sequence[bool]], shuffles: int = _SHUFFLES) -> float:
    """p-value of a trend of success rates over time, whatever the rates of the policies.

    A permutation test: how often the outcomes of each policy in random order have a trend as strong as theirs.

    Args:
        outcomes: of each policy, in the order of time.
        shuffles: number of random orders, the same in each call.
    """
    rng = np.random.default_rng(0)
    total, shuffled = 0.0, np.zeros(shuffles)
    for policy in outcomes:
        values = np.array(policy, dtype=float)
        times = np.arange(len(values)) - (len(values) - 1) / 2
        total += float(times @ values)
        shuffled += rng.permuted(np.tile(values, (shuffles, 1)), axis=1) @ times
    as_strong = int((np.abs(shuffled) >= abs(total) - _EDGE).sum())
    return (as_strong + 1) / (shuffles + 1)


@cache
def _bets() -> tuple[Array, Array, Array]:
    """Stake of each bet in the mixture, as a fraction of the capital, and the logarithms of its weight and its loss.

    Stakes follow a Beta(2, 2) distribution, which needs the fewest episodes over a range of differences.
    Any weights that do not depend on the outcomes are valid.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    stakes = (nodes + 1) / 2
    density = weights * stakes * (1 - stakes)
    return stakes, np.log(density / density.sum()), np.log1p(-stakes)


def _log_mean(exponents: Array) -> float:
    top = exponents.max()
    return float(top + np.log(np.exp(exponents - top).sum()))


def log_capital(first: float, second: float, same: float, difference: float) -> float:
    """Logarithm of the capital won by betting against a supposed difference of success rates, from a capital of 1.

    Half of the capital bets that the true difference is larger, half that it is smaller. With every episode a bet
    multiplies its capital by 1 + stake * (x / mean - 1), where x is 1, 1/2 or 0 if the first policy, neither or the
    second one did better, and `mean` the supposed mean of x. If the supposed difference is the true one, the expected
    capital never grows, so the probability that it ever reaches 1 / alpha is at most alpha (Ville's inequality).

    Args:
        first: number of episodes that only the first policy won.
        second: number of episodes that only the second one won.
        same: number of the others.
        difference: the supposed difference, between -1 and 1.
    """
    stakes, weights, lost = _bets()
    mean = (1 + difference) / 2

    def side(mean: float, won: float, not_won: float) -> float:
        gain = np.log1p(stakes * (1 / mean - 1))
        tie = np.log1p(stakes * (0.5 / mean - 1))
        return _log_mean(weights + won * gain + same * tie + not_won * lost)

    return float(np.logaddexp(side(mean, first, second), side(1 - mean, second, first)) - math.log(2))


class PairedTest:
    """Anytime-valid test of two policies on the same episodes: valid however often one looks and whenever one stops.

    It assumes independent episodes, as those of different seeds are.

    Args:
        alpha: the probability that `interval` ever misses the true difference.

    Attributes:
        pairs: the outcomes so far.
        p_value: the smallest so far. If the policies do not differ, the probability that it ever falls to p or below
            is at most p.
        sign: 1 if the first policy was ahead when `p_value` was reached, -1 if it was behind.
        interval: the differences that have never been refuted. It is valid at all times simultaneously.
    """

    def __init__(self, alpha: float = ALPHA) -> None:
        self._log_limit = -math.log(alpha)
        self.pairs = Pairs(0, 0, 0)
        self.p_value = 1.0
        self.sign = 0
        self.interval = Interval(-1.0, 1.0)

    def add(self, first: bool, second: bool) -> None:
        """Add the next episode: whether each policy succeeded."""
        old = self.pairs
        ahead, behind = first and not second, second and not first
        self.pairs = pairs = Pairs(old.first + ahead, old.second + behind, old.same + (first == second))
        p_value = math.exp(-max(0.0, self._log_capital(0.0)))
        if p_value < self.p_value:
            self.p_value, self.sign = p_value, 1 if pairs.first > pairs.second else -1
        self.interval = self._narrowed()

    def _log_capital(self, difference: float) -> float:
        return log_capital(self.pairs.first, self.pairs.second, self.pairs.same, difference)

    def _refuted(self, difference: float) -> bool:
        return self._log_capital(difference) >= self._log_limit

    def _narrowed(self) -> Interval:
        """Remove the differences that the outcomes so far refute from the interval."""
        # The capital is a log-convex function of the difference, so the differences that are not refuted form an
        # interval around the observed one. If the observed one is outside the interval so far, the latter stays.
        low, high = self.interval.low, self.interval.high
        middle = self.pairs.difference
        if not low <= middle <= high:
            return self.interval
        return Interval(self._end(middle, low), self._end(middle, high))

    def _end(self, inside: float, end: float) -> float:
        from scipy.optimize import brentq

        inside, outside = (min(max(each, _EDGE - 1), 1 - _EDGE) for each in (inside, end))
        outwards = math.copysign(_TOLERANCE, outside - inside)
        if abs(inside - outside) <= _TOLERANCE or not self._refuted(outside - outwards):
            return end
        limit = self._log_limit
        edge = brentq(lambda each: self._log_capital(each) - limit, inside, outside - outwards, xtol=_TOLERANCE / 4)
        return float(edge) + outwards / 2  # refuted, whatever the rounding


def episodes_to_decide(pairs: Pairs, margin: float, alpha: float = ALPHA) -> int | None:
    """Project how many more episodes decide, if outcomes keep their present frequencies.

    Args:
        pairs: the outcomes so far; at least one.
        margin: differences below it count as none.
        alpha: as for `PairedTest`.

    Returns:
        The number of episodes; None if it exceeds 100,000.
    """
    limit = -math.log(alpha)

    def decided(episodes: int) -> bool:
        scale = episodes / pairs.episodes
        counts = pairs.first * scale, pairs.second * scale, pairs.same * scale
        if pairs.first != pairs.second and log_capital(*counts, 0.0) >= limit:
            return True
        ends = [log_capital(*counts, end) for end in (-margin, margin)]
        return abs(pairs.difference) < margin and min(ends) >= limit

    total = _first(decided, pairs.episodes, _MOST + pairs.episodes)
    return None if total is None else total - pairs.episodes


def _first(holds: Callable[[int], bool], low: int, most: int) -> int | None:
    """The smallest number above `low` for which a monotonic condition holds; None if above `most`."""
    high = low + 1
    while not holds(high):
        if high >= most:
            return None
        low, high = high, min(2 * high, most)
    while high - low > 1:
        middle = (low + high) // 2
        if holds(middle):
            high = middle
        else:
            low = middle
    return high


@cache
def _wins_needed(losses: int, alpha: float) -> tuple[int, ...]:
    """Smallest number of wins that refutes equal success rates, for 0 to `losses` losses."""
    needed: list[int] = []
    wins = 0
    for lost in range(losses + 1):
        while wins <= lost or log_capital(wins, lost, 0.0, 0.0) < -math.log(alpha):
            wins += 1
        needed.append(wins)
    return tuple(needed)


def decided_by(first: float, second: float, episodes: int, alpha: float = ALPHA) -> Array:
    """Exact probability that `PairedTest` finds a difference within n episodes, for n from 0 to `episodes`.

    Args:
        first: success rate of the first policy.
        second: success rate of the second policy, with outcomes independent of the first.
        episodes: maximum number of episodes.
        alpha: as for `PairedTest`.

    Returns:
        Probabilities, shape (episodes + 1,).
    """
    from scipy.stats import binom

    ahead, behind = first * (1 - second), second * (1 - first)
    differing = ahead + behind
    if differing == 0:
        return np.zeros(episodes + 1)
    needed = np.array(_wins_needed(episodes, alpha))
    share = ahead / differing
    after = np.zeros(episodes + 1)
    """Index: number of episodes with different outcomes. Probability of a decision within them."""
    undecided = np.array([1.0])
    """Index: number of wins. Probability of being undecided with them."""
    for number in range(1, episodes + 1):
        wins = np.arange(number + 1)
        going = np.zeros(number + 1)
        going[1:] += undecided * share
        going[:-1] += undecided * (1 - share)
        now = (wins >= needed[number - wins]) | (number - wins >= needed[wins])
        after[number] = after[number - 1] + going[now].sum()
        going[now] = 0.0
        undecided = going
    numbers = np.arange(episodes + 1)
    return np.array([float(binom.pmf(numbers[: n + 1], n, differing) @ after[: n + 1]) for n in numbers])
