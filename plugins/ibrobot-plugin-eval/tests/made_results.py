"""Made-up results of an evaluation."""

from __future__ import annotations

from typing import Any

from ibrobot_eval.episodes import Result
from ibrobot_eval.policies import Policy


def policy(label: str) -> Policy:
    return Policy(label, "robot.yaml", label, "model", ())


def result(seed: int, success: bool, **more: object) -> Result:
    fields: dict[str, Any] = {
        "time_s": 2.0 + seed % 7 / 10,
        "interventions": {},
        "faults": (),
        "factors": {},
        "acting": {},
        **more,
    }
    return Result(seed, success, **fields)


def results(*outcomes: bool) -> list[Result]:
    return [result(seed, outcome) for seed, outcome in enumerate(outcomes)]


def spread(successes: int, episodes: int, step: int = 1) -> list[Result]:
    """Successes spread over the seeds in an order that `step` determines."""
    return results(*(seed * step % episodes < successes for seed in range(episodes)))
