"""Attempts at an episode: what hangs or dies is told to the next process, however it hangs."""

import subprocess
import sys

import pytest
from ibrobot_eval import limits
from ibrobot_eval.limits import Attempt, EpisodeTooLong

HANGS = {
    "in Python": "while True: pass",
    "in C, with the interpreter locked": "sum(range(10**12))",
    "asleep": "import time; time.sleep(1e6)",
    "without beats": "import threading; threading.Event().wait()",
}
ENDS = {"exits": "os._exit(3)", "aborts": "os.abort()", "is killed": "os.kill(os.getpid(), 9)", "leaves": "sys.exit(0)"}
PROGRAM = """
import os, runpy, sys
from pathlib import Path
Attempt = runpy.run_path(sys.argv[4])["Attempt"]  # alone, since the package takes long to import
with Attempt(Path(sys.argv[1]), float(sys.argv[2]), 1e6) as attempt:
    attempt.beat()
    exec(sys.argv[3])
"""


def attempt(file, code, answer_s=60.0):
    """Attempt an episode in a process of its own; its exit code."""
    command = [sys.executable, "-c", PROGRAM, file, str(answer_s), code, limits.__file__]
    return subprocess.run(command, check=False, timeout=300).returncode


@pytest.mark.parametrize("how", HANGS)
def test_an_attempt_that_hangs_ends_and_is_reported(tmp_path, how):
    file = tmp_path / "attempts" / "one"
    assert attempt(file, HANGS[how], 0.5) == 1
    assert Attempt(file, 0.5, 60.0).error.startswith('it hung: no step ended within 0.5 s (at "')


@pytest.mark.parametrize("how", ENDS)
def test_an_attempt_that_ends_its_process_is_repeated_once(tmp_path, how):
    file = tmp_path / "one"
    attempt(file, ENDS[how])
    assert Attempt(file, 60.0, 60.0).error == ""
    attempt(file, ENDS[how])
    assert Attempt(file, 60.0, 60.0).error == "it ended its process, 2 times"


def test_an_attempt_that_ends_in_order_leaves_nothing(tmp_path):
    file = tmp_path / "one"
    with Attempt(file, 60.0, 60.0) as good:
        good.beat()
    assert not file.exists()
    with pytest.raises(ValueError, match="x"), Attempt(file, 60.0, 60.0):
        raise ValueError("x")
    assert not file.exists(), "an error is told otherwise"


def test_an_episode_has_a_limit(tmp_path):
    with Attempt(tmp_path / "one", 60.0, 1e-6) as slow, pytest.raises(EpisodeTooLong, match="not end within 1e-06 s"):
        slow.beat()


def test_an_episode_that_never_starts_ends(tmp_path):
    file = tmp_path / "one"
    program = PROGRAM.replace("1e6", "0.1").replace("    attempt.beat()\n", "")
    subprocess.run([sys.executable, "-c", program, file, "0.1", "while True: pass", limits.__file__], check=False)
    assert Attempt(file, 0.1, 0.1).error.startswith("it hung: no start within 0.1 s (at ")
