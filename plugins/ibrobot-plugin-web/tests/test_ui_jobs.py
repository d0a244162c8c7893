"""Forms and events of commands on the page of `ibrobot ui`, with a command that no plugin has."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, override

import attrs
import pytest
from ibrobot_provenance.asking import Ask
from ibrobot_provenance.processes import Jobs, arguments
from ibrobot_testing.command import command_line
from ibrobot_web.ui import forms, jobs
from ibrobot_web.ui.context import Ui
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.forms import form_of, in_page_words, read_form
from ibrobot_web.ui.jobs import answer, event_reader, sight, start

from ibrobot_core.api import IbrobotError, MissingDependency, option
from ibrobot_core.app import Command, Event, Registry, Shown
from ibrobot_core.events import encode_event


@attrs.frozen(kw_only=True)
class Brew:
    """An option of each sort."""

    water: Path = option(typed="WATER", label="Water", help="where it is")
    beans: tuple[Path, ...] = option((), names="episodes", help="which")
    heat: float = option(95.0, ge=0, le=100, unit="degC", label="Heat", help="how hot")
    cups: int | None = option(None, ge=1, help="how many")
    roast: str = option("dark", choices={"dark": "dark and bitter", "light": "light"}, help="which roast")
    flavour: tuple[str, ...] = option((), choices=("nut", "berry"), help="what it tastes of")
    milk: bool = option(False, label="With milk", more=True, help="whether to add some")
    machine: tuple[str, ...] = option((), names="robot", more=True, help="which machines")
    grinder: str = option("auto", label=None, help="for experts")


@attrs.frozen(kw_only=True)
class Poured(Event):
    """A cup is full."""

    cups: int = option(help="cups so far")
    of: int = option(help="cups in all")
    spilt: str = option("", help="what went wrong")
    pot: str = option("", help="the pot, at the end")

    @override
    def shown(self) -> Shown:
        made = {"dataset": self.pot} if self.pot else {}
        return Shown(f"{self.cups} cups", self.cups / self.of, self.spilt, {"cup": self.cups, "ml": 2.5}, made)


BREW = Command("brew", Brew, "Brew coffee.", (Poured,))


@pytest.fixture
def ui(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ui:
    registry = Registry(commands={"brew": BREW}, command_packages={"brew": "coffee"})
    monkeypatch.setattr(forms, "installed_plugins", lambda: registry)
    return Ui(Folders([tmp_path]), Jobs(tmp_path))


def test_a_form_has_all_that_its_owner_declares(ui: Ui) -> None:
    form = form_of(ui, "brew")
    fields = {field["name"]: field for field in form["fields"]}
    assert (form["title"], form["summary"], form["missing"]) == ("Brew", "Brew coffee.", "")
    assert list(fields) == ["water", "beans", "heat", "cups", "roast", "flavour", "milk", "machine"], (
        "not those for terminals"
    )
    assert fields["heat"] == {
        "name": "heat", "label": "Heat", "help": "how hot", "unit": "degC", "kind": "number", "several": False,
        "required": False, "default": 95.0, "choices": [], "open": False, "min": 0, "max": 100, "more": False,
        "names": "", "suggest": "",
    }  # fmt: skip
    assert fields["roast"]["choices"] == [["dark", "dark and bitter"], ["light", "light"]]
    assert (fields["cups"]["kind"], fields["cups"]["label"]) == ("whole", "Cups")
    assert (fields["flavour"]["several"], fields["milk"]["kind"], fields["milk"]["more"]) == (True, "flag", True)
    assert (form["known"]["episodes"], set(form["known"])) == ([], {"episodes", "robot"})
    assert {"value": "so101", "text": "so101"} in form["known"]["robot"]


def test_values_of_a_form_become_arguments_that_give_the_same_options(
    ui: Ui, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = {"water": "well", "cups": 2, "roast": "light", "flavour": ["nut", "berry"], "milk": True, "heat": 90.5}
    found = read_form(ui, BREW, values)
    assert found == Brew(water=tmp_path / "well", cups=2, roast="light", flavour=("nut", "berry"), milk=True, heat=90.5)
    words = arguments(found)
    assert words == [
        "--heat=90.5",
        "--cups=2",
        "--roast=light",
        "--flavour=nut",
        "--flavour=berry",
        "--milk",
        "--",
        str(tmp_path / "well"),
    ]
    seen: list[Any] = []
    monkeypatch.setattr(Brew, "__call__", lambda self: seen.extend([self]), raising=False)
    command_line(attrs.evolve(BREW, events=())).main(words, standalone_mode=False)
    assert seen == [found]


def test_empty_fields_leave_the_choice_to_the_command(ui: Ui, tmp_path: Path) -> None:
    assert read_form(ui, BREW, {"water": "a", "cups": "", "heat": None}) == Brew(water=tmp_path / "a")


@attrs.frozen(kw_only=True)
class Deliver:
    """Options of a command that runs a robot."""

    robot: str = option(typed="ROBOT", names="robot", help="who brings it")
    viewer: str | None = option(None, typed="--viewer TYPE", names="viewer", label=None, help="what shows the robot")


def test_a_command_that_may_run_a_robot_shows_it_on_a_page(ui: Ui, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page can stop it; others get no options of runs, which they do not know."""
    commands = {"brew": BREW, "deliver": Command("deliver", Deliver, "Bring coffee.", (Poured,))}
    registry = Registry(commands=commands, command_packages=dict.fromkeys(commands, "coffee"))
    for module in (forms, jobs):
        monkeypatch.setattr(module, "installed_plugins", lambda: registry)
    started: list[tuple[Any, ...]] = []

    def note(self: Jobs, kind: str, title: str, words: Any, *, read: Any, asks: bool) -> Any:
        started.append(
            (title, words, read(encode_event(Poured(cups=1, of=2))), read("viewer: http://127.0.0.1:5/#token"))
        )
        return SimpleNamespace(number=len(started))

    monkeypatch.setattr(Jobs, "start", note)
    page = attrs.evolve(ui, run_options=("--web", "--set", "viewer.port=0"))
    assert [start(page, name, values)["number"] for name, values in VALUES.items()] == [1, 2]
    (brew, deliver) = started
    assert brew[:2] == ("Brew well", ["brew", "--events", "--", str(ui.folders.first / "well")])
    assert deliver[:2] == ("Deliver so101", ["deliver", "--events", *page.run_options, "--", "so101"])
    assert deliver[2]["text"] == "1 cups"
    assert deliver[3] == {"url": "http://127.0.0.1:5/#token", "watch_url": None}


VALUES = {"brew": {"water": "well"}, "deliver": {"robot": "so101"}}


@pytest.mark.parametrize(
    ("values", "error"),
    [
        ({}, "^Water: required key is missing$"),
        ({"water": "../x"}, "outside the opened folders"),
        ({"water": "a", "machine": ["so101", "../x.yaml"]}, "outside the opened folders"),
        ({"water": "a", "heat": 101}, "^Heat: 101.0 is too large, must be at most 100 degC$"),
        ({"water": "a", "grinder": "b"}, "has no field grinder"),
    ],
)
def test_wrong_values_are_named_by_their_labels(ui: Ui, values: Any, error: str) -> None:
    with pytest.raises(IbrobotError, match=error):
        read_form(ui, BREW, values)


def test_what_a_command_lacks_is_said_in_its_form(ui: Ui, monkeypatch: pytest.MonkeyPatch) -> None:
    def lacks() -> None:
        raise MissingDependency("there is no water", remedy="open the tap")

    dry = Registry(commands={"brew": attrs.evolve(BREW, check=lacks)}, command_packages={"brew": "coffee"})
    monkeypatch.setattr(forms, "installed_plugins", lambda: dry)
    assert form_of(ui, "brew")["missing"] == "there is no water; open the tap"


def test_events_become_facts_in_the_words_of_their_owner(ui: Ui, tmp_path: Path) -> None:
    read = event_reader(ui.folders, BREW)
    assert read("grinding") is None
    facts = dict(read(encode_event(Poured(cups=1, of=2, spilt=f"{tmp_path}/cup: --milk helps"))) or {})
    facts |= read(encode_event(Poured(cups=2, of=2, pot="pot"))) or {}
    assert facts == {
        "text": "2 cups",
        "progress": 1.0,
        "problems": ["cup: “With milk” helps"],
        "axes": ["cup", "ml"],
        "points": [[1, 2.5], [2, 2.5]],
        "made": [{"kind": "dataset", "path": "pot"}],
    }


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ('{"event": "poured", "cups": 1}', "of: required key is missing"),
        ('{"event": "poured", "cups": 1, "of": 2, "sugar": 3}', "sugar: unknown key"),
        ('{"event": "drunk"}', "unknown event 'drunk'; declared: poured, failed"),
    ],
)
def test_an_event_of_another_shape_is_an_error_of_the_job(ui: Ui, line: str, error: str) -> None:
    facts = event_reader(ui.folders, BREW)(line) or {}
    assert error in facts["error"]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("--milk adds some", "“With milk” adds some"),
        ("--roast light is milder, --heat 3 is not", "“Roast: light” is milder, “Heat” 3 is not"),
        ("see --policy.path=x, --other and --milk-foam", "see --policy.path=x, --other and --milk-foam"),
        ("run `ibrobot brew --milk` first", "run “Brew” first"),
        ("run `ibrobot paint`", "run `ibrobot paint`"),
    ],
)
def test_errors_have_labels_in_place_of_flags_and_commands(ui: Ui, text: str, shown: str) -> None:
    assert in_page_words(text, BREW) == shown


class Asking:
    """A page's server whose job asks two questions, and says what was answered."""

    PROGRAM = """
import json, sys
from ibrobot_core.events import encode_event
from ibrobot_provenance.asking import Ask, Choice, Sight
sight = Sight(camera="top", wanted="a.jpg", live="../b.jpg")
yes_or_no = (Choice(key="y", text="yes"), Choice(key="n", text="no"))
for number, text, choices in ((1, "go on?", yes_or_no), (2, "why?", ())):
    print(encode_event(Ask(ask=number, text=text, choices=choices, sights=(sight,))), flush=True)
    given = {}
    while given.get("ask") != number:
        given = json.loads(sys.stdin.readline() or sys.exit("nobody can answer: standard input has ended"))
    print("answered:", given["answer"], flush=True)
"""

    def __init__(self, folder: Path) -> None:
        command = Command("brew", Brew, "Brew coffee.", (Poured, Ask))
        self.ui = Ui(Folders([folder]), Jobs(folder))
        self.job = self.ui.jobs.start(
            "brew",
            "Brew",
            ["-c", self.PROGRAM],
            program=(sys.executable,),
            asks=True,
            read=event_reader(self.ui.folders, command),
        )
        (folder / "a.jpg").write_bytes(b"picture")
        (folder.parent / "b.jpg").write_bytes(b"secret")

    def until(self, met: Callable[[], bool]) -> None:
        changed = threading.Event()
        self.ui.jobs.listeners.add(changed.set)
        while not met():
            assert changed.wait(60), self.job.lines
            changed.clear()


@pytest.fixture
def asking(tmp_path: Path) -> Iterator[Asking]:
    folder = tmp_path / "opened"
    folder.mkdir()
    found = Asking(folder)
    yield found
    found.ui.close()


def test_a_job_asks_and_is_answered(asking: Asking) -> None:
    ui, job = asking.ui, asking.job
    asking.until(lambda: job.facts.get("ask") is not None)
    assert job.json()["facts"]["ask"] == {
        "ask": 1,
        "text": "go on?",
        "choices": ({"key": "y", "text": "yes", "urgent": False}, {"key": "n", "text": "no", "urgent": False}),
        "sights": ({"camera": "top", "wanted": "a.jpg", "live": "../b.jpg"},),
    }
    with pytest.raises(IbrobotError, match="'x' is no answer; the answers are: y, n"):
        answer(ui, number=job.number, ask=1, answer="x")
    with pytest.raises(IbrobotError, match="was answered already"):
        answer(ui, number=job.number, ask=2, answer="y")
    answer(ui, number=job.number, ask=1, answer="y")
    with pytest.raises(IbrobotError, match="was answered already"):
        answer(ui, number=job.number, ask=1, answer="n")
    asking.until(lambda: (job.facts.get("ask") or {}).get("ask") == 2)
    answer(ui, number=job.number, ask=2, answer='so\nthat, "it" ends')
    asking.until(lambda: job.state == "done")
    assert list(job.lines) == ["answered: y", "answered: so", 'that, "it" ends']
    assert "ask" not in job.facts
    with pytest.raises(IbrobotError, match="was answered already"):
        answer(ui, number=job.number, ask=2, answer="late")


def test_pictures_of_questions_are_those_in_the_opened_folders(asking: Asking) -> None:
    asking.until(lambda: asking.job.facts.get("ask") is not None)
    ask = {"number": asking.job.number, "ask": 1}
    assert sight(asking.ui, **ask, sight=0, which="wanted").content == b"picture"
    with pytest.raises(IbrobotError, match="outside the opened folders"):
        sight(asking.ui, **ask, sight=0, which="live")
    for wrong in ({**ask, "sight": 1}, {**ask, "ask": 2, "sight": 0}):
        with pytest.raises(IbrobotError, match="no such picture"):
            sight(asking.ui, **wrong, which="wanted")


def test_a_job_that_asks_ends_with_the_page_s_server(asking: Asking) -> None:
    asking.until(lambda: asking.job.facts.get("ask") is not None)
    assert asking.job.process.stdin is not None
    asking.job.process.stdin.close()  # as when the server is killed
    asking.until(lambda: asking.job.state == "failed")
    assert "nobody can answer: standard input has ended" in asking.job.lines[-1]
