"""What goes wrong with a disk or a bag, over every command that meets it: one clear message, nothing half-written."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attrs
import pytest
from command_line import run_here
from recordings import CONTRACT, record

from ibrobot_core.contract.specs import Contract
from ibrobot_core.plugins import installed_plugins

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("first_conversion")]

FULL = "No space left on device"
TOO_LARGE = "File too large"
ONLY_READ = "Read-only file system"


@attrs.frozen
class Ran:
    """What a command printed, and its exit code."""

    code: int
    out: str
    err: str


Run = Callable[..., Ran]


@pytest.fixture(scope="module")
def run(ibrobot: tuple[str, ...]) -> Run:
    def execute(*arguments: object, largest: int | None = None) -> Ran:
        """Run `ibrobot`; no file may become larger than `largest` [bytes]."""

        if largest is None:
            done = run_here(*arguments)
        else:
            done = subprocess.run(
                [*ibrobot, *map(str, arguments)],
                capture_output=True,
                text=True,
                timeout=120,
                check=False,
                preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest)),
            )
        assert "Traceback" not in done.stderr, done.stderr
        return Ran(done.returncode, done.stdout, done.stderr)

    return execute


@pytest.fixture
def mounted(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Mounts a small file system; skips where that is not permitted."""
    places: list[Path] = []

    def mount(options: str) -> Path:
        place = tmp_path / f"disk{len(places)}"
        place.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except FileNotFoundError:
            pytest.skip("there is no mount")
        if done.returncode:
            pytest.skip(f"a file system cannot be mounted here: {done.stderr.strip()}")
        places.append(place)
        return place

    yield mount
    for place in places:
        subprocess.run(["umount", str(place)], check=True)


@pytest.fixture
def read_only(mounted: Callable[[str], Path]) -> Path:
    return mounted("ro")


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of two episodes, a megabyte each."""
    root = tmp_path_factory.mktemp("bags") / "blocks"
    for number in (1, 2):
        record(root / f"episodes/episode_{number:06d}", number, 0.5, "sort")
    return root


@pytest.fixture(scope="module")
def dataset(bags: Path, run: Run) -> Path:
    made = run("convert", bags, "--out", bags.parent / "set", "--no-videos")
    assert made.code == 0, made.err
    return bags.parent / "set"


def record_picks(run: Run, root: Path, *more: object, episodes: int = 1, **limits: Any) -> Ran:
    arguments = ("record", "so101_blind", "--sim", "--lockstep", "--headless", "--root", root, "--dataset", "picks")
    return run(*arguments, "--episodes", episodes, "--set", "recording.min_free=0", *more, **limits)


@pytest.fixture(scope="module")
def picks(tmp_path_factory: pytest.TempPathFactory, run: Run) -> Path:
    """A dataset of one episode of the simulated SO-101."""
    root = tmp_path_factory.mktemp("recorded")
    assert record_picks(run, root).code == 0
    return root / "picks"


def states(folder: Path) -> list[tuple[bool, int]]:
    """Of each episode: whether it is whole, and its messages."""
    found = []
    for path in sorted((folder / "episodes").iterdir()):
        reader = installed_plugins().open_episode(path)
        summary = reader.summary()
        assert sum(1 for _ in reader.messages()) == sum(each.count for each in summary.topics.values())
        reader.close()
        found.append((summary.finished, sum(each.count for each in summary.topics.values())))
    return found


@pytest.fixture(scope="module")
def other(bags: Path) -> Path:
    """A dataset with an episode of the contract, and one of another rate."""
    root = bags.parent / "mixed"
    shutil.copytree(bags / "episodes/episode_000001", root / "episodes/episode_000001")
    slower = attrs.evolve(CONTRACT, rate_hz=20.0)
    record(root / "episodes/episode_000002", 5, 0.5, "sort", contract=slower, fingerprint=slower.fingerprint())
    return root


@pytest.fixture(scope="module")
def silent(bags: Path) -> Path:
    """An episode whose top camera never sent a picture, and whose arm had no command."""
    path = bags.parent / "silent/episodes/episode_000001"
    never = (0.0, 10.0)
    record(path, 1, 0.5, "sort", gap={"/top": never, "/commands": never})
    return path


class TestFullDisk:
    def test_record_ends_with_the_recording(self, run: Run, mounted: Callable[[str], Path]):
        """Nobody is there to make room, so no further episode is run and lost."""
        disk = mounted("size=1000k")
        done = record_picks(run, disk, episodes=20)
        assert done.code == 1
        assert done.out.splitlines()[-1].startswith("faults     recording ended: ")
        assert f"cannot be written: {FULL}; it stays unfinished, with what was written before" in done.err
        assert "; the run ends" in done.err
        found = states(disk / "picks")
        assert 1 <= len(found) < 20
        assert [finished for finished, _ in found] == [True] * (len(found) - 1) + [False]

    def test_a_run_that_only_happens_to_record_goes_on(self, run: Run, mounted: Callable[[str], Path]):
        disk = mounted("size=300k")
        recording = f"recording={{type: mcap, root: {disk}, dataset: picks, min_free: 0}}"
        arguments = ("launch", "so101_blind", "--sim", "--lockstep", "--headless", "--episodes", 2, "--set", recording)
        done = run(*arguments)
        assert done.code == 1
        assert "the robot goes on" in done.err
        assert "episodes   2, of which 2 succeeded" in done.out

    def test_record_refuses_to_begin_where_there_is_too_little_room(self, run: Run, mounted: Callable[[str], Path]):
        disk = mounted("size=2m")
        done = record_picks(run, disk, "--set", "recording.min_free=67108864")
        assert done.code == 1
        assert "its disk has 1 MiB left, recording needs 64 MiB (min_free); make room" in done.err
        assert list((disk / "picks/episodes").iterdir()) == []

    def test_record_with_a_bounded_file_size(self, run: Run, tmp_path: Path):
        done = record_picks(run, tmp_path, largest=150_000)
        assert done.code == 1
        assert f"cannot be written: {TOO_LARGE}; it stays unfinished" in done.err
        kept = states(tmp_path / "picks")
        assert not any(finished for finished, _ in kept)
        assert all(count > 50 for _, count in kept), "what was written before is there"
        listed = run("episodes", "verify", tmp_path / "picks")
        assert listed.code == 1
        assert listed.out.count("unfinished; `ibrobot episodes repair` makes it whole") == len(kept)
        assert run("episodes", "repair", tmp_path / "picks").code == 0
        assert all(finished for finished, _ in states(tmp_path / "picks"))

    @pytest.mark.parametrize("videos", ["--no-videos", "--codec=h264"])
    def test_convert_leaves_no_dataset(self, run: Run, bags: Path, mounted: Callable[[str], Path], videos: str):
        disk = mounted("size=200k")
        done = run("convert", bags, "--out", disk / "set", videos)
        assert done.code == 1
        assert FULL in done.err
        assert not (disk / "set/meta/info.json").exists()
        again = run("convert", disk / "set:0", "--out", disk / "other")
        assert again.code in (1, 2)

    def test_convert_stops_at_the_first_and_goes_on_where_there_is_room(
        self, run: Run, tmp_path: Path, mounted: Callable[[str], Path]
    ):
        disk = mounted("size=500k")
        for number in range(1, 5):
            record(tmp_path / f"bags/episode_{number}", number, 0.3 if number == 1 else 1.2, "sort")
        arguments = ("convert", tmp_path / "bags", "--out", disk / "set", "--no-videos", "--jobs", 1)
        done = run(*arguments)
        assert (done.code, done.out) == (1, "")
        assert done.err.count(FULL) == 1, "not once for each episode"
        assert "stopped at episode_" in done.err
        kept = [int(text) for text in re.findall(r"(\d) of 4 episodes converted and kept in", done.err)]
        assert kept[0] >= 1
        assert f"{disk}/set/.staging: make room, and run the same command again" in done.err
        assert list((disk / "set").rglob("*.making")) == []
        subprocess.run(["mount", "-o", "remount,size=40m", str(disk)], check=True)
        done = run(*arguments)
        assert done.code == 0, done.err
        assert f"4 episodes, 113 frames, {kept[0]} of them by an earlier run" in done.out

    def test_convert_with_a_bounded_file_size(self, run: Run, bags: Path, tmp_path: Path):
        done = run("convert", bags, "--out", tmp_path / "set", "--no-videos", "--jobs", 1, largest=10_000)
        assert done.code == 1
        assert done.err.count(f"{TOO_LARGE}") >= 2, "one an episode"
        assert not (tmp_path / "set").exists()

    def test_convert_back_leaves_no_episode(self, run: Run, dataset: Path, mounted: Callable[[str], Path]):
        disk = mounted("size=400k")
        done = run("convert", dataset, "--to", "bag", "--out", disk / "back", "--set", "min_free=0")
        assert done.code == 1
        assert f"stopped at set:0: {FULL}" in done.err
        assert f"0 of 2 episodes converted and kept in {disk}/back: make room, and run the same command" in done.err
        assert done.err.count(FULL) == 1
        assert list(disk.rglob("*.mcap")) == []
        done = run("convert", dataset, "--to", "bag", "--out", disk / "back")
        assert "MiB left, recording needs 512 MiB (min_free)" in done.err
        assert list(disk.iterdir()) == []

    def test_convert_back_with_a_bounded_file_size(self, run: Run, dataset: Path, tmp_path: Path):
        done = run("convert", dataset, "--to", "bag", "--out", tmp_path / "back", largest=100_000)
        assert done.code == 1
        assert TOO_LARGE in done.err
        assert not (tmp_path / "back").exists()

    def test_repair_keeps_the_original(self, run: Run, bags: Path, mounted: Callable[[str], Path]):
        disk = mounted("size=1500k")
        path = disk / "episode_000001"
        shutil.copytree(bags / "episodes/episode_000001", path)
        (path / "metadata.yaml").unlink()
        before = (path / "episode_000001_0.mcap").read_bytes()
        (path / "episode_000001_0.mcap").write_bytes(before[:-20])
        done = run("episodes", "repair", path)
        assert done.code == 1
        assert f"cannot be written: {FULL}" in done.err
        assert (path / "episode_000001_0.mcap").read_bytes() == before[:-20]
        assert [each.name for each in disk.iterdir()] == ["episode_000001"]

    def test_trim_and_export_leave_nothing(self, run: Run, bags: Path, tmp_path: Path):
        episode = bags / "episodes/episode_000001"
        for number, arguments in enumerate(
            (
                ("trim", episode, "--to", "0.4", "-o", tmp_path / "part"),
                ("export", episode, "/joint_states", "-o", tmp_path / "joints.csv"),
                ("export", episode, "/top", "-o", tmp_path / "top"),
            )
        ):
            done = run("episodes", *arguments, largest=100 if number else 50_000)
            assert done.code == 1
            assert f"cannot be written: {TOO_LARGE}" in done.err
            assert list(tmp_path.iterdir()) == []


class TestReadOnlyFolder:
    def test_record(self, run: Run, read_only: Path):
        done = record_picks(run, read_only)
        assert done.code == 2
        assert f"recording.root: {read_only} is not writable for this user" in done.err

    def test_convert_and_the_way_back(self, run: Run, bags: Path, dataset: Path, read_only: Path):
        done = run("convert", bags, "--out", read_only / "set")
        assert (done.code, done.err) == (2, f"error: {read_only}/set: cannot be written: {ONLY_READ}\n")
        done = run("convert", dataset, "--to", "bag", "--out", read_only / "back")
        assert done.code == 2
        assert ONLY_READ in done.err

    def test_a_file_where_a_folder_should_be(self, run: Run, bags: Path, dataset: Path, tmp_path: Path):
        (tmp_path / "file").write_text("in the way")
        for arguments in ((bags,), (dataset, "--to", "bag")):
            done = run("convert", *arguments, "--out", tmp_path / "file/set")
            assert done.code == 2
            assert "Not a directory" in done.err
        done = record_picks(run, tmp_path / "file")
        assert done.code == 2
        assert f"recording.root: {tmp_path}/file is a file, not a folder" in done.err

    def test_episodes_are_read_where_nothing_can_be_written(self, run: Run, bags: Path, mounted: Callable[[str], Path]):
        disk = mounted("size=4m")
        path = disk / "episode_000001"
        shutil.copytree(bags / "episodes/episode_000001", path)
        (path / "metadata.yaml").unlink()
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        assert run("episodes", "info", path).code == 0
        done = run("episodes", "repair", path)
        assert done.code == 1
        assert f"cannot be locked: {ONLY_READ}" in done.err


class TestTruncatedChunk:
    @pytest.fixture(params=["", "metadata.yaml"])
    def cut(self, tmp_path: Path, request: pytest.FixtureRequest) -> Path:
        """An episode whose last chunk is cut; with its `metadata.yaml` it looks whole."""
        path = tmp_path / "cut/episodes/episode_000001"
        record(path, 1, 1.6, "sort")
        if not request.param:
            (path / "metadata.yaml").unlink()
        file = path / "episode_000001_0.mcap"
        os.truncate(file, int(file.stat().st_size * 0.7))
        return path

    def test_info_and_verify_tell(self, run: Run, cut: Path):
        assert "unfinished; `ibrobot episodes repair` makes it whole" in run("episodes", "info", cut).out
        done = run("episodes", "verify", cut)
        assert done.code == 1
        assert "unfinished" in done.out
        if (cut / "metadata.yaml").exists():
            assert "metadata.yaml says" in done.out

    def test_convert_takes_what_is_there_and_tells(self, run: Run, cut: Path, tmp_path: Path):
        done = run("convert", cut, "--out", tmp_path / "set", "--no-videos", "--missing", "hold", "--json")
        assert done.code == 0, done.err
        (report,) = json.loads(done.out)["reports"]
        assert report["finished"] is False
        assert 10 < report["frames"] < 40
        again = run("convert", cut, "--out", tmp_path / "message", "--no-videos", "--missing", "hold")
        assert f"unfinished cut/episode_000001: it has the {report['frames']} frames that could be read" in again.err

    def test_repair_makes_it_whole(self, run: Run, cut: Path):
        done = run("episodes", "repair", cut)
        assert done.code == 0, done.err
        assert "repaired" in done.out
        assert run("episodes", "repair", cut).out.endswith("is whole\n")

    def test_replay_tells(self, run: Run, picks: Path, tmp_path: Path):
        path = tmp_path / "episode_000001"
        shutil.copytree(picks / "episodes/episode_000001", path)
        file = path / "episode_000001_0.mcap"
        os.truncate(file, int(file.stat().st_size * 0.6))
        done = run("replay", path, "so101_blind", "--sim", "--lockstep", "--headless")
        assert "is unfinished; " in done.err
        assert done.code in (0, 3)


class TestOtherContract:
    def test_convert_leaves_it_out(self, run: Run, other: Path, tmp_path: Path):
        done = run("convert", other, "--out", tmp_path / "set", "--no-videos")
        assert done.code == 1
        assert "left out mixed/episode_000002: its contract differs from that of mixed/episode_000001:" in done.err
        assert "this episode: 20.0" in done.err
        assert "1 episode, " in done.out

    @pytest.mark.parametrize("changed", ["robot", "calibration"])
    def test_convert_leaves_out_another_robot(self, run: Run, tmp_path: Path, changed: str):
        pan = {"id": 1, "drive_mode": 0, "homing_offset": 3, "range_min": 100, "range_max": 4000}
        for number, offset in enumerate((3, 4), 1):
            calibration = json.dumps({"arm": {"pan": {**pan, "homing_offset": offset}}})
            mark: dict[str, Any] = {"robot": f"arm{number}"} if changed == "robot" else {"calibration": calibration}
            record(tmp_path / f"bags/episode_{number}", number, 0.5, "sort", **mark)
        done = run("convert", tmp_path / "bags", "--out", tmp_path / "set", "--no-videos")
        assert done.code == 1
        assert "left out episode_2: its " in done.err
        assert "--any-robot merges them regardless" in done.err
        added = run("convert", tmp_path / "bags", "--out", tmp_path / "set", "--no-videos", "--append")
        assert added.code == 1, "the dataset's robot counts"
        assert (
            run("convert", tmp_path / "bags", "--out", tmp_path / "set", "--no-videos", "--append", "--any-robot").code
            == 0
        )

    def test_verify_tells(self, run: Run, other: Path):
        done = run("episodes", "verify", other)
        assert done.code == 1
        assert f"its contract is {attrs.evolve(CONTRACT, rate_hz=20.0).fingerprint()[:12]}" in done.out

    def test_record_into_a_dataset_of_another_contract(self, run: Run, picks: Path):
        done = record_picks(run, picks.parent, "--set", "contract.rate_hz=20")
        assert done.code == 2
        assert "dataset.yaml: its episodes have another contract; record into another dataset" in done.err
        assert "this run: 20" in done.err
        assert "the dataset: 30" in done.err
        assert len(states(picks)) == 1

    def test_convert_back_with_another_contract(self, run: Run, dataset: Path, tmp_path: Path):
        done = run("convert", dataset, "--to", "bag", "--out", tmp_path / "back", "--config", "so101_blind")
        assert done.code == 1
        assert "was made with another contract than that of --config:" in done.err
        assert "--config: " in done.err
        assert "dataset: " in done.err
        assert not (tmp_path / "back").exists()

    def test_replay_is_refused(self, run: Run, bags: Path):
        done = run("replay", bags / "episodes/episode_000001", "so101_blind", "--sim", "--headless")
        assert done.code == 2
        assert "was recorded with another contract than that of" in done.err
        assert "recorded: topic: /commands" in done.err


class TestMissingTopic:
    def test_record_does_not_begin(self, run: Run, tmp_path: Path):
        lamp = "contract.observations=[{key: observation.lamp, topic: /lamp, type: std_msgs/msg/Int32}]"
        done = run(
            "record", "so101_blind", "--sim", "--lockstep", "--headless", "--mode", "teleop", "--auto", "--root",
            tmp_path, "--set", lamp, "--duration", "2", "--set", "recording.min_free=0",
            "--set", "control_modes.teleop={executors: [arm_position, gripper_position]}",
        )  # fmt: skip
        assert "not recording: the contract's topics are silent: /lamp (nothing yet)" in done.err
        assert list(tmp_path.rglob("*.mcap")) == []

    def test_convert_names_it(self, run: Run, silent: Path, tmp_path: Path):
        done = run("convert", silent, "--out", tmp_path / "set")
        assert done.code == 1
        assert "no message of /top, /commands, which the contract needs; available: /joint_states, /wrist" in done.err
        assert not (tmp_path / "set").exists()

    def test_verify_names_it(self, run: Run, silent: Path):
        done = run("episodes", "verify", silent)
        assert done.code == 1
        for topic in ("/top", "/commands"):
            assert f"no message of {topic}, which is in its contract" in done.out

    def test_replay_names_it(self, run: Run, picks: Path, tmp_path: Path):
        reader = installed_plugins().open_episode(picks / "episodes/episode_000001")
        metadata = dict(reader.summary().metadata)
        reader.close()
        wanted = Contract.from_canonical(json.loads(metadata["contract"]))
        record(tmp_path / "unheard", 1, 0.5, contract=wanted, config=metadata["config"])
        done = run("replay", tmp_path / "unheard", "--sim", "--lockstep", "--headless")
        assert done.code == 2
        assert "/gripper_position_controller/commands, so nothing to replay; available: /commands, /joint" in done.err
