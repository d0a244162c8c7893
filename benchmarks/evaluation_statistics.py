"""The statistics of `ibrobot eval` by simulation: coverage of intervals, false positives under peeking, episodes.

    python benchmarks/evaluation_statistics.py [--experiments 20000]

Prints one JSON object: the coverage of the intervals of a success rate and of a difference, at eight rates; the share
of experiments in which two equal policies are called different, looked at after each of 500 episodes, by the test of
`ibrobot eval` and by the exact test of McNemar; and for four pairs of policies the mean number of episodes of the
sequential test, given up after so many that it finds the difference with a probability of 80 or 95 %, beside the number
that the exact test of McNemar needs for the same probability. Exits with 1 if the exact interval covers less than
nominally, or more than 5 % of equal policies are called different.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from ibrobot_eval.statistics import (
    ALPHA,
    Interval,
    Pairs,
    clopper_pearson,
    decided_by,
    log_capital,
    tango,
    wilson,
)

RATES = (0.02, 0.1, 0.25, 0.5, 0.7, 0.9, 0.95, 0.99)
EPISODES = 50
LONGEST = 500
Table = np.ndarray[Any, np.dtype[np.bool_]]
LONGEST_COMPARED = 2000
COMPARED = 4000
"""Experiments with that many episodes."""
POWERS = (0.8, 0.95)
POLICIES = ((0.9, 0.6), (0.9, 0.8), (0.6, 0.5), (0.94, 0.6))


def covered(rate: float, rng: np.random.Generator, experiments: int) -> dict[str, Any]:
    """Coverage of the intervals of a success rate, and of the difference of two policies of which one is worse."""
    known: dict[int, tuple[Interval, Interval]] = {}
    hits = np.zeros(2)
    for count in rng.binomial(EPISODES, rate, experiments).tolist():
        known.setdefault(count, (wilson(count, EPISODES), clopper_pearson(count, EPISODES)))
        hits += [each.low <= rate <= each.high for each in known[count]]
    worse = rate * 0.8
    differing = np.array([rate * (1 - worse), worse * (1 - rate)])
    found: dict[tuple[int, ...], bool] = {}
    pairs_hit = 0
    for counts in map(tuple, rng.multinomial(EPISODES, [*differing, 1 - differing.sum()], experiments).tolist()):
        if counts not in found:
            interval = tango(Pairs(*counts))
            found[counts] = interval.low <= rate - worse <= interval.high
        pairs_hit += found[counts]
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


def needed_by_mcnemar(first: float, second: float, power: float) -> int | None:
    """The smallest number of episodes, in steps of 5, with which the exact test of McNemar has this power."""
    low, high = 1, 200
    if mcnemar_power(first, second, 5 * high) < power:
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if mcnemar_power(first, second, 5 * middle) >= power else (middle, high)
    return 5 * high


def beside_mcnemar(
    first: float, second: float, rng: np.random.Generator, experiments: int, sequential: Table
) -> Iterator[dict[str, Any]]:
    """Mean number of episodes of the sequential test and number of those of the exact test of McNemar, by power."""
    decided = np.array(decided_at(first, second, rng, experiments, sequential), dtype=float)
    decided[decided == 0] = np.inf
    for power in POWERS:
        longest = float(np.quantile(decided, power, method="higher"))
        found = np.isfinite(longest)
        yield {
            "rates": [first, second],
            "power": power,
            "given_up_after": int(longest) if found else None,
            "mean_episodes": round(float(np.minimum(decided, longest).mean()), 1) if found else None,
            "mcnemar_episodes": needed_by_mcnemar(first, second, power),
        }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", type=int, default=20_000)
    experiments = parser.parse_args().experiments
    rng = np.random.default_rng(0)
    coverage = [covered(rate, rng, experiments) for rate in RATES]
    # With equal rates of 1/2 and independent outcomes the outcomes differ most often, so there is most to be fooled by.
    sequential = reached(LONGEST)
    peeking = {
        rate: round(sum(n > 0 for n in decided_at(rate, rate, rng, experiments, sequential)) / experiments, 4)
        for rate in (0.5, 0.7, 0.9)
    }
    with_mcnemar = decided_at(0.5, 0.5, rng, experiments, significant(LONGEST))
    compared = reached(LONGEST_COMPARED)
    efficiency = [
        row for rates in POLICIES for row in beside_mcnemar(*rates, rng, min(experiments, COMPARED), compared)
    ]
    report = {
        "experiments": experiments,
        "coverage": coverage,
        "false_positives": peeking,
        "false_positives_of_mcnemar": round(sum(n > 0 for n in with_mcnemar) / experiments, 4),
        "false_positives_exactly": round(float(decided_by(0.5, 0.5, LONGEST)[-1]), 4),
        "efficiency": efficiency,
    }
    print(json.dumps(report, indent=1))
    # Three standard deviations of what chance adds to a coverage that is exactly nominal.
    slack = 3 * (ALPHA * (1 - ALPHA) / experiments) ** 0.5
    exact = all(each["clopper_pearson"] >= 1 - ALPHA - slack for each in coverage)
    return 0 if exact and max(peeking.values()) <= ALPHA else 1


if __name__ == "__main__":
    sys.exit(main())
