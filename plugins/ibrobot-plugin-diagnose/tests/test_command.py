"""`ibrobot explain` on recorded runs."""

from __future__ import annotations

import json
import os
import re
import shutil
from importlib.util import find_spec

import numpy as np
import pytest
import trainer
from command_line import run_here
from ibrobot_diagnose.commands.check import lines_of
from ibrobot_diagnose.references import read_episode
from ibrobot_provenance.reports import Cases, ReportDescriptor, Text
from made_runs import Run, record_run

from ibrobot_core.api import DatasetError, RecorderError
from ibrobot_core.app import installed_plugins

pytestmark = [
    pytest.mark.integration,  # another package records the bags
    pytest.mark.skipif(find_spec("ibrobot_mcap") is None, reason="needs ibrobot-plugin-mcap"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three demonstrations, and two runs."""
    root = tmp_path_factory.mktemp("episodes")
    for number in range(3):
        record_run(root / "demos" / "episodes" / f"episode_{number + 1:06d}", Run(seed=number, acts=False, seconds=5))
    dark = Run(seed=20, seconds=4, outcome="failure", picture=lambda camera, picture, t_s: picture // 4)
    record_run(root / "runs" / "episodes" / "episode_000001", dark)
    record_run(root / "runs" / "episodes" / "episode_000002", Run(seed=21, seconds=4, latency_s=1.1, outcome="failure"))
    return root


def test_first_line_is_the_cause_and_the_remedy_follows(folder):
    done = run_here("explain", folder / "runs" / "episodes" / "episode_000002")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("The model needed 1")
    assert "What to do: Make the model faster" in done.stdout
    assert "--data" in done.stdout


def test_dataset_of_the_model_shows_more_causes(folder):
    done = run_here("explain", folder / "runs:1", "--data", folder / "demos", "--json")
    (explained,) = json.loads(done.stdout)
    assert explained["causes"][0]["name"] == "picture_dark"
    assert explained["first"] == explained["causes"][0]["text"]
    assert explained["causes"][0]["number"] < 40
    assert "ticks" not in explained


def test_ticks_are_added_on_request(folder):
    done = run_here("explain", folder / "runs:2", "--ticks", "--json")
    (explained,) = json.loads(done.stdout)
    assert {"hold", "policy"} <= {each["by"] for each in explained["ticks"]}
    assert explained["between"]["share_held"] > 0.1


@pytest.mark.usefixtures("fork_server")
def test_unreadable_episode_is_named_and_the_others_are_explained(folder, tmp_path):
    bad = tmp_path / "bad"
    bad.mkdir()
    (bad / "metadata.yaml").write_text("nothing: 1\n")
    alone = run_here("explain", bad)
    assert (alone.returncode, alone.stdout) == (2, "")
    assert f"error: {bad}: has no .mcap or .db3 file" in alone.stderr
    both = run_here("explain", bad, folder / "runs" / "episodes" / "episode_000001", "--jobs", 1)
    assert both.returncode == 1
    assert str(bad) in both.stderr
    assert both.stdout.startswith("None of the ")


@pytest.mark.usefixtures("fork_server")
@pytest.mark.parametrize(
    ("damaged", "says"),
    [
        (1, "Nothing was found in 2 episodes; 1 of 3 episodes could not be read."),
        (3, "Nothing was checked: 3 of 3 episodes could not be read."),
    ],
)
def test_check_says_how_many_episodes_it_could_not_read(damaged, says, folder, tmp_path):
    """That nothing was found says nothing of them."""
    for number in range(3):
        record_run(tmp_path / f"pick/episodes/episode_{number}", Run(seed=number, acts=False, seconds=5, cameras=()))
    for number in range(damaged):
        (bag,) = (tmp_path / f"pick/episodes/episode_{number}").glob("*.mcap")
        bag.write_bytes(b"no bag")
    done = run_here("datasets", "check", tmp_path / "pick", "--jobs", 1)
    assert done.returncode == 1
    assert done.stdout.endswith(f"{damaged} of 3 episodes could not be read{'.' if damaged == 3 else ''}\n")
    assert done.stderr.count("unreadable: ") == damaged
    facts = json.loads(run_here("datasets", "check", tmp_path / "pick", "--jobs", 1, "--json").stdout)
    assert lines_of({**facts, "listed": []})[-1] == says


@pytest.mark.usefixtures("fork_server")
def test_check_lists_the_worst_episode_first(folder):
    record_run(folder / "demos" / "episodes" / "episode_000009", Run(seed=9, acts=False, seconds=9, idle_s=4.0))
    done = run_here("datasets", "check", folder / "demos", "--json", "--jobs", 1)
    assert done.returncode == 0, done.stderr
    checked = json.loads(done.stdout)
    assert checked["episodes"] == 4
    assert checked["listed"][0]["episode"].endswith("episode_000009")
    assert checked["listed"][0]["causes"][0]["name"] == "idle_start"
    assert "idle_start" in checked["counts"]


@pytest.mark.usefixtures("fork_server")
def test_episodes_of_a_single_reading_are_not_said_to_be_like_one_another(tmp_path):
    for number in range(2):
        record_run(tmp_path / "episodes" / f"episode_{number}", Run(seed=number, acts=False, seconds=0.01, cameras=()))
    done = run_here("datasets", "check", tmp_path, "--jobs", 1)
    assert done.returncode == 1
    assert done.stderr.count("nothing can be checked: it has 1 reading of joints") == 2


@pytest.mark.usefixtures("fork_server")
def test_check_writes_a_report_with_what_mends_each_episode(folder, tmp_path):
    from ibrobot_diagnose.check_contents import lines_of, read_contents

    demos = tmp_path / "demos" / "episodes"
    for number in range(3):
        record_run(demos / f"episode_00000{number}", Run(seed=number, acts=False, seconds=5))
    record_run(demos / "episode_000009", Run(seed=9, acts=False, seconds=14, idle_s=4.0, outcome="unknown"))
    done = run_here("datasets", "check", tmp_path / "demos", "--out", tmp_path / "check", "--jobs", 1)
    assert done.stdout.rstrip().endswith(f"report: {tmp_path / 'check' / 'report.html'}")
    page = (tmp_path / "check" / "report.html").read_text()
    assert page.count("<img") >= 2
    assert not re.search(r"""(?:src|href)=["']?https?:""", page)
    assert lines_of(tmp_path / "check")[0] in done.stdout
    (shown,) = (each for each in read_contents(tmp_path / "check")[0].blocks if isinstance(each, Cases))
    (case,) = (each for each in shown.cases if "episode_000009" in each.title)
    assert case.episode == demos / "episode_000009"
    cut, success, failure, drop = case.fixes
    assert re.fullmatch(r"Cut the first 3\.\d s and the last \d\.\d s", cut.label)
    assert (cut.does, cut.outcome) == ("trim", "unknown")
    assert 3 < cut.begin_s < cut.end_s < 14
    assert [(each.does, each.outcome) for each in (success, failure, drop)] == [
        ("mark", "success"), ("mark", "failure"), ("delete", ""),
    ]  # fmt: skip
    trimmed = run_here("episodes", "trim", case.episode, "--from", cut.begin_s, "--to", cut.end_s, "--in-place")
    assert trimmed.returncode == 0, trimmed.stderr
    (shown,) = (each for each in read_contents(tmp_path / "check")[0].blocks if isinstance(each, Cases))
    (case,) = (each for each in shown.cases if "episode_000009" in each.title)
    assert case.fixes == ()
    assert case.text.endswith("It has changed since the check.")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[]", "cannot be read: it has no first line"),
        ("{", "cannot be read"),
        ('{"first": "x"}', "is not a check of a dataset"),
        ('{"first": "x", "listed": [{}], "paths": ["a"], "folders": [0]}', "is not a check of a dataset"),
        ('{"first": "x", "listed": [{"causes": []}], "paths": ["a"], "folders": [0]}', "is not a check of a dataset"),
    ],
)
def test_damaged_check_is_named(tmp_path, text, problem):
    descriptor = installed_plugins().find("report", "check")
    assert isinstance(descriptor, ReportDescriptor)
    assert not descriptor.reads(tmp_path)
    (tmp_path / "check.json").write_text(text)
    assert descriptor.reads(tmp_path)
    with pytest.raises(DatasetError, match=rf"check\.json: {problem}"):
        descriptor.make(tmp_path)


def test_card_of_a_dataset_is_made_and_used(folder, tmp_path):
    card = tmp_path / "reference.json"
    assert run_here("datasets", "card", folder / "demos", "--out", card).returncode == 0
    (explained,) = json.loads(run_here("explain", folder / "runs:1", "--data", card, "--json").stdout)
    assert explained["causes"][0]["name"] == "picture_dark"


@pytest.mark.parametrize("text", ["{", '{"schema": "ibrobot card", "version": 2}', '{"schema": "another"}'])
def test_bad_card_is_named(folder, tmp_path, text):
    card = tmp_path / "reference.json"
    card.write_text(text)
    done = run_here("explain", folder / "runs:1", "--data", card)
    assert done.returncode == 2
    assert str(card) in done.stderr


@pytest.fixture(scope="module")
def dataset(folder, tmp_path_factory):
    """A LeRobot dataset of the demonstrations."""
    out = tmp_path_factory.mktemp("datasets") / "demos"
    done = run_here("convert", folder / "demos", "--out", out, "--jobs", 1, "--codec", "h264")
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.usefixtures("fork_server")
@pytest.mark.parametrize("described", [True, False], ids=["of ibrobot", "of others"])
def test_lerobot_dataset_is_checked_and_is_data_for_explain(folder, dataset, described, tmp_path):
    root = tmp_path / "demos"
    shutil.copytree(dataset, root)
    if not described:
        (root / "meta" / "ibrobot.json").unlink()
    checked = json.loads(run_here("datasets", "check", root, "--json", "--jobs", 1).stdout)
    assert (checked["episodes"], checked["unreadable"]) == (len(list(folder.glob("demos/*/*"))), [])
    (explained,) = json.loads(run_here("explain", folder / "runs:1", "--data", root, "--json").stdout)
    assert explained["causes"][0]["name"] == "picture_dark"


@pytest.mark.usefixtures("fork_server")
def test_training_writes_the_card_beside_its_checkpoint(folder, dataset, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr("ibrobot_lerobot.trainer.find_trainer", lambda: str(trainer.install(tmp_path)))
    weights = tmp_path / "torch/hub/checkpoints/resnet18-stand_in.pth"
    weights.parent.mkdir(parents=True)
    weights.touch()
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    done = run_here("train", dataset, "--out", tmp_path / "out", "--steps", 10)
    assert done.returncode == 0, done.stderr
    card = json.loads((tmp_path / "out/checkpoints/last/pretrained_model/reference.json").read_text())
    assert card["trained"] == {"policy": "small_act", "step": 10, "steps": 10, "batch_size": 32, "dataset": "demos"}
    (explained,) = json.loads(run_here("explain", folder / "runs:1", "--data", tmp_path / "out", "--json").stdout)
    assert {"picture_dark", "checkpoint_early"} <= {each["name"] for each in explained["causes"]}


@pytest.mark.usefixtures("fork_server")
def test_report_is_one_page_that_needs_no_network(folder, tmp_path):
    from ibrobot_diagnose.contents import lines_of, read_contents

    done = run_here("explain", folder / "runs:1", "--data", folder / "demos", "--out", tmp_path / "one")
    assert done.stdout.rstrip().endswith(f"report: {tmp_path / 'one' / 'report.html'}")
    page = (tmp_path / "one" / "report.html").read_text()
    assert page.count("<img") > 10
    assert not re.search(r"""(?:src|href)=["']?https?:""", page)
    assert "too dark" in page
    assert "What to do" in page
    sections = read_contents(tmp_path / "one")
    first = sections[0].blocks[0]
    assert isinstance(first, Text)
    assert first.text == lines_of(tmp_path / "one")[0] == done.stdout.splitlines()[0]
    several = run_here("explain", folder / "runs", "--out", tmp_path / "all", "--jobs", 1)
    assert several.returncode == 0, several.stderr
    assert len(list(tmp_path.glob("all/*/report.html"))) == 2


def test_explanation_is_a_report_of_pages(folder, tmp_path):
    descriptor = installed_plugins().find("report", "explanation")
    assert isinstance(descriptor, ReportDescriptor)
    assert not descriptor.reads(tmp_path)
    (tmp_path / "explanation.json").write_text("[]")
    assert descriptor.reads(tmp_path)
    with pytest.raises(DatasetError, match=r"explanation\.json: cannot be read"):
        descriptor.make(tmp_path)


def test_run_is_compared_with_one_that_worked(folder):
    good = record_run(folder / "good" / "episode_000001", Run(seed=22, seconds=4))
    (explained,) = json.loads(run_here("explain", folder / "runs:1", "--against", good, "--json").stdout)
    assert explained["causes"][0]["name"] == "picture_dark"
    assert explained["lines"][-1] == f"“The data” stands here for what it is compared with: 1 run of {good}."
    both = run_here("explain", folder / "runs:1", "--against", good, "--data", folder / "demos")
    assert both.returncode == 2
    assert "exclude each other" in both.stderr


def as_others_write(root, version, names, action=lambda entry: entry):
    """Make a dataset of ibrobot one of another program: of version 2.1, a file of each episode and lines of JSON.

    `names` is what its features say of their elements; `action` makes the entry of the actions another one.
    """
    import pyarrow.parquet as pq

    (root / "meta/ibrobot.json").unlink()
    info = json.loads((root / "meta/info.json").read_text())
    for key in ("observation.state", "action"):
        info["features"][key]["names"] = names
    info["features"]["action"] = action(info["features"]["action"])
    if version == "v2.1":
        table = pq.read_table(root / "data/chunk-000/file-000.parquet")
        numbers = table["episode_index"].to_pylist()
        shutil.rmtree(root / "data")
        shutil.rmtree(root / "meta/episodes")
        (root / "meta/tasks.parquet").unlink()
        (root / "data/chunk-000").mkdir(parents=True)
        lines = []
        for number in dict.fromkeys(numbers):
            rows = table.slice(numbers.index(number), numbers.count(number))
            pq.write_table(rows, root / f"data/chunk-000/episode_{number:06d}.parquet")
            lines.append({"episode_index": number, "tasks": ["pick up the cube"], "length": len(rows)})
        (root / "meta/episodes.jsonl").write_text("".join(json.dumps(each) + "\n" for each in lines))
        (root / "meta/tasks.jsonl").write_text('{"task_index": 0, "task": "pick up the cube"}\n')
        info |= {
            "codebase_version": version, "chunks_size": 1000,
            "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        }  # fmt: skip
    (root / "meta/info.json").write_text(json.dumps(info))
    return root


@pytest.fixture(scope="module")
def plain_dataset(tmp_path_factory):
    """A LeRobot dataset of three demonstrations without cameras, of which the second trembles."""
    root = tmp_path_factory.mktemp("plain")
    for number in range(3):
        shake = 0.05 if number == 1 else 0.0
        run = Run(seed=number, acts=False, seconds=5, cameras=(), shake=shake)
        record_run(root / f"demos/episodes/episode_{number + 1:06d}", run)
    done = run_here("convert", root / "demos", "--out", root / "set", "--jobs", 1)
    assert done.returncode == 0, done.stderr
    return root / "set"


NAMED = ["pan", "lift", "elbow", "gripper"]


@pytest.mark.parametrize(
    ("names", "first"),
    [
        (NAMED, "pan"),
        ([NAMED], "pan"),
        ({"motors": NAMED}, "pan"),
        ({"lift": 1, "pan": 0, "gripper": 3, "elbow": 2}, "pan"),
        (None, "joint_1"),
        (["state"], "joint_1"),
        (["a", "a", "a", "a"], "joint_1"),
        (["a", "a.pos", "b", "c"], "joint_1"),
    ],
    ids=[
        "a list",
        "a list in a list",
        "a list in an object",
        "places",
        "none",
        "too few",
        "one for all",
        "two for one",
    ],
)
def test_foreign_datasets_are_read_however_they_name_joints(names, first, plain_dataset, tmp_path):
    root = as_others_write(shutil.copytree(plain_dataset, tmp_path / "set"), "v3.0", names)
    window = read_episode(root.with_name("set:1"))
    assert window.joints[0] == first
    assert np.isfinite(window.states).all()


@pytest.mark.usefixtures("fork_server")
def test_dataset_of_version_2_1_is_checked(plain_dataset, tmp_path):
    root = as_others_write(shutil.copytree(plain_dataset, tmp_path / "set"), "v2.1", [NAMED])
    checked = json.loads(run_here("datasets", "check", root, "--json", "--jobs", 1).stdout)
    assert (checked["episodes"], checked["unreadable"]) == (3, [])
    assert [each["causes"][0]["name"] for each in checked["listed"]] == ["jerk"]
    assert checked["listed"][0]["episode"].endswith(":1")


@pytest.mark.parametrize(
    ("names", "action", "says"),
    [
        (None, lambda entry: {**entry, "shape": [3]}, "observation.state has 4 elements and action 3, and not both"),
        (NAMED, lambda entry: {**entry, "shape": [2, 2]}, "has no vector action, so joints are unknown; its features:"),
        (NAMED, lambda entry: {**entry, "shape": [10**12]}, "has no vector action, so joints are unknown"),
        (NAMED, lambda entry: {**entry, "shape": None}, "has no vector action, so joints are unknown"),
    ],
    ids=["other size", "a matrix", "too large", "no shape"],
)
def test_dataset_whose_joints_are_unknown_is_refused(names, action, says, plain_dataset, tmp_path):
    root = as_others_write(shutil.copytree(plain_dataset, tmp_path / "set"), "v3.0", names, action)
    with pytest.raises(RecorderError, match=says):
        read_episode(root.with_name("set:0"))


@pytest.mark.parametrize("shape", [None, [], [3], ["x", 1, 2], [4, 4, 4, 3], {}])
def test_pictures_without_a_size_are_named_with_their_feature(shape, plain_dataset, tmp_path):
    root = as_others_write(shutil.copytree(plain_dataset, tmp_path / "set"), "v3.0", NAMED)
    info = json.loads((root / "meta/info.json").read_text())
    info["features"]["observation.images.top"] = {"dtype": "video", "shape": shape}
    (root / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(RecorderError, match=r"info.json: features: observation.images.top: shape: pictures have \[he"):
        read_episode(root.with_name("set:0"))
