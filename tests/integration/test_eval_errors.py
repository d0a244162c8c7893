"""`ibrobot eval` of policies that break: errors are counted apart from failures, and cost no other episode."""

from __future__ import annotations

import csv
import json
import random
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from typing import Any, override

import pytest
from command_line import run_here
from evaluations import MINI, Here, episodes_here, ready_forkserver
from ibrobot_provenance.jobs import Done, Job
from ibrobot_testing.site import Site, made_up_site

pytestmark = pytest.mark.integration

ROBOT = (
    MINI
    + """\
models:
  bad: {type: bad, how: good}
control_modes:
  policy: {executors: [all_position], inference: {model: bad}, dispatch: {watermark: 5}}
default_control_mode: policy
contract:
  rate_hz: 25
  max_duration_s: 2
  observations:
    - {key: observation.state, topic: /joint_states, select: [position.pan, position.grip]}
  actions:
    - {executor: all_position, topic: /all/commands}
control: {rate_hz: 50, stop: hold}
"""
)


@pytest.fixture(scope="module", autouse=True)
def _forkserver() -> Iterator[None]:
    with ready_forkserver():
        yield


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with episodes_here(monkeypatch):
        yield


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """A folder with the robot, and the policies that break."""
    plugins = Path(__file__).parents[1] / "shared/plugins"
    monkeypatch.chdir(tmp_path)
    Path("mini.yaml").write_text(ROBOT)
    with made_up_site(tmp_path / "site", plugins, monkeypatch) as site:
        site.add("bad-policies", "bad_policies.py")
        yield site


def evaluate(how: str, *more: object, episodes: int = 3, every: int = 1) -> Any:
    """Evaluate a policy; its report as JSON, with exit code and messages."""
    sets = ("--set", f"models.bad.how={how}", "--set", f"models.bad.every={every}")
    done = run_here(
        "eval", "mini.yaml", *sets, "--episodes", episodes, "--out", "out", "--jobs", 2, "--videos", 0, *more
    )
    file = Path("out/report.json")
    report = json.loads(file.read_text()) if file.exists() else None
    return done.returncode, report, done.stdout + done.stderr


ERRORS = {
    "raise": "requests to the policy failed: RuntimeError: shapes (7,) and (6,) do not match",
    "nan": "requests to the policy failed: ",
    "exit": "it ended its process, 2 times",
    "kill": "it ended its process, 2 times",
}


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("how", ["raise", "nan"])
def test_errors_are_no_failures(site: Site, how: str) -> None:
    """Every third episode breaks, and the others are run."""
    code, report, text = evaluate(how, every=3, episodes=4)
    check(how, code, report, text)
    assert [bool(each["recording"]) for each in report["episodes"]] == [True] * 4
    again, same, text = evaluate(how, every=3, episodes=4)
    assert (again, same) == (0, report), text


@pytest.mark.parametrize("how", ["exit", pytest.param("kill", marks=pytest.mark.long)])
def test_a_policy_that_ends_its_process_costs_no_other_episode(site: Site, how: str) -> None:
    code, report, text = evaluate(how, every=3, episodes=4)
    check(how, code, report, text)
    assert [bool(each["recording"]) for each in report["episodes"]] == [False, True, True, False]


def check(how: str, code: int, report: Any, text: str) -> None:
    """Check an evaluation of which the first and the last of four episodes break."""
    assert code == 0, text
    (policy,) = report["policies"]
    assert (policy["successes"], policy["errors"], policy["disturbed"]) == (2, 2, 0)
    assert [each["success"] for each in report["episodes"]] == [False, True, True, False]
    for number in (0, 3):
        assert ERRORS[how] in report["episodes"][number]["error"]
    assert "2 of 4 succeeded, 2 errors, 95 % interval" in text
    assert "policy: 2 episodes ended in an error: " in text
    rows = list(csv.DictReader(Path("out/report.csv").read_text().splitlines()))
    assert [bool(row["error"]) for row in rows] == [True, False, False, True]
    assert "## Errors" in Path("out/report.md").read_text()
    assert "Errors of policies" in Path("out/report.html").read_text()


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("how", ["raise", "nan"])
def test_an_evaluation_of_errors_alone_ends(site: Site, how: str) -> None:
    code, report, text = evaluate(how, episodes=40)
    assert code == 1
    assert "so far, all ended in an error, so this is no evaluation: " in text
    assert ERRORS[how] in text
    assert 1 <= len(report["episodes"]) <= 12, "it ends early, with a report"
    assert not any(each["success"] for each in report["episodes"])
    again, _, text = evaluate(how, episodes=40)
    assert (again, "to try again" in text) == (1, True)


@pytest.mark.usefixtures("here")
def test_a_poor_policy_has_failures_and_no_errors(site: Site) -> None:
    code, report, text = evaluate("poor", episodes=2)
    assert (code, [each["error"] for each in report["episodes"]]) == (0, ["", ""])
    assert "error" not in text.lower()


def test_a_policy_that_hangs_is_an_error(site: Site) -> None:
    code, report, text = evaluate("hang", "--answer-limit", 10, every=2, episodes=2)
    assert code == 0, text
    hung, good = report["episodes"]
    assert hung["error"].startswith("it hung: no step ended within 10 s (at ")
    assert "bad_policies.py" in hung["error"]
    assert good["success"]


@pytest.mark.usefixtures("here")
def test_an_episode_that_takes_too_long_is_an_error(site: Site) -> None:
    code, report, text = evaluate("poor", "--episode-limit", 1e-6, episodes=1)
    assert code == 1, text
    assert report["episodes"][0]["error"] == "it did not end within 1e-06 s"


@pytest.mark.usefixtures("here")
def test_a_film_that_differs_is_a_note(site: Site) -> None:
    """A policy that is never the same twice; its report is there before the films, and after them."""
    code, report, text = evaluate("moody", "--videos", 5, "--set", "contract.max_duration_s=0.4", episodes=6)
    assert code == 0, text
    failed = [each for each in report["episodes"] if not each["success"]]
    notes = [note for note in report["notes"] if "the policy is not deterministic" in note]
    assert len(failed) > 0
    assert report["notes"] == notes
    assert len(notes) + len(list(Path("out/videos").rglob("*.mp4"))) == min(5, len(failed))
    assert all(note in text for note in notes)


CODE = ("Python", "ibrobot-core", "lerobot", "mujoco", "numpy", "ray", "torch")


@pytest.fixture
def code(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """The installed code, as the test changes it."""
    made = dict.fromkeys(CODE, "1.0")
    monkeypatch.setattr("ibrobot_eval.episodes.installed_code", lambda providers: dict(made))
    return made


@pytest.mark.usefixtures("here", "site")
@pytest.mark.parametrize("package", CODE)
def test_code_that_changed_between_calls_is_refused(code: dict[str, str], package: str) -> None:
    evaluate("good", episodes=1)
    code[package] = "1.1"
    refused, _, text = evaluate("good", episodes=2)
    assert refused == 2
    assert f"out: was begun with other settings: versions {package} 1.0, now 1.1; choose a new folder" in text


@pytest.mark.usefixtures("here", "site")
@pytest.mark.parametrize("package", CODE)
def test_code_that_changes_during_an_evaluation_ends_it(
    code: dict[str, str], package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Changing(Here):
        """Finds other code after an episode."""

        @override
        def run[R](
            self, jobs: Iterable[Job[R]], watch: Callable[[int], None] = lambda count: None
        ) -> Generator[Done[R]]:
            for done in super().run(jobs, watch):
                code[package] = "1.1"
                yield done

    monkeypatch.setattr("ibrobot_eval.evaluation.open_pool", lambda *_: Changing())
    ended, _, text = evaluate("good", episodes=2)
    assert ended not in (0, 2)
    assert f"the installed code changed during the evaluation: {package} 1.1, not 1.0" in text
    assert len(list(Path("out/results/policy").iterdir())) == 1, "the episode before it is kept"


@pytest.mark.usefixtures("here")
def test_source_of_an_editable_plugin_counts(site: Site) -> None:
    direct = {"url": site.folder.as_uri(), "dir_info": {"editable": True}}
    (site.folder / "bad_policies-1.0.dist-info/direct_url.json").write_text(json.dumps(direct))
    evaluate("good", episodes=1)
    assert evaluate("good", episodes=2)[0] == 0
    with (site.folder / "bad_policies.py").open("a") as file:
        file.write("\nSUPERFLUOUS = True\n")
    refused, _, text = evaluate("good", episodes=3)
    assert refused == 2
    assert "versions bad-policies 1.0 (source " in text


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("left", [0, 0.5])
def test_a_damaged_result_is_made_again(site: Site, left: float) -> None:
    _, report, _ = evaluate("good", episodes=3)
    for file in random.Random(0).sample(sorted(Path("out/results/policy").iterdir()), 2):
        content = file.read_bytes()
        file.write_bytes(content[: int(len(content) * left)])
    merged = run_here("eval", "merge", "out", "--out", "merged")
    assert merged.returncode == 2
    assert "is not the result of an episode: " in merged.stderr
    code, again, text = evaluate("good", episodes=3)
    assert (code, again) == (0, report), text
    assert text.count("the episode is run again") == 2
