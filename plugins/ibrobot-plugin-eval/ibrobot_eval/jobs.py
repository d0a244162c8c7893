"""The jobs of an evaluation, for the processes of a pool: run an episode, or film it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import attrs

from ibrobot_eval.episodes import Place, Result, run_episode
from ibrobot_eval.film import film
from ibrobot_eval.policies import Policy


@attrs.frozen
class EpisodeJob:
    """An episode to run, or to film."""

    out: Path
    """The folder of the evaluation."""
    policy: Policy
    seed: int
    document: str
    """Hash of the robot YAML with which the evaluation began."""


def run_in_pool(job: EpisodeJob, progress: Callable[[int], None]) -> Result:
    """Run an episode."""
    _quiet()
    return run_episode(job.out, job.policy, job.seed, job.document)


def film_in_pool(job: EpisodeJob, progress: Callable[[int], None]) -> None:
    """Film a finished episode."""
    _quiet()
    place = Place.of(job.out, job.policy, job.seed)
    film(place.video, job.policy, Result.read(place.result))


def _quiet() -> None:
    """Keep the messages of runs out of the evaluation's log."""
    logging.getLogger("ibrobot").setLevel(logging.ERROR)
