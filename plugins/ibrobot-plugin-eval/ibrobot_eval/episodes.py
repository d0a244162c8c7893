"""One episode of an evaluation: a pure function of files and a seed, whose result is written atomically."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import override
from uuid import uuid4

import attrs
from ibrobot_provenance.code import differing_code, installed_code
from ibrobot_provenance.files import replace_file
from ibrobot_terminal.plural import counted

from ibrobot_core.api import MODEL_ANSWERS, Contract, DatasetError, Message, ModelAnswer, RecorderError, seconds
from ibrobot_core.app import (
    ComponentFailed,
    LaunchRequest,
    RobotConfig,
    Runtime,
    Session,
    installed_plugins,
)
from ibrobot_eval.limits import Attempt, EpisodeTooLong
from ibrobot_eval.policies import Policy, as_texts, document_hash

SCRATCH = ".unfinished"
"""Folder within the evaluation for episodes until they are complete."""
_DEPTH = 1_000_000
"""More answers of a policy than an episode has."""


@attrs.frozen
class Result:
    """The result of an episode."""

    seed: int
    success: bool
    time_s: float
    """Duration of the episode, in simulated time; of a success, the time to success [s]."""
    interventions: Mapping[str, int]
    """Kind of intervention of the safety layer -> number of interventions, for those that occurred."""
    faults: tuple[str, ...] = attrs.field(converter=as_texts)
    factors: Mapping[str, float]
    """Values drawn by the scene from the seed, e.g. the position of an object, and those of varied keys."""
    acting: Mapping[str, str]
    """Model, weights and fingerprint of the policy that acted, as recordings state them."""
    error: str = ""
    """What the policy did wrong besides acting badly: it raised, hung, or ended its process; empty if nothing."""

    @property
    def is_error(self) -> bool:
        """Whether the episode counts as an error rather than a failure."""
        return bool(self.error) and not self.success

    @classmethod
    def read(cls, file: Path) -> Result:
        """Read the result in a file.

        Raises:
            DatasetError: if it is not a result, e.g. because a power failure cut it.
        """
        try:
            return cls(**json.loads(file.read_text(encoding="utf-8")))
        except (ValueError, TypeError) as error:
            raise DatasetError(f"{file}: is not the result of an episode: {error}") from None


@attrs.frozen
class Place:
    """Paths of an episode's result, recording and video in the folder of the evaluation."""

    result: Path
    episode: Path
    video: Path

    @classmethod
    def of(cls, out: Path, policy: Policy, seed: int) -> Place:
        """Return the place of an episode."""
        folder, name = policy.folder, f"seed_{seed:06d}"
        paths = (f"results/{folder}/{name}.json", f"episodes/{folder}/{name}", f"videos/{folder}/{name}.mp4")
        return cls(*(out / each for each in paths))


@attrs.frozen
class EpisodeJob:
    """An episode to run, or to film."""

    out: Path
    """The folder of the evaluation."""
    policy: Policy
    seed: int
    document: str
    """Hash of the robot YAML with which the evaluation began."""
    code: Mapping[str, str]
    """The installed code with which it began."""
    all_pictures: bool
    """Whether the recording also has the pictures that the policy does not look at."""
    answer_s: float
    """Longest time of a step, e.g. of an answer of the policy [s]."""
    episode_s: float
    """Longest time of the episode, in real time [s]."""

    def attempt(self, what: str) -> Attempt:
        """An attempt to do something with the episode."""
        file = self.out / SCRATCH / "attempts" / self.policy.folder / f"{what}_{self.seed:06d}"
        return Attempt(file, self.answer_s, self.episode_s)

    @property
    def place(self) -> Place:
        """The place of the episode."""
        return Place.of(self.out, self.policy, self.seed)


def run_episode(job: EpisodeJob, progress: Callable[[int], None]) -> Result:
    """Run an episode in lockstep, and write its recording and result. For the processes of a pool.

    Raises:
        IbrobotError: e.g. if the policy fails, or the recording is incomplete.
    """
    hide_messages()
    if document_hash(job.policy.load()) != job.document:
        raise ComponentFailed(f"{job.policy.config}: changed during the evaluation")
    if changed := differing_code(job.code, code_here()):
        raise ComponentFailed(f"the installed code changed during the evaluation: {'; '.join(changed)}")
    attempt = job.attempt("episode")
    if attempt.error:
        return _broken(job, attempt.error)
    with attempt:
        try:
            return _run(job, attempt)
        except EpisodeTooLong as error:
            return _broken(job, str(error))


def _broken(job: EpisodeJob, error: str) -> Result:
    """Write and return the result of an episode without an end, and thus without a recording."""
    result = Result(job.seed, False, 0.0, {}, (), job.policy.varied_names(job.seed), {}, error)
    write(job.place.result, json.dumps(attrs.asdict(result), indent=1) + "\n")
    return result


def _run(job: EpisodeJob, attempt: Attempt) -> Result:
    """Run an episode, within the limits of an attempt."""
    place, policy, seed = job.place, job.policy, job.seed
    scratch = job.out / SCRATCH / uuid4().hex  # another process may run the episode at the same time
    config, recordings = recorded_in(scratch, policy.load(seed))
    if not job.all_pictures:
        config = without_unseen_pictures(config, policy.model)
    runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(lockstep=True, seed=seed, episodes=1)))
    session = runtime.session
    answers = session.bus.subscribe(MODEL_ANSWERS, _DEPTH)
    run_to_end(runtime, attempt)
    if session.state is None or session.state.success is None:
        raise ComponentFailed(f"{config.source}: the scene has no task, so success is not defined")
    time_s = seconds(session.clock.now_ns() - session.episodes.begun_ns)
    bags = list(recordings.glob("*/"))
    outcome = "success" if session.outcome.successes else "failure"
    metadata = _checked(bags, outcome, session.outcome.faults)
    factors = json.loads(metadata.get("factors", "{}")) | policy.varied_names(seed)
    acting = json.loads(metadata.get("policy", "{}"))
    success, faults = session.outcome.successes == 1, session.outcome.faults
    error = _errors([each.message for each in answers.drain()])
    result = Result(seed, success, round(time_s, 6), interventions(session), faults, factors, acting, error)
    place.episode.parent.mkdir(parents=True, exist_ok=True)
    try:
        bags[0].rename(place.episode)
    except OSError:
        if not place.episode.is_dir():
            raise
        # A process that was killed, or one beside this, has made the same recording.
    write(place.result, json.dumps(attrs.asdict(result), indent=1) + "\n")
    shutil.rmtree(scratch)
    return result


def _errors(answers: Sequence[Message]) -> str:
    """What went wrong with requests to the policy; empty if nothing did."""
    asked = [each for each in answers if isinstance(each, ModelAnswer)]
    failed = [each.error for each in asked if each.error]
    return f"{len(failed)} of {counted(len(asked), 'request')} to the policy failed: {failed[0]}" if failed else ""


def code_here() -> dict[str, str]:
    """The installed code on which episodes depend."""
    return installed_code([*installed_plugins().versions(), "ibrobot-plugin-eval"])


class _NewErrors(logging.Filter):
    """Passes each error once: a policy that raises does so at every request of every episode."""

    def __init__(self) -> None:
        super().__init__()
        self._known: set[str] = set()

    @override
    def filter(self, record: logging.LogRecord) -> bool:
        if record.exc_info is None or record.exc_info[1] is None:
            return True
        text = f"{record.getMessage()}: {record.exc_info[1]!r}"
        new = text not in self._known
        self._known.add(text)
        return new


_NEW_ERRORS = _NewErrors()


def hide_messages() -> None:
    """Keep the messages of runs in this process out of the evaluation's log, and all but the first of equal errors."""
    logging.getLogger("ibrobot").setLevel(logging.ERROR)
    logging.getLogger("ibrobot.inference").addFilter(_NEW_ERRORS)


def recorded_in(folder: Path, config: RobotConfig) -> tuple[RobotConfig, Path]:
    """Have a robot record into a folder, without a viewer. Also returns the parent folder of its recordings.

    A recording does not contain its path, so that equal episodes have equal bytes.
    """
    assert config.recording is not None
    recording = attrs.evolve(config.recording, root=str(folder), dataset="one")
    return attrs.evolve(config, recording=recording, viewer=None), recording.folder / "episodes"


def without_unseen_pictures(config: RobotConfig, model: str) -> RobotConfig:
    """Have a robot that records its contract leave out the pictures that a model does not look at.

    In lockstep, a picture that nobody receives is not rendered, which would take most of an episode's time.
    """
    assert config.recording is not None
    if config.recording.topics != "contract":
        return config
    seen = installed_plugins().build_policy(config, model).spec.observations
    contract = Contract.from_config(config, config.models[model].extra_observations)
    unseen = {each.topic for each in contract.observation_parts if each.image is not None}
    unseen -= {each.topic for each in contract.observation_parts if each.key in seen}
    if not unseen:
        return config
    kept = tuple(topic for topic in (*contract.topics, MODEL_ANSWERS) if topic not in unseen)
    return attrs.evolve(config, recording=attrs.evolve(config.recording, topics=kept))


def interventions(session: Session) -> dict[str, int]:
    """Kind of intervention of the safety layer -> number of interventions, for those that occurred."""
    counts = session.counts()["safety"]
    # The others count ticks without a request, and emergency stops.
    return {kind: count for kind, count in counts.items() if count and kind not in ("missing", "estop")}


def run_to_end(runtime: Runtime, attempt: Attempt) -> None:
    """Run in lockstep.

    Raises:
        IbrobotError: if a component fails.
        EpisodeTooLong: if it exceeds the limit of the attempt.
    """
    runtime.start()
    try:
        attempt.beat()
        while not runtime.step():
            attempt.beat()
    finally:
        runtime.stop()
    runtime.raise_failure()


def _checked(bags: list[Path], outcome: str, faults: list[str]) -> Mapping[str, str]:
    """Check that the recording of an episode is complete, and return its metadata."""
    what = f": {'; '.join(faults)}" if faults else ""
    if len(bags) != 1:
        raise RecorderError(f"the episode was not recorded{what}")
    with closing(installed_plugins().open_episode(bags[0])) as reader:
        summary = reader.summary()
    if not summary.finished or summary.outcome != outcome:
        raise RecorderError(f"the recording of the episode is incomplete{what}")
    return summary.metadata


def write(path: Path, content: str | bytes) -> None:
    """Write a file atomically, and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, content)
