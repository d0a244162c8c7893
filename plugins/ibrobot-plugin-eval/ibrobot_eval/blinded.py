"""Runs blinded trials with an operator at the terminal, who does not learn which policy acts."""

from __future__ import annotations

import logging
import queue
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import override

import attrs

from ibrobot_core.api import IbrobotError, TeleopError, seconds
from ibrobot_core.app import (
    KeyReader,
    LaunchRequest,
    LogFormatter,
    Runtime,
    Session,
    echo,
    end_signals,
    error_line,
    installed_plugins,
)
from ibrobot_eval.comparison import Decision
from ibrobot_eval.episodes import NO_INTERVENTION, SCRATCH, Result
from ibrobot_eval.evaluation import Request
from ibrobot_eval.policies import Policy
from ibrobot_eval.report import Episode, Report
from ibrobot_eval.statistics import decided_by
from ibrobot_eval.trials import FAILURE, OUTCOMES, SUCCESS, VOID, Order, Trial

NEEDED = {0.1: 770, 0.2: 164, 0.3: 69}
"""Difference -> trials of each policy with which it is found with a probability of 80 %, by `episodes_for`."""
LOG = "trials.log"
_POLL_S = 0.05
_JUDGE = "s success, f failure, v void"
_KEYS = {outcome[0]: outcome for outcome in OUTCOMES}


class Quit(Exception):
    """The operator ends the trials for today."""


def power(trials: int) -> list[str]:
    """What so many trials of each policy can show, for the operator."""
    needed = ", ".join(f"{100 * difference:g} points: {number}" for difference, number in NEEDED.items())
    found = []
    for difference in NEEDED:
        chance = decided_by(0.5 + difference / 2, 0.5 - difference / 2, trials)[-1]
        found.append(f"{100 * difference:g} points with {100 * chance:.0f} %")
    return [
        f"trials of each policy that find a difference of success rates with a probability of 80 %: {needed}",
        f"the number asked for, {trials}, finds {', '.join(found)}",
    ]


class Blinding:
    """Replaces words that tell the policies apart.

    Args:
        words: the words.
    """

    def __init__(self, words: Iterable[str]) -> None:
        ordered = sorted(map(re.escape, words), key=len, reverse=True)
        self._words = re.compile(rf"(?<![\w-])(?:{'|'.join(ordered)})(?![\w-])")

    @classmethod
    def of(cls, policies: Iterable[Policy]) -> Blinding:
        """For the names of policies, modes and models, and the texts in the models' options, e.g. paths."""
        words: set[str] = set()
        for policy in policies:
            options = attrs.asdict(policy.load().models[policy.model].options).values()
            texts = {str(each) for each in options if isinstance(each, str | Path) and len(str(each)) > 1}
            words |= {policy.label, policy.folder, policy.mode, policy.model} | texts
        return cls(words)

    def __call__(self, text: str) -> str:
        """The text without those words."""
        return self._words.sub("POLICY", text)


class _BlindFormatter(LogFormatter):
    """Formats log records without the words that tell the policies apart."""

    def __init__(self, blinding: Blinding) -> None:
        super().__init__("%(levelname).1s %(message)s")
        self._blinding = blinding

    @override
    def format(self, record: logging.LogRecord) -> str:
        return self._blinding(super().format(record))


@contextmanager
def _blind_log(out: Path, blinding: Blinding) -> Iterator[None]:
    """Write the log into the folder, and warnings to the screen, without the words that tell the policies apart."""
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
    """The trials of an evaluation, one after another.

    Args:
        request: what the user asks for.
        reset: a command that resets the scene before each trial; empty if the operator does it.
    """

    def __init__(self, request: Request, reset: str) -> None:
        self._request = request
        self._reset = shlex.split(reset)
        self._policies = {each.label: each for each in request.policies}
        self._blinding = Blinding.of(request.policies)
        self._order = Order(request.out, list(self._policies))
        self._simulated = request.policies[0].load().simulated

    def run(self) -> bool:
        """Run trials until there are enough, or until they decide; returns whether that is so.

        Raises:
            TeleopError: without a terminal.
            DatasetError: if the order has been opened.
        """
        if self._enough():
            return True
        self._order.check_sealed()
        if not sys.stdin.isatty():
            raise TeleopError("blinded trials need a terminal, whose keys begin and judge them")
        if not self._order.trials:
            for line in power(self._request.episodes):
                echo(line)
        keys = KeyReader()
        pressed = keys.subscribe()
        with _blind_log(self._request.out, self._blinding), keys:
            try:
                while not self._enough():
                    self._trial(keys, pressed)
            except Quit:
                return False
        return True

    def report(self) -> Report:
        """Open the order, and report on the trials of the complete blocks. No trial can follow."""
        results = self._results(self._order.open())
        numbers = {(each.block, each.place): each.number for each in self._order.trials if each.outcome != VOID}
        episodes = [
            Episode(label, self._result(trial), f"episodes/trial_{numbers[trial.block, trial.place]:04d}", "", "")
            for label, trials in self._order.outcomes().items()
            for trial in trials
        ]
        request = self._request
        return Report.of(results, episodes, request.margin, until_decided=request.until_decided)

    def _enough(self) -> bool:
        request = self._request
        if self._order.blocks >= request.episodes:
            return True
        if not request.until_decided:
            return False
        decision = Decision(list(self._policies), request.margin)
        decision.look(self._results(self._order.outcomes()))
        return decision.after is not None

    def _results(self, outcomes: Mapping[str, Sequence[Trial]]) -> dict[str, list[Result]]:
        return {label: [self._result(each) for each in trials] for label, trials in outcomes.items()}

    def _result(self, trial: Trial) -> Result:
        success = trial.outcome == SUCCESS
        return Result(trial.block, success, trial.time_s, trial.interventions, trial.faults, {}, {})

    def _trial(self, keys: KeyReader, pressed: queue.SimpleQueue[str]) -> None:
        """Run the next trial, and keep the operator's judgement."""
        block, place, label = self._order.next()
        number = len(self._order.trials) + 1
        self._prepare(pressed, number, block)
        policy = self._policies[label]
        try:
            ran = self._run(policy, number, block, keys, pressed)
        except IbrobotError as error:
            echo(self._blinding(f"trial {number} did not run: {error_line(error)}"))
            _ask(pressed, "Enter tries it again, q ends for today", ("enter",))
            return
        outcome = ran.outcome or _KEYS[_ask(pressed, f"trial {number} has ended: {_JUDGE}", tuple(_KEYS))]
        reason = ""
        if outcome == VOID:
            while not reason:
                reason = _typed(pressed, "reason: ")
        self._order.add(
            Trial(number, block, place, outcome, reason, ran.time_s, ran.interventions, ran.faults, self._order.seal)
        )
        echo(f"trial {number}: {outcome}")

    def _prepare(self, pressed: queue.SimpleQueue[str], number: int, block: int) -> None:
        """Have the scene reset, and wait for the operator."""
        if self._reset:
            echo("resetting the scene …")
            if failed := _failure_of(self._reset):
                echo(self._blinding(f"the reset failed: {failed}"))
        scene = "the simulation resets the scene" if self._simulated else f"set the scene to start {block + 1}"
        text = (
            f"trial {number} (start {block + 1} of {self._request.episodes}): {scene}; Enter begins, q ends for today"
        )
        _ask(pressed, text, ("enter",))

    def _run(self, policy: Policy, number: int, block: int, keys: KeyReader, pressed: queue.SimpleQueue[str]) -> _Ran:
        """Run a policy until the operator judges it, or until its time is over."""
        config = policy.load()
        assert config.recording is not None
        scratch = self._request.out / SCRATCH / f"trial_{number:04d}"
        shutil.rmtree(scratch, ignore_errors=True)
        recording = attrs.evolve(config.recording, root=str(scratch), dataset="one")
        config = attrs.evolve(config, recording=recording, viewer=None)
        episodes = 1 if config.simulated else None
        duration_s = None if config.simulated else config.contract.max_duration_s
        seed = self._request.seed + block
        session = Session(config, installed_plugins(), LaunchRequest(False, seed, duration_s, episodes))
        runtime = Runtime(session)
        keys.gone = lambda: session.fail("keys", TeleopError("the terminal is gone"))
        judged: list[str] = []
        with _ended_by_signals(session) as came, _listening(pressed, session, lambda key: _judge(session, judged, key)):
            echo("starting …")
            runtime.start()
            echo(f"running: {_JUDGE}, Esc emergency stop")
            try:
                while not runtime.wait(_POLL_S):
                    if session.faults:
                        break
                time_s = seconds(session.clock.now_ns() - session.episodes.begun_ns)
            finally:
                runtime.stop()
        for line in session.outcome.holding:
            echo(self._blinding(line))
        if came:
            raise Quit
        runtime.raise_failure()
        episode = self._request.out / "episodes" / f"trial_{number:04d}"
        for bag in recording.folder.glob("episodes/*/"):
            shutil.rmtree(episode, ignore_errors=True)  # of a trial that was not judged
            episode.parent.mkdir(parents=True, exist_ok=True)
            bag.rename(episode)
        counts = session.counts()["safety"]
        happened = {kind: count for kind, count in counts.items() if count and kind not in NO_INTERVENTION}
        faults = tuple(map(self._blinding, session.outcome.faults))
        return _Ran(_KEYS[judged[0]] if judged else "", round(time_s, 3), happened, faults)


@attrs.frozen
class _Ran:
    """A trial that has run."""

    outcome: str
    """As the operator judged it while it ran; empty if it ended by itself."""
    time_s: float
    interventions: dict[str, int]
    faults: tuple[str, ...]


def _failure_of(command: Sequence[str]) -> str:
    """Run a command; returns why it failed, empty if it did not."""
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    except OSError as error:
        return f"{command[0]}: {error.strerror}"
    last = (done.stderr or done.stdout).strip().splitlines()[-1:]
    return f"exit code {done.returncode}: {' '.join(last)}" if done.returncode else ""


def _judge(session: Session, judged: list[str], key: str) -> None:
    """Handle a key of a running trial: a judgement ends it."""
    with session.changing:  # a simulated episode may end at the same time
        if key in _KEYS and session.episodes.running:
            judged.append(key)
            session.episodes.end({SUCCESS: SUCCESS, FAILURE: FAILURE}.get(_KEYS[key], "unknown"))
            session.finish()


@contextmanager
def _ended_by_signals(session: Session) -> Iterator[list[int]]:
    """End the run in an orderly way at Ctrl-C, SIGTERM and SIGHUP; gives a list of those that came."""
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
def _listening(pressed: queue.SimpleQueue[str], session: Session, judge: Callable[[str], None]) -> Iterator[None]:
    """Stop the robot at Esc, from a thread that waits for nothing else; other keys judge."""
    ended = threading.Event()

    def work() -> None:
        while not ended.is_set():
            try:
                key = pressed.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            if key != "esc":
                judge(key)
                continue
            try:
                session.emergency_stop()
            except IbrobotError as error:
                session.log.error("%s", error)

    thread = threading.Thread(target=work, name="keys of the trial", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _ask(pressed: queue.SimpleQueue[str], text: str, keys: tuple[str, ...]) -> str:
    """Print a prompt and wait for one of the keys.

    Raises:
        Quit: if the operator presses q.
    """
    while not pressed.empty():  # keys typed before the question do not answer it
        pressed.get()
    echo(text)
    while (key := pressed.get()) not in keys:
        if key == "q":
            raise Quit
    return key


def _typed(pressed: queue.SimpleQueue[str], text: str) -> str:
    """Print a prompt and return the line that the operator types."""
    echo(text, nl=False)
    line = ""
    while (key := pressed.get()) != "enter":
        if key == "backspace":
            line = line[:-1]
        else:
            line += " " if key == "space" else key if len(key) == 1 else ""
    echo(line)
    return line.strip()
