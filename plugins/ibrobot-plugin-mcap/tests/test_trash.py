"""Deleting and trimming episodes so that both can be undone."""

from __future__ import annotations

import json
import re
import shlex

import pytest
from click.testing import CliRunner
from ibrobot_mcap import trash
from ibrobot_mcap.commands.find_episodes import episodes_in
from ibrobot_mcap.reader import Rosbag2Reader
from ibrobot_testing.command import command_line

from ibrobot_core.api import RecorderError

from .conftest import JOINTS, Bench, read, stamp, summary

episodes = command_line("episodes")


@pytest.fixture
def episode(tmp_path):
    (tmp_path / "pick" / "episodes").mkdir(parents=True)
    bench = Bench(tmp_path / "pick" / "episodes")
    bench.begin(prompt="pick")
    bench.write(100)
    bench.end()
    return bench.path


def files(folder):
    return {str(each.relative_to(folder)): each.read_bytes() for each in folder.rglob("*") if each.is_file()}


def run(*arguments):
    result = CliRunner().invoke(episodes, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_a_deleted_episode_comes_back_as_it_was(tmp_path, episode):
    before = files(tmp_path)
    assert "moved to .trash" in run("delete", "--to-trash", episode)
    assert not episode.exists()
    with pytest.raises(RecorderError, match="contains no episode"):
        episodes_in(tmp_path)
    for path in (tmp_path, tmp_path / "pick", tmp_path / "pick/episodes"):
        (row,) = json.loads(run("trash", path, "--json"))
    assert (row["done"], row["path"]) == ("deleted", str(episode))
    assert "restored" in run("trash", tmp_path, "--restore", row["id"])
    assert files(tmp_path) == before, "nothing else is left"


@pytest.mark.parametrize("change", [("delete", "--to-trash"), ("trim", "--in-place", "--from", "0.3")])
def test_the_command_that_undoes_a_change_is_the_one_that_it_prints(tmp_path, episode, change):
    folder = (tmp_path / "pick").rename(tmp_path / "my picks")
    episode = folder / episode.relative_to(tmp_path / "pick")
    before = {name: content for name, content in files(episode).items() if name.endswith(".mcap")}
    command, *arguments = change
    (undo,) = re.findall(r"^to undo: `ibrobot episodes (.*)`$", run(command, episode, *arguments), re.MULTILINE)
    assert {name: files(tmp_path).get(str(episode.relative_to(tmp_path) / name)) for name in before} != before
    assert "restored" in run(*shlex.split(undo))
    assert {name: files(episode)[name] for name in before} == before


def test_a_trim_in_place_keeps_the_original_until_the_trash_is_emptied(tmp_path, episode):
    before = files(episode)
    run("mark", episode, "failure")
    run("mark", episode, "success")
    cut = run("trim", episode, "--in-place", "--from", "0.3", "--to", "0.5")
    assert "its outcome was success, now it is unknown: `ibrobot episodes mark` sets it" in cut
    part = read(episode)
    assert [item.received_ns for item in part] == [stamp(index) for index in range(30, 51)]
    assert summary(episode).metadata["trimmed"] == "0.3 s to 0.5 s of episode_000001"
    assert (summary(episode).outcome, summary(episode).metadata.get("marked")) == ("unknown", None)
    (trimmed,) = trash.trashed_in(tmp_path)
    trash.restore(trimmed)
    assert files(episode).keys() == before.keys()
    assert len(read(episode)) == 100
    (replaced,) = trash.trashed_in(tmp_path)
    assert (replaced.done, len(read(replaced.kept))) == ("replaced", 21)
    trash.restore(replaced)
    assert len(read(episode)) == 21
    assert "deleted 1 for good" in run("trash", tmp_path, "--empty", "--yes")
    assert [each.name for each in episode.parent.iterdir()] == [episode.name]


def test_a_part_with_the_end_keeps_the_outcome_and_a_person_may_set_it_for_others(tmp_path, episode):
    run("trim", episode, "--from", "0.3", "-o", tmp_path / "end")
    assert summary(tmp_path / "end").outcome == "success"
    run("trim", episode, "--to", "0.3", "-o", tmp_path / "begin")
    assert summary(tmp_path / "begin").outcome == "unknown"
    run("mark", tmp_path / "begin", "success")
    assert summary(tmp_path / "begin").outcome == "success"
    assert "its outcome" not in run("trim", tmp_path / "begin", "-o", tmp_path / "whole")


def test_a_link_to_an_episode_comes_back_as_the_link_that_it_was(tmp_path, episode):
    link = tmp_path / "links" / "first"
    link.parent.mkdir()
    link.symlink_to("../pick/episodes/episode_000001")
    run("delete", "--to-trash", link)
    assert not link.is_symlink()
    (row,) = json.loads(run("trash", link.parent, "--json"))
    assert "restored" in run("trash", link.parent, "--restore", row["id"])
    assert (link.readlink().as_posix(), len(read(link))) == ("../pick/episodes/episode_000001", 100)
    run("delete", "--yes", link)
    assert (link.is_symlink(), len(read(episode))) == (False, 100)


def test_a_failed_trim_leaves_the_episode(tmp_path, episode, monkeypatch):
    before = files(tmp_path)
    with pytest.raises(RecorderError, match=r"is 0\.99 s long; --from 0\.5 --to 2 is outside it"):
        run("trim", episode, "--in-place", "--from", "0.5", "--to", "2")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(trash, "_discard", fail)
    with pytest.raises(RecorderError, match="cannot be trimmed: No space left on device"):
        trash.trim(episode, 0.1, 0.2)
    assert files(tmp_path) == before


def test_a_later_recording_keeps_its_place(tmp_path, episode):
    trashed = trash.discard(episode)
    bench = Bench(episode.parent)
    bench.begin()
    bench.write(5)
    bench.end()
    assert trash.restore(trashed) == episode.with_name("episode_000001_restored")
    assert (len(read(episode)), len(read(episode.with_name("episode_000001_restored")))) == (5, 100)


def test_only_episodes_are_moved_and_only_what_is_in_the_trash_is_restored(tmp_path, episode):
    with pytest.raises(RecorderError, match="is not an episode; nothing was deleted"):
        run("delete", "--to-trash", episode, tmp_path)
    with pytest.raises(RecorderError, match=r"its trash has no '\.\./\.\.'; it has nothing"):
        run("trash", tmp_path, "--restore", "../..")
    (episode.parent / ".trash" / "x").mkdir(parents=True)
    (episode.parent / ".trash" / "x" / "undo.json").write_text('{"name": "../../../..", "done": "deleted"}')
    assert trash.trashed_in(tmp_path) == []
    assert episode.is_dir()


def test_reading_from_a_time_on_skips_what_is_before(episode):
    reader = Rosbag2Reader(episode)
    try:
        stamps = [item.received_ns for item in reader.messages()]
        for since in (0, stamp(0), stamp(40), stamp(40) + 1, stamp(200)):
            found = [item.received_ns for item in reader.messages_since(since, {JOINTS})]
            assert found == [each for each in stamps if each >= since]
    finally:
        reader.close()
