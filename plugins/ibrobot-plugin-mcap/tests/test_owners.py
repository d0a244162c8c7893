"""An episode has one owner at a time; changes of it that are killed are finished."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner
from ibrobot_mcap import trash
from ibrobot_provenance.ownership import InUse, Ownership
from ibrobot_testing.command import command_line
from killed_process import KILLED, killing

from ibrobot_core.api import RecorderError

from .conftest import Bench, read, summary

episodes = command_line("episodes")


@pytest.fixture
def episode(tmp_path):
    root = tmp_path / "pick" / "episodes"
    root.mkdir(parents=True)
    bench = Bench(root)
    bench.begin(uuid="2b0f0c57-7f0e-4d4c-9d7b-1f6a3c2f9a10")
    bench.write(100)
    bench.end()
    return bench.path


def run(*arguments):
    result = CliRunner().invoke(episodes, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def content(folder):
    return {str(each.relative_to(folder)): each.read_bytes() for each in folder.rglob("*") if each.is_file()}


@pytest.mark.parametrize(
    "command",
    [
        ("mark", "EPISODE", "failure"),
        ("trim", "EPISODE", "--in-place", "--to", "0.5"),
        ("trim", "EPISODE", "--to", "0.5", "-o", "part"),
        ("delete", "EPISODE", "--yes"),
        ("delete", "EPISODE", "--to-trash"),
    ],
    ids=" ".join,
)
def test_no_command_changes_an_episode_that_is_being_recorded(tmp_path, episode, command, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = content(episode)
    with (
        Ownership(episode, "is being recorded"),
        pytest.raises(InUse, match=f"is being recorded by process {os.getpid()}; try again"),
    ):
        run(*(str(episode) if word == "EPISODE" else word for word in command))
    assert content(episode) == before
    assert [each.name for each in episode.parent.iterdir()] == [episode.name]


def test_a_repair_skips_what_is_being_recorded_and_a_restore_waits_for_it(tmp_path, episode):
    shutil.copytree(episode, episode.with_name("episode_000002"))
    (episode / "metadata.yaml").unlink()
    with Ownership(episode, "is being recorded"):
        result = CliRunner().invoke(episodes, ["repair", str(tmp_path)])
        assert f"{episode}: is being recorded by process {os.getpid()}" in result.output
        assert "episode_000002: is whole" in result.output
        assert result.exit_code == 1
    assert [each.name for each in episode.iterdir()] == ["episode_000001_0.mcap"]
    trashed = trash.discard(episode)
    with Ownership(episode, "is being recorded"), pytest.raises(InUse, match="is being recorded"):
        trash.restore(trashed)
    assert trash.restore(trashed) == episode


def test_of_two_restores_at_once_the_second_finds_nothing_to_restore(episode):
    run("trim", episode, "--in-place", "--to", "0.5")
    (trimmed,) = trash.trashed_in(episode.parent)
    trash.restore(trimmed)
    with pytest.raises(RecorderError, match="is no longer there; another command restored or deleted it"):
        trash.restore(trimmed)
    assert len(read(episode)) == 100


def test_what_is_restored_while_the_trash_is_listed_is_no_longer_in_it(episode, monkeypatch):
    trash.discard(episode)
    real = Path.iterdir

    def late(self):
        """Another command restores the episode between the look at its folder and into it."""
        if ".trash" in self.parts and self.name == episode.name:
            self.rename(episode)
        return real(self)

    for metadata in (episode.parent / ".trash").rglob("metadata.yaml"):  # so that its files are looked at
        metadata.unlink()
    monkeypatch.setattr(Path, "iterdir", late)
    assert trash.trashed_in(episode.parent) == []
    assert len(read(episode)) == 100


def test_an_episode_that_was_deleted_meanwhile_is_not_there(episode, monkeypatch):
    real = Ownership.__init__

    def late(self, path, *arguments, **more):
        """Another command deletes the episode between the look at it and the lock."""
        real(self, path, *arguments, **more)
        shutil.rmtree(path, ignore_errors=True)

    shutil.copytree(episode, kept := episode.with_name("kept"))
    monkeypatch.setattr(Ownership, "__init__", late)
    for command in (("mark", episode, "failure"), ("trim", episode, "--in-place"), ("trim", episode, "-o", "part")):
        with pytest.raises(RecorderError, match="episode_000001: there is no such episode"):
            run(*command)
        shutil.copytree(kept, episode)


@pytest.mark.parametrize("threaded", [False, True])
def test_a_recording_whose_folder_was_replaced_is_no_success(tmp_path, bench, threaded):
    made = bench(threaded=threaded)
    made.begin()
    made.write(50)
    made.path.rename(tmp_path / "moved")  # as another program may
    shutil.copytree(tmp_path / "moved", made.path)
    there = content(made.path)
    with pytest.raises(RecorderError, match="was moved, replaced or removed while it was being recorded"):
        made.end()
    assert content(made.path) == there, "nothing of this recording lands in what is there now"
    assert not (tmp_path / "moved/metadata.yaml").exists()


def test_a_recording_whose_file_was_replaced_or_removed_is_no_success(tmp_path, bench):
    for folder, replace in (("removed", Path.unlink), ("replaced", lambda file: shutil.copy(file, tmp_path / "x"))):
        made = bench(folder)
        made.begin()
        made.write(50)
        (file,) = made.path.glob("*.mcap")
        replace(file)
        if folder == "replaced":
            (tmp_path / "x").rename(file)
        with pytest.raises(RecorderError, match=r"_0\.mcap: was moved, replaced or removed"):
            made.end()
        assert not (made.path / "metadata.yaml").exists()


def test_discarding_a_recording_removes_nothing_else(tmp_path, bench, episode):
    made = bench()
    made.begin()
    made.path.rename(tmp_path / "moved")
    shutil.copytree(episode, made.path)
    with pytest.raises(RecorderError, match="was moved, replaced or removed"):
        made.end("discarded")
    assert len(read(made.path)) == 100


@pytest.fixture(scope="module")
def killed():
    with killing() as run_and_kill:
        yield run_and_kill


def originals(folder):
    """The copies of the whole episode, in the trash or not."""
    found = [path for path in folder.rglob("episode_*") if path.is_dir()]
    return [path for path in found if len(read(path)) == 100]


COMMANDS = {
    "trim": lambda episode: ("trim", episode, "--in-place", "--to", "0.5"),
    "delete": lambda episode: ("delete", episode, "--to-trash"),
    "mark": lambda episode: ("mark", episode, "failure"),
    "repair": lambda episode: ("repair", episode),
}


@pytest.mark.parametrize("name", ["trim", "delete", "mark", pytest.param("repair", marks=pytest.mark.long)])
def test_wherever_a_change_is_killed_nothing_is_lost_and_the_next_command_finishes_it(tmp_path, episode, name, killed):
    shutil.copytree(episode, tmp_path / "kept")
    if name == "repair":
        (tmp_path / "kept/metadata.yaml").unlink()
    for point in range(1, 40):
        shutil.rmtree(tmp_path / "pick")
        shutil.copytree(tmp_path / "kept", episode)
        code, _ = killed(point, "episodes", *COMMANDS[name](episode))
        listed = CliRunner().invoke(episodes, ["list", str(tmp_path)])
        shown = "pick:1" in listed.output or "episode_000001" in listed.output
        assert shown or ".trash" in os.listdir(episode.parent), (point, listed.output)
        CliRunner().invoke(episodes, ["repair", str(episode)])
        assert len(originals(tmp_path / "pick")) == 1, point
        left = {each.name for each in episode.parent.iterdir()} - {episode.name, ".trash", f".{episode.name}.lock"}
        assert left == set(), point
        if episode.exists():
            assert summary(episode).finished
            assert len(read(episode)) in (100, 51)
        if code != KILLED:
            break
    assert point > 4, "it was killed at some points"
    assert code == 0
