"""`ibrobot --help`, `--version`, and what the command line does with errors."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ibrobot_core import __version__
from ibrobot_core.plugins import Registry, discover

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

    from tests.cli.conftest import Ran

Ibrobot = Callable[..., "Ran"]


@pytest.mark.parametrize("arguments", [["--help"], ["-h"]])
def test_help_lists_every_command_and_those_of_plugins(ibrobot: Ibrobot, robot: Path, arguments: list[str]) -> None:
    ran = ibrobot(*arguments)

    lines = [line.split(maxsplit=1) for line in ran.out.splitlines()]
    assert ran.code == 0
    own = [command for name, command in discover([]).commands.items() if " " not in name]
    assert [command.name for command in own] == ["launch", "config", "doctor"]
    for command in own:
        assert [command.name, command.summary] in lines
    assert ["greet", "Say hello."] in lines


def test_help_imports_nothing_slow() -> None:
    code = (
        "import sys\n"
        "sys.argv = ['ibrobot', '--help']\n"
        "from ibrobot_core.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "slow = ('numpy', 'rich', 'yaml', 'mujoco', 'torch', 'cv2', 'ibrobot_core.config')\n"
        "print('slow:', [name for name in slow if name in sys.modules])\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)

    assert ran.stdout.splitlines()[-1] == "slow: []"


def test_version(ibrobot: Ibrobot) -> None:
    assert ibrobot("--version").out == f"ibrobot, version {__version__}\n"


def test_an_error_of_a_plugins_command_is_one_line_and_its_code(ibrobot: Ibrobot, robot: Path) -> None:
    ran = ibrobot("greet")

    assert (ran.code, ran.out, ran.err) == (1, "", "error: nobody there\n")


def test_wrong_usage_exits_with_2(ibrobot: Ibrobot) -> None:
    ran = ibrobot("lunch")

    assert ran.code == 2
    assert "No such command 'lunch'" in ran.err


@pytest.mark.parametrize("command", ["convert", "record", "replay"])
def test_command_of_a_missing_plugin_names_the_package(
    ibrobot: Ibrobot, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.setattr("ibrobot_core.plugins.installed_plugins", Registry)
    ran = ibrobot(command, "so101")

    message = f"error: ibrobot {command} needs a plugin that is not installed: pip install ibrobot-plugin-data\n"
    assert (ran.code, ran.out, ran.err) == (2, "", message)


@pytest.mark.skipif(find_spec("ibrobot_terminal") is not None, reason="has the command")
def test_command_below_one_that_is_not_installed_names_the_package(ibrobot: Ibrobot) -> None:
    ran = ibrobot("plugins", "show", "wave")

    message = "error: ibrobot plugins needs a plugin that is not installed: pip install ibrobot-terminal\n"
    assert (ran.code, ran.out, ran.err) == (2, "", message)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("chek", "No such command 'chek', did you mean 'check'?; see `ibrobot plugins --help`"),
        pytest.param(
            "show",
            "ibrobot plugins needs a plugin that is not installed: pip install ibrobot-terminal",
            marks=pytest.mark.skipif(find_spec("ibrobot_terminal") is not None, reason="has the command"),
        ),
    ],
)
def test_a_word_below_a_command_that_is_not_installed_may_be_mistyped(
    ibrobot: Ibrobot, site: Site, word: str, message: str
) -> None:
    site.add("commands-below", "commands_below.py")
    ran = ibrobot("plugins", word)
    assert (ran.code, ran.err) == (2, f"error: {message}\n")


@pytest.mark.parametrize("command", ["config", "doctor"])
def test_every_command_explains_itself(ibrobot: Ibrobot, command: str) -> None:
    ran = ibrobot(command, "--help")

    assert ran.code == 0
    assert ran.out.startswith(f"Usage: ibrobot {command}")


@pytest.mark.parametrize("command", [(), ("config",)])
def test_a_group_without_a_command_shows_its_help(ibrobot: Ibrobot, command: tuple[str, ...]) -> None:
    ran = ibrobot(*command)

    assert (ran.code, ran.out) == (2, "")
    assert ran.err.splitlines() == ibrobot(*command, "--help").out.splitlines()
    assert ran.err.startswith(" ".join(("Usage: ibrobot", *command)))


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("la", {"launch"}),
        ("config ", {"check", "show"}),
        ("config ch", {"check"}),
        ("config check --", {"--json", "--help"}),
        ("launch --lock", {"--lockstep"}),
        ("feed --from b", {"bowl", "bottle"}),
        ("feed --what ", {"milk", "mash"}),
        ("feed EPI", {"EPISODE"}),
    ],
)
def test_a_shell_completes_commands_options_choices_and_paths(
    ibrobot: Ibrobot, site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, typed: str, offered: set[str]
) -> None:
    site.add("fake-feeding", "feeding.py")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("_IBROBOT_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", f"ibrobot {typed}")
    monkeypatch.setenv("COMP_CWORD", str(len(typed.split(" "))))
    ran = ibrobot()

    lines = [line.partition(",") for line in ran.out.splitlines()]
    assert ran.code == 0
    if typed == "feed EPI":  # the shell completes paths itself
        assert [kind for kind, _, _ in lines] == ["file"]
    else:
        assert offered <= {text for _, _, text in lines}
        assert all(text.startswith(typed.rsplit(" ", maxsplit=1)[-1]) for _, _, text in lines)
