"""Commands whose options and events are declared: their command line, errors and events derive from that."""

from __future__ import annotations

import json
from pathlib import Path
from typing import ClassVar

import attrs
import pytest
from click.testing import CliRunner, Result
from plugins.counting import COUNT, Count, Counted

from ibrobot_core.api import option
from ibrobot_core.app import Command, Emit, Event, Failed, Shown
from ibrobot_core.cli.declared import click_command
from ibrobot_core.errors import ConfigError, IbrobotError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "a.txt").write_text("text")
    (tmp_path / "b.bin").write_bytes(bytes(10))
    return tmp_path


def run(*words: object) -> Result:
    return CliRunner().invoke(click_command(COUNT), [str(word) for word in words])


def error(*words: object) -> str:
    found = run(*words).exception
    assert isinstance(found, IbrobotError)
    assert found.exit_code == ConfigError.exit_code
    return str(found)


def test_help_has_choices_units_defaults_and_meaning() -> None:
    text = " ".join(run("--help").output.split())
    assert "count [OPTIONS] FOLDERS..." in text
    assert "--kind all|text Files to count (all: all files; text: texts). [default: all]" in text
    assert "--at-least BYTES Size from which they count. [default: 0]" in text
    assert "--events" in text


def test_the_function_gets_an_object_of_the_declared_class(folder: Path) -> None:
    assert run(folder).output == f"{folder} has 2 files\n"
    assert run(folder, "--kind", "text", folder, "--at-least=4").output == f"{folder} has 1 files\n" * 2


def test_errors_of_values_name_the_flag(folder: Path) -> None:
    assert error(folder, "--kind", "pictures") == "--kind: 'pictures' is not one of: all, text"
    assert error(folder, "--at-least=-1", "--kind=x") == (
        "--kind: 'x' is not one of: all, text; --at-least: -1 is too small, must be at least 0 bytes"
    )


def test_the_result_is_shown_or_printed_as_json(folder: Path, tmp_path: Path) -> None:
    assert json.loads(run(folder, "--json").output) == [{"folder": str(folder), "files": 2}]
    assert "--json" not in CliRunner().invoke(click_command(Command("every", Every)), ["--help"]).output


@pytest.mark.parametrize("words", [(), ("--json",)])
def test_a_result_that_is_not_good_is_printed_before_the_exit_code(folder: Path, words: tuple[str, ...]) -> None:
    result = run(folder, "--at-least=100", *words)
    assert result.exit_code == 1
    assert str(folder) in result.output


def test_events_are_lines_of_their_classes(folder: Path) -> None:
    (line,) = run(folder, "--events").output.splitlines()
    assert json.loads(line) == {"event": "counted", "folder": str(folder), "files": 2}


def test_with_events_an_error_is_an_event_too(folder: Path) -> None:
    result = run(folder / "none", "--events")
    assert result.exit_code == 1
    reason = f"{folder / 'none'}: is no folder; leave it out, or choose --kind text"
    assert json.loads(result.output) == {"event": "failed", "error": reason}
    assert json.loads(run(folder, "--kind=x", "--events").output)["error"].startswith("--kind: ")


@attrs.frozen
class Undeclared(Event):
    """Not among the events of `count`."""

    def shown(self) -> Shown:
        return Shown()


def test_an_undeclared_event_is_a_bug() -> None:
    @attrs.frozen
    class Shouting:
        """Print an event."""

        def __call__(self, emit: Emit) -> None:
            assert emit is not None
            emit(Undeclared())

    command = click_command(Command("shout", Shouting, events=(Counted,)))
    with pytest.raises(TypeError, match="ibrobot shout does not declare the event Undeclared"):
        CliRunner().invoke(command, ["--events"], catch_exceptions=False)


@attrs.frozen(kw_only=True)
class Every:
    """An option of each sort."""

    config: Path = option(typed="CONFIG", help="a file")
    length_s: float | None = option(None, unit="s", help="a time")
    tags: tuple[str, ...] = option(("a",), choices=("a", "b"), help="tags")
    device: str = option("auto", choices=("auto", "cpu"), open=True, help="a device")
    sure: bool = option(False, help="whether")
    rate: float | None = option(None, typed="-r --rate [HZ=40]", gt=0, help="a value that may be left out")
    pairs: tuple[tuple[int, int], ...] = option((), typed="--pair ID BITS", help="two numbers each")
    seen: ClassVar[list[Every]] = []

    def __call__(self) -> None:
        self.seen.append(self)


def every(*words: str) -> Every:
    seen = Every.seen
    seen.clear()
    result = CliRunner().invoke(click_command(Command("every", Every)), list(words))
    if result.exception is not None:
        raise result.exception
    (found,) = seen
    return found


def test_every_sort_of_option_is_read() -> None:
    assert every("x") == Every(config=Path("x"))
    assert every("x", "--length-s", "2", "--tags=b", "--tags=a", "--device=cuda:1", "--sure") == Every(
        config=Path("x"), length_s=2.0, tags=("b", "a"), device="cuda:1", sure=True
    )
    assert every("x", "-r").rate == 40.0
    assert every("x", "--rate", "2").rate == 2.0
    assert every("--pair", "1", "2", "--pair", "3", "4", "x").pairs == ((1, 2), (3, 4))
    with pytest.raises(IbrobotError, match="--tags: 'c' is not one of: a, b"):
        every("x", "--tags=c")


def test_the_classes_describe_themselves() -> None:
    assert COUNT.options is Count
    assert all(field.metadata["help"] for kind in (Count, Counted, Failed) for field in attrs.fields(kind))
