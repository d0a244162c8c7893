"""What LeRobot and the libraries below it print, warn and log while they load stays out of the terminal."""

from __future__ import annotations

import logging
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from types import ModuleType

import pytest
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import LeRobotPolicy
from ibrobot_testing.contexts import host_context

from ibrobot_core.api import PolicyError

from .test_checkpoint import step, write

WORDS = "a library is unhappy"


def own_handler() -> None:
    """As transformers and huggingface_hub: a handler of the library, made while it is imported."""
    log = logging.getLogger("unhappy_new")
    log.propagate = False
    log.addHandler(logging.StreamHandler())
    log.warning(WORDS)


NOISES: dict[str, Callable[[], None]] = {
    "stdout": lambda: print(WORDS),
    "stderr": lambda: print(WORDS, file=sys.stderr),
    "progress": lambda: print(f"\r50%\r{WORDS}", end="", file=sys.stderr),
    "warning": lambda: warnings.warn(WORDS, stacklevel=1),
    "root": lambda: logging.getLogger().warning(WORDS),
    "logger": lambda: logging.getLogger("unhappy").warning(WORDS),
    "own handler": own_handler,
}


def fake_pipeline(monkeypatch: pytest.MonkeyPatch, act: Callable[[], None]) -> None:
    """A stand-in for the module that has LeRobot's own steps."""
    module = ModuleType("ibrobot_lerobot.pipeline")
    module.LeRobotSteps = lambda checkpoint: act()  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write(tmp_path / "odd", (step("tokenizer_processor"),), type="smolvla")


@pytest.fixture(autouse=True)
def _own_handlers() -> Iterator[None]:
    yield
    logging.getLogger("unhappy_new").handlers.clear()


def make(path: Path) -> LeRobotPolicy:
    return LeRobotPolicy(LeRobotPolicyOptions(path), host_context())


@pytest.mark.filterwarnings("always")
@pytest.mark.parametrize(("noise", "end"), list(product(NOISES, ["", "error", "same error", "debug"])))
def test_libraries_are_heard_only_before_an_error_or_with_debug(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture,
    noise: str, end: str,
) -> None:  # fmt: skip
    def act() -> None:
        NOISES[noise]()
        NOISES[noise]()
        if "error" in end:
            raise PolicyError(WORDS if end == "same error" else "no more")

    fake_pipeline(monkeypatch, act)
    monkeypatch.setattr(warnings, "showwarning", lambda message, *_: print(message, file=sys.stderr))
    if end == "debug":
        monkeypatch.setenv("IBROBOT_DEBUG", "1")
    else:
        monkeypatch.delenv("IBROBOT_DEBUG", raising=False)
    if "error" in end:
        with pytest.raises(PolicyError, match=WORDS if end == "same error" else "no more"):
            make(path)
    else:
        make(path)
    out, err = capsys.readouterr()
    records = [record.getMessage() for record in caplog.records if WORDS in record.getMessage()]
    assert not out
    if end == "debug":
        assert WORDS in err or records == [WORDS] * 2
    elif end == "error":
        assert WORDS not in err
        (said,) = records
        assert said.startswith("before the next error: ")
        assert said.count(WORDS) == 1
    else:
        assert (WORDS in err, records) == (False, [])


def test_ibrobot_and_other_threads_are_heard(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("IBROBOT_DEBUG", raising=False)

    def act() -> None:
        host_context().log.warning("of ibrobot")
        other = threading.Thread(target=print, args=("of another thread",))
        other.start()
        other.join()

    fake_pipeline(monkeypatch, act)
    make(path)
    assert capsys.readouterr().out == "of another thread\n"
    assert "of ibrobot" in caplog.messages


def test_a_handler_that_a_library_made_meanwhile_writes_again(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("IBROBOT_DEBUG", raising=False)
    fake_pipeline(monkeypatch, own_handler)
    make(path)
    assert not capsys.readouterr().err
    logging.getLogger("unhappy_new").warning("later")
    assert capsys.readouterr().err == "later\n"


@pytest.mark.parametrize("error", [ImportError("libtorch.so: cannot open"), OSError("libtorch.so: cannot open")])
def test_a_lerobot_that_cannot_be_imported_is_not_said_to_be_missing(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """Libraries repeat the cause in each error that they raise from it."""
    site = tmp_path / "site"
    for name in ("lerobot", "torch"):
        (site / name).mkdir(parents=True)
    (site / "lerobot/__init__.py").write_text("")
    (site / "torch/__init__.py").write_text(
        f"try:\n    raise {error!r}\nexcept Exception as error:\n"
        "    raise RuntimeError(f'Failed to import torch ({error})') from error\n"
    )
    monkeypatch.syspath_prepend(str(site))
    for name in [each for each in sys.modules if each.partition(".")[0] in ("lerobot", "torch")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "ibrobot_lerobot.pipeline", raising=False)
    with pytest.raises(PolicyError) as raised:
        make(path)
    assert str(raised.value) == "LeRobot is installed, but cannot be imported: libtorch.so: cannot open"
