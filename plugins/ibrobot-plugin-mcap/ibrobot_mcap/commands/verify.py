"""`ibrobot episodes verify`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import attrs
from ibrobot_provenance.jobs import Job, open_pool

from ibrobot_core.api import option
from ibrobot_core.app import Unsuccessful, echo, wrong_input


@attrs.frozen(kw_only=True)
class Verify:
    """Check every message of the episodes in PATH.

    Prints problems, one on each line, and exits with 1 if there are any.

    Problems are: unfinished episodes, messages that cannot be decoded, counts that differ from metadata.yaml, lost
    messages, topics of the contract without messages, header stamps that decrease, pauses in a topic longer than --gap
    times its median period, and different contracts within one dataset.
    """

    path: Path = option(typed="PATH", names="episodes", help="an episode, or a folder of them")
    gap: float = option(5.0, ge=1, help="longest pause, in periods")
    on: str = option("", typed="--on TYPE[://ADDRESS]", help="pool that checks the episodes, e.g. processes")
    jobs: int | None = option(None, ge=1, help="episodes at once; with --on by default one per core")

    @wrong_input()
    def __call__(self) -> None:
        from ibrobot_mcap.commands.find_episodes import episodes_in

        bad = 0
        contracts: dict[Path, tuple[str, Path]] = {}
        episodes = episodes_in(self.path)
        checks = (
            _in_pool(episodes, self.gap, self.on, self.jobs)
            if self.on or self.jobs
            else (check((each, self.gap)) for each in episodes)
        )
        for episode, (problems, fingerprint) in zip(episodes, checks, strict=True):
            first, where = contracts.setdefault(episode.parent, (fingerprint, episode))
            if fingerprint != first:
                problems.append(f"its contract is {fingerprint[:12]}, that of {where.name} is {first[:12]}")
            bad += bool(problems)
            echo(f"{episode}: {f'{len(problems)} problems' if len(problems) > 1 else ''.join(problems) or 'good'}")
            for problem in problems if len(problems) > 1 else ():
                echo(f"  {problem}")
        if bad:
            raise Unsuccessful


def check(order: tuple[Path, float], progress: Callable[[int], None] = lambda more: None) -> tuple[list[str], str]:
    """The problems of an episode, with the longest pause in periods, and the fingerprint of its contract."""
    from ibrobot_mcap.checks import problems_of
    from ibrobot_mcap.commands.find_episodes import summary_of

    episode, gap = order
    return problems_of(episode, gap), summary_of(episode).metadata.get("fingerprint", "")


def _in_pool(episodes: Sequence[Path], gap: float, on: str, jobs: int | None) -> Iterator[tuple[list[str], str]]:
    """The result of `check` for each episode, in their order."""
    early: dict[Path, tuple[list[str], str]] = {}
    work = (Job(check, (episode, gap)) for episode in episodes)
    with closing(open_pool(on, jobs)) as pool, closing(pool.run(work)) as finished:
        for episode in episodes:
            while episode not in early:
                done = next(finished)
                early[done.job.argument[0]] = done.result()
            yield early.pop(episode)
