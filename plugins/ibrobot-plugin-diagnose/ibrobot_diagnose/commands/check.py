"""`ibrobot datasets check`: each episode of a dataset, compared with the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from ibrobot_provenance.jobs import Job, open_pool
from ibrobot_terminal.plural import counted

from ibrobot_core.api import DatasetError, RecorderError
from ibrobot_core.app import Emit, Unsuccessful, echo, wrong_input
from ibrobot_diagnose.card import Card, Maker
from ibrobot_diagnose.cause import Reference
from ibrobot_diagnose.diagnosis import diagnose
from ibrobot_diagnose.options import CheckOptions, CheckProgress, CheckReport
from ibrobot_diagnose.pictures import Shown
from ibrobot_diagnose.references import find_episodes, read_episode
from ibrobot_diagnose.report import finding_facts
from ibrobot_diagnose.window import Window

_PARTS = 5
"""The episodes of a part are compared with the ones of the other parts."""
_ENOUGH = 5
"""So many episodes show what is usual among them."""
_MOST = 4
"""Pictures of an episode in the report."""


@attrs.frozen(kw_only=True)
class CheckDataset(CheckOptions):
    """Check each episode of a DATASET, and list the ones to look at, worst first.

    Each episode is compared with the others: idle beginnings and ends, stalls, jerk, cut-off joints, pictures that are
    black, frozen, dark or blurred, a camera that moved, commands that the arm does not follow, a gripper that never
    acts, odd lengths and ways, starts and tasks that no other has, copies, and episodes that nobody judged. The same
    causes explain runs, see `ibrobot explain`.
    """

    @wrong_input()
    def __call__(self, emit: Emit) -> dict[str, Any] | None:
        episodes = find_episodes([self.dataset])
        if len(episodes) < 2:
            raise DatasetError(f"{self.dataset}: episodes: {len(episodes)}; at least 2 are needed to compare them")
        checked, shown = _checked(self, episodes, emit)
        if self.out is not None:
            from ibrobot_diagnose.check_contents import write_check

            write_check(self.out, checked, lines_of(checked), shown)
        if emit is not None:
            emit(CheckReport(out=str(self.out or ""), lines=tuple(lines_of(checked))))
            return None
        if checked["unreadable"]:
            for each in dict.fromkeys(checked["unreadable"]):  # of a dataset as a whole, it is the same for all
                echo(f"unreadable: {each}", err=True)
            raise Unsuccessful(checked)
        return checked

    def show(self, checked: dict[str, Any]) -> None:
        """Print the listed episodes."""
        for line in lines_of(checked):
            echo(line)
        if self.out is not None:
            echo(f"report: {self.out / 'report.html'}")


def _checked(
    options: CheckOptions, episodes: Sequence[Path], emit: Emit
) -> tuple[dict[str, Any], dict[str, list[Shown]]]:
    """Check the episodes: the facts of those with findings, worst first, and the pictures of each."""
    done, unreadable = 0, []

    def tell() -> None:
        nonlocal done
        done += 1
        if emit is not None:
            emit(CheckProgress(done=done, of=2 * len(episodes)))

    def run(jobs: Sequence[Job[Any]]) -> Iterator[tuple[Path, Any]]:
        with closing(open_pool(options.on, options.jobs)) as pool, closing(pool.run(jobs)) as finished:
            for each in finished:
                tell()
                if each.error is not None:
                    unreadable.append(str(each.error))
                else:
                    yield each.job.argument[0], each.result()

    makers = dict(run([Job(summarise, (episode,)) for episode in episodes]))
    readable = [episode for episode in episodes if episode in makers]
    parts = min(_PARTS, len(readable))
    cards = [_card([makers[each] for i, each in enumerate(readable) if i % parts != part]) for part in range(parts)]
    jobs = []
    for i, near in enumerate(nearest_earlier([makers[each] for each in readable])):
        ways = np.empty((0, 0)) if near is None else makers[readable[near]].ways[0]
        names = () if near is None else (readable[near].name,)
        jobs.append(Job(check_episode, (readable[i], attrs.evolve(cards[i % parts], ways=ways, way_names=names))))
    results = {episode: result for episode, result in run(jobs)}
    listed = []
    for episode in (each for each in readable if each in results):
        result = results[episode]
        causes = [each for each in result.causes if each["likelihood"] >= options.least]
        if causes:
            facts = {"outcome": result.outcome, "seconds": round(result.seconds, 3)}
            listed.append({"episode": str(episode), **facts, "causes": causes})
    listed.sort(key=lambda each: (-each["causes"][0]["likelihood"], -len(each["causes"]), each["episode"]))
    broken = Counter(each for result in results.values() for each in result.broken)
    counts = Counter(cause["name"] for each in listed for cause in each["causes"])
    checked = {
        "dataset": str(options.dataset), "episodes": len(episodes), "listed": listed,
        "counts": dict(counts.most_common()), "unreadable": unreadable,
        "untested": [{"name": name, "why": why, "episodes": count} for (name, why), count in broken.items()],
    }  # fmt: skip
    return checked, {each["episode"]: results[Path(each["episode"])].shown for each in listed}


def nearest_earlier(makers: Sequence[Maker]) -> list[int | None]:
    """The earlier episode whose way is nearest to that of each: of two copies, the later one is to be dropped.

    None for an episode that has no way, or before which there is none with as many joints.
    """
    rows = [each.ways[0] if each.ways else np.empty((1, 0)) for each in makers]
    numbers: dict[int, list[int]] = {}
    for number, row in enumerate(rows):
        numbers.setdefault(row.size, []).append(number)
    nearest: list[int | None] = [None] * len(rows)
    for size, alike in numbers.items():
        ways = np.concatenate([rows[number] for number in alike])
        for place in range(1, len(alike) if size else 0):
            far = np.abs(ways[:place] - ways[place]).max(axis=1)
            nearest[alike[place]] = alike[int(far.argmin())]
    return nearest


def _card(makers: Sequence[Maker]) -> Card:
    joined = Maker()
    for each in makers:
        joined.join(each)
    return joined.card()


def summarise(order: tuple[Path], progress: Callable[[int], None] = lambda more: None) -> Maker:
    """What the card needs of an episode.

    Raises:
        RecorderError: if it cannot be read.
    """
    maker = Maker()
    maker.add(read_episode(order[0]))
    return maker


@attrs.frozen
class Checked:
    """An episode that was checked."""

    outcome: str
    seconds: float
    causes: list[dict[str, Any]]
    """The facts of its findings, most probable first."""
    shown: list[Shown]
    """Pictures of the most probable one, or of the episode."""
    broken: tuple[tuple[str, str], ...]
    """Names of causes with a mistake, and which."""


def check_episode(order: tuple[Path, Card], progress: Callable[[int], None] = lambda more: None) -> Checked:
    """Compare an episode with the others.

    Raises:
        RecorderError: if it cannot be read.
    """
    episode, card = order
    window = attrs.evolve(read_episode(episode), teaches=True)
    if "state" not in window.streams:
        raise RecorderError(
            f"{episode}: nothing can be checked: it has {counted(len(window.state.times_ns), 'reading')} of joints"
        )
    diagnosis = diagnose(window, Reference(card))
    findings = diagnosis.findings
    shown = list(findings[0].evidence.pictures) if findings else []
    if findings and not shown:
        shown = list(_seen(window, findings[0].evidence.since_s or 0.0))
    facts = [{**finding_facts(each), "remedy": each.cause.to_do_with_episode()} for each in findings]
    return Checked(window.outcome, window.seconds, facts, shown[:_MOST], diagnosis.broken)


def _seen(window: Window, at_s: float) -> Iterator[Shown]:
    """What each camera saw at a time."""
    for camera in window.cameras.values():
        if camera.kept:
            near = min(camera.kept, key=lambda i: abs(window.since(camera.times_ns[i]) - at_s))
            yield Shown(f"{camera.name} at {window.since(camera.times_ns[near]):.1f} s", camera.kept[near])


def lines_of(checked: Mapping[str, Any]) -> list[str]:
    """A line for each listed episode, worst first, each cause with a mistake, and few episodes; at last the counts."""
    listed, of = checked["listed"], checked["episodes"] - len(checked["unreadable"])
    lacking = f"{len(checked['unreadable'])} of {counted(checked['episodes'], 'episode')} could not be read"
    untested = [
        f"Not tested{'' if each['episodes'] == of else f' in {each["episodes"]} of {counted(of, "episode")}'}: "
        f"{each['name']}, since {each['why']}."
        for each in checked["untested"]
    ]
    if not of:
        return [*untested, f"Nothing was checked: {lacking}."]
    rest = f"; {lacking}" if checked["unreadable"] else ""
    notes = untested
    if of < _ENOUGH:
        few = f"Only {counted(of, 'episode')} to compare: look at them yourself, and check again with more."
        notes = [*untested, few]
    if not listed:
        return [*notes, f"Nothing was found in {counted(of, 'episode')}{rest}."]
    lines = []
    for each in listed:
        first, *others = each["causes"]
        more = f" Also: {', '.join(other['name'] for other in others)}." if others else ""
        lines.append(f"{each['episode']}: {first['text']}{more}")
    names = ", ".join(f"{name} {count}" for name, count in checked["counts"].items())
    return [*lines, *notes, f"{len(listed)} of {counted(of, 'episode')} to look at: {names}{rest}"]
