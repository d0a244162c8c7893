"""`ibrobot launch` with a made-up robot: options that exclude each other, summary, exit codes, the first Ctrl-C."""

from __future__ import annotations

import json
import logging
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, override

import pytest
from ibrobot_testing.fakes import FakePolicy

from ibrobot_core.cli.run import _Signals, run_robot
from ibrobot_core.config.load import load_config
from ibrobot_core.errors import PolicyError
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.run_hooks import RunHooks

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

    from tests.cli.conftest import Ran

ROBOT = """\
robot:
  name: mini
  joints:
    - {name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
  groups: {arm: [pan]}
  description:
    poses: {home: [0], up: [0.4]}
hardware: {type: arm}
simulation: {type: scene}
executors:
  position: {type: position, group: arm}
  trajectory: {type: waypoints, group: arm}
models:
  net: {type: net}
control_modes:
  policy: {executors: [position], inference: {model: net}}
  stick: {executors: [position], teleop: stick}
  bug: {executors: [position], teleop: bug}
  person: {executors: [position], teleop: person}
  cautious: {executors: [position], teleop: cautious}
  plan: {executors: [trajectory], planner: {type: cubic}}
  idle: {executors: [position]}
default_control_mode: policy
teleoperation:
  stick: {type: stick}
  bug: {type: bug}
  person: {type: person}
  cautious: {type: cautious}
contract:
  rate_hz: 25
  max_duration_s: 1
  observations:
    - {key: observation.state, topic: /joint_states, select: [position.pan]}
  actions:
    - {executor: position, topic: /commands}
control: {rate_hz: 50}
"""


@pytest.fixture
def launch(
    site: Site, ibrobot: Callable[..., Ran], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Ran]]:
    """Run `ibrobot launch mini.yaml …` in this process, and put back what it sets for the whole process."""
    site.add("fake-parts", "cli_parts.py")
    monkeypatch.chdir(tmp_path)
    Path("mini.yaml").write_text(ROBOT)
    root, ours = logging.getLogger(), logging.getLogger("ibrobot")
    handlers, levels = list(root.handlers), (root.level, ours.level)
    signals = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield lambda *arguments: ibrobot("launch", "mini.yaml", *arguments)
    root.handlers[:] = handlers
    root.setLevel(levels[0])
    ours.setLevel(levels[1])
    for number, handler in signals.items():
        signal.signal(number, handler)


LOCKSTEP = ("--sim", "--lockstep", "--headless")


def test_the_summary_in_words(launch: Callable[..., Ran]):
    ran = launch(*LOCKSTEP, "--episodes", "2")
    assert ran.code == 0, ran.err
    assert ran.out.splitlines() == [
        "mini: policy for 1.1 s",
        "episodes   2, of which 2 succeeded",
        "loop       56 ticks in lockstep",
        "faults     none",
    ]


CAMERA = ("--set", "peripherals=[{name: top, kind: camera, type: camera}]")


def test_the_summary_names_the_cameras_that_could_not_run(launch: Callable[..., Ran]):
    ran = launch(*LOCKSTEP, *CAMERA, "--episodes", "1")
    assert ran.code == 0, ran.err
    absent = "camera top: no OpenGL; sudo apt-get install libegl1"
    assert ran.err.count(absent) == 1
    assert f"W running without {absent}" in ran.err.splitlines()
    assert f"without    {absent}" in ran.out.splitlines()


def test_a_missing_library_is_an_error_with_the_remedy_where_it_is_needed(launch: Callable[..., Ran]):
    pytest.importorskip("ibrobot_data")
    wanted = ("--set", "recording={type: unused, topics: all}")
    ran = launch(*LOCKSTEP, *CAMERA, *wanted)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err.endswith("error: the recording needs camera top: no OpenGL; sudo apt-get install libegl1\n")


@pytest.mark.skipif(find_spec("ibrobot_data") is not None, reason="ibrobot-plugin-data is installed")
def test_a_recording_without_its_plugin_names_the_package(launch: Callable[..., Ran]):
    ran = launch(*LOCKSTEP, "--set", "recording={type: unused, topics: all}")
    message = "section 'recording' needs a plugin that is not installed: pip install ibrobot-plugin-data"
    assert (ran.code, ran.out, ran.err) == (2, "", f"error: {message}\n")


def test_the_summary_as_json_is_the_last_line(launch: Callable[..., Ran]):
    ran = launch(*LOCKSTEP, "--episodes", "2", "--seed", "5", "--json")
    assert ran.code == 0, ran.err
    summary = json.loads(ran.out.splitlines()[-1])
    assert summary.items() >= {"robot": "mini", "seed": 5, "episodes": 2, "successes": 2, "faults": []}.items()
    assert summary["loop"].keys() >= {"rate_hz", "lateness_p50_us", "lateness_p99_us", "missed"}


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("--episodes", "1"), 0),
        (("--duration", "0.2"), 0),
        (("--episodes", "2", "--seed", "12"), 3),
        (("--episodes", "1", "--seed", "66", "--set", "contract.max_duration_s=4"), 1),
        (("--mode", "stick", "--duration", "2"), 1),
        (("--mode", "bug"), 1),
        (("--mode", "person"), 0),
        (("--mode", "cautious", "--duration", "2"), 1),
        (("--mode", "plan", "--goal", "up", "--duration", "0.2"), 0),
        (("--mode", "idle", "--goal", "up"), 2),
        (("--mode", "climb"), 2),
        (("--set", "control.rate_hz=fast"), 2),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_exit_codes(launch: Callable[..., Ran], arguments: tuple[str, ...], code: int):
    ran = launch(*LOCKSTEP, "--json", *arguments)
    assert ran.code == code, ran.err
    assert bool(ran.out) == (code != 2), "a summary, unless nothing ran"
    assert "Traceback" not in ran.err


def test_a_device_that_is_lost_is_a_fault_and_the_run_goes_on(launch: Callable[..., Ran]):
    ran = launch(*LOCKSTEP, "--mode", "stick", "--duration", "2", "--json")
    assert "E fault: the stick is gone; the robot holds" in ran.err
    summary = json.loads(ran.out.splitlines()[-1])
    assert summary.items() >= {"faults": ["the stick is gone"], "duration_s": 2.0}.items()


@pytest.mark.parametrize("as_json", [True, False])
def test_a_fault_that_was_reset_is_a_note(
    launch: Callable[..., Ran], capsys: pytest.CaptureFixture[str], as_json: bool
):
    """As an operator does who tries the emergency stop first."""
    registry = installed_plugins()
    config = load_config("mini.yaml", mode="idle", sim=True, registry=registry)

    class Cautious(RunHooks):
        def __init__(self, runtime: Runtime) -> None:
            self.runtime, self.ticks = runtime, 0

        @override
        def step(self) -> None:
            self.ticks += 1
            if self.ticks in (5, 20):
                self.runtime.session.emergency_stop()
            elif self.ticks == 10 or (self.ticks == 25 and resets_all):
                self.runtime.reset(self.runtime.session.stops)

    for resets_all in (True, False):
        request = LaunchRequest(lockstep=True, duration_s=1.0)
        with pytest.raises(SystemExit) as ended:
            run_robot(config, request, headless=True, as_json=as_json, make_hooks=Cautious)
        out = capsys.readouterr().out
        assert ended.value.code == (0 if resets_all else 1)
        if as_json:
            summary = json.loads(out.splitlines()[-1])
            left = [] if resets_all else ["emergency stop"]
            assert (summary["faults"], summary["faults_at_end"]) == (["emergency stop"] * 2, left)
        else:
            last = "emergency stop (reset)" if resets_all else "emergency stop"
            assert sorted(out.splitlines()[-1].removeprefix("faults     ").split("; ")) == sorted(
                [last, "emergency stop (reset)"]
            )


def test_what_died_is_reported_after_the_summary(launch: Callable[..., Ran]):
    ran = launch(*LOCKSTEP, "--mode", "bug", "--json")
    assert ran.err.splitlines()[-1].startswith("error: mode:bug: ZeroDivisionError: one over nothing (a bug at ")
    assert json.loads(ran.out)["mode"] == "bug"


def test_the_first_ctrl_c_ends_the_run_in_order(launch: Callable[..., Ran]):
    ran = launch(*LOCKSTEP, "--mode", "person", "--json")
    assert ran.code == 0, ran.err
    assert "stopping; Ctrl-C again stops at once" in ran.err
    assert 45 <= json.loads(ran.out)["loop"]["ticks"] < 150  # a thread acts on the signal, while simulated time goes on


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_before_the_run_begins_leaves_no_summary(
    launch: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch, number: signal.Signals
):
    interrupted = threading.Event()

    def load(self: object) -> None:
        signal.raise_signal(number)
        assert interrupted.wait(10)

    monkeypatch.setattr(FakePolicy, "load", load)
    monkeypatch.setattr(_Signals, "_stop", _then(_Signals._stop, interrupted.set))
    ran = launch(*LOCKSTEP, "--json")
    assert (ran.code, ran.out) == (130, "")
    assert ran.err.endswith("error: stopped\n")


def _then(first: Callable[..., None], second: Callable[[], None]) -> Callable[..., None]:
    def both(*arguments: object) -> None:
        first(*arguments)
        second()

    return both


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_other_signals_end_the_run_as_ctrl_c_does(
    launch: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch, number: signal.Signals
):
    # Where nobody handles it, the signal must not end the tests.
    monkeypatch.setattr(signal, "raise_signal", partial(_raise_handled, signal.raise_signal, number))
    ran = launch(*LOCKSTEP, "--mode", "person", "--duration", "3", "--json")
    assert ran.code == 0, ran.err
    assert 45 <= json.loads(ran.out)["loop"]["ticks"] < 150  # a thread acts on the signal, while simulated time goes on


def _raise_handled(raise_signal: Callable[[int], None], number: int, _: int) -> None:
    if signal.getsignal(number) is not signal.SIG_DFL:
        raise_signal(number)


def test_a_hangup_that_the_caller_ignores_stays_ignored(launch: Callable[..., Ran]):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert launch(*LOCKSTEP, "--duration", "0.1").code == 0
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


def test_json_is_alone_on_standard_output(launch: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("ibrobot_core.cli.display._PLAIN_PERIOD_S", 0.0)
    ran = launch(*LOCKSTEP, "--duration", "0.2", "--json")
    assert json.loads(ran.out)["mode"] == "policy"
    assert "mode policy | loop " in ran.err


def test_dry_run_as_json(launch: Callable[..., Ran]):
    ran = launch(*LOCKSTEP, "--dry-run", "--json")
    assert (ran.code, ran.err) == (0, "")
    plan = json.loads(ran.out)
    assert [component["name"] for component in plan["components"]] == [
        "model:net",
        "control",
        "mode:policy",
        "status",
        "episodes",
    ]
    assert plan["components"][2]["needs"] == ["control", "model:net"]
    assert (plan["without"], len(plan["models"])) == ("", 1)


def test_dry_run_prints_the_plan(launch: Callable[..., Ran]):
    ran = launch(*LOCKSTEP, "--dry-run")
    assert (ran.code, ran.err) == (0, "")
    assert [line.split()[1] for line in ran.out.splitlines()[:-2]] == [
        "model:net",
        "control",
        "mode:policy",
        "status",
        "episodes",
    ]
    assert ran.out.splitlines()[-1] == (
        "model net fits the contract: observation.state -> 1 numbers in chunks of 10; "
        "what it was trained on is not known"
    )


def test_command_of_a_plugin_runs_a_robot_with_a_source_of_its_own(
    launch: Callable[..., Ran], ibrobot: Callable[..., Ran], site: Site
):
    site.add("nodding", "nodding.py")
    nod = ("nod", "mini.yaml", *LOCKSTEP, "--mode", "idle", "--joint", "pan")
    ran = ibrobot(*nod)
    assert ran.code == 0, ran.err
    assert "nodded     once, with pan" in ran.out.splitlines()
    assert json.loads(ibrobot(*nod, "--json").out)["nodded"] == "pan"
    assert "mode:idle  nods with pan  (needs control)" in ibrobot(*nod, "--dry-run").out


WRONG_CONTRACT = """\
error: mini.yaml: models.net: model 'net' does not fit the contract of mini.yaml
error: the policy does not fit the contract:
error:   observation.state
error:       policy: (1,)
error:     contract: (2,)
"""


def test_dry_run_compares_the_model_with_the_contract(launch: Callable[..., Ran]):
    config = Path("mini.yaml")
    config.write_text(config.read_text().replace("select: [position.pan]", "select: [position.pan, velocity.pan]"))
    ran = launch(*LOCKSTEP, "--dry-run")
    assert (ran.code, ran.err) == (2, WRONG_CONTRACT)
    assert launch(*LOCKSTEP, "--dry-run", "--mode", "stick").code == 0, "this mode has no model"


def test_deep_check_compares_the_models_of_all_modes(launch: Callable[..., Ran], ibrobot: Callable[..., Ran]):
    deep = ("config", "check", "mini.yaml", "--sim", "--mode", "stick", "--deep")
    ran = ibrobot(*deep)
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.splitlines()[-1].startswith("model net fits the contract: observation.state -> 1 numbers")
    config = Path("mini.yaml")
    config.write_text(config.read_text().replace("select: [position.pan]", "select: [position.pan, velocity.pan]"))
    assert ibrobot(*deep[:-1]).code == 0, "without --deep nothing of the model is read"
    ran = ibrobot(*deep)
    assert (ran.code, ran.err) == (2, WRONG_CONTRACT)
    [problem] = json.loads(ibrobot(*deep, "--json").out)
    assert problem["path"] == "models.net"


@pytest.mark.parametrize(("mode", "code"), [("monolithic", 2), ("far", 0)])
def test_deep_check_wants_weights_only_where_they_are_loaded(
    launch: Callable[..., Ran], ibrobot: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch, mode: str, code: int
):
    def check_weights(self: object) -> None:
        raise PolicyError("model.safetensors is missing")

    monkeypatch.setattr(FakePolicy, "check_weights", check_weights)
    transport = ("--set", "transport={type: net}") if mode == "far" else ()
    ran = ibrobot(
        "config",
        "check",
        "mini.yaml",
        "--sim",
        "--deep",
        "--set",
        f"control_modes.policy.inference.execution_mode={mode}",
        *transport,
    )
    assert ran.code == code
    assert ran.err == ("" if code == 0 else "error: mini.yaml: models.net: model.safetensors is missing\n")


def test_missing_checkpoint_has_the_same_exit_code_as_in_a_dry_run(
    launch: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch
):
    def check_weights(self: object) -> None:
        raise PolicyError("model.safetensors is missing")

    monkeypatch.setattr(FakePolicy, "check_weights", check_weights)
    ran = launch(*LOCKSTEP, "--episodes", "1")
    assert (ran.code, ran.out) == (2, "")
    assert ran.err.endswith("error: model:net: model.safetensors is missing\n")
    assert launch(*LOCKSTEP, "--dry-run").code == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--sim", "--viewer", "any", "--headless"), "--viewer and --headless exclude each other"),
        (("--lockstep",), "--lockstep is for simulation: add --sim"),
        (("--sim", "--episodes", "0"), "--episodes: 0 is too small"),
        (("--sim", "--duration", "-1"), "--duration: -1.0 is too small"),
        ((*LOCKSTEP, "--mode", "plan"), "--lockstep: nothing sends mode plan a goal: add --goal, --duration or --epis"),
        (
            ("--sim", "--set", "executors.position.stale_timeout=1e300"),
            "stale_timeout: 1e+300 is too large",
        ),
    ],
)
def test_options_that_make_no_sense_are_refused(launch: Callable[..., Ran], arguments: tuple[str, ...], message: str):
    ran = launch(*arguments)
    assert ran.code == 2
    assert message in ran.err
    assert ran.out == ""


@pytest.mark.parametrize("mode", ["plan", "person", "bug"], ids=["ended", "interrupted", "failed"])
def test_what_holds_torque_is_said_however_the_run_ends(launch, mode):
    ran = launch("--sim", "--lockstep", "--headless", "--mode", mode, "--duration", "2", "--seed", "7")

    assert ran.err.count("/dev/ttyARM holds torque; to take it off: `arm torque off`") == 1


STEPPED = """
import atexit, logging, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever the shell that started the tests set
at, steps, begun = int(sys.argv.pop(1)), 0, False

def step():
    global steps
    steps += 1
    if steps == at:
        signal.raise_signal(signal.SIGINT)

def hook(event, arguments):
    global begun
    if event == "import":
        begun = begun or arguments[0] == "ibrobot_core.cli.main"
        if begun:
            step()

def log(self, record, handle=logging.Logger.handle):
    handle(self, record)
    step()

logging.Logger.handle = log
sys.addaudithook(hook)
if not at:
    atexit.register(lambda: print("steps", steps, file=sys.stderr))
from ibrobot_core.cli.command import main
main()
"""


def test_ctrl_c_at_any_moment_of_the_start_is_one_line(site: Site, tmp_path: Path):
    site.add("fake-parts", "cli_parts.py")
    (tmp_path / "mini.yaml").write_text(ROBOT)

    def run(at: int) -> tuple[int, str, str]:
        command = [
            sys.executable,
            "-c",
            STEPPED,
            str(at),
            "launch",
            "mini.yaml",
            *LOCKSTEP,
            "--json",
            "--duration",
            "0",
        ]
        ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        return ran.returncode, ran.stdout, ran.stderr

    code, out, err = run(0)
    assert code == 0, err
    steps = int(err.rpartition("steps ")[2])
    codes = []
    for at in (1, *(int(share * steps) for share in (0.1, 0.3, 0.5, 0.7, 0.9)), steps - 1):
        code, out, err = run(at)
        codes.append(code)
        if code == 130:
            logged = [line for line in err.splitlines() if not line.startswith(("I ", "W goals of "))]
            assert (out, logged) == ("", ["error: stopped"]), f"step {at} of {steps}"
        else:  # it ran already, and stopped in order
            assert code == 0, err
            assert "Traceback" not in err
            assert json.loads(out)["robot"] == "mini"
    assert codes[:4] == [130] * 4
