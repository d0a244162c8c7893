"""`ibrobot eval`: count the successes of policies on the same seeds, and say whether they differ."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import attrs
from ibrobot_provenance.jobs import check_pool
from ibrobot_terminal.plural import counted

from ibrobot_core.api import option
from ibrobot_core.app import (
    ComponentFailed,
    Emit,
    Event,
    Failed,
    RequestError,
    Unsuccessful,
    echo,
    wrong_input,
)
from ibrobot_eval.blinded import Blinded, reset_of
from ibrobot_eval.episodes import Result
from ibrobot_eval.evaluation import Evaluation, Watch, opened
from ibrobot_eval.operators import AtPage, AtTerminal, Operator
from ibrobot_eval.options import Begin, EvalOptions, Progress, Told, outcome_of
from ibrobot_eval.options import Report as ReportEvent
from ibrobot_eval.page import write_all
from ibrobot_eval.policies import Policy, find_policies
from ibrobot_eval.report import Report

_INTERRUPTED = 130
_KEPT = "interrupted; finished episodes are kept: {} to continue"


@attrs.frozen(kw_only=True)
class Evaluate(EvalOptions):
    """Count the successes of policies, and compare them.

    Each CONFIG is a robot YAML as for `ibrobot launch`, evaluated in each --mode with each --model. In simulation, all
    policies get the same seeds. An episode depends on files and its seed alone, so it is the same in one process or
    many, and the report has the command that repeats it.

    With hardware, an operator judges blinded trials at the terminal: in random order, within blocks of one trial of
    each policy.

    After an interruption, run the same command again to continue; a larger --episodes adds episodes. The verdict stays
    valid however often you look and whenever you stop. Exits with 0 whatever the policies achieve, but with 1 if all
    episodes of one ended in an error.
    """

    overrides: tuple[str, ...] = option(
        (), typed="--set PATH=VALUE", label=None, help="override a key, e.g. control.rate_hz=50"
    )
    as_json: bool = option(False, typed="--json", label=None, help="print the report as JSON")

    def __call__(self, emit: Emit) -> None:
        with wrong_input():
            policies = find_policies(self.config, self.mode, self.model, self.overrides, self.vary, sim=self.sim)
            options = attrs.evolve(self, trials=_checked(self, policies))
            check_pool(options.on)
            reset = reset_of(options)
            try:
                with opened(options, policies) as evaluation:
                    if options.trials:
                        report = _judged(options, policies, reset, AtTerminal() if emit is None else AtPage(emit))
                    else:
                        report = _evaluated(evaluation, emit, quiet=self.as_json)
            except KeyboardInterrupt:
                if emit is not None:
                    emit(Failed(_KEPT.format("start the same evaluation again")))
                else:
                    echo(_KEPT.format("run the same command again"), err=True)
                raise Unsuccessful(exit_code=_INTERRUPTED) from None
        if report is not None:
            self._tell(report, emit)
            if evaluation.broken:
                raise ComponentFailed(evaluation.broken)
        elif emit is not None:
            emit(Told(text="not finished: start the same evaluation again to continue"))
        else:
            echo("not finished: run the same command again to continue")

    def _tell(self, report: Report, emit: Emit) -> None:
        """Print the report."""
        if emit is not None:
            emit(ReportEvent(out=str(self.out), lines=tuple(report.lines())))
        elif self.as_json:
            echo(json.dumps(report.facts()))
        else:
            for line in report.lines():
                echo(line)
            echo(f"report: {self.out / 'report.html'}")


def _checked(options: EvalOptions, policies: Sequence[Policy]) -> bool:
    """Return whether the evaluation consists of blinded trials.

    Raises:
        RequestError: for options that do not fit together.
    """
    if options.until_decided and len(policies) < 2:
        raise RequestError("--until-decided compares policies: give at least two")
    simulated = {each.load().simulated for each in policies}
    if len(simulated) > 1:
        raise RequestError("some of the robots are simulated, others are not: add --sim")
    trials = options.trials or simulated == {False}
    if trials and options.vary:
        raise RequestError("--vary is for episodes in simulation, not for blinded trials")
    if options.shard and (trials or options.until_decided):
        raise RequestError("--shard has a fixed number of episodes; give neither --until-decided nor --trials")
    if not options.seeds:
        raise RequestError(f"--shard {options.shard}: there are more shards than episodes ({options.episodes})")
    for given, flag in ((options.reset, "--reset"), (options.reset_task, "--reset-task"), (options.open, "--open")):
        if given and not trials:
            raise RequestError(f"{flag} is for blinded trials, not for episodes in simulation")
    if options.reset and options.reset_task:
        raise RequestError("--reset and --reset-task exclude each other")
    return trials


def _evaluated(evaluation: Evaluation, emit: Emit, *, quiet: bool) -> Report:
    """Run the missing episodes, and write the report."""
    with _lines(evaluation, quiet) if emit is None else _events(evaluation, emit) as watch:
        results = evaluation.run(watch)

    def filming(failures: int) -> None:
        if emit is None and not quiet:
            echo(f"filming {counted(failures, 'failure')}", err=True)

    options = evaluation.options

    def written(notes: Sequence[str]) -> Report:
        report = Report.of_simulation(
            evaluation.policies, results, options.margin, until_decided=options.until_decided, notes=notes
        )
        write_all(options.out, report)
        return report

    report = written(())  # before the videos, which may fail
    notes = evaluation.film(results, options.videos, filming)
    return written(notes) if notes or options.videos else report


def _judged(
    options: EvalOptions, policies: Sequence[Policy], reset: Sequence[str], operator: Operator
) -> Report | None:
    """Run blinded trials, and write the report. Returns None if the operator stops before the last trial."""
    blinded = Blinded(options, policies, reset, operator)
    if not options.open and not blinded.run():
        return None
    report = blinded.report()
    write_all(options.out, report)
    return report


@contextmanager
def _events(evaluation: Evaluation, emit: Callable[[Event], None]) -> Iterator[Watch]:
    """Yield a function that prints an event for each episode."""
    begin = time.monotonic()
    total = len(evaluation.options.seeds) * len(evaluation.policies)
    emit(Begin(of=total, done=evaluation.resumed))

    def tell(done: int, total: int, policy: Policy, result: Result) -> None:
        event = Progress(
            done=done, of=total, policy=policy.label, seed=result.seed, success=result.success, time_s=result.time_s,
            error=result.error if result.is_error else "", seconds=round(time.monotonic() - begin, 1),
        )  # fmt: skip
        emit(event)

    yield tell


@contextmanager
def _lines(evaluation: Evaluation, quiet: bool) -> Iterator[Watch]:
    """Yield a function that shows the progress: a bar on a terminal, otherwise one line per episode."""
    for damage in evaluation.damaged:
        echo(damage, err=True)
    if evaluation.resumed and not quiet:
        echo(f"continuing after {counted(evaluation.resumed, 'episode')}", err=True)
    if not sys.stderr.isatty():

        def line(done: int, total: int, policy: Policy, result: Result) -> None:
            if not quiet:
                outcome = outcome_of(result.success, result.error)
                echo(f"{policy.label}, seed {result.seed}: {outcome} ({done} of {total})", err=True)

        yield line
        return
    from ibrobot_terminal.screen import Screen
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    counts_column, successes_column = (
        TextColumn(each, markup=False) for each in ("{task.description}", "{task.fields[successes]}")
    )
    columns = (counts_column, BarColumn(), successes_column, TimeRemainingColumn())
    with Bar(*columns, console=Screen(stderr=True)) as bar:
        task = bar.add_task("starting", total=None, successes="")
        counts: dict[str, list[int]] = {}

        def move(done: int, total: int, policy: Policy, result: Result) -> None:
            count = counts.setdefault(policy.label, [0, 0, 0])
            count[0] += result.success
            count[1] += 1
            count[2] += result.is_error
            successes = ", ".join(
                f"{label} {won} of {ran}{f' ({counted(errors, "error")})' if errors else ''}"
                for label, (won, ran, errors) in counts.items()
            )
            bar.update(
                task,
                description=f"{done} of {counted(total, 'episode')}",
                completed=done,
                total=total,
                successes=successes,
            )

        yield move
