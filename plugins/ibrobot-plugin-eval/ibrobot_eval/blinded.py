"""Blinded trials: an operator judges them without learning which policy acts."""

from __future__ import annotations

import logging
import math
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import override

import attrs
import numpy as np
from ibrobot_provenance.asking import Choice
from ibrobot_terminal.plural import counted

from ibrobot_core.api import IbrobotError, seconds
from ibrobot_core.app import LaunchRequest, LogFormatter, Runtime, Session, end_signals, error_text, installed_plugins
from ibrobot_eval.cameras import StartPictures, cameras_of, live_pictures
from ibrobot_eval.comparison import Decision
from ibrobot_eval.episodes import SCRATCH, Result, interventions, recorded_in
from ibrobot_eval.operators import QUIT, Operator, Quit
from ibrobot_eval.options import EvalOptions
from ibrobot_eval.policies import Policy
from ibrobot_eval.report import Episode, Report, p_value
from ibrobot_eval.statistics import ALPHA, decided_by, drift, level_of
from ibrobot_eval.trials import FAILURE, OUTCOMES, SEALED, SUCCESS, VOID, Order, Trial

DIFFERENCES = (0.1, 0.2, 0.3)
"""Differences of success rates for which the power is stated."""
POWER = 0.8
_NEEDED = {2: (770, 164, 69), 3: (931, 203, 87), 4: (1026, 228, 97), 5: (1095, 245, 105), 6: (1149, 258, 111)}
"""Policies -> trials for each of `DIFFERENCES`, computed in advance, since that takes seconds."""
_MOST_TRIALS = 6400
LOG = "trials.log"
_POLL_S = 0.05
STARTS = "starts"
"""Folder of the pictures of the starts."""
_KEYS = {outcome[0]: outcome for outcome in OUTCOMES}
_JUDGE = tuple(Choice(key=key, text=outcome) for key, outcome in _KEYS.items())
_OUTCOME = "outcome"
_STOP = Choice(key="esc", text="emergency stop", urgent=True)


def trials_needed(difference: float, policies: int) -> int | None:
    """Trials of each policy that tell a pair with this difference of rates apart in 80 %; None above 6400.

    Rates are those around 50 %, for which most trials are needed.
    """
    if difference in DIFFERENCES and policies in _NEEDED:
        return _NEEDED[policies][DIFFERENCES.index(difference)]
    most = 100
    while most <= _MOST_TRIALS:
        chances = decided_by(0.5 + difference / 2, 0.5 - difference / 2, most, level_of(math.comb(policies, 2)))
        if chances[-1] >= POWER:
            return int(np.argmax(chances >= POWER))
        most *= 2
    return None


def power(trials: int, policies: int) -> list[str]:
    """Statistical power of this number of trials of each policy, in words for the operator; none for one policy."""
    if policies < 2:
        return []
    needed, chances = [], []
    for difference in DIFFERENCES:
        chance = decided_by(0.5 + difference / 2, 0.5 - difference / 2, trials, level_of(math.comb(policies, 2)))[-1]
        number = trials_needed(difference, policies)
        needed.append(f"{100 * difference:g} points: {number or f'more than {_MOST_TRIALS}'}")
        chances.append(f"{100 * difference:g} points: {100 * chance:.0f} %")
    of = "both" if policies == 2 else f"two of the {policies}"
    return [
        f"trials of each policy that detect a difference between the success rates of {of} policies with a probability "
        f"of {100 * POWER:g} %: {', '.join(needed)}",
        f"probability with {counted(trials, 'trial')} of each policy: {', '.join(chances)}",
        "these numbers are for rates around 50 %, e.g. 55 and 45 %; near 0 and 100 % fewer trials are enough",
    ]


def drift_over(results: Mapping[str, Sequence[Result]]) -> str:
    """What the trials say of a drift of success rates over time, in words; empty for fewer than four of a policy."""
    outcomes = [[each.success for each in trials_of_one] for trials_of_one in results.values()]
    half = min(map(len, outcomes), default=0) // 2
    if half < 2:
        return ""
    p = drift(outcomes)
    if p > ALPHA:
        return f"no drift of the success rates over the trials was found (p {p_value(p)})"
    early = np.mean([success for trials_of_one in outcomes for success in trials_of_one[:half]])
    late = np.mean([success for trials_of_one in outcomes for success in trials_of_one[half:]])
    return (
        f"the success rates drifted over the trials (p {p_value(p)}): {100 * early:.0f} % in the first half, "
        f"{100 * late:.0f} % in the second; the comparison allows for it, since each start has a trial of each policy, "
        "but the rates are those of no one state of robot, scene and operator"
    )


class Blinding:
    """Replaces words that identify a policy.

    Args:
        words: the words to replace.
    """

    def __init__(self, words: Iterable[str]) -> None:
        ordered = sorted(map(re.escape, words), key=len, reverse=True)
        self._words = re.compile(rf"(?<![\w-])(?:{'|'.join(ordered)})(?![\w-])")

    @classmethod
    def of(cls, policies: Iterable[Policy]) -> Blinding:
        """Blind the names of policies, modes and models, and texts in the models' options, e.g. paths."""
        words: set[str] = set()
        for policy in policies:
            options = attrs.asdict(policy.load().models[policy.model].options).values()
            texts = {str(each) for each in options if isinstance(each, str | Path) and len(str(each)) > 1}
            words |= {policy.label, policy.folder, policy.mode, policy.model} | texts
        return cls(words)

    def __call__(self, text: str) -> str:
        """Return the text with each of the words replaced by POLICY."""
        return self._words.sub("POLICY", text)


class _BlindFormatter(LogFormatter):
    """Formats log records without words that identify a policy."""

    def __init__(self, blinding: Blinding) -> None:
        super().__init__("%(levelname).1s %(message)s")
        self._blinding = blinding

    @override
    def format(self, record: logging.LogRecord) -> str:
        return self._blinding(super().format(record))


@contextmanager
def _blind_log(out: Path, blinding: Blinding) -> Iterator[None]:
    """Log to a file in the folder, and warnings to the screen, without words that identify a policy."""
    file, screen = logging.FileHandler(out / LOG, encoding="utf-8"), logging.StreamHandler(sys.stderr)
    screen.setLevel(logging.WARNING)
    for handler in (file, screen):
        handler.setFormatter(_BlindFormatter(blinding))
    logging.basicConfig(level=logging.WARNING, handlers=(file, screen), force=True)
    logging.getLogger("ibrobot").setLevel(logging.INFO)
    logging.captureWarnings(True)
    try:
        yield
    finally:
        logging.captureWarnings(False)
        logging.basicConfig(level=logging.WARNING, handlers=[logging.NullHandler()], force=True)
        file.close()


class Blinded:
    """Runs the blinded trials of an evaluation.

    Args:
        options: the evaluation.
        policies: the policies.
        reset: command that resets the scene before each trial; empty if the operator resets it.
        operator: judges the trials.
    """

    def __init__(
        self, options: EvalOptions, policies: Sequence[Policy], reset: Sequence[str], operator: Operator
    ) -> None:
        self._options = options
        self._out = options.out
        self._reset = reset
        self._operator = operator
        self._policies = {each.label: each for each in policies}
        self._blinding = Blinding.of(policies)
        self._order = Order(options.out, list(self._policies))
        self._robot = policies[0].load()

    def run(self) -> bool:
        """Run trials until all are done or the comparison is decided. Returns False if the operator ends before that.

        Raises:
            IbrobotError: if nobody can be asked.
            DatasetError: if the order has been opened.
        """
        if self._enough():
            return True
        self._order.check_sealed()
        with self._operator.present(), _blind_log(self._out, self._blinding):
            if not self._order.trials:
                sealed = f"do not open {self._out / SEALED} and {self._out / SCRATCH}: recordings there name the policy"
                for line in (*power(self._options.episodes, len(self._policies)), sealed):
                    self._operator.say(line)
            try:
                while not self._enough():
                    self._trial()
            except Quit:
                return False
        return True

    def report(self) -> Report:
        """Open the sealed order, and report on the trials of complete blocks. No trial can follow."""
        results = self._results(self._order.open())
        numbers = {(each.block, each.place): each.number for each in self._order.trials if each.outcome != VOID}
        episodes = [
            Episode(label, self._result(trial), f"episodes/{_name(numbers[trial.block, trial.place])}", "", "")
            for label, trials in self._order.outcomes().items()
            for trial in trials
        ]
        options = self._options
        notes = [note for note in (drift_over(results),) if note]
        return Report.of(results, episodes, options.margin, until_decided=options.until_decided, notes=notes)

    def _enough(self) -> bool:
        options = self._options
        if self._order.blocks >= options.episodes:
            return True
        if not options.until_decided:
            return False
        decision = Decision(list(self._policies), options.margin)
        decision.look(self._results(self._order.outcomes()))
        return decision.after is not None

    def _results(self, outcomes: Mapping[str, Sequence[Trial]]) -> dict[str, list[Result]]:
        return {label: [self._result(each) for each in trials] for label, trials in outcomes.items()}

    def _result(self, trial: Trial) -> Result:
        success = trial.outcome == SUCCESS
        return Result(trial.block, success, trial.time_s, trial.interventions, trial.faults, {}, {})

    def _trial(self) -> None:
        """Run the next trial, and store the operator's judgement."""
        block, place, label = self._order.next()
        number = len(self._order.trials) + 1
        operator = self._operator
        starts = StartPictures(self._out / STARTS / f"start_{block + 1:04d}", cameras_of(self._robot))
        self._prepare(number, block, starts)
        try:
            trial = self._run(number, block, place, self._policies[label], starts)
        except IbrobotError as error:
            failed = self._blinding(f"trial {number} did not run: {error_text(error, '; ')}")
            operator.ask(failed, (Choice(key="enter", text="try again"), QUIT))
            return
        outcome = trial.outcome or _KEYS[operator.ask(f"trial {number} has ended", (*_JUDGE, QUIT))]
        reason = ""
        if outcome == VOID:
            while not reason:
                reason = operator.ask(f"trial {number} is void; reason").strip()
        self._order.add(attrs.evolve(trial, outcome=outcome, reason=reason))
        operator.say(f"trial {number}: {outcome}")

    def _prepare(self, number: int, block: int, starts: StartPictures) -> None:
        """Reset the scene, and wait for the operator."""
        operator = self._operator
        if self._reset:
            operator.say("resetting the scene …")
            if failed := _failure_of(self._reset):
                operator.say(self._blinding(f"the reset failed: {failed}"))
        live = self._out / SCRATCH / "live"
        simulated = self._robot.simulated
        with ExitStack() as stack:
            shows = operator.sees and not simulated
            if shows and (problems := stack.enter_context(live_pictures(self._robot, live))):
                operator.say(f"no live pictures: {problems}")
            sights = starts.sights(live)
            scene = "the simulation resets the scene" if simulated else f"set the scene to start {block + 1}"
            if any(each.wanted for each in sights) and not simulated:
                scene += " as in the picture" if len(sights) == 1 else " as in the pictures"
            text = f"trial {number} (start {block + 1} of {self._options.episodes}), {scene}"
            operator.ask(text, (Choice(key="enter", text="begin the trial"), QUIT), sights)

    def _run(self, number: int, block: int, place: int, policy: Policy, starts: StartPictures) -> Trial:
        """Run a policy until the operator judges it or its time is up; returns a trial without outcome if it is up."""
        scratch = self._out / SCRATCH / _name(number)
        shutil.rmtree(scratch, ignore_errors=True)
        config, recordings = recorded_in(scratch, policy.load())
        episodes = 1 if config.simulated else None
        duration_s = None if config.simulated else config.contract.max_duration_s
        seed = self._options.seed + block
        session = Session(config, installed_plugins(), LaunchRequest(False, seed, duration_s, episodes))
        runtime = Runtime(session)
        # The first trial of a block defines the picture of its start.
        pictures = starts.taken(session.bus) if all(each.outcome == VOID for each in self._order.of(block)) else None
        judged: list[str] = []
        self._operator.say("starting …")
        with _ended_by_signals(session) as came, _listening(self._operator, session, judged):
            runtime.start()
            self._operator.say(f"trial {number} is running")
            self._operator.put(_OUTCOME, (*_JUDGE, _STOP))
            try:
                while not runtime.wait(_POLL_S):
                    if pictures is not None:
                        pictures.take()
                    if session.faults:
                        break
                time_s = seconds(session.clock.now_ns() - session.episodes.begun_ns)
            finally:
                runtime.stop()
        for line in session.outcome.holding:
            self._operator.say(self._blinding(line))
        if came:
            raise Quit
        runtime.raise_failure()
        episode = self._out / SEALED / _name(number)
        for bag in recordings.glob("*/"):
            shutil.rmtree(episode, ignore_errors=True)  # left by a trial that was not judged
            episode.parent.mkdir(parents=True, exist_ok=True)
            bag.rename(episode)
        faults = tuple(map(self._blinding, session.outcome.faults))
        outcome, happened = _KEYS[judged[0]] if judged else "", interventions(session)
        return Trial(number, block, place, outcome, "", round(time_s, 3), happened, faults, self._order.seal)


def _name(number: int) -> str:
    return f"trial_{number:04d}"


def reset_of(options: EvalOptions) -> Sequence[str]:
    """The command that resets the scene; empty if there is none.

    Raises:
        PluginError: if no installed plugin performs tasks.
    """
    if options.reset_task is None:
        return shlex.split(options.reset)
    name = installed_plugins().command("task").name
    program = (sys.executable, "-c", "from ibrobot_core.cli.command import main; main()")
    where = ("--sim",) if options.sim else ()
    return [*program, name, "run", str(options.reset_task), options.config[0], "--headless", *where]


def _failure_of(command: Sequence[str]) -> str:
    """Run a command. Returns why it failed; empty if it succeeded."""
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    except OSError as error:
        return f"{command[0]}: {error.strerror}"
    last = (done.stderr or done.stdout).strip().splitlines()[-1:]
    return f"exit code {done.returncode}: {' '.join(last)}" if done.returncode else ""


def _judge(session: Session, judged: list[str], key: str) -> bool:
    """Judge a running trial, which ends it. Returns False if none is running."""
    with session.changing:  # a simulated episode may end at the same time
        if not session.episodes.running:
            return False
        judged.append(key)
        session.episodes.end({SUCCESS: SUCCESS, FAILURE: FAILURE}.get(_KEYS[key], "unknown"))
        session.finish()
        return True


@contextmanager
def _ended_by_signals(session: Session) -> Iterator[list[int]]:
    """End the run in order at Ctrl-C, SIGTERM and SIGHUP. Yields the list of signals received so far."""
    came: list[int] = []

    def end(number: int, frame: object) -> None:
        came.append(number)
        threading.Thread(target=session.finish, name="signal", daemon=True).start()

    before = {number: signal.signal(number, end) for number in end_signals()}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _listening(operator: Operator, session: Session, judged: list[str]) -> Iterator[None]:
    """Handle answers in a thread that does nothing else: Esc stops the robot, others judge the trial."""
    ended = threading.Event()

    def work() -> None:
        while not ended.is_set():
            try:
                given = operator.answer(_POLL_S)
            except IbrobotError as error:
                session.fail("operator", error)
                return
            if given == _STOP.key:
                try:
                    session.emergency_stop()
                except IbrobotError as error:
                    session.log.error("%s", error)
                operator.put(_OUTCOME, (*_JUDGE, _STOP))
            elif given is not None and not _judge(session, judged, given):
                operator.put(_OUTCOME, (*_JUDGE, _STOP))

    thread = threading.Thread(target=work, name="answers to the trial", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
