"""Errors of the command line: one form, the exit codes of the reference, and no traceback unless asked for."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from ibrobot_testing import ibrobot_command

from ibrobot_core.bug_reports import DEBUG

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

    from tests.cli.conftest import Ran

Ibrobot = Callable[..., "Ran"]


@pytest.fixture
def bugs(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site.add("fake-bugs", "bugs.py")
    monkeypatch.delenv(DEBUG, raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("nothing",), 2, "No such command 'nothing'; see `ibrobot --help`"),
        (("config", "check", "a", "b"), 2, "Got unexpected extra argument (b); see `ibrobot config check --help`"),
        (("odd", "read"), 2, "Missing argument 'FILE'; see `ibrobot odd read --help`"),
        (("odd", "xyzzy"), 2, "No such command 'xyzzy'; see `ibrobot odd --help`"),
        (("confg",), 2, "No such command 'confg', did you mean 'config'?; see `ibrobot --help`"),
        (("odd", "read", "no.txt"), 2, "no.txt: No such file or directory"),
        (("odd", "ask"), 130, "stopped"),
    ],
)
def test_errors_have_one_form(
    ibrobot: Ibrobot, bugs: None, arguments: tuple[str, ...], code: int, message: str
) -> None:
    ran = ibrobot(*arguments)

    assert (ran.code, ran.out, ran.err) == (code, "", f"error: {message}\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("odd", "bug"), "ZeroDivisionError: integer division or modulo by zero"),
        (("broken",), "RuntimeError: cannot be loaded"),
    ],
)
def test_bug_is_one_line_that_names_the_file_with_the_traceback(
    ibrobot: Ibrobot, bugs: None, arguments: tuple[str, ...], message: str
) -> None:
    ran = ibrobot(*arguments)

    assert ran.code == 1
    [line] = ran.err.splitlines()
    assert line.startswith(f"error: {message} (a bug at site/fake_bugs.py:")
    log = Path(line.rpartition(" is in ")[2].rstrip(")")).read_text()
    assert log.startswith("Traceback")
    assert message in log


def test_debug_prints_the_traceback(ibrobot: Ibrobot, bugs: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DEBUG, "")  # so that it is put back
    ran = ibrobot("--debug", "odd", "bug")

    assert ran.code == 1
    assert ran.err.startswith("Traceback")
    assert ran.err.endswith("\nerror: ZeroDivisionError: integer division or modulo by zero\n")


def test_ascii_terminal_shows_what_it_can(bugs: None, tmp_path: Path) -> None:
    environment = {**os.environ, "LC_ALL": "C", "PYTHONIOENCODING": "ascii", "TERM": "dumb", "TMPDIR": str(tmp_path)}
    command = (sys.executable, "-c", "from ibrobot_core.cli.main import main; main()", "odd", "say")

    ran = subprocess.run(command, env=environment, capture_output=True, check=False)

    assert ran.returncode == 1
    assert ran.stdout == b"gr\\xf6\\xdfer \\u2026 \\u2713\n"
    assert ran.stderr.startswith(b"error: ValueError: gr\\xf6\\xdfer")


@pytest.mark.parametrize(
    "arguments",
    [
        (), ("--help",), ("launch", "--help"), ("record", "--help"), ("replay", "--help"), ("convert", "--help"),
        ("serve", "--help"), ("plugins",), ("doctor",), ("config", "schema"), ("config", "check", "no.yaml"),
    ],
)  # fmt: skip
def test_no_command_needs_more_than_ascii(
    ibrobot: Ibrobot, bugs: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    for name in ("stdout", "stderr"):
        stream = (tmp_path / name).open("w", encoding="ascii", errors="strict")
        monkeypatch.setattr(sys, name, stream)

    ran = ibrobot(*arguments)

    assert ran.code in (0, 1, 2)
    for name in ("stdout", "stderr"):
        getattr(sys, name).close()
    assert "UnicodeEncodeError" not in (tmp_path / "stderr").read_text()
    assert (tmp_path / "stdout").read_text() + (tmp_path / "stderr").read_text()


def piped(*arguments: str, **streams: Any) -> subprocess.CompletedProcess[str]:
    """Run the command line as a process, with given standard streams."""
    command = (*ibrobot_command(), *arguments)
    return subprocess.run(command, text=True, check=False, timeout=60, **streams)


def test_full_output_is_an_error_of_one_line() -> None:
    with open("/dev/full", "w", encoding="utf-8") as full:
        ran = piped("doctor", stdout=full, stderr=subprocess.PIPE)
    assert (ran.returncode, ran.stderr) == (1, "error: standard output: No space left on device\n")


@pytest.mark.parametrize("command", ["doctor", "--help"])
def test_reader_that_left_is_an_error_of_one_line(command: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w", encoding="utf-8") as output:
        ran = piped(command, stdout=output, stderr=subprocess.PIPE)
    assert (ran.returncode, ran.stderr) == (1, "error: standard output: Broken pipe\n")


@pytest.mark.parametrize("closed", [0, 1, 2])
def test_closed_standard_streams_are_no_bug(closed: int) -> None:
    command = f"{shlex.join(ibrobot_command())} --help {closed}>&-"
    ran = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False, timeout=60)
    assert (ran.returncode, ran.stderr) == (0, "")


def test_deleted_working_folder_is_no_bug(tmp_path: Path) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    command = f"rmdir {folder} && exec {shlex.join(ibrobot_command())} config check robot.yaml --set recording.root=x"
    ran = subprocess.run(["sh", "-c", command], cwd=folder, capture_output=True, text=True, check=False, timeout=60)
    assert ran.returncode == 2
    assert "bug" not in ran.stderr


def test_viewer_is_named_as_it_was_typed(ibrobot: Ibrobot, robot: Path) -> None:
    ran = ibrobot("launch", "mini.yaml", "--viewer", "foo", "--dry-run")
    assert ran.code == 2
    assert ran.err.startswith("error: --viewer foo: viewer.type: ")
