"""`ibrobot explain` on recorded runs."""

from __future__ import annotations

import json

import pytest
from command_line import run_here
from made_runs import Made, Run, metadata

from ibrobot_core.api import EpisodeEnd, EpisodeStart
from ibrobot_core.app import installed_plugins

pytestmark = pytest.mark.integration  # another package records the bags


def record(folder, run):
    """Record a made run as a bag."""
    from ibrobot_testing.contexts import host_context

    descriptor = installed_plugins().find("recorder", "mcap")
    made = Made(run)
    summary = made.summary()
    recorder = descriptor.make(descriptor.options(), host_context())
    topics = {topic: each.type for topic, each in summary.topics.items()}
    folder.parent.mkdir(parents=True, exist_ok=True)
    recorder.begin(EpisodeStart(folder, summary.start_ns, topics, metadata(run)))
    for item in made.messages():
        recorder.write(item.topic, item.message, item.received_ns)
    recorder.end(EpisodeEnd(summary.end_ns, run.outcome, {}))
    recorder.close()
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three demonstrations, and two runs."""
    root = tmp_path_factory.mktemp("episodes")
    for number in range(3):
        record(root / "demos" / "episodes" / f"episode_{number + 1:06d}", Run(seed=number, acts=False, seconds=5))
    dark = Run(seed=20, seconds=4, outcome="failure", picture=lambda camera, picture, t_s: picture // 4)
    record(root / "runs" / "episodes" / "episode_000001", dark)
    record(root / "runs" / "episodes" / "episode_000002", Run(seed=21, seconds=4, latency_s=1.1, outcome="failure"))
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


def test_unreadable_episode_is_named_and_the_others_are_explained(folder, tmp_path):
    bad = tmp_path / "bad"
    bad.mkdir()
    (bad / "metadata.yaml").write_text("nothing: 1\n")
    done = run_here("explain", bad)
    assert done.returncode == 1
    assert str(bad) in done.stderr
