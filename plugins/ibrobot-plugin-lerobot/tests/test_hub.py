"""`ibrobot datasets push` and `pull` against a stand-in of the Hub's API, killed in the middle and resumed."""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from ibrobot_testing.command import ibrobot_command

from .conftest import CAMERA, STATE, write
from .hub_stand_in import Hub

pytest.importorskip("huggingface_hub", reason="needs huggingface_hub")

TOKEN = "hf_only_for_this_test"
Run = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def hub() -> Iterator[Hub]:
    with Hub(TOKEN) as hub:
        yield hub


@pytest.fixture
def run(hub: Hub, tmp_path: Path) -> Iterator[Run]:
    """Starts `ibrobot datasets …` with the stand-in for the Hub."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: object, token: str | None = TOKEN) -> subprocess.Popen[str]:
        environment = {
            **os.environ,
            "HF_ENDPOINT": hub.url,
            "HF_HOME": str(tmp_path / "home"),
            "HF_HUB_DISABLE_XET": "1",
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "HF_HUB_DOWNLOAD_TIMEOUT": "60",
        }
        environment.pop("HF_TOKEN", None)
        if token is not None:
            environment["HF_TOKEN"] = token
        command = [*ibrobot_command(), "datasets", *map(str, arguments)]
        pipe = subprocess.PIPE
        process = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=pipe, stderr=pipe, text=True)
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def done(process: subprocess.Popen[str]) -> str:
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert TOKEN not in out + err
    return out


def refused(process: subprocess.Popen[str]) -> str:
    out, err = process.communicate(timeout=120)
    assert process.returncode == 2, out + err
    assert TOKEN not in out + err
    return err


class Killer:
    """Kills a command in the middle of its second transfer of a kind."""

    def __init__(self, hub: Hub, kind: str) -> None:
        self._kind = kind
        self._seen = 0
        self._lock = threading.Lock()
        self.reached, self.killed = threading.Event(), threading.Event()
        hub.hold = self._hold

    def _hold(self, kind: str, name: str) -> bool:
        with self._lock:
            self._seen += kind == self._kind and not name.startswith("meta")
            last = self._seen > 1
        if last:
            self.reached.set()
            self.killed.wait(60)
        return not last

    def kill(self, process: subprocess.Popen[str]) -> None:
        assert self.reached.wait(60)
        process.kill()
        process.communicate()
        self.killed.set()


def content(root: Path) -> dict[str, bytes]:
    paths = (path for kind in ("meta", "data", "videos") for path in (root / kind).rglob("*") if path.is_file())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in paths}


def test_push_and_pull_are_killed_and_go_on(hub: Hub, run: Run, tmp_path: Path) -> None:
    cameras = {f"observation.images.{name}": CAMERA for name in ("top", "wrist", "side")}
    dataset = write(tmp_path / "pick", {"observation.state": STATE, **cameras}, (5, 4))
    killer = Killer(hub, "upload")
    killer.kill(run("push", dataset, "me/pick"))
    assert hub.files == {}, "a dataset is there as a whole or not at all"
    assert sum(hub.uploads.values()) >= 1
    hub.hold = lambda kind, name: True
    assert done(run("push", dataset, "me/pick")) == f"{dataset} -> {hub.url}/datasets/me/pick\n"
    assert set(hub.uploads.values()) == {1}, "what had arrived is not sent again"
    assert hub.files is not None
    card = hub.files.pop("README.md").decode()
    assert "9 frames at 30 Hz" in card
    assert "tags: [LeRobot]" in card
    assert hub.files == content(dataset)
    assert hub.tags == {"v3.0": hub.commit}

    killer = Killer(hub, "download")
    killer.kill(run("pull", "me/pick"))
    arrived = content(tmp_path / "datasets/pick")
    assert arrived
    hub.hold = lambda kind, name: True
    assert "me/pick -> datasets/pick: 2 episodes, 9 frames at 30 Hz" in done(run("pull", "me/pick"))
    assert {hub.downloads[name] for name in arrived} == {1}, "what had arrived is not fetched again"
    assert content(tmp_path / "datasets/pick") == content(dataset)


def test_a_new_version_replaces_the_old_files(hub: Hub, run: Run, tmp_path: Path) -> None:
    dataset = write(tmp_path / "pick", {"observation.state": STATE}, (4,))
    done(run("push", dataset, "me/pick", "--private"))
    assert hub.files is not None
    hub.files |= {"videos/old.mp4": b"old", "README.md": b"mine", "notes.txt": b"kept"}
    done(run("push", dataset, "me/pick"))
    assert hub.files == {**content(dataset), "README.md": b"mine", "notes.txt": b"kept"}
    assert (hub.commits, hub.tags) == (2, {"v3.0": hub.commit})


def test_faults_name_the_remedy(hub: Hub, run: Run, tmp_path: Path) -> None:
    dataset = write(tmp_path / "pick", {"observation.state": STATE}, (4,))
    assert "run `hf auth login`, or set HF_TOKEN" in refused(run("push", dataset, "me/pick", token=None))
    assert "me/pick: the Hub refuses the token" in refused(run("push", dataset, "me/pick", token="hf_other"))
    assert "me/pick: the Hub has no such dataset" in refused(run("pull", "me/pick"))
    assert "is not empty, and not from an earlier" in refused(run("pull", "me/pick", "--out", dataset))
    assert "is not a LeRobot dataset" in refused(run("push", tmp_path, "me/pick"))
    hub.url = "http://127.0.0.1:9"
    assert "the Hub cannot be reached" in refused(run("pull", "me/pick"))
