"""An evaluation's folder, and the episodes that worker processes run for it."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import attrs
from ibrobot_provenance.jobs import Done, Job, open_pool
from ibrobot_provenance.ownership import owned
from ibrobot_terminal.plural import counted

from ibrobot_core.api import DatasetError
from ibrobot_core.app import ComponentFailed, installed_plugins
from ibrobot_eval.comparison import Decision
from ibrobot_eval.episodes import SCRATCH, EpisodeJob, Place, Result, code_here, hide_messages, run_episode, write
from ibrobot_eval.film import can_film, film
from ibrobot_eval.options import SETTINGS, EvalOptions
from ibrobot_eval.policies import Identity, Policy, identify

ASKED = "asked"
"""Key of the settings for the policies as the user named them; a later call may name them differently."""
_FORMAT = 1
_ENOUGH_ERRORS = 5
"""Number of episodes that end in an error, without one that does not, after which the evaluation ends."""
Watch = Callable[[int, int, Policy, Result], None]
"""Receives the number of finished episodes, the total, and the policy and result of the episode just finished."""


class Evaluation:
    """An evaluation in its folder, which is locked by the context of `opened`.

    Attributes:
        options: the evaluation that the user asks for.
        policies: the policies.
        resumed: number of episodes that earlier calls have finished.
    """

    def __init__(
        self, options: EvalOptions, policies: Sequence[Policy], identities: Mapping[str, Identity],
        code: Mapping[str, str],
    ) -> None:  # fmt: skip
        self.options = options
        self._code = code
        self.policies = policies
        self._identities = identities
        self._results: dict[tuple[str, int], Result] = {}
        self.damaged: list[str] = []
        """Damaged results of earlier calls."""
        for policy in policies:
            for seed in options.seeds:
                if (result := self._read(Place.of(options.out, policy, seed))) is not None:
                    self._results[policy.label, seed] = result
        self.resumed = len(self._results)
        self._decision = Decision([each.label for each in policies] if options.until_decided else [], options.margin)

    def _read(self, place: Place) -> Result | None:
        """The result of an earlier call; None if there is none, or a damaged one: the episode is run again."""
        if not place.result.exists():
            return None
        try:
            return Result.read(place.result)
        except DatasetError as error:
            self.damaged.append(f"{error}; the episode is run again")
            place.result.unlink()
            shutil.rmtree(place.episode, ignore_errors=True)  # what damaged the result may have damaged it
            return None

    @property
    def broken(self) -> str:
        """Why the evaluation ends: all episodes of a policy so far were errors, and these are enough; else empty."""
        for policy in self.policies:
            results = [result for (label, _), result in self._results.items() if label == policy.label]
            if (
                results
                and len(results) >= min(_ENOUGH_ERRORS, len(self.options.seeds))
                and all(e.is_error for e in results)
            ):
                text = Counter(each.error for each in results).most_common(1)[0][0]
                folder = Place.of(self.options.out, policy, 0).result.parent
                return (
                    f"{policy.label}: {counted(len(results), 'episode')} so far, all ended in an error, so this is no "
                    "evaluation: "
                    f"{text}; after a repair that changes no file, remove {folder} to try again"
                )
        return ""

    def results(self) -> dict[str, list[Result]]:
        """Label -> the results of the first seeds without a gap."""
        by_label: dict[str, list[Result]] = {}
        for policy in self.policies:
            done = by_label.setdefault(policy.label, [])
            for seed in self.options.seeds:
                if (result := self._results.get((policy.label, seed))) is None:
                    break
                done.append(result)
        return by_label

    def run(self, watch: Watch) -> dict[str, list[Result]]:
        """Run the missing episodes. Returns label -> results in the order of their seeds.

        Raises:
            IbrobotError: if an episode fails; finished ones are kept.
        """
        seeds = self.options.seeds
        todo = [
            self._job(policy, seed)
            for seed in seeds
            for policy in self.policies
            if (policy.label, seed) not in self._results
        ]
        total = len(seeds) * len(self.policies)
        self._decision.look(self.results())
        if todo and self._decision.after is None and not self.broken:
            with self._running(run_episode, todo) as finished:
                for job, result in map(_result, finished):
                    file = job.place.result
                    if not file.exists():
                        raise DatasetError(
                            f"{file}: not found after a machine of the pool wrote it: --out must be in a folder that "
                            "all machines of the pool share"
                        )
                    self._check_policy(job.policy, result)
                    self._results[job.policy.label, job.seed] = result
                    watch(len(self._results), total, job.policy, result)
                    self._decision.look(self.results())
                    if self._decision.after is not None or (result.is_error and self.broken):
                        break
        return self._kept()

    def film(self, results: Mapping[str, Sequence[Result]], most: int, begin: Callable[[int], None]) -> list[str]:
        """Film failures without a video. Returns a note for each that could not be filmed.

        Args:
            results: label -> results in the order of their seeds.
            most: maximum number of videos for each policy.
            begin: receives the number of failures to film, if there are any.
        """
        todo = []
        for policy in self.policies:
            failed = [each.seed for each in results[policy.label] if not (each.success or each.error)][:most]
            if failed and can_film(policy):
                todo += [self._job(policy, seed) for seed in failed]
        todo = [job for job in todo if not job.place.video.exists()]
        notes: dict[tuple[str, int], str] = {}
        if todo:
            begin(len(todo))
            with self._running(_film, todo) as finished:
                for done in finished:
                    job = done.job.argument
                    if (error := done.error or done.result()) is not None:
                        notes[job.policy.label, job.seed] = f"{job.policy.label}, seed {job.seed}: {error}"
        return [notes[job.policy.label, job.seed] for job in todo if (job.policy.label, job.seed) in notes]

    def _job(self, policy: Policy, seed: int) -> EpisodeJob:
        options = self.options
        document = self._identities[policy.label].document
        limits = options.answer_limit, options.episode_limit
        return EpisodeJob(options.out, policy, seed, document, self._code, options.all_pictures, *limits)

    @contextmanager
    def _running[R](
        self, function: Callable[[EpisodeJob, Callable[[int], None]], R], orders: Sequence[EpisodeJob]
    ) -> Iterator[Iterator[Done[R]]]:
        """Run jobs in the pool. Yields an iterator over the finished ones."""
        jobs = (Job(function, order) for order in orders)
        with (
            closing(open_pool(self.options.on, self.options.jobs)) as pool,
            closing(pool.run(jobs)) as finished,
        ):
            yield finished

    def _check_policy(self, policy: Policy, result: Result) -> None:
        """Refuse results of other weights, e.g. while a training overwrites them."""
        acted = (r for (label, _), r in self._results.items() if label == policy.label and r.acting)
        if result.acting and next(acted, result).acting != result.acting:
            raise ComponentFailed(f"{policy.label}: the policy's weights changed during the evaluation")

    def _kept(self) -> dict[str, list[Result]]:
        """Return the results up to the decision, and remove those beyond it."""
        by_label, decided = self.results(), self._decision.after
        if decided is None:
            return by_label
        for policy in self.policies:
            for seed in self.options.seeds[decided:]:
                place = Place.of(self.options.out, policy, seed)
                place.result.unlink(missing_ok=True)
                shutil.rmtree(place.episode, ignore_errors=True)
        return {label: results[:decided] for label, results in by_label.items()}


def _film(job: EpisodeJob, progress: Callable[[int], None]) -> str | None:
    """Film a finished episode. Returns why it cannot be filmed, or None. For the processes of a pool."""
    hide_messages()
    attempt = job.attempt("film")
    if attempt.error:
        return f"not filmed: {attempt.error}"
    with attempt:
        film(job.place.video, job.policy, Result.read(job.place.result), attempt)
    return None


def _result[R](done: Done[R]) -> tuple[Any, R]:
    """A finished job and its result. Raises its error if it failed."""
    job = done.job.argument
    if done.error is not None:
        which = f"{job.policy.label}, seed {job.seed}"
        raise ComponentFailed(f"{which}: {done.error}; finished episodes are kept", done.error.exit_code)
    return job, done.result()


@contextmanager
def opened(options: EvalOptions, policies: Sequence[Policy]) -> Iterator[Evaluation]:
    """Begin an evaluation in its folder, or continue that of an earlier call.

    Raises:
        InUse: if another process writes to the folder.
        DatasetError: if the folder contains anything else, was begun with other settings or files, or is read-only.
    """
    out = options.out
    registry = installed_plugins()
    identities = {policy.label: identify(policy, registry) for policy in policies}
    settings: dict[str, Any] = {
        "format": _FORMAT,
        "seed": options.seeds[0],
        "until_decided": options.until_decided,
        "margin": options.margin,
        "trials": options.trials,
        "vary": list(options.vary),
        "all_pictures": options.all_pictures,
        "policies": {
            each.label: {"mode": each.mode, "model": each.model, **attrs.asdict(identities[each.label])}
            for each in policies
        },
        "versions": code_here(),
        ASKED: [attrs.asdict(each) for each in policies],
    }
    with owned(out, "is being evaluated", DatasetError):
        try:
            _begin(options, settings)
        except OSError as error:
            raise DatasetError(f"{out}: cannot be written: {error.strerror}") from error
        shutil.rmtree(out / SCRATCH, ignore_errors=True)  # of a call that was killed
        try:
            yield Evaluation(options, policies, identities, settings["versions"])
        finally:
            shutil.rmtree(out / SCRATCH, ignore_errors=True)


def _begin(options: EvalOptions, settings: Mapping[str, Any]) -> None:
    """Write the settings into a new folder, or compare them to the present ones."""
    out, file = options.out, options.out / SETTINGS
    if file.is_file():
        known = read_settings(file)
        if differing := list(differences(known, {**settings, ASKED: known.get(ASKED)})):
            raise DatasetError(f"{out}: was begun with other settings: {'; '.join(differing)}; choose a new folder")
        done = max((len(list(each.glob("seed_*.json"))) for each in (out / "results").glob("*")), default=0)
        if done > len(options.seeds) and not options.until_decided:
            raise DatasetError(
                f"{out}: already has {counted(done, 'episode')} of a policy; --episodes must not be less"
            )
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out}: exists and is not an evaluation; choose a new folder")
    write(file, json.dumps(settings, indent=1) + "\n")


def read_settings(file: Path) -> dict[str, Any]:
    """Read the settings of an evaluation.

    Raises:
        FileNotFoundError: if there is no such file.
        DatasetError: if it is damaged.
    """
    try:
        settings: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DatasetError(f"{file}: cannot be read: {error}") from None
    return settings


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
