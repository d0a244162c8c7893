"""`ibrobot eval` as a user runs it: the scripted pick in simulation, beside one whose gripper stays open."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import chdir, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from command_line import run_here
from evaluations import MINI, episodes_here, ready_forkserver
from ibrobot_testing.site import made_up_site

from ibrobot_core.config import find_config
from ibrobot_core.plugins import installed_plugins

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.integration
PATIENCE_S = 120.0


REACH = (
    MINI
    + """\
models:
  good: {type: bad, how: good}
  poor: {type: bad, how: poor}
control_modes:
  scripted: {executors: [all_position], inference: {model: good}, dispatch: {watermark: 5}}
  again: {executors: [all_position], inference: {model: good}, dispatch: {watermark: 5}}
  faulty: {executors: [all_position], inference: {model: poor}, dispatch: {watermark: 5}}
default_control_mode: scripted
contract:
  rate_hz: 25
  max_duration_s: 20  # so that an episode lasts long enough to be interrupted
  observations:
    - {key: observation.state, topic: /joint_states, select: [position.pan, position.grip]}
  actions:
    - {executor: all_position, topic: /all/commands}
control: {rate_hz: 100, stop: hold}
"""
)
"""A robot whose episodes are computed quickly, with the same modes."""


def write_robots(folder: Path) -> Path:
    """Write the robot YAMLs `picks` and `reach`, whose modes are one good policy twice, and one that cannot succeed."""
    text = find_config("so101_pick_cube", installed_plugins()).read_text(encoding="utf-8")
    text = text.replace("max_duration_s: 20", "max_duration_s: 5")
    text = text.replace("  rate_hz: 100\n", "  rate_hz: 50\n")  # half of the ticks
    text = text.replace("\nmodels:\n", "\nmodels:\n  broken: {type: scripted_pick, gripper_closed: 0.6}\n")
    executors = "executors: [arm_position, gripper_position]"
    text = text.replace(
        "\ncontrol_modes:\n",
        f"\ncontrol_modes:\n  faulty: {{{executors}, inference: {{model: broken}}}}\n",
    )
    (folder / "picks.yaml").write_text(text, encoding="utf-8")
    (folder / "reach.yaml").write_text(REACH, encoding="utf-8")
    return folder


@pytest.fixture(scope="module", autouse=True)
def _site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Installs the policies and the scene of `reach`."""
    plugins = Path(__file__).parents[1] / "shared/plugins"
    with (
        pytest.MonkeyPatch.context() as monkeypatch,
        made_up_site(tmp_path_factory.mktemp("installed") / "site", plugins, monkeypatch) as site,
    ):
        site.add("bad-policies", "bad_policies.py")
        with ready_forkserver():
            yield


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A new folder with the robot YAMLs for each test, so that a rerun starts from scratch."""
    (tmp_path / "eval").mkdir()
    return write_robots(tmp_path / "eval")


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with episodes_here(monkeypatch):
        yield


def evaluated(folder: Path, robot: str, episodes: int) -> Path:
    """An evaluation of two policies, in this process."""
    with pytest.MonkeyPatch.context() as monkeypatch, episodes_here(monkeypatch):
        done = evaluate(write_robots(folder), "--out", "whole", "--episodes", episodes, robot=robot)
    assert done.returncode == 0, done.stderr
    assert f"scripted  {episodes} of {episodes} succeeded" in done.stdout
    assert f"faulty    0 of {episodes} succeeded" in done.stdout
    return folder / "whole"


@pytest.fixture(scope="module")
def picked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return evaluated(tmp_path_factory.mktemp("picked"), "picks.yaml", episodes=1)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return evaluated(tmp_path_factory.mktemp("whole"), "reach.yaml", episodes=2)


def arguments(*more: object, robot: str = "reach.yaml") -> list[str]:
    policies = ("--mode", "scripted", "--mode", "faulty")
    return ["eval", robot, *policies, "--episodes", "2", "--videos", "1", *map(str, more)]


def evaluate(folder: Path, *more: object, robot: str = "reach.yaml") -> subprocess.CompletedProcess[str]:
    with chdir(folder):
        return run_here(*arguments(*more, robot=robot))


def digests(folder: Path) -> dict[str, str]:
    """Hash of every file of an evaluation."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def children(pid: int) -> list[int]:
    return list(map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()))


class Started:
    """An evaluation in a process of its own."""

    def __init__(self, folder: Path, *more: object) -> None:
        program = "from ibrobot_core.cli.command import main; main()"
        self.process = subprocess.Popen(
            [sys.executable, "-c", program, *arguments(*more)],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def await_episode(self) -> str:
        """Wait for the next episode."""
        assert self.process.stderr is not None
        return self.process.stderr.readline()

    def workers(self) -> list[int]:
        """The worker processes, which another process forks."""
        return [worker for child in children(self.process.pid) for worker in children(child)]

    def end(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, out, err


@pytest.fixture
def start(folder: Path) -> Iterator[Any]:
    started: list[Started] = []

    def begin(*more: object) -> Started:
        started.append(Started(folder, *more))
        return started[-1]

    yield begin
    for each in started:
        each.process.kill()
        each.process.communicate()


def test_two_processes_give_the_bytes_of_one(folder: Path, picked: Path) -> None:
    """Each of two worker processes runs one episode, whose bytes are those from the tests' process."""
    assert evaluate(folder, "--out", "two", "--jobs", 2, "--episodes", 1, robot="picks.yaml").returncode == 0
    assert digests(folder / "two") == digests(picked)
    assert len(list(picked.rglob("*.mcap"))) == 2
    assert len(list(picked.rglob("*.mp4"))) == 1


def test_printed_command_repeats_an_episode_byte_by_byte(folder: Path, picked: Path, tmp_path: Path) -> None:
    episode = json.loads((picked / "report.json").read_text())["episodes"][-1]
    assert (episode["policy"], episode["seed"], episode["success"]) == ("faulty", 0, False)
    program, *command = shlex.split(episode["command"])
    (tmp_path / "picks.yaml").write_bytes((folder / "picks.yaml").read_bytes())
    with chdir(tmp_path):
        assert (program, run_here(*command).returncode) == ("ibrobot", 3)
    repeated = tmp_path / "episodes/default/episodes/episode_000001"
    assert digests(repeated) == digests(picked / episode["recording"])


@pytest.mark.usefixtures("here")
def test_pictures_that_the_policy_does_not_look_at_are_recorded_on_request_only(tmp_path: Path) -> None:
    shared = "so101.yaml", "--sim", "--episodes", 1, "--jobs", 1, "--videos", 0, "--set", "contract.max_duration_s=1"
    lines = []
    for out, more in (("few", ()), ("all", ("--all-pictures",))):
        with chdir(tmp_path):
            assert run_here("eval", *map(str, (*shared, "--out", out, *more))).returncode == 0
        lines.append(topics_of(next((tmp_path / out / "episodes").rglob("*_000000"))))
    few, every = lines
    assert {topic for topic in every if topic not in few} == {"/camera/top/image_raw", "/camera/wrist/image_raw"}
    assert few == {topic: number for topic, number in every.items() if topic in few}
    assert few["/model_answers"] > 0


def topics_of(episode: Path) -> dict[str, int]:
    """Topic -> number of messages in a recording."""
    with closing(installed_plugins().open_episode(episode)) as reader:
        return dict(Counter(each.topic for each in reader.messages()))


def test_episode_of_a_killed_worker_is_run_again(start: Any, folder: Path, whole: Path) -> None:
    running = start("--out", "killed", "--jobs", 1)
    assert "(1 of 4)" in running.await_episode()
    (worker,) = running.workers()
    os.kill(worker, signal.SIGKILL)
    code, _, err = running.end()
    assert (code, [f"({n} of 4)" in err for n in range(2, 5)]) == (0, [True] * 3), err
    assert digests(folder / "killed") == digests(whole)


def test_interrupted_evaluation_goes_on_with_nothing_twice(start: Any, folder: Path, whole: Path) -> None:
    running = start("--out", "stopped", "--jobs", 1)
    running.await_episode()
    os.killpg(running.process.pid, signal.SIGINT)  # as a terminal does
    code, _, err = running.end()
    assert (code, "Traceback" in err) == (130, False), err
    assert "run the same command again to continue" in err
    results = {path: path.stat().st_mtime_ns for path in (folder / "stopped" / "results").rglob("*.json")}
    assert 1 <= len(results) < 4
    done = evaluate(folder, "--out", "stopped", "--jobs", 2)
    assert (done.returncode, done.stderr.count("success (") + done.stderr.count("failure (")) == (0, 4 - len(results))
    assert {path: path.stat().st_mtime_ns for path in results} == results
    assert digests(folder / "stopped") == digests(whole)


def test_workers_end_with_a_killed_command_and_write_nothing_more(start: Any, folder: Path) -> None:
    running = start("--out", "orphaned", "--jobs", 1)
    running.await_episode()
    (worker,) = running.workers()
    os.kill(worker, signal.SIGSTOP)  # at the beginning of its next episode
    running.process.kill()
    running.process.wait()
    results = sorted((folder / "orphaned/results").rglob("*.json"))
    os.kill(worker, signal.SIGCONT)
    deadline = time.monotonic() + PATIENCE_S
    while Path(f"/proc/{worker}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()
    assert sorted((folder / "orphaned/results").rglob("*.json")) == results


@pytest.mark.usefixtures("here")
def test_merged_shards_are_the_whole_evaluation(folder: Path, whole: Path) -> None:
    for number, videos in ((2, 0), (1, 1)):
        done = evaluate(folder, "--out", f"part{number}", "--shard", f"{number}/2", "--videos", videos, "--jobs", 1)
        assert done.returncode == 0, done.stderr
    with chdir(folder):
        twice = run_here("eval", "merge", "part1", "part2", "part1", "--out", "merged")
        other = run_here("eval", "merge", "part1", folder, "--out", "merged")
        (Path("other")).mkdir()
        settings = json.loads(Path("part2/evaluation.json").read_text())
        settings["policies"]["faulty"]["contract"] = "another"
        Path("other/evaluation.json").write_text(json.dumps(settings))
        contract = run_here("eval", "merge", "part1", "other", "--out", "merged")
        assert not Path("merged").exists()
        merged = run_here("eval", "merge", "part2", "part1", "--out", "merged")
    assert "part1: has scripted, seed 0, which part1 has too" in twice.stderr
    assert "is not an evaluation: it has no evaluation.json" in other.stderr
    assert "other: differs from part1: policies faulty contract changed" in contract.stderr
    assert (merged.returncode, "scripted  2 of 2 succeeded" in merged.stdout) == (0, True), merged.stderr
    assert digests(folder / "merged") == digests(whole)
    refused = evaluate(folder, "--out", "part3", "--shard", "2/1")
    assert "--shard: '2/1' is no part; give I/N with I from 1 to N, e.g. 2/8" in refused.stderr


@pytest.mark.parametrize("numbers", [(2,), pytest.param((1, 2), marks=pytest.mark.long)], ids=str)
def test_it_stops_as_soon_as_the_fault_is_certain(folder: Path, numbers: tuple[int, ...]) -> None:
    options = ("--until-decided", "--episodes", 30, "--set", "contract.max_duration_s=1")
    reports = []
    for jobs in numbers:
        done = evaluate(folder, *options, "--jobs", jobs, "--out", f"decided{jobs}")
        assert done.returncode == 0, done.stderr
        assert "scripted  8 of 8 succeeded" in done.stdout
        assert "scripted is better than faulty" in done.stdout
        reports.append(digests(folder / f"decided{jobs}"))
    assert reports[0] == reports[-1]
    done = evaluate(folder, *options, "--out", "decided2")
    assert (done.returncode, digests(folder / "decided2")) == (0, reports[0]), "the same command adds nothing"


@pytest.mark.usefixtures("here")
def test_policy_beside_itself_is_no_different(folder: Path) -> None:
    with chdir(folder):
        command = ("eval", "reach.yaml", "--mode", "scripted", "--mode", "again", "--episodes", 3, "--out", "self")
        done = run_here(*command, "--json")
    (comparison,) = json.loads(done.stdout)["comparisons"]
    assert comparison["pairs"] == {"first": 0, "second": 0, "same": 3}
    assert comparison["verdict"] == "undecided"
    assert comparison["more_episodes"] > 10


@pytest.mark.usefixtures("here")
def test_policies_of_several_yamls_are_compared(folder: Path) -> None:
    with chdir(folder):
        text = Path("reach.yaml").read_text().replace("max_duration_s: 20", "max_duration_s: 1")
        Path("short.yaml").write_text(text)
        Path("seldom.yaml").write_text(text.replace("how: poor}", "how: poor, every: 2}"))
        command = ("eval", "short.yaml", "seldom.yaml", "--mode", "faulty", "--episodes", 2, "--out", "yamls", "--json")
        done = run_here(*command)
    assert done.returncode == 0, done.stderr
    (comparison,) = json.loads(done.stdout)["comparisons"]
    assert (comparison["first"], comparison["second"]) == ("short", "seldom")
    assert comparison["pairs"] == {"first": 0, "second": 1, "same": 1}


def test_folder_of_other_settings_is_refused(folder: Path, whole: Path, tmp_path: Path) -> None:
    before = digests(whole)
    for more, said in (
        (("--seed", 5), "seed 0, now 5"),
        (("--margin", 0.2), "margin 0.1, now 0.2"),
        (("--set", "control.rate_hz=50"), "policies scripted robot YAML changed"),
        (("--mode", "again"), "policies again is new"),
        (("--episodes", 1), "--episodes must not be less"),
    ):
        done = evaluate(folder, "--out", whole, *more)
        assert (done.returncode, said in done.stderr) == (2, True), done.stderr
    assert digests(whole) == before
    (tmp_path / "else").write_text("something else")
    done = evaluate(folder, "--out", tmp_path)
    assert (done.returncode, "is not an evaluation; choose a new folder" in done.stderr) == (2, True), done.stderr


def test_folder_has_one_owner(start: Any, folder: Path) -> None:
    running = start("--out", "owned", "--jobs", 1)
    running.await_episode()
    (worker,) = running.workers()
    os.kill(worker, signal.SIGSTOP)  # so that it does not end before the other begins
    done = evaluate(folder, "--out", "owned")
    os.kill(worker, signal.SIGKILL)
    assert done.returncode == 1
    assert f"owned: is being evaluated by process {running.process.pid}" in done.stderr


def test_wrong_command_lines_name_the_remedy(folder: Path) -> None:
    for words, said in (
        (("--mode", "planned"), "control_modes.planned: has no inference; only policies can be evaluated"),
        (("--mode", "script"), "script"),
        (("--model", "other"), "has no model 'other'; the models are:"),
        (("--on", "slurm"), "unknown pool type 'slurm'"),
        (("--until-decided",), "--until-decided compares policies: give at least two"),
        (("--mode", "scripted", "--mode", "scripted"), "control_modes.scripted: is given twice"),
    ):
        with chdir(folder):
            done = run_here("eval", "picks.yaml", *words, "--out", "wrong")
        assert (done.returncode, said in done.stderr) == (2, True), done.stderr
        assert not (folder / "wrong").exists()


@pytest.mark.usefixtures("here")
def test_scene_without_a_task_is_an_error(folder: Path) -> None:
    with chdir(folder):
        done = run_here(
            "eval", "so101_blind", "--sim", "--set", "simulation.scene=empty", "--episodes", 1, "--out", "no"
        )
    assert done.returncode != 0
    assert "error:" in done.stderr


def test_events_tell_a_program_the_result(folder: Path, whole: Path) -> None:
    done = evaluate(folder, "--out", whole, "--events")
    begin, report = (json.loads(line) for line in done.stdout.splitlines())
    assert (done.returncode, begin) == (0, {"event": "begin", "of": 4, "done": 4})
    assert (report["event"], report["out"]) == ("report", str(whole))
    assert report["lines"][1].startswith("faulty    0 of 2 succeeded")


@pytest.mark.usefixtures("here")
def test_episode_with_a_varied_key_is_repeated_by_its_command(folder: Path, tmp_path: Path) -> None:
    with chdir(folder):
        options = (
            "--vary",
            "simulation.latency=0:0.02:2",
            "--episodes",
            2,
            "--seed",
            1,
            "--jobs",
            1,
            "--out",
            "varied",
        )
        done = run_here("eval", "picks.yaml", "--mode", "scripted", *options)
    assert done.returncode == 0, done.stderr
    episodes = json.loads((folder / "varied/report.json").read_text())["episodes"]
    assert [each["factors"]["latency"] for each in episodes] == [0.02, 0.0]
    assert all(0.1 < each["factors"]["cube_x"] < 0.3 for each in episodes)
    (tmp_path / "picks.yaml").write_bytes((folder / "picks.yaml").read_bytes())
    with chdir(tmp_path):
        run_here(*shlex.split(episodes[0]["command"])[1:])
    repeated = tmp_path / "episodes/default/episodes/episode_000001"
    assert digests(repeated) == digests(folder / "varied" / episodes[0]["recording"])
