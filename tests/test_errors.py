"""Errors that worker processes send arrive as they were raised; remedies install where they are printed."""

from __future__ import annotations

import copy
import os
import subprocess
import sys
from collections.abc import Iterator
from multiprocessing import Pipe
from pathlib import Path
from zipfile import ZipFile

import pytest

from ibrobot_core import errors
from ibrobot_core.errors import (
    ComponentFailed,
    ConfigError,
    IbrobotError,
    MissingDependency,
    PlanCode,
    PlanningError,
    PluginNotInstalled,
    Problem,
    how_to_install,
)

MADE = (
    ConfigError([Problem("robot.yaml", 7, "simulation.type", "there is no 'reach'")] * 60),
    PluginNotInstalled("hardware", "reach", "ibrobot-plugin-reach"),
    MissingDependency("OpenGL", apt=("libegl1",)),
    PlanningError("too far", PlanCode.NO_IK_SOLUTION),
    ComponentFailed("killed", 3),
)


def every_error() -> Iterator[IbrobotError]:
    """One error of each class."""
    made: dict[type[IbrobotError], IbrobotError] = {type(each): each for each in MADE}
    for kind in vars(errors).values():
        if isinstance(kind, type) and issubclass(kind, IbrobotError):
            yield made.get(kind) or kind("why")


@pytest.mark.parametrize("error", list(every_error()), ids=lambda error: type(error).__name__)
def test_errors_cross_processes(error: IbrobotError) -> None:
    here, there = Pipe()
    with here, there:
        here.send(error)
        sent = there.recv()
    for arrived in (sent, copy.copy(error)):
        assert type(arrived) is type(error)
        assert str(arrived) == str(error)
        assert vars(arrived) == vars(error)
        assert arrived.exit_code == error.exit_code


def installer(monkeypatch: pytest.MonkeyPatch, prefix: Path, *, has_pip: bool, path: str = "") -> Path:
    """Act as if the interpreter were that of an environment, which exists; returns the interpreter."""
    python = prefix / "bin/python"
    python.parent.mkdir(parents=True)
    (prefix / "bin/pip").touch(0o755)
    monkeypatch.delenv("IBROBOT_INSTALLER")
    monkeypatch.delenv("VIRTUAL_ENV", raising=False)
    monkeypatch.setenv("PATH", path)
    monkeypatch.setattr("sys.executable", str(python))
    monkeypatch.setattr("sys.prefix", str(prefix))
    monkeypatch.setattr("ibrobot_core.errors.find_spec", lambda name: object() if has_pip else None)
    monkeypatch.chdir(prefix.parent)
    return python


def test_pip_installs_where_it_is_the_one_of_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installer(monkeypatch, tmp_path / "env", has_pip=True, path=f"{tmp_path / 'env/bin'}:/usr/bin")
    assert how_to_install("ibrobot[sim]", "lerobot") == 'pip install "ibrobot[sim]" lerobot'


def test_the_interpreter_is_named_where_the_shell_finds_another_pip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other/bin"
    other.mkdir(parents=True)
    (other / "pip").touch(0o755)
    python = installer(monkeypatch, tmp_path / "env", has_pip=True, path=f"{other}:{tmp_path / 'env/bin'}")
    assert how_to_install("lerobot") == f"{python} -m pip install lerobot"


def test_uv_installs_where_there_is_no_pip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    python = installer(monkeypatch, tmp_path / "env", has_pip=False)
    assert how_to_install("lerobot") == f"uv pip install lerobot --python {python}"
    monkeypatch.setenv("VIRTUAL_ENV", str(tmp_path / "env"))
    assert how_to_install("lerobot") == "uv pip install lerobot"
    monkeypatch.delenv("VIRTUAL_ENV")
    (tmp_path / ".venv").symlink_to("env")
    assert how_to_install("lerobot") == "uv pip install lerobot"


def test_another_installer_is_named_if_the_user_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IBROBOT_INSTALLER", "pixi add --pypi")
    assert how_to_install("lerobot") == "pixi add --pypi lerobot"


def make_wheel(folder: Path) -> Path:
    """A wheel with the module `waved` alone."""
    wheel = folder / "waved-1.0-py3-none-any.whl"
    files = {
        "waved.py": "",
        "waved-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: waved\nVersion: 1.0\n",
        "waved-1.0.dist-info/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        "waved-1.0.dist-info/RECORD": "",
    }
    with ZipFile(wheel, "w") as file:
        for name, text in files.items():
            file.writestr(name, text)
    return wheel


@pytest.mark.parametrize("program", ["uv", "python"])
def test_the_command_installs_into_the_environment_that_prints_it(program: str, tmp_path: Path) -> None:
    place = tmp_path / "an env"
    python = place / "bin/python"
    environ = {name: value for name, value in os.environ.items() if name not in ("IBROBOT_INSTALLER", "VIRTUAL_ENV")}
    makes = ["uv", "venv", "--quiet"] if program == "uv" else [sys.executable, "-m", "venv"]
    try:
        subprocess.run([*makes, str(place)], env=environ, cwd=tmp_path, check=True, capture_output=True)
    except (FileNotFoundError, subprocess.CalledProcessError) as error:
        pytest.skip(f"{program} makes no environment here: {error}")
    code = f"from ibrobot_core.errors import how_to_install; print(how_to_install({str(make_wheel(tmp_path))!r}))"
    here = {**environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = subprocess.run([python, "-c", code], env=here, check=True, capture_output=True, text=True).stdout
    assert ("uv pip" in command) == (program == "uv")
    offline = {**environ, "UV_OFFLINE": "1", "PIP_NO_INDEX": "1", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    subprocess.run(command, shell=True, env=offline, cwd=tmp_path, check=True, capture_output=True)
    subprocess.run([python, "-c", "import waved"], env=environ, cwd="/", check=True)
