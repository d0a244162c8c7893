"""`ibrobot eval`: count the successes of policies on the same seeds, and say whether they differ."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import attrs
import click

from ibrobot_core.app import ComponentFailed, Failed, declared, echo, emit, installed_plugins, run_options, wrong_input
from ibrobot_eval import EVAL
from ibrobot_eval.blinded import Blinded, reset_of
from ibrobot_eval.episodes import Result
from ibrobot_eval.evaluation import Evaluation, Watch, opened
from ibrobot_eval.merge import WithMerge
from ibrobot_eval.operators import AtPage, AtTerminal, Operator
from ibrobot_eval.options import Begin, EvalOptions, Progress, Told, outcome_of
from ibrobot_eval.options import Report as ReportEvent
from ibrobot_eval.page import write_all
from ibrobot_eval.policies import Policy, find_policies
from ibrobot_eval.report import Report

_INTERRUPTED = 130
_KEPT = "interrupted; finished episodes are kept: {} to continue"


@click.command("eval", cls=WithMerge)
@declared(EVAL)
@run_options("overrides")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def evaluate(options: EvalOptions, /, *, overrides: tuple[str, ...], as_json: bool, events: bool) -> None:
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
    with wrong_input():
        policies = find_policies(options.config, options.mode, options.model, overrides, options.vary, sim=options.sim)
        options = attrs.evolve(options, trials=_checked(options, policies))
        installed_plugins().check_pool(options.on)
        reset = reset_of(options)
        try:
            with opened(options, policies) as evaluation:
                if options.trials:
                    report = _judged(options, policies, reset, AtPage() if events else AtTerminal())
                else:
                    report = _evaluated(evaluation, events=events, quiet=as_json)
        except KeyboardInterrupt:
            if events:
                emit(EVAL, Failed(_KEPT.format("start the same evaluation again")))
            else:
                echo(_KEPT.format("run the same command again"), err=True)
            sys.exit(_INTERRUPTED)
    if report is None:
        if events:
            emit(EVAL, Told(text="not finished: start the same evaluation again to continue"))
        else:
            echo("not finished: run the same command again to continue")
    else:
        _tell(options.out, report, events=events, as_json=as_json)
        if evaluation.broken:
            raise ComponentFailed(evaluation.broken)


def _checked(options: EvalOptions, policies: Sequence[Policy]) -> bool:
    """Return whether the evaluation consists of blinded trials.

    Raises:
        UsageError: for options that do not fit together.
    """
    if options.until_decided and len(policies) < 2:
        raise click.UsageError("--until-decided compares policies: give at least two")
    simulated = {each.load().simulated for each in policies}
    if len(simulated) > 1:
        raise click.UsageError("some of the robots are simulated, others are not: add --sim")
    trials = options.trials or simulated == {False}
    if trials and options.vary:
        raise click.UsageError("--vary is for episodes in simulation, not for blinded trials")
    if options.shard and (trials or options.until_decided):
        raise click.UsageError("--shard has a fixed number of episodes; give neither --until-decided nor --trials")
    if not options.seeds:
        raise click.UsageError(f"--shard {options.shard}: there are more shards than episodes ({options.episodes})")
    for given, flag in ((options.reset, "--reset"), (options.reset_task, "--reset-task"), (options.open, "--open")):
        if given and not trials:
            raise click.UsageError(f"{flag} is for blinded trials, not for episodes in simulation")
    if options.reset and options.reset_task:
        raise click.UsageError("--reset and --reset-task exclude each other")
    return trials


def _tell(out: Path, report: Report, *, events: bool, as_json: bool) -> None:
    """Print the report."""
    if events:
        emit(EVAL, ReportEvent(out=str(out), lines=tuple(report.lines())))
    elif as_json:
        echo(json.dumps(report.facts()))
    else:
        for line in report.lines():
            echo(line)
        echo(f"report: {out / 'report.html'}")


def _evaluated(evaluation: Evaluation, *, events: bool, quiet: bool) -> Report:
    """Run the missing episodes, and write the report."""
    with (_events if events else _lines)(evaluation, quiet) as watch:
        results = evaluation.run(watch)

    def filming(failures: int) -> None:
        if not (events or quiet):
            echo(f"filming {failures} failures", err=True)

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
def _events(evaluation: Evaluation, quiet: bool) -> Iterator[Watch]:
    """Yield a function that prints an event for each episode."""
    begin = time.monotonic()
    total = len(evaluation.options.seeds) * len(evaluation.policies)
    emit(EVAL, Begin(of=total, done=evaluation.resumed))

    def tell(done: int, total: int, policy: Policy, result: Result) -> None:
        event = Progress(
            done=done, of=total, policy=policy.label, seed=result.seed, success=result.success, time_s=result.time_s,
            error=result.error if result.is_error else "", seconds=round(time.monotonic() - begin, 1),
        )  # fmt: skip
        emit(EVAL, event)

    yield tell


@contextmanager
def _lines(evaluation: Evaluation, quiet: bool) -> Iterator[Watch]:
    """Yield a function that shows the progress: a bar on a terminal, otherwise one line per episode."""
    for damage in evaluation.damaged:
        echo(damage, err=True)
    if evaluation.resumed and not quiet:
        echo(f"continuing: {evaluation.resumed} episodes are done already", err=True)
    if not sys.stderr.isatty():

        def line(done: int, total: int, policy: Policy, result: Result) -> None:
            if not quiet:
                outcome = outcome_of(result.success, result.error)
                echo(f"{policy.label}, seed {result.seed}: {outcome} ({done} of {total})", err=True)

        yield line
        return
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    from ibrobot_core.app import Screen

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
                f"{label} {won} of {ran}{f' ({errors} errors)' if errors else ''}"
                for label, (won, ran, errors) in counts.items()
            )
            bar.update(
                task, description=f"{done} of {total} episodes", completed=done, total=total, successes=successes
            )

        yield move
