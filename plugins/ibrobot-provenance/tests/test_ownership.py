"""One owner at a time, also across processes and after a kill."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from ibrobot_provenance.ownership import InUse, Ownership, lock_file, owned

from ibrobot_core.api import DatasetError
from ibrobot_core.app import wrong_input

HOLD = """
import sys
from pathlib import Path
from ibrobot_provenance.ownership import Ownership
owned = Ownership(Path(sys.argv[1]), "is being recorded")
print("owned", flush=True)
sys.stdin.read()
"""


def test_another_owner_is_named_until_it_has_ended(tmp_path: Path):
    path = tmp_path / "episode"
    with Ownership(path, "is being recorded"):
        by = f"is being recorded by process {os.getpid()}; try again when that has ended"
        with pytest.raises(InUse, match=f"episode: {by}") as refused, wrong_input():
            Ownership(path, "is being trimmed", wait_s=0.0)
        assert refused.value.exit_code == 1, "the command was right"
    with Ownership(path, "is being trimmed"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_readers_share_it_and_nobody_changes_it_meanwhile(tmp_path: Path):
    path = tmp_path / "episode"
    first, second = (Ownership(path, f"is being {what}", shared=True) for what in ("converted", "copied"))
    second.close()
    with pytest.raises(InUse, match="is being converted"):
        Ownership(path, "is being deleted", wait_s=0.0)
    first.close()
    first.close()
    with Ownership(path, "is being deleted"), pytest.raises(InUse, match="is being deleted"):
        Ownership(path, "is being converted", shared=True, wait_s=0.0)
    assert list(tmp_path.iterdir()) == []


def test_after_a_kill_nobody_owns_it(tmp_path: Path):
    path = tmp_path / "episode"
    command = [sys.executable, "-c", HOLD, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "owned\n"
        with pytest.raises(InUse, match=f"is being recorded by process {child.pid}"):
            Ownership(path, "is being trimmed", wait_s=0.0)
        child.kill()
    assert lock_file(path).exists()
    Ownership(path, "is being trimmed").close()
    assert list(tmp_path.iterdir()) == []


def test_who_shares_it_is_named_and_not_who_was_killed(tmp_path: Path):
    path = tmp_path / "episode"
    with Ownership(path, "is being copied", shared=True):
        command = [sys.executable, "-c", HOLD.replace('recorded"', 'converted", shared=True'), str(path)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            assert child.stdout.readline() == "owned\n"
            with pytest.raises(InUse, match=f"is being converted by process {child.pid};"):
                Ownership(path, "is being trimmed", wait_s=0.0)
            child.kill()
        with pytest.raises(InUse, match=f"is being copied by process {os.getpid()};"):
            Ownership(path, "is being trimmed", wait_s=0.0)


def test_there_is_never_more_than_one_owner(tmp_path: Path):
    inside, most, done = 0, 0, 0

    def work() -> None:
        nonlocal inside, most, done
        for _ in range(50):
            with Ownership(tmp_path / "episode", "is being changed", wait_s=60.0):
                inside += 1
                most = max(most, inside)
                os.sched_yield()
                inside -= 1
            done += 1

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (most, done) == (1, 200)
    assert list(tmp_path.iterdir()) == []


def test_all_addresses_of_an_episode_have_one_owner(tmp_path: Path):
    episode = tmp_path / "episode"
    episode.mkdir()
    (episode / "episode_0.mcap").touch()
    (tmp_path / "link").symlink_to("episode")
    with Ownership(episode, "is being recorded"):
        for path in (tmp_path / "link", episode / "episode_0.mcap", tmp_path / "x" / ".." / "episode"):
            with pytest.raises(InUse, match="is being recorded"):
                Ownership(path, "is being trimmed", wait_s=0.0)


@pytest.mark.parametrize("name", [b"e" * 255, b"caf\xe9", "épisode".encode()])
def test_every_name_can_be_owned(tmp_path: Path, name: bytes):
    path = tmp_path / os.fsdecode(name)
    with Ownership(path, "is being recorded"), pytest.raises(InUse, match="is being recorded"):
        Ownership(path, "is being trimmed", wait_s=0.0)


def test_what_nobody_can_change_needs_no_owner_to_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    real = os.open

    def read_only(path: str, flags: int, mode: int = 0o777) -> int:
        if flags & os.O_CREAT:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
        return real(path, flags, mode)

    monkeypatch.setattr(os, "open", read_only)
    Ownership(tmp_path / "episode", "is being converted", shared=True).close()
    with pytest.raises(OSError, match="Read-only file system"):
        Ownership(tmp_path / "episode", "is being trimmed")
    monkeypatch.undo()
    with Ownership(tmp_path / "episode", "is being recorded"):
        monkeypatch.setattr(os, "open", read_only)
        with pytest.raises(InUse, match="is being recorded"):
            Ownership(tmp_path / "episode", "is being converted", shared=True, wait_s=0.0)


def test_owned_creates_the_folders_above_and_raises_the_given_error(tmp_path: Path) -> None:
    with owned(tmp_path / "new" / "folder", "is being written", DatasetError):
        assert (tmp_path / "new").is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match=r"file/folder: cannot be written: (Not a directory|File exists)"):
        owned(tmp_path / "file" / "folder", "is being written", DatasetError)
    with pytest.raises(DatasetError, match=r"none/folder: cannot be locked: No such file"):
        owned(tmp_path / "none" / "folder", "is being read", DatasetError, shared=True)
