"""`ibrobot explain`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs
from ibrobot_provenance.jobs import Job, open_pool
from ibrobot_terminal.plural import counted

from ibrobot_core.app import Emit, RequestError, Unsuccessful, echo, wrong_input
from ibrobot_diagnose.options import ExplainOptions, Progress, Report
from ibrobot_diagnose.references import card_of, find_episodes, read_episode

if TYPE_CHECKING:
    from ibrobot_diagnose.card import Card


@attrs.frozen(kw_only=True)
class Explain(ExplainOptions):
    """Say why a recorded run of a policy failed.

    The first line of each explanation is the most probable cause, with its number. Its evidence and what to do about
    it follow, then the other causes in their order, what happened between the model's answers and the arm, and what
    was tested and found healthy.
    """

    @wrong_input()
    def __call__(self, emit: Emit) -> list[dict[str, Any]] | None:
        episodes = find_episodes(self.episodes)
        if self.data is not None and self.against is not None:
            raise RequestError("--data and --against exclude each other: a run is compared with one of them")
        if self.server is not None and self.model is None:
            raise RequestError("--server needs --model: `--model .` is the one that acted")
        data = self.data or self.against
        card = card_of(data) if data is not None else None
        results: dict[Path, dict[str, Any]] = {}
        failed = []
        for number, (episode, result, error) in enumerate(_explained(self, episodes, card), 1):
            if error:
                failed.append(error)
                echo(error, err=True)
            else:
                results[episode] = result
            if emit is not None:
                first = str(result.get("first", ""))
                emit(Progress(done=number, of=len(episodes), episode=str(episode), first=first, error=error))
        listed = [results[each] for each in episodes if each in results]
        if failed:
            raise Unsuccessful(None if emit is not None else listed)
        if emit is not None:
            emit(Report(out=str(self.out or ""), lines=tuple(f"{each['episode']}: {each['first']}" for each in listed)))
            return None
        return listed

    def show(self, listed: list[dict[str, Any]]) -> None:
        """Print the explanations."""
        for number, each in enumerate(listed):
            if len(listed) > 1:
                echo(f"{'' if not number else chr(10)}{each['episode']} ({each['outcome']})")
            for line in each["lines"]:
                echo(line)
        if self.out is not None:
            echo(f"report: {self.out / 'report.html' if len(listed) == 1 else self.out}")


def _explained(
    options: ExplainOptions, episodes: Sequence[Path], card: Card | None
) -> Iterator[tuple[Path, dict[str, Any], str]]:
    """Each episode with its explanation, or why there is none; a single one that cannot be explained is an error."""
    if len(episodes) == 1 and not options.on:
        yield episodes[0], explain_episode((episodes[0], options, card)), ""
        return
    work = [Job(explain_episode, (episode, options, card)) for episode in episodes]
    with closing(open_pool(options.on, options.jobs)) as pool, closing(pool.run(work)) as finished:
        for done in finished:
            episode = done.job.argument[0]
            yield episode, {} if done.error else done.result(), str(done.error or "")


def explain_episode(
    order: tuple[Path, ExplainOptions, Card | None], progress: Callable[[int], None] = lambda more: None
) -> dict[str, Any]:
    """Explain an episode; its facts and lines.

    Raises:
        IbrobotError: if it cannot be read, or the model cannot be asked.
    """
    from ibrobot_diagnose.cause import Reference
    from ibrobot_diagnose.diagnosis import diagnose
    from ibrobot_diagnose.report import Explanation

    episode, options, card = order
    window = read_episode(episode)
    examined = None
    if options.model is not None:
        from ibrobot_diagnose.ask_again import examine, model_of

        examined = examine(
            model_of(window, episode, "" if options.model == "." else options.model, options.server or "")
        )
    reference = Reference(card, examined)
    explanation = Explanation.of(window, reference, diagnose(window, reference, tested=lambda name: progress(1)))
    if options.out is not None:
        from ibrobot_diagnose.contents import write_report

        write_report(folder_of(options, episode), explanation, episode)
    lines = explanation.lines()
    if card is not None and options.against is not None:
        runs = counted(card.episodes, "run")
        lines.append(f"“The data” stands here for what it is compared with: {runs} of {options.against}.")
    return {**explanation.facts(ticks=options.ticks), "lines": lines}


def folder_of(options: ExplainOptions, episode: Path) -> Path:
    """The folder of an episode's report: `out`, or one below it if there are several episodes."""
    assert options.out is not None
    if find_episodes(options.episodes) == [episode]:
        return options.out
    dataset = episode.parents[1].name if episode.parent.name == "episodes" else episode.parent.name
    return options.out / f"{dataset}-{episode.name.replace(':', '-')}"
