"""Simulated experiments with the statistics of `ibrobot eval`: coverage of intervals, decisions under peeking."""

from __future__ import annotations

from typing import Any

import numpy as np
from ibrobot_eval.statistics import ALPHA, Interval, Pairs, clopper_pearson, log_capital, tango, wilson

EPISODES = 50
Table = np.ndarray[Any, np.dtype[np.bool_]]


def covered(rate: float, rng: np.random.Generator, experiments: int) -> dict[str, Any]:
    """Coverage of the intervals of a success rate, and of the difference of two policies of which one is worse."""
    known: dict[int, tuple[Interval, Interval]] = {}
    hits = np.zeros(2)
    for count in rng.binomial(EPISODES, rate, experiments).tolist():
        known.setdefault(count, (wilson(count, EPISODES), clopper_pearson(count, EPISODES)))
        hits += [each.low <= rate <= each.high for each in known[count]]
    worse = rate * 0.8
    differing = np.array([rate * (1 - worse), worse * (1 - rate)])
    holds: dict[tuple[int, ...], bool] = {}
    pairs_hit = 0
    for counts in map(tuple, rng.multinomial(EPISODES, [*differing, 1 - differing.sum()], experiments).tolist()):
        if counts not in holds:
            interval = tango(Pairs(*counts))
            holds[counts] = interval.low <= rate - worse <= interval.high
        pairs_hit += holds[counts]
    names = ("wilson", "clopper_pearson")
    return {
        "rate": rate,
        **{name: round(hit / experiments, 4) for name, hit in zip(names, hits, strict=True)},
        "paired_difference": round(pairs_hit / experiments, 4),
    }


def reached(longest: int) -> Table:
    """Whether the sequential test finds a difference, by wins and losses, shape (longest + 1, longest + 1)."""
    found = np.zeros((longest + 1, longest + 1), dtype=np.bool_)
    wins = 0
    for losses in range(longest + 1):
        while wins <= longest and (wins <= losses or log_capital(wins, losses, 0.0, 0.0) < -np.log(ALPHA)):
            wins += 1
        found[wins:, losses] = True
    return found | found.T


def significant(longest: int) -> Table:
    """Whether the exact test of McNemar finds a difference, by wins and losses, shape (longest + 1, longest + 1)."""
    from scipy.stats import binom

    wins = np.arange(longest + 1)
    fewer, total = np.minimum(wins[:, None], wins), wins[:, None] + wins
    found: Table = 2 * binom.cdf(fewer, total, 0.5) <= ALPHA
    return found


def decided_at(first: float, second: float, rng: np.random.Generator, experiments: int, found_by: Table) -> list[int]:
    """The episode after which a test finds a difference if one looks after each, per experiment; 0 if never.

    The experiments have as many episodes as the table `found_by` has wins.
    """
    outcomes = rng.random((2, experiments, len(found_by) - 1), dtype=np.float32)
    ahead, behind = outcomes[0] < first, outcomes[1] < second
    wins = np.cumsum(ahead & ~behind, axis=1, dtype=np.int16)
    losses = np.cumsum(behind & ~ahead, axis=1, dtype=np.int16)
    found = found_by[wins, losses]
    return [int(each) for each in np.where(found.any(axis=1), found.argmax(axis=1) + 1, 0)]


def mcnemar_power(first: float, second: float, episodes: int) -> float:
    """Probability that McNemar's exact test finds a difference after a fixed number of episodes.

    For policies with these success rates and independent outcomes.
    """
    from scipy.stats import binom

    ahead, behind = first * (1 - second), second * (1 - first)
    numbers = np.arange(episodes + 1)
    found: Any = np.zeros(episodes + 1)
    for number in numbers:
        wins = np.arange(number + 1)
        p_values = np.minimum(1.0, 2 * binom.cdf(np.minimum(wins, number - wins), number, 0.5))
        found[number] = binom.pmf(wins, number, ahead / (ahead + behind))[p_values <= ALPHA].sum()
    return float(binom.pmf(numbers, episodes, ahead + behind) @ found)
