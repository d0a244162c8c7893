"""An evaluation's folder, and the episodes that worker processes run for it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import DatasetError
from ibrobot_core.app import ComponentFailed, Done, Job, installed_plugins, owned
from ibrobot_eval.comparison import Decision
from ibrobot_eval.episodes import SCRATCH, Place, Result, write
from ibrobot_eval.film import can_film
from ibrobot_eval.jobs import EpisodeJob, FilmJob, film_in_pool, run_in_pool
from ibrobot_eval.options import SETTINGS
from ibrobot_eval.policies import Identity, Policy, identify

ASKED = "asked"
"""Key of the settings for the policies as the user named them; a later call may name them differently."""
_FORMAT = 1
Watch = Callable[[int, int, Policy, Result], None]
"""Receives the number of finished episodes, the total, and the policy and result of the episode just finished."""


@attrs.frozen
class Request:
    """An evaluation that a user asks for."""

    out: Path
    policies: tuple[Policy, ...]
    episodes: int
    """Number of episodes of each policy; the maximum with `until_decided`."""
    seed: int
    """Seed of the first episode; later ones add 1."""
    until_decided: bool
    margin: float
    jobs: int | None
    """Number of parallel episodes; None for as many as fit into the pool."""
    on: str = ""
    """The pool; see `Registry.pool`."""
    trials: bool = False
    """Whether an operator judges blinded trials; otherwise episodes run in simulation."""


class Evaluation:
    """An evaluation in its folder, which is locked by the context of `opened`.

    Attributes:
        request: the evaluation that the user asks for.
        identities: label of a policy -> what its results depend on.
        resumed: number of episodes that earlier calls have finished.
    """

    def __init__(self, request: Request, identities: Mapping[str, Identity]) -> None:
        self.request = request
        self.identities = identities
        self._results: dict[tuple[str, int], Result] = {}
        for policy in request.policies:
            for seed in self._seeds:
                file = Place.of(request.out, policy, seed).result
                if file.exists():
                    self._results[policy.label, seed] = Result.read(file)
        self.resumed = len(self._results)
        self._decision = Decision(
            [each.label for each in request.policies] if request.until_decided else [], request.margin
        )

    @property
    def _seeds(self) -> range:
        return range(self.request.seed, self.request.seed + self.request.episodes)

    def results(self) -> dict[str, list[Result]]:
        """Label -> the results of the first seeds without a gap."""
        found: dict[str, list[Result]] = {}
        for policy in self.request.policies:
            done = found.setdefault(policy.label, [])
            for seed in self._seeds:
                if (result := self._results.get((policy.label, seed))) is None:
                    break
                done.append(result)
        return found

    def run(self, watch: Watch) -> dict[str, list[Result]]:
        """Run the missing episodes. Returns label -> results in the order of their seeds.

        Raises:
            IbrobotError: if an episode fails; finished ones are kept.
        """
        request = self.request
        todo = [
            EpisodeJob(str(request.out), policy, seed, self.identities[policy.label].document)
            for seed in self._seeds
            for policy in request.policies
            if (policy.label, seed) not in self._results
        ]
        total = len(self._seeds) * len(request.policies)
        self._decision.look(self.results())
        if todo and self._decision.after is None:
            with self._running(run_in_pool, todo) as done:
                for job, result in done:
                    file = Place.of(request.out, job.policy, job.seed).result
                    if not file.exists():
                        raise DatasetError(
                            f"{file}: not found after a machine of the pool wrote it: --out must be in a folder that "
                            "all machines of the pool share"
                        )
                    self._check_policy(job.policy, result)
                    self._results[job.policy.label, job.seed] = result
                    watch(len(self._results), total, job.policy, result)
                    self._decision.look(self.results())
                    if self._decision.after is not None:
                        break
        return self._kept()

    def film(self, results: Mapping[str, Sequence[Result]], most: int, begin: Callable[[int], None]) -> None:
        """Film failures without a video.

        Args:
            results: label -> results in the order of their seeds.
            most: maximum number of videos for each policy.
            begin: receives the number of failures to film, if there are any.
        """
        todo = []
        for policy in self.request.policies:
            failed = [each.seed for each in results[policy.label] if not each.success][:most]
            if failed and can_film(policy):
                todo += [FilmJob(str(self.request.out), policy, seed) for seed in failed]
        todo = [job for job in todo if not Place.of(self.request.out, job.policy, job.seed).video.exists()]
        if todo:
            begin(len(todo))
            with self._running(film_in_pool, todo) as done:
                for _ in done:
                    pass

    @contextmanager
    def _running[J: (EpisodeJob, FilmJob), R](
        self, function: Callable[[J, Callable[[int], None]], R], orders: Sequence[J]
    ) -> Iterator[Iterator[tuple[J, R]]]:
        """Run jobs in the pool. Yields an iterator over each finished job and its result."""
        jobs = (Job(function, order) for order in orders)
        with (
            closing(installed_plugins().pool(self.request.on, self.request.jobs)) as pool,
            closing(pool.run(jobs)) as finished,
        ):
            yield map(_result, finished)

    def _check_policy(self, policy: Policy, result: Result) -> None:
        """Refuse results of other weights, e.g. while a training overwrites them."""
        before = next((r for (label, _), r in self._results.items() if label == policy.label), result)
        if before.acting != result.acting:
            raise ComponentFailed(f"{policy.label}: the policy's weights changed during the evaluation")

    def _kept(self) -> dict[str, list[Result]]:
        """Return the results up to the decision, and remove those beyond it."""
        found, decided = self.results(), self._decision.after
        if decided is None:
            return found
        for policy in self.request.policies:
            for seed in self._seeds[decided:]:
                place = Place.of(self.request.out, policy, seed)
                place.result.unlink(missing_ok=True)
                shutil.rmtree(place.episode, ignore_errors=True)
        return {label: results[:decided] for label, results in found.items()}


def _result[R](done: Done[R]) -> tuple[Any, R]:
    """A finished job and its result. Raises its error if it failed."""
    job = done.job.argument
    if done.error is not None:
        which = f"{job.policy.label}, seed {job.seed}"
        failed = ComponentFailed(f"{which}: {done.error}; finished episodes are kept")
        failed.exit_code = done.error.exit_code
        raise failed
    return job, done.result()


@contextmanager
def opened(request: Request) -> Iterator[Evaluation]:
    """Begin an evaluation in its folder, or continue that of an earlier call.

    Raises:
        InUse: if another process writes to the folder.
        DatasetError: if the folder contains anything else, was begun with other settings or files, or is read-only.
    """
    out = request.out
    registry = installed_plugins()
    identities = {policy.label: identify(policy, registry) for policy in request.policies}
    settings = {
        "format": _FORMAT,
        "seed": request.seed,
        "until_decided": request.until_decided,
        "margin": request.margin,
        "trials": request.trials,
        "vary": list(request.policies[0].vary),
        "policies": {
            each.label: {"mode": each.mode, "model": each.model, **attrs.asdict(identities[each.label])}
            for each in request.policies
        },
        "versions": registry.versions(),
        ASKED: [attrs.asdict(each) for each in request.policies],
    }
    with owned(out, "is being evaluated", DatasetError):
        try:
            _begin(request, settings)
        except OSError as error:
            raise DatasetError(f"{out}: cannot be written: {error.strerror}") from error
        try:
            yield Evaluation(request, identities)
        finally:
            shutil.rmtree(out / SCRATCH, ignore_errors=True)


def _begin(request: Request, settings: Mapping[str, Any]) -> None:
    """Write the settings into a new folder, or compare them to the present ones."""
    out, file = request.out, request.out / SETTINGS
    if file.is_file():
        try:
            known = json.loads(file.read_text(encoding="utf-8"))
        except ValueError as error:
            raise DatasetError(f"{file}: cannot be read: {error}") from None
        if differing := list(differences(known, {**settings, ASKED: known.get(ASKED)})):
            raise DatasetError(f"{out}: was begun with other settings: {'; '.join(differing)}; choose a new folder")
        done = max((len(list(each.glob("seed_*.json"))) for each in (out / "results").glob("*")), default=0)
        if done > request.episodes and not request.until_decided:
            raise DatasetError(f"{out}: already has {done} episodes of a policy; --episodes must not be smaller")
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out}: exists and is not an evaluation; choose a new folder")
    write(file, json.dumps(settings, indent=1) + "\n")


def differences(known: Mapping[str, Any], now: Mapping[str, Any], where: str = "") -> Iterator[str]:
    """Describe the differences between two nested mappings."""
    for key in {**known, **now}:
        old, new = known.get(key), now.get(key)
        if old == new:
            continue
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from differences(old, new, f"{where}{key} ")
        elif key in _HASHES:
            yield f"{where}{_HASHES[key]} changed"
        elif isinstance(old, Mapping) or isinstance(new, Mapping):
            yield f"{where}{key} is {'new' if old is None else 'missing'}"
        else:
            yield f"{where}{key} {old}, now {new}"


_HASHES = {"document": "robot YAML", "contract": "contract", "policy": "policy's fingerprint", "files": "files"}
