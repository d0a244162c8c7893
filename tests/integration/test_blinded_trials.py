"""Blinded trials with a simulated arm, as an operator runs them at a terminal."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import chdir, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from blinded_arm import ARM, NAMES
from command_line import run_here
from evaluations import MINI
from ibrobot_testing.command import command_line

from ibrobot_core.plugins import installed_plugins

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

pytestmark = pytest.mark.integration
PATIENCE_S = 240.0


class Terminal:
    """`ibrobot eval` with blinded trials at a terminal of its own."""

    def __init__(self, folder: Path, *words: str) -> None:
        self._master, slave = pty.openpty()
        program = "from ibrobot_core.cli.command import main; main()"
        self.process = subprocess.Popen(
            [sys.executable, "-c", program, *(words or command())],
            cwd=folder,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
        )
        os.close(slave)
        self.shown = ""
        self._seen = 0

    def see(self, pattern: str) -> str:
        """Wait until the terminal shows something new."""
        deadline = time.monotonic() + PATIENCE_S
        while not (found := re.search(pattern, self.shown[self._seen :])):
            if not select.select([self._master], [], [], 0.5)[0]:
                assert time.monotonic() < deadline, f"{pattern!r} did not come: {self.shown}"
                continue
            try:
                self.shown += os.read(self._master, 4096).decode()
            except OSError:
                pytest.fail(f"{pattern!r} did not come: {self.shown}")
        self._seen += found.end()
        return found[0]

    def press(self, keys: str) -> None:
        os.write(self._master, keys.encode())

    def judge(self, trial: int, key: str, *, early: str = "") -> None:
        """Begin a trial, and judge it when it has ended; keys that come before it has begun do not judge it."""
        self.press(f"\r{early}")
        self.see(f"trial {trial} has ended: s success, f failure, v void")
        self.press(key)

    def end(self) -> int:
        with suppress(OSError):
            while data := os.read(self._master, 4096):
                self.shown += data.decode()
        return self.process.wait(PATIENCE_S)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._master)


SIMULATED = (
    MINI
    + """\
models:
  model_one: {type: bad, how: poor}
  model_two: {type: bad, how: poor}
control_modes:
  careful: {executors: [all_position], inference: {model: model_one}}
  hasty: {executors: [all_position], inference: {model: model_two}}
default_control_mode: careful
contract:
  rate_hz: 25
  max_duration_s: 0.5
  observations:
    - {key: observation.state, topic: /joint_states, select: [position.pan, position.grip]}
  actions:
    - {executor: all_position, topic: /all/commands}
control: {rate_hz: 50, stop: hold}
"""
)
"""A simulated arm with two policies of which neither succeeds."""


@pytest.fixture
def folder(site: Site, tmp_path: Path) -> Path:
    """A folder with the YAML of the simulated arm."""
    site.add("bad-policies", "bad_policies.py")
    (tmp_path / "arm.yaml").write_text(SIMULATED, encoding="utf-8")
    return tmp_path


@pytest.fixture
def terminals(folder: Path) -> Iterator[list[Terminal]]:
    started: list[Terminal] = []
    yield started
    for each in started:
        each.close()


def command() -> list[str]:
    modes = [word for name in NAMES for word in ("--mode", name)]
    return ["eval", "arm.yaml", "--sim", "--trials", *modes, "--episodes", "2", "--out", "blind"]


def test_operator_judges_blind_and_goes_on_after_a_crash(folder: Path, terminals: list[Terminal]) -> None:
    first = Terminal(folder)
    terminals.append(first)
    first.see("detect a difference between the success rates")
    first.see(r"trial 1 \(start 1 of 2\).*Enter begin the trial")
    first.judge(1, "s", early="f")
    first.see("trial 1: success")
    first.see(r"trial 2 \(start 1 of 2\)")
    first.judge(2, "v")
    first.see("reason: ")
    first.press("the light went out\r")
    first.see("trial 2: void")
    first.see("trial 3")
    first.press("\r")
    first.see("outcome: s")
    os.kill(first.process.pid, signal.SIGKILL)  # a crash in the middle of a trial
    first.process.wait()

    early = _analysis(folder)
    assert (early.returncode, "need a terminal" in early.stderr) != (0, False)

    second = Terminal(folder)
    terminals.append(second)
    for number in (3, 4, 5):
        second.see(rf"trial {number} \(start {1 if number == 3 else 2} of 2\)")
        second.judge(number, "f")
        second.see(f"trial {number}: failure")
    assert second.end() == 0

    blind = first.shown + second.shown[: second.shown.index("trial 5: failure")]
    out = folder / "blind"
    log = (out / "trials.log").read_text(encoding="utf-8")
    names = [str(path.relative_to(out)) for path in out.rglob("*")]
    assert "episode 1: failure" in log, "the log has what the run says, without names"
    for name in (*NAMES, "model_one", "model_two"):
        assert name not in blind
        assert name not in log
        assert not [path for path in names if name in path]
    trials = [json.loads(each.read_text()) for each in sorted((out / "trials").glob("*.json"))]
    assert [each["outcome"] for each in trials] == ["success", "void", "failure", "failure", "failure"]
    assert trials[1]["reason"] == "the light went out"
    assert not any(name in json.dumps(trials) for name in NAMES)
    report = json.loads((out / "report.json").read_text())
    assert sorted((each["label"], each["successes"], each["episodes"]) for each in report["policies"]) in (
        [("careful", 0, 2), ("hasty", 1, 2)],
        [("careful", 1, 2), ("hasty", 0, 2)],
    )
    assert len(list((out / "episodes").glob("trial_*"))) == 5

    repeated = _analysis(folder)
    assert repeated.returncode == 0, "what is complete can be analysed again"
    file = sorted((out / "trials").glob("*.json"))[-1]
    file.write_text(json.dumps(json.loads(file.read_text()) | {"seal": "0"}))
    refused = _analysis(folder)
    assert (refused.returncode, "so they are not blind" in refused.stderr) == (2, True), refused.stderr


def _analysis(folder: Path) -> subprocess.CompletedProcess[str]:
    with chdir(folder):
        return run_here(*command())


def test_keys_judge_a_running_arm_and_ctrl_c_ends_it_in_an_orderly_way(
    site: Site, tmp_path: Path, terminals: list[Terminal]
) -> None:
    site.add("ibrobot-reaching", "reaching_arm.py")
    (tmp_path / "arm.yaml").write_text(ARM, encoding="utf-8")
    modes = [word for name in NAMES for word in ("--mode", name)]
    terminal = Terminal(tmp_path, "eval", "arm.yaml", *modes, "--episodes", "1", "--out", "blind")
    terminals.append(terminal)
    terminal.see(r"trial 1 \(start 1 of 1\), set the scene to start 1")
    terminal.press("\r")
    terminal.see("outcome: s")
    terminal.press("s")
    terminal.see("trial 1: success")
    terminal.see("trial 2")
    terminal.press("\r")
    terminal.see("outcome: s")
    os.kill(terminal.process.pid, signal.SIGINT)
    terminal.see("not finished")
    assert terminal.end() == 0
    (trial,) = [json.loads(each.read_text()) for each in (tmp_path / "blind/trials").glob("*.json")]
    assert (trial["outcome"], trial["faults"], trial["time_s"] > 0) == ("success", [], True)
    reader = installed_plugins().open_episode(tmp_path / "blind/.sealed/trial_0001")
    try:
        assert reader.summary().outcome == "success"
    finally:
        reader.close()
    assert not any(name in terminal.shown for name in NAMES)


def test_reset_task_is_performed_by_the_command_for_tasks() -> None:
    from ibrobot_eval.blinded import reset_of
    from ibrobot_eval.options import EvalOptions

    options = EvalOptions(config=("arm.yaml",), out=Path("blind"), reset_task=Path("clear table.yaml"), sim=True)
    program, _, _, name, verb, *words = reset_of(options)
    assert (program, name, verb) == (sys.executable, "task", "run")
    given = command_line(f"{name} {verb}").make_context(verb, words).params
    assert (given["file"], given["config"], given["sim"], given["headless"]) == (
        "clear table.yaml",
        "arm.yaml",
        True,
        True,
    )


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["--sim", "--reset-task", "clear.yaml"], "--reset-task is for blinded trials"),
        (["--sim", "--trials", "--reset-task", "clear.yaml", "--reset", "true"], "exclude each other"),
    ],
)
def test_options_of_trials_that_do_not_fit_are_errors(folder: Path, words: list[str], error: str) -> None:
    with chdir(folder):
        done = run_here("eval", "arm.yaml", "--mode", "careful", "--episodes", "1", "--out", "blind", *words)
    assert (done.returncode, error in done.stderr) == (2, True), done.stderr


def test_trials_without_an_operator_are_an_error(folder: Path) -> None:
    with chdir(folder):
        done = run_here(*command(), "--events")
    assert done.returncode != 0
    assert "nobody can answer: standard input has ended" in done.stdout
