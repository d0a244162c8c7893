"""The views convert, datasets and training of `ibrobot ui`, and trained policies in robot YAMLs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from ibrobot_web.model_edit import with_model
from ibrobot_web.ui import convert, training
from ibrobot_web.ui.context import Ui
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.job_runner import Jobs
from ibrobot_web.ui.server import routes_of
from ui_server import UiServer, run_ui

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import find_config, installed_plugins

CONFIG = Path(find_config("so101_blind", installed_plugins()))
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
    found = routes_of(view)[route]
    return found.answer(ui, found.read(facts or {}))


@pytest.mark.parametrize("name", ["so101", "so101_blind", "so101_pick_cube", "bi_so101"])
def test_only_the_policy_changes_in_a_robot_yaml(name: str) -> None:
    old = Path(find_config(name, installed_plugins())).read_text(encoding="utf-8")
    edit = with_model(old, "/a folder/pretrained_model")
    before, after = old.splitlines(), edit.text.splitlines()
    kept = [line for line in before if line in after]
    assert len(before) - len(kept) <= 1, "at most the line with the path is another"
    assert [line for line in after if "#" in line] == [line for line in before if "#" in line], "comments stay"
    document = yaml.safe_load(edit.text)
    model = document["control_modes"][edit.mode]["inference"]["model"]
    assert document["models"][model] == {"type": "lerobot", "path": "/a folder/pretrained_model"}
    assert with_model(edit.text, "/b", model=model).text == edit.text.replace("/a folder/pretrained_model", "/b")


def test_comments_on_the_first_entries_stay_with_them() -> None:
    old = (
        "models:  # all\n  # the first\n  a: {type: x}\n"
        "control_modes: {hold: {executors: [p]}}\nexecutors:\n  p: {type: position}\n"
    )
    edit = with_model(old, "/p", model="new", mode="run")
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
        with_model(text, "/p", model=model)


def test_a_shipped_robot_is_copied_and_an_own_one_is_changed(ui: Ui) -> None:
    checkpoint = ask(ui, "training", "GET /list")["checkpoints"][0]["path"]
    assert checkpoint == "training/checkpoints/000010/pretrained_model"
    asked = {"robot": "so101_blind", "checkpoint": checkpoint}
    shipped = CONFIG.read_bytes()
    seen = ask(ui, "training", "GET /preview", asked)
    assert (seen["target"], seen["new"]) == ("so101_blind_trained.yaml", True)
    assert seen["problems"] == [] or ("hardware", "mujoco") not in installed_plugins().entries
    assert sum(line.startswith("+") for line in seen["diff"]) == 3, "a model, a mode, and the diff's head"
    assert not list(ui.folders.first.glob("*.yaml")), "looking changes nothing"
    done = ask(ui, "training", "POST /apply", {**asked, "digest": seen["digest"]})
    assert CONFIG.read_bytes() == shipped
    own = {"robot": done["robot"], "checkpoint": checkpoint}
    again = ask(ui, "training", "GET /preview", own)
    assert (again["target"], again["new"], again["diff"]) == ("so101_blind_trained.yaml", False, [])
    with pytest.raises(IbrobotError, match="exists already"):
        ask(ui, "training", "POST /apply", {**asked, "digest": seen["digest"]})
    (ui.folders.first / "wrong.yaml").write_text(shipped.decode().replace("upper:", "uper:", 1))
    assert any(
        "uper" in problem for problem in ask(ui, "training", "GET /preview", {**own, "robot": "wrong.yaml"})["problems"]
    )
    (ui.folders.first / done["robot"]).write_text(shipped.decode() + "# mine\n")
    with pytest.raises(IbrobotError, match="has changed since"):
        ask(ui, "training", "POST /apply", {**own, "digest": again["digest"]})


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
            ask(ui, "training", "GET /preview", facts)
        with pytest.raises(IbrobotError, match="outside the opened folders"):
            ask(ui, "training", "POST /apply", {**facts, "digest": "x"})
    train = {"dataset": "a", "out": "b", "steps": 1, "batch_size": 1}
    for wrong, error in (
        ({"dataset": "/etc"}, "outside"),
        ({"out": ".."}, "outside"),
        ({"policy": "--x=1"}, "must be names"),
        ({"device": "cpu --x"}, "must be names"),
        ({"steps": 0}, "steps: 0 is too small"),
        ({"steps": "x"}, "steps: expected a whole number"),
        ({"gpu": 1}, "gpu: unknown key"),
    ):
        with pytest.raises(IbrobotError, match=error):
            ask(ui, "training", "POST /start", {**train, **wrong})
    assert ui.jobs.all() == []


@needs_data
def test_conversions_are_confined_and_their_options_checked(ui: Ui) -> None:
    for wrong, error in (
        ({"paths": ["/etc"]}, "outside"), ({"out": "../x"}, "outside"), ({"out": "."}, "choose a new folder"),
        ({"only": "x"}, "only: 'x' is not one of"), ({"missing": "--help"}, "missing: '--help' is not one of"),
        ({"append": "yes"}, "append: expected true or false"), ({"out": 3}, "out: expected text"),
        ({"paths": []}, "paths: choose at least one"), ({"paths": None}, "paths: expected a list"),
    ):  # fmt: skip
        with pytest.raises(IbrobotError, match=error):
            ask(ui, "convert", "POST /start", {"paths": ["."], "out": "new", **wrong})
    assert ui.jobs.all() == []


def events(*found: dict[str, Any]) -> list[str]:
    return [json.dumps(each) for each in found]


def test_events_become_progress_results_and_problems() -> None:
    read = convert.event_reader()
    facts: dict[str, Any] = {}
    step = {"event": "progress", "of": 2, "total_frames": 100, "seconds": 1.0}
    report = {
        "event": "report", "episodes": 1, "frames": 50, "failed": 1, "passed_over": 0, "skipped_ticks": 3,
        "held_ticks": 0, "lost_messages": 0, "without_prompt": 0, "size_bytes": 2e6,
    }  # fmt: skip
    for line in (
        "a line",
        '{"event"',
        *events(
            {"event": "begin", "of": 2},
            {**step, "done": 0, "frames": 25},
            {**step, "done": 1, "frames": 50, "episode": "a", "error": "no contract\nat all"},
            report,
        ),
    ):
        facts |= read(line) or {}
    assert facts["problems"] == [{"episode": "a", "error": "no contract\nat all"}]
    assert facts["text"] == "1 episode, 50 frames, left out 1, ticks skipped 3; the dataset has 2.0 MB"
    assert facts["progress"] == 1.0


def test_the_loss_of_a_training_is_plotted(ui: Ui) -> None:
    read = training.event_reader(ui)
    facts: dict[str, Any] = {}
    said = []
    for line in events(
        {"event": "begin", "step": 0, "steps": 10},
        {"event": "progress", "step": 1, "steps": 10, "loss": 0.7, "seconds": 300.0},
        {"event": "progress", "step": 4, "steps": 10, "loss": 0.5, "seconds": 360.0},
        {"event": "progress", "step": 9, "steps": 10, "loss": 0.4, "seconds": 460.0},
        {"event": "report", "checkpoint": "training/checkpoints/000010/pretrained_model"},
    ):
        facts |= read(line) or {}
        said.append(facts["text"])
    assert said[1:4] == [
        "step 1 of 10, loss 0.7",
        "step 4 of 10, loss 0.5, about 2 min left",
        "step 9 of 10, loss 0.4, less than a minute left",
    ]
    assert (facts["points"], facts["steps"], facts["progress"]) == ([(1, 0.7), (4, 0.5), (9, 0.4)], 10, 1.0)


@needs_data
@needs_lerobot
def test_an_episode_is_converted_and_its_dataset_shown_and_played(tmp_path: Path) -> None:
    pytest.importorskip("ibrobot_mcap", reason="needs ibrobot-plugin-mcap")
    from made_episodes import JOINTS, make_episode

    from ibrobot_core.api import Contract, Feature, JointState, ObservationPart
    from ibrobot_core.app import Align

    names = ("pan", "tilt")
    state = ObservationPart(
        "observation.state", JOINTS, JointState.ros_type, tuple(f"position.{name}" for name in names), None, Align(),
        Feature("float32", (2,), tuple(f"{name}.pos" for name in names)),
    )  # fmt: skip
    contract = Contract(10, (state,), ()).canonical()
    make_episode(tmp_path / "pick/episodes/episode_000001", cameras=(), prompt="pick", contract=contract)

    async def test(server: UiServer) -> None:
        (group,) = (await server.get("convert/list"))["groups"]
        await server.post("convert/start", paths=[group["path"]], out="datasets/pick")
        job, lines = await server.job(lambda job: job["state"] in ("done", "failed"))
        assert job["state"] == "done", lines
        assert (job["facts"]["report"]["episodes"], job["facts"]["problems"]) == (1, [])
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
        facts = await server.get("datasets/open", path="datasets/pick:0")
        assert facts["motion"]["positions"][-1] == pytest.approx([1.0, 2.0], abs=0.1)
        with pytest.raises(RuntimeError, match="has no episode 7"):
            await server.get("datasets/open", path="datasets/pick:7")
        with pytest.raises(RuntimeError, match="outside the opened folders"):
            await server.get("datasets/info", path="..")
        server.ui.view_state["recordings"].forget()

    run_ui([tmp_path], test)
