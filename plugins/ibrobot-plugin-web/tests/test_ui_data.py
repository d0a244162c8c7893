"""Jobs of other plugins, datasets and policies in `ibrobot ui`, and trained policies in robot YAMLs."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from ibrobot_provenance.processes import Jobs
from ibrobot_web.model_edit import with_model
from ibrobot_web.ui.context import Ui, read_facts
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.forms import read_form
from ibrobot_web.ui.recordings import Episodes
from ibrobot_web.ui.server import routes_of
from ui_server import UiServer, run_ui

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import Registry, find_config, installed_plugins

CONFIG = Path(find_config("so101_blind", installed_plugins()))
needs_eval = pytest.mark.skipif("eval" not in installed_plugins().commands, reason="needs ibrobot-plugin-eval")
needs_data = pytest.mark.skipif("convert" not in installed_plugins().commands, reason="needs ibrobot-plugin-data")
needs_lerobot = pytest.mark.skipif(
    "datasets" not in installed_plugins().commands, reason="needs ibrobot-plugin-lerobot"
)


@pytest.fixture
def ui(tmp_path: Path) -> Ui:
    folder = tmp_path / "work"
    folder.mkdir()
    (folder / "training/checkpoints/000010/pretrained_model").mkdir(parents=True)
    (folder / "training/checkpoints/000010/pretrained_model/config.json").write_text("{}")
    return Ui(Folders([folder]), Jobs(folder))


def ask(ui: Ui, view: str, route: str, facts: Any = None) -> Any:
    """The answer of a view to plain facts."""
    handler = routes_of(view)[route]
    return handler(ui, **read_facts(handler, facts or {}))


@pytest.mark.parametrize("name", ["so101", "so101_blind", "so101_pick_cube", "bi_so101"])
def test_only_the_policy_changes_in_a_robot_yaml(name: str) -> None:
    old = Path(find_config(name, installed_plugins())).read_text(encoding="utf-8")
    edit = with_model(old, "/a folder/pretrained_model", "lerobot")
    before, after = old.splitlines(), edit.text.splitlines()
    kept = [line for line in before if line in after]
    assert len(before) - len(kept) <= 1, "at most the line with the path is another"
    assert [line for line in after if "#" in line] == [line for line in before if "#" in line], "comments stay"
    document = yaml.safe_load(edit.text)
    model = document["control_modes"][edit.mode]["inference"]["model"]
    assert document["models"][model] == {"type": "lerobot", "path": "/a folder/pretrained_model"}
    assert with_model(edit.text, "/b", "lerobot", model=model).text == edit.text.replace(
        "/a folder/pretrained_model", "/b"
    )


def test_comments_on_the_first_entries_stay_with_them() -> None:
    old = (
        "models:  # all\n  # the first\n  a: {type: x}\n"
        "control_modes: {hold: {executors: [p]}}\nexecutors:\n  p: {type: position}\n"
    )
    edit = with_model(old, "/p", "lerobot", model="new", mode="run")
    assert edit.text == (
        'models:  # all\n  new: {type: lerobot, path: "/p"}\n  # the first\n  a: {type: x}\n'
        "control_modes: {hold: {executors: [p]}, run: {executors: [p], inference: {model: new}}}\n"
        "executors:\n  p: {type: position}\n"
    )


@pytest.mark.parametrize(
    ("text", "model", "error"),
    [
        ("models: {a: {type: x}}", "a", "is of another type"),
        ("models: [", "", "is not YAML"),
        ("models: 3", "", "models must be a mapping"),
        ("models:\ncontrol_modes: {}", "", "models is empty"),
        ("a: 1", "x}: {y", "use letters, digits and _"),
        ("models: {a: {type: lerobot}}", "a", "has no path"),
    ],
)
def test_what_cannot_be_edited_is_said(text: str, model: str, error: str) -> None:
    with pytest.raises(IbrobotError, match=error):
        with_model(text, "/p", "lerobot", model=model)


@needs_lerobot
def test_a_shipped_robot_is_copied_and_an_own_one_is_changed(ui: Ui) -> None:
    checkpoint = ask(ui, "policies", "GET /list")[0]["path"]
    assert checkpoint == "training/checkpoints/000010/pretrained_model"
    asked = {"robot": "so101_blind", "checkpoint": checkpoint}
    shipped = CONFIG.read_bytes()
    seen = ask(ui, "policies", "GET /preview", asked)
    assert (seen["target"], seen["new"]) == ("so101_blind_trained.yaml", True)
    assert seen["problems"] == [] or ("hardware", "mujoco") not in installed_plugins().entries
    assert sum(line.startswith("+") for line in seen["diff"]) == 3, "a model, a mode, and the diff's head"
    assert not list(ui.folders.first.glob("*.yaml")), "looking changes nothing"
    done = ask(ui, "policies", "POST /apply", {**asked, "digest": seen["digest"]})
    assert CONFIG.read_bytes() == shipped
    own = {"robot": done["robot"], "checkpoint": checkpoint}
    again = ask(ui, "policies", "GET /preview", own)
    assert (again["target"], again["new"], again["diff"]) == ("so101_blind_trained.yaml", False, [])
    with pytest.raises(IbrobotError, match="exists already"):
        ask(ui, "policies", "POST /apply", {**asked, "digest": seen["digest"]})
    (ui.folders.first / "wrong.yaml").write_text(shipped.decode().replace("upper:", "uper:", 1))
    assert any(
        "uper" in problem for problem in ask(ui, "policies", "GET /preview", {**own, "robot": "wrong.yaml"})["problems"]
    )
    (ui.folders.first / done["robot"]).write_text(shipped.decode() + "# mine\n")
    with pytest.raises(IbrobotError, match="has changed since"):
        ask(ui, "policies", "POST /apply", {**own, "digest": again["digest"]})


def test_nothing_outside_the_opened_folders_is_read_or_written(ui: Ui, tmp_path: Path) -> None:
    inside = "training/checkpoints/000010/pretrained_model"
    shutil.copytree(ui.folders.first / inside, tmp_path / "outside")
    for facts in (
        {"robot": "so101_blind", "checkpoint": "../outside"},
        {"robot": "../x.yaml", "checkpoint": inside},
        {"robot": "so101_blind", "checkpoint": inside, "target": "../x.yaml"},
        {"robot": "so101_blind", "checkpoint": inside, "target": "/etc/x.yaml"},
    ):
        with pytest.raises(IbrobotError, match="outside the opened folders"):
            ask(ui, "policies", "GET /preview", facts)
        with pytest.raises(IbrobotError, match="outside the opened folders"):
            ask(ui, "policies", "POST /apply", {**facts, "digest": "x"})
    assert ui.jobs.all() == []


def start(ui: Ui, command: str, **values: Any) -> Any:
    """Ask for a job with the values of its form."""
    return ask(ui, "jobs", "POST /start", {"command": command, "values": values})


@needs_lerobot
@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"dataset": "/etc"}, "outside"),
        ({"out": ".."}, "outside"),
        ({"policy": "--x=1"}, "Policy: '--x=1' is not a name such as act"),
        ({"device": "cpu --x"}, "Device: 'cpu --x' is not a name such as cuda:0"),
        ({"steps": 0}, "Steps: 0 is too small, must be at least 1"),
        ({"steps": "x"}, "Steps: expected a whole number"),
        ({"gpu": 1}, "has no field gpu"),
        ({"lerobot_options": ["--output_dir=/etc"]}, "has no field lerobot_options"),
    ],
)
def test_trainings_are_confined_and_checked_in_the_words_of_the_form(ui: Ui, wrong: Any, error: str) -> None:
    with pytest.raises(IbrobotError, match=error):
        start(ui, "train", **{"dataset": "a", "out": "b", "steps": 1, "batch_size": 1, **wrong})
    assert ui.jobs.all() == []


@needs_data
@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"episodes": ["/etc"]}, "outside"),
        ({"out": "../x"}, "outside"),
        ({"config": "/etc/robot.yaml"}, "outside"),
        ({"calibration": "/etc/passwd"}, "Calibration: '/etc/passwd' is no name"),
        ({"only": "x"}, "Rows: 'x' is not one of"),
        ({"missing": "--help"}, "Missing observations: '--help' is not one of"),
        ({"outcome": ["success", "lost"]}, "Outcomes: 'lost' is not one of"),
        ({"append": "yes"}, "Add to it: expected true or false"),
        ({"out": 3}, "Dataset: expected text"),
        ({"episodes": []}, "Episodes: choose at least one"),
        ({"episodes": None}, "Episodes: required key is missing"),
    ],
)
def test_conversions_are_confined_and_checked_in_the_words_of_the_form(ui: Ui, wrong: Any, error: str) -> None:
    with pytest.raises(IbrobotError, match=error):
        start(ui, "convert", **{"episodes": ["."], "out": "new", **wrong})
    assert ui.jobs.all() == []


@needs_eval
def test_form_may_name_several_robots(ui: Ui) -> None:
    command = installed_plugins().command("eval")
    found = read_form(ui, command, {"config": ["so101_pick_cube", "so101_blind"], "out": "new"})
    assert found.config == ("so101_pick_cube", "so101_blind")


@needs_eval
@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"config": ["/etc/robot.yaml"]}, "outside"),
        ({"config": ["so101_pick_cube", "../robot.yaml"]}, "outside"),
        ({"out": "/etc"}, "outside"),
        ({"margin": 2}, "Margin: 2.0 is too large"),
        ({"mode": "scripted"}, "Modes: expected a list"),
        ({"config": None}, "Config: required key is missing|Robot YAML: required key is missing"),
    ],
)
def test_evaluations_are_confined_and_checked_in_the_words_of_the_form(ui: Ui, wrong: Any, error: str) -> None:
    with pytest.raises(IbrobotError, match=error):
        start(ui, "eval", **{"config": ["so101_pick_cube"], "mode": ["scripted"], "out": "new", **wrong})
    assert ui.jobs.all() == []


@pytest.mark.parametrize("command", ["launch", "episodes", "episodes delete", "", "--help"])
def test_only_jobs_run_by_a_form(ui: Ui, command: str) -> None:
    with pytest.raises(IbrobotError, match="is no job"):
        start(ui, command)


def test_a_job_that_is_not_installed_names_its_package(ui: Ui, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ibrobot_web.ui.forms.installed_plugins", Registry)
    monkeypatch.setattr("ibrobot_web.ui.jobs.installed_plugins", Registry)
    form = ask(ui, "jobs", "GET /form", {"command": "convert"})
    missing = "ibrobot convert needs a plugin that is not installed: pip install ibrobot-plugin-data"
    assert (form["fields"], form["missing"]) == ([], missing)
    with pytest.raises(IbrobotError, match="pip install ibrobot-plugin-data"):
        start(ui, "convert", out="new")


@needs_data
@needs_lerobot
def test_an_episode_is_converted_and_its_dataset_shown_and_played(tmp_path: Path) -> None:
    pytest.importorskip("ibrobot_mcap", reason="needs ibrobot-plugin-mcap")
    from made_episodes import JOINTS, make_episode

    from ibrobot_core.api import Contract, Feature, JointState, ObservationPart
    from ibrobot_core.app import Align

    names = ("pan", "tilt")
    state = ObservationPart(
        "observation.state",
        JOINTS,
        JointState.ros_type,
        tuple(f"position.{name}" for name in names),
        None,
        Align(),
        Feature("float32", (2,), tuple(f"{name}.pos" for name in names)),
    )
    contract = Contract(10, (state,), ()).canonical()
    make_episode(tmp_path / "pick/episodes/episode_000001", cameras=(), prompt="pick", contract=contract)

    async def test(server: UiServer) -> None:
        form = await server.get("jobs/form", command="convert")
        (episodes,) = form["known"]["episodes"]
        assert episodes["text"] == "pick: 1 success"
        assert [each["suggest"] for each in form["fields"] if each["name"] == "outcome"] == ["success"]
        values = {"episodes": [episodes["value"]], "out": "datasets/pick"}
        await server.post("jobs/start", command="convert", values=values)
        job, lines = await server.job(lambda job: job["state"] in ("done", "failed"))
        assert job["state"] == "done", lines
        assert job["facts"]["text"].startswith("1 episode, ")
        assert job["facts"]["made"] == [{"kind": "dataset", "path": "datasets/pick"}]
        assert "problems" not in job["facts"]
        assert await server.get("datasets/list") == ["datasets/pick"]
        info = await server.get("datasets/info", path="datasets/pick")
        (feature,) = info["features"]
        assert (info["episodes"], info["fps"], info["tasks"]) == (1, 10, ["pick"])
        assert (feature["key"], feature["unit"], feature["names"]) == (
            "observation.state",
            "rad",
            ["pan.pos", "tilt.pos"],
        )
        assert feature["stats"]["max"] == pytest.approx([1.0, 2.0], abs=0.1)
        facts = await server.get("episodes/open", path="datasets/pick:0")
        assert facts["motion"]["positions"][-1] == pytest.approx([1.0, 2.0], abs=0.1)
        with pytest.raises(RuntimeError, match="has no episode 7"):
            await server.get("episodes/open", path="datasets/pick:7")
        with pytest.raises(RuntimeError, match="outside the opened folders"):
            await server.get("datasets/info", path="..")
        server.ui.keep(Episodes).close()
        await server.post("jobs/start", command="convert", values={**values, "missing": "hold"})
        job, _ = await server.job(lambda job: job["number"] == 2 and job["state"] in ("done", "failed"))
        assert job["state"] == "failed"
        assert job["facts"]["error"] == "datasets/pick: already has a dataset; “Add to it” adds to it"

    run_ui([tmp_path], test)
