"""Work that packages offer, as services of a run: a command that no plugin has, in a process."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast, override

import attrs
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_mcp import work
from ibrobot_mcp.work import Places, WorkResult, WorkServices, report_lines
from ibrobot_provenance.reports import Case, Cases, Plots, ReportDescriptor, ReportSection, Table, Text
from ibrobot_provenance.work import Work, Workplace, some_options
from ibrobot_terminal.authority import Agent
from ibrobot_testing import make_session

from ibrobot_core.api import IbrobotError, Options, option
from ibrobot_core.app import Command, Event, Registry, RequestError, RunView, Session, Shown


@attrs.frozen(kw_only=True)
class Look:
    """Options of a command, of which callers state some."""

    things: tuple[Path, ...] = option((), help="what to look at")
    count: int = option(2, ge=1, le=9, help="how often")
    run: str = option("", help="a command, which callers must not state")
    out: Path = option(help="where to")


@attrs.frozen(kw_only=True)
class Looked(Event):
    """A look."""

    done: int = option(help="looks so far")
    out: str = option("", help="the result")

    @override
    def shown(self) -> Shown:
        return Shown(f"looked {self.done} times", self.done / 2, made={"looks": self.out} if self.out else {})


LOOKS = 'print(\'{"event": "looked", "done": 1}\', flush=True)\n'
ENDS = f"""
import sys; from pathlib import Path
out = Path(next(each for each in sys.argv if each.startswith('--out=')).removeprefix('--out='))
out.mkdir(parents=True); (out / 'found.txt').write_text(' '.join(sys.argv[1:]))
{LOOKS}print('{{"event": "looked", "done": 2, "out": "' + str(out) + '"}}')
"""
FAILS = f'{LOOKS}print(\'{{"event": "failed", "error": "it is too dark"}}\'); raise SystemExit(1)'
BREAKS = "print('Traceback'); raise SystemExit(3)"
WAITS = f"import sys; {LOOKS}sys.stdout.flush(); import threading; threading.Event().wait()"


def _made(wanted: Any, place: Workplace) -> Look:
    if "missing" in [each.name for each in wanted.things]:
        raise ValueError("things: there is no missing")
    return Look(out=place.out, **attrs.asdict(wanted, recurse=False))


def _contents(folder: Path) -> list[ReportSection]:
    case = Case("episode 3", "it fell", None, command="ibrobot look 3")
    blocks = (
        Text((folder / "found.txt").read_text()), Table(("a", "b"), (("1", "2"),)), Plots(("<svg/>",)), Cases((case,)),
    )  # fmt: skip
    return [ReportSection("Looks", blocks)]


REPORT = ReportDescriptor(
    "looks", summary="looks", reads=lambda folder: True, lines=lambda folder: ("ok",), make=_contents
)


class Rig:
    """A run that offers work."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, keeps: str, program: str) -> None:
        options = some_options(Look, "things", "count")
        offered = attrs.evolve(REPORT, command="look", work=Work("stare", "Look at things.", options, _made, keeps))
        registry = Registry(commands={"look": Command("look", Look, "Look.", (Looked,))})
        monkeypatch.setattr(work, "installed_plugins", lambda: registry)
        monkeypatch.setattr(work, "kinds_of_reports", lambda: {"looks": offered})
        monkeypatch.setattr(work, "states_folder", lambda: folder / "states")
        monkeypatch.setattr(work, "_IDLE", (sys.executable, "-c", program))
        self.session: Session = make_session()
        self.services = WorkServices(cast("RunView", self.session))
        self.call = self.session.bus.call

    def ended(self) -> WorkResult:
        for thread in [each for each in threading.enumerate() if each.name.startswith("job ")]:
            thread.join(30)
        outcome = self.call("/stare/result", 1)
        assert isinstance(outcome, WorkResult)
        return outcome


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[Rig]:
    keeps, program = getattr(request, "param", ("", ENDS))
    made = Rig(tmp_path, monkeypatch, keeps, program)
    yield made
    made.services.close()
    assert not [name for name in made.session.bus.services() if name.startswith("/stare")]
    assert not made.services._scratch.exists()


def with_work(keeps: str, program: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("rig", [(keeps, program)], indirect=True, ids=["work"])


def test_a_result_has_the_report_and_nothing_is_kept(rig: Rig) -> None:
    assert rig.call("/stare", {"count": 5}) == 1
    outcome = rig.ended()
    assert (outcome.success, outcome.lines, outcome.folder) == (True, ("looked 2 times",), "")
    assert outcome.report[0] == "# Looks"
    assert "look --events --count=5 --out=" in outcome.report[1]
    assert outcome.report[2:] == ("a | b", "1 | 2", "episode 3: it fell: ibrobot look 3")
    assert not (rig.services._scratch / "results").exists()
    assert rig.call("/stare/result", 1) == outcome, "it may be asked for again"


@with_work("looks", ENDS)
def test_results_that_are_kept_are_in_folders_of_their_own(rig: Rig, tmp_path: Path) -> None:
    rig.call("/stare", {})
    first = tmp_path / "states" / "looks" / f"{rig.session.config.robot.name}-1"
    assert rig.ended().folder == str(first)
    assert (first / "found.txt").is_file()
    assert rig.services._places.new("looks").name.endswith("-2")
    assert rig.services._places.find(f"looks/{first.name}") == first, "other work may read it"


def test_only_what_is_kept_needs_a_grant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for keeps, reads in (("", True), ("looks", False)):
        rig = Rig(tmp_path, monkeypatch, keeps, ENDS)
        services = rig.session.bus.services()
        assert services["/stare"].reads is reads
        assert services["/stare/cancel"].urgent
        assert not any(services[f"/stare{part}"].persons for part in ("", "/result", "/progress", "/cancel"))
        rig.services.close()


@with_work("", WAITS)
def test_one_works_at_a_time_until_it_is_cancelled(rig: Rig) -> None:
    number = rig.call("/stare", {})
    with pytest.raises(RequestError, match="/stare: stare works already, see /stare/progress"):
        rig.call("/stare", {})
    assert rig.call("/stare/result", number) is None
    assert rig.call("/stare/progress", None).running
    rig.call("/stare/cancel", None)
    rig.call("/stare/cancel", None)  # the process may not have begun to take signals
    assert rig.ended() == WorkResult(False, ("cancelled",), "")
    assert not rig.call("/stare/progress", None).running
    rig.call("/stare/cancel", None)


@with_work("", FAILS)
def test_a_failure_says_why(rig: Rig) -> None:
    rig.call("/stare", {})
    assert rig.ended() == WorkResult(False, ("it is too dark",), "")


@with_work("", BREAKS)
def test_a_process_that_breaks_shows_its_last_lines(rig: Rig) -> None:
    rig.call("/stare", {})
    assert rig.ended() == WorkResult(False, ("ended with exit code 3", "Traceback"), "")


@pytest.mark.parametrize(
    ("request_", "why"),
    [
        ({"run": "rm -rf ~"}, "run: unknown key"),
        ({"out": "/tmp/x"}, "out: unknown key"),
        ({"count": 10}, "count: 10 is too large, must be at most 9"),
        ({"things": ["/etc/passwd"]}, "things.0: '/etc/passwd' is no recording, dataset or result of this run"),
        ({"things": "x"}, "things: expected a list"),
    ],
)
def test_wrong_requests_start_nothing(rig: Rig, request_: Any, why: str) -> None:
    with pytest.raises(RequestError) as caught:
        rig.call("/stare", request_)
    assert why in str(caught.value)
    assert not rig.services._jobs.all()


def test_unknown_numbers_are_refused(rig: Rig) -> None:
    with pytest.raises(RequestError, match=r"there is no stare 7; these are known: none"):
        rig.call("/stare/result", 7)


def places_in(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Places:
    """Those of a run that records into `episodes/pick`, beside files that are nobody's business."""
    for name in ("episodes/pick/episodes/episode_000001", "evaluations/a", "private"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / "private" / "key").write_text("secret")
    (folder / "episodes" / "out").symlink_to(folder / "private")
    (folder / "episodes" / "round").symlink_to("round")
    monkeypatch.setattr(work, "kinds_of_work", lambda: [(SimpleNamespace(keeps="evaluations"), "")])
    recording = SimpleNamespace(root=str(folder / "episodes"), dataset="pick")
    return Places(cast("RunView", SimpleNamespace(config=SimpleNamespace(recording=recording))))


def test_recordings_are_named_in_several_ways(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    places = places_in(tmp_path, monkeypatch)
    episode = tmp_path / "episodes" / "pick" / "episodes" / "episode_000001"
    for text in (
        "episode_000001",
        "pick:1",
        str(episode),
        "pick/episodes/episode_000001",
        "episodes/pick/episodes/episode_000001",
    ):
        assert places.find(text) == episode, text
    assert places.find("evaluations/a") == tmp_path / "evaluations" / "a"


@pytest.mark.parametrize(
    "text",
    [
        "/", "~", "private", "../private", "../private/key", "out", "out/key", "episodes/out/key", "/etc/passwd",
        "evaluations/../private", "pick/../../private", "pick/episodes/../../out/key", "x" * 900, "a/" * 400,
        "nothing:1", "private:1", "/proc/self/environ", "$HOME", "evaluations/b", "round", "round/pick", "round:1",
    ],
)  # fmt: skip
def test_other_files_are_out_of_reach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    places = places_in(tmp_path, monkeypatch)
    with pytest.raises(ValueError, match="is no recording, dataset or result of this run"):
        print(places.find(text))


def test_no_text_leads_out_of_the_folders(tmp_path: Path) -> None:
    parts = st.sampled_from(
        ["..", ".", "pick", "episodes", "out", "private", "key", "evaluations", "a", "", "pick:1", "~"]
    )

    with pytest.MonkeyPatch.context() as monkeypatch:
        places = places_in(tmp_path, monkeypatch)

        @given(st.lists(parts | st.text(max_size=5), max_size=6), st.booleans())
        def never_outside(words: list[str], absolute: bool) -> None:
            text = "/".join(words)
            try:
                outcome = places.find(f"{tmp_path}/{text}" if absolute else text)
            except ValueError:
                return
            assert any(outcome.is_relative_to(tmp_path / top) for top in ("episodes", "evaluations"))
            assert "private" not in outcome.parts[len(tmp_path.parts) :]

        never_outside()


def test_options_are_those_of_the_command() -> None:
    some = some_options(Look, "count")
    assert issubclass(some, Options)
    assert [each.alias for each in attrs.fields(some)] == ["count"]
    make: Callable[..., Options] = some
    with pytest.raises(ValueError, match="too large"):
        make(count=10)


def test_a_report_that_cannot_be_read_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(folder: Path) -> list[ReportSection]:
        raise IbrobotError("report.json is damaged")

    monkeypatch.setattr(work, "kinds_of_reports", lambda: {"looks": attrs.evolve(REPORT, make=broken)})
    assert report_lines("looks", Path("x")) == ["report.json is damaged"]
    assert report_lines("unknown", Path("x")) == []


@with_work("", WAITS)
@pytest.mark.parametrize("of_agent", [False, True])
def test_an_agent_ends_only_work_that_an_agent_has_begun(rig: Rig, of_agent: bool) -> None:
    """The same holds for the end of its authority, which cancels as the agent."""
    acting = rig.session.authority.acting

    def as_agent(name: str) -> None:
        token = acting.set(Agent("1:claude", 0))
        try:
            rig.call(name)
        finally:
            acting.reset(token)

    as_agent("/stare") if of_agent else rig.call("/stare")
    if not of_agent:
        with pytest.raises(RequestError, match="/stare/cancel: a person began it: ask a person to end it"):
            as_agent("/stare/cancel")
        assert rig.call("/stare/progress").running
        rig.call("/stare/cancel")
    else:
        as_agent("/stare/cancel")
    assert rig.ended().lines[0] == "cancelled"


@pytest.mark.parametrize("kind", ["device", "pipe", "huge"])
def test_results_that_would_fill_the_memory_are_not_read(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(work, "kinds_of_reports", lambda: {"looks": REPORT})
    path = tmp_path / "evaluation.json"
    if kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        with path.open("wb") as file:
            file.truncate(1 << 40)
    assert report_lines("looks", tmp_path) == [f"{path}: is not a file of at most 32 MiB"]
