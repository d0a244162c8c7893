"""`ibrobot convert` where it was before: after a kill, beside another conversion, and of changed episodes."""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import attrs
import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import run_here
from convert import record as record_benchmark
from ibrobot_data import run as run_module
from ibrobot_data.episode import make_writer
from ibrobot_data.run import STAGING
from ibrobot_lerobot.layout import open_dataset
from ibrobot_provenance.ownership import Ownership
from killed_process import KILLED, killing
from recordings import record

from ibrobot_core.app import installed_plugins

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("first_conversion")]

UUID = "2b0f0c57-7f0e-4d4c-9d7b-1f6a3c2f9a1{}"
Killed = Callable[..., tuple[int, int]]


def convert(*arguments: object) -> CompletedProcess[str]:
    return run_here("convert", *arguments, "--no-videos")


def report(*arguments: object) -> dict[str, Any]:
    done = convert(*arguments, "--json")
    found: dict[str, Any] = json.loads(done.stdout)
    return found | {"code": done.returncode, "err": done.stderr}


def episodes(*arguments: object) -> CompletedProcess[str]:
    return run_here("episodes", *arguments)


def own(dataset: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((dataset / "meta/ibrobot.json").read_bytes())
    return found


def digest(dataset: Path) -> dict[str, str]:
    files = sorted(path for path in dataset.rglob("*") if path.is_file())
    return {str(path.relative_to(dataset)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def lengths(dataset: Path) -> list[int]:
    """Rows of each episode, by the tables; they agree with what the dataset says of itself."""
    tables = [pq.read_table(path).to_pydict() for path in sorted((dataset / "data").rglob("*.parquet"))]
    numbers = np.concatenate([np.array(table["episode_index"]) for table in tables])
    found = np.bincount(numbers).tolist()
    there = open_dataset(dataset)
    assert there is not None
    assert [row["length"] for row in there.episodes()] == found
    assert [each["stretch"][1] for each in own(dataset)["episodes"]] == found
    return list(map(int, found))


@pytest.fixture
def bags(tmp_path: Path) -> Path:
    """Two episodes of random UUIDs."""
    for number in (1, 2):
        folder = tmp_path / f"blocks/episodes/episode_{number:06d}"
        record(folder, number, 0.3 + 0.1 * number, "sort", uuid=UUID.format(number))
    return tmp_path / "blocks"


@pytest.fixture(scope="module")
def killed() -> Iterator[Killed]:
    with killing() as run:
        yield run


@pytest.mark.parametrize("append", [False, pytest.param(True, marks=pytest.mark.long)])
def test_killed_at_any_point_of_its_end_the_same_command_goes_on(
    bags: Path, tmp_path: Path, killed: Killed, append: bool
) -> None:
    out, whole = tmp_path / "set", tmp_path / "whole"
    record(tmp_path / "bad/episode_000003", 3, 0.3, contract=None)  # what failed does not end it
    first, second = bags / "episodes/episode_000001", bags / "episodes/episode_000002"
    command = [second, tmp_path / "bad", "--no-videos", "--jobs", 1, *(["--append"] if append else [])]
    if append:
        assert convert(first, "--out", tmp_path / "before").returncode == 0
        shutil.copytree(tmp_path / "before", whole)
    assert convert(*command, "--out", whole).returncode == 1
    last, points = 0, set()
    for back in (None, 0, 1, 3, 8, 21):
        shutil.rmtree(out, ignore_errors=True)
        if append:
            shutil.copytree(tmp_path / "before", out)
        code, at = killed(0 if back is None else last - back, "convert", *command, "--out", out)
        if back is None:
            assert code == 1
            last = at
            continue
        assert code == KILLED
        points.add(at)
        again = convert(*command, "--out", out)
        assert again.returncode == 1, again.stderr
        assert "already has a dataset" not in again.stderr, f"{back} changes before its end"
        assert digest(out) == digest(whole), f"{back} changes before its end"
    assert len(points) == 5


def test_a_killed_conversion_of_what_all_can_be_converted_ends_well(bags: Path, tmp_path: Path) -> None:
    """The last moment: the staging folder is gone, and nothing was printed."""
    first = report(bags, "--out", tmp_path / "set")
    assert (first["code"], first["episodes"]) == (0, 2)
    again = report(bags, "--out", tmp_path / "set")
    assert (again["code"], again["passed_over"], again["err"]) == (0, 2, "")
    record(bags / "episodes/episode_000003", 3, 0.3)
    refused = convert(bags, "--out", tmp_path / "set")
    assert refused.returncode == 2
    assert "already has a dataset; --append adds to it" in refused.stderr
    otherwise = convert(bags, "--out", tmp_path / "set", "--missing", "hold")
    assert "already has a dataset; --append adds to it" in otherwise.stderr


def test_of_two_conversions_into_one_folder_the_second_finds_the_first_ones_dataset(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, first, second = tmp_path / "set", *sorted((bags / "episodes").iterdir())

    def beside(*arguments: Any, **more: Any) -> Ownership:
        """Between the second one's first look at the folder and its lock, the first one begins and ends."""
        monkeypatch.setattr(run_module, "Ownership", Ownership)
        assert convert(first, "--out", out).returncode == 0
        return Ownership(*arguments, **more)

    monkeypatch.setattr(run_module, "Ownership", beside)
    refused = convert(second, "--out", out)
    assert (refused.returncode, "already has a dataset" in refused.stderr) == (2, True)
    monkeypatch.setattr(run_module, "Ownership", beside)
    (out / "meta").rename(tmp_path / "meta")  # so that the first one begins anew
    shutil.rmtree(out)
    assert convert(second, "--out", out, "--append").returncode == 0
    assert [each["source"] for each in own(out)["episodes"]] == ["blocks/episode_000001", "blocks/episode_000002"]
    assert len(lengths(out)) == 2


def test_a_conversion_into_a_folder_that_another_one_writes_names_that_one(bags: Path, tmp_path: Path) -> None:
    out = tmp_path / "set"
    with run_module.own_staging(out):
        for more in ((), ("--append",)):
            refused = convert(bags, "--out", out, *more)
            assert refused.returncode == 1
            assert f"{out}: is being written by process {os.getpid()}" in refused.stderr
    assert not out.exists()


def test_two_conversions_to_bags_do_not_write_at_once(bags: Path, tmp_path: Path) -> None:
    assert convert(bags, "--out", tmp_path / "set").returncode == 0
    out = tmp_path / "back"
    command = ("convert", tmp_path / "set", "--to", "bag", "--out", out)
    with run_module.own_staging(out):
        (out / STAGING / "episode_000001").mkdir()
        refused = run_here(*command)
        assert refused.returncode == 1
        assert f"{out}: is being written by process {os.getpid()}" in refused.stderr
        assert (out / STAGING / "episode_000001").exists()
    assert run_here(*command).returncode == 0
    assert sorted(path.name for path in out.iterdir()) == ["dataset.yaml", "episodes"]


def test_a_label_that_changed_after_the_conversion_is_reported(bags: Path, tmp_path: Path) -> None:
    out, first = tmp_path / "set", bags / "episodes/episode_000001"
    assert convert(bags, "--out", out).returncode == 0
    assert episodes("mark", first, "failure").returncode == 0
    changed = convert(bags, "--out", out, "--append")
    assert changed.returncode == 1
    message = "the dataset has this episode, as blocks/episode_000001, with the outcome success; now it is failure"
    assert f"left out blocks/episode_000001: {message}: convert into a new dataset" in changed.stderr
    assert "blocks/episode_000002: already in the dataset" in changed.stderr
    assert episodes("mark", first, "success").returncode == 0
    assert convert(bags, "--out", out, "--append").returncode == 0


@pytest.mark.parametrize("uuid", [UUID.format(1), ""], ids=["random", "none"])
def test_a_trimmed_episode_is_another_state_of_the_one_in_the_dataset(tmp_path: Path, uuid: str) -> None:
    episode, out = tmp_path / "blocks/episodes/episode_000001", tmp_path / "set"
    named: dict[str, Any] = {"uuid": uuid} if uuid else {}
    record(episode, 1, 0.9, "sort", **named)
    assert convert(episode, "--out", out).returncode == 0

    def refused() -> None:
        done = convert(episode, "--out", out, "--append")
        assert done.returncode == 1, done.stdout
        assert "the dataset has another state of this episode, as blocks/episode_000001: it was" in done.stderr
        assert len(lengths(out)) == 1

    assert episodes("trim", episode, "--in-place", "--to", "0.6").returncode == 0
    refused()
    assert episodes("trim", episode, "--in-place", "--to", "0.5").returncode == 0
    refused()
    shutil.rmtree(out)
    assert convert(episode, "--out", out).returncode == 0
    for row in json.loads(episodes("trash", episode.parent, "--json").stdout):
        assert episodes("trash", episode.parent, "--restore", row["id"]).returncode == 0
        refused()
    assert episodes("trim", episode, "--in-place", "--to", "0.4").returncode == 0
    refused()


def test_two_parts_of_one_recording_are_two_episodes(tmp_path: Path) -> None:
    record(tmp_path / "long", 1, 0.9, uuid=UUID.format(1))
    for name, begin, end in (("first", "0", "0.4"), ("second", "0.4", "0.8")):
        assert episodes("trim", tmp_path / "long", "--from", begin, "--to", end, "-o", tmp_path / name).returncode == 0
    assert convert(tmp_path / "first", "--out", tmp_path / "set").returncode == 0
    added = report(tmp_path / "first", tmp_path / "second", "--out", tmp_path / "set", "--append")
    assert (added["code"], added["episodes"], added["passed_over"]) == (0, 1, 1), added["err"]


def test_names_that_collide_lose_no_episode(tmp_path: Path) -> None:
    for number, name in enumerate(("x/bag (3)", "y/bag", "z/bag", "w/bag", "w/bag (2)"), 1):
        record(tmp_path / name, number, 0.2 + 0.1 * number, uuid=UUID.format(number))
    paths = [tmp_path / name for name in ("x/bag (3)", "y/bag", "z/bag", "w/bag", "w/bag (2)")]
    found = report(*paths, "--out", tmp_path / "set", "--jobs", 2)
    assert found["code"] == 0, found["err"]
    assert len({each["source"] for each in found["reports"]}) == 5
    made = lengths(tmp_path / "set")
    assert made == sorted(set(made)), "of the lengths of the recordings, in order"
    assert [each["recorded"]["uuid"] for each in own(tmp_path / "set")["episodes"]] == [
        UUID.format(number) for number in range(1, 6)
    ]


def test_copies_are_found_before_they_are_encoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, uuid in ((1, UUID.format(1)), (2, "")):  # by UUID, and by content
        named: dict[str, Any] = {"uuid": uuid} if uuid else {}
        record(tmp_path / f"bags/{number}", number, 0.4, **named)
        shutil.copytree(tmp_path / f"bags/{number}", tmp_path / f"bags/{number}_copy")
    record(tmp_path / "bags/3", 3, 0.4)
    converted: list[str] = []
    real = run_module._run_in_pool

    def noted(jobs: Any, *more: Any) -> Any:
        converted.extend(job.source for job in jobs)
        return real(jobs, *more)

    monkeypatch.setattr(run_module, "_run_in_pool", noted)
    found = report(tmp_path / "bags", "--out", tmp_path / "set")
    assert (found["code"], sorted(converted)) == (0, ["1", "2", "3"])
    passed_over = {each["source"]: each["passed_over"] for each in found["reports"]}
    assert passed_over == {"1": "", "1_copy": "is a copy of 1", "2": "", "2_copy": "is a copy of 2", "3": ""}


@pytest.mark.parametrize("only", [(), ("--outcome", "success")], ids=["all", "successes"])
def test_of_copies_whose_outcomes_differ_none_is_converted(bags: Path, tmp_path: Path, only: tuple[str, ...]) -> None:
    shutil.copytree(bags / "episodes/episode_000001", bags / "episodes/episode_000003")
    assert episodes("mark", bags / "episodes/episode_000001", "failure").returncode == 0
    done = convert(bags, "--out", tmp_path / "set", *only)
    assert done.returncode == 1
    sources = "blocks/episode_000001, blocks/episode_000003"
    assert f"left out {sources}: copies of one episode have different outcomes: " in done.stderr
    assert "blocks/episode_000001 is failure, blocks/episode_000003 is success; `ibrobot episodes mark`" in done.stderr
    assert [each["source"] for each in own(tmp_path / "set")["episodes"]] == ["blocks/episode_000002"]


def test_an_outcome_that_is_marked_during_the_conversion_counts(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = run_module._run_in_pool

    def marked(*arguments: Any) -> Any:
        assert episodes("mark", bags / "episodes/episode_000001", "failure").returncode == 0
        return real(*arguments)

    monkeypatch.setattr(run_module, "_run_in_pool", marked)
    found = report(bags, "--out", tmp_path / "set", "--outcome", "success")
    assert (found["code"], found["episodes"]) == (0, 1)
    assert [each["passed_over"] for each in found["reports"]] == ["its outcome is failure", ""]


def test_a_copy_takes_the_place_of_an_original_that_is_damaged(tmp_path: Path) -> None:
    record(tmp_path / "bags/1", 1, 0.5, uuid=UUID.format(1))
    for name in ("2", "3"):
        shutil.copytree(tmp_path / "bags/1", tmp_path / "bags" / name)
    (file,) = (tmp_path / "bags/1").glob("*.mcap")
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF  # in a picture: the chunk's checksum finds it
    file.write_bytes(content)
    found = report(tmp_path / "bags", "--out", tmp_path / "set")
    assert found["code"] == 1
    assert [bool(each["error"]) for each in found["reports"]] == [True, False, False]
    assert [each["passed_over"] for each in found["reports"]] == ["", "", "is a copy of 2"]
    assert len(lengths(tmp_path / "set")) == 1


def test_what_shaped_a_dataset_is_in_its_record(bags: Path, tmp_path: Path) -> None:
    out, (first, second) = tmp_path / "set", sorted((bags / "episodes").iterdir())
    assert convert(first, "--out", out, "--missing", "hold", "--outcome", "success", "--prompt", "x").returncode == 0
    refused = convert(second, "--out", out, "--append")
    assert refused.returncode == 2
    assert "was made with other settings: missing hold, now skip" in refused.stderr
    assert convert(second, "--out", out, "--append", "--missing", "hold").returncode == 0
    kept = own(out)
    assert kept["conversion"]["missing"] == "hold"
    every = {"episodes": 1, "only": "all", "context": 2.0, "calibration": "", "failed": []}
    assert kept["runs"] == [
        every | {"outcomes": ["success"], "prompt": "x"},
        every | {"outcomes": ["success", "failure", "unknown"], "prompt": ""},
    ]
    del kept["conversion"]["missing"]  # as an older version left it
    (out / "meta/ibrobot.json").write_text(json.dumps(kept))
    assert convert(bags, "--out", out, "--append").returncode == 0


def test_the_file_of_an_episode_has_the_outcome_that_a_person_gave(bags: Path, tmp_path: Path) -> None:
    episode = bags / "episodes/episode_000001"
    assert episodes("mark", episode, "failure").returncode == 0
    found = report(episode / "episode_000001_0.mcap", "--out", tmp_path / "set")
    assert [each["outcome"] for each in found["reports"]] == ["failure"]
    only = convert(episode / "episode_000001_0.mcap", "--out", tmp_path / "good", "--outcome", "success")
    assert "its outcome is failure" in only.stderr


def test_cuts_have_row_numbers_of_the_episode(tmp_path: Path) -> None:
    who = ((0.0, "policy"), (1.0, "operator"), (2.0, "policy"))
    record(tmp_path / "bag", 1, 3.0, commanders=who, gap={"/top": (0.2, 0.6), "/wrist": (1.3, 1.7)})
    found = report(tmp_path / "bag", "--out", tmp_path / "set", "--only", "interventions", "--context", "0")
    assert found["code"] == 0, found["err"]
    (kept,) = own(tmp_path / "set")["episodes"]
    ((row, ticks),) = kept["cuts"]
    assert (0 < row < kept["stretch"][1], ticks > 2) == (True, True)
    stamps = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet").to_pydict()
    assert len(stamps["index"]) == kept["stretch"][1]
    assert len(found["reports"][0]["cuts"]) == 2, "of the recording: row numbers of the recording"


@pytest.mark.parametrize("seed", range(8))
def test_cuts_add_up_to_the_skipped_ticks(tmp_path: Path, seed: int) -> None:
    """Gaps at the beginning, in the middle and at the end, of one or two cameras."""
    draw = random.Random(seed)
    places = [(0.0, 1.3), (0.5, draw.uniform(0.8, 1.2)), (draw.uniform(1.3, 1.6), 2.1)]
    gap = {topic: draw.choice(places) for topic in draw.sample(["/top", "/wrist"], draw.randint(1, 2))}
    record(tmp_path / "bag", seed, 2.0, gap=gap)
    found = report(tmp_path / "bag", "--out", tmp_path / "set", "--no-videos")
    assert found["code"] == 0, found["err"]
    (kept,) = own(tmp_path / "set")["episodes"]
    assert sum(ticks for _, ticks in kept["cuts"]) == kept["skipped"] > 0, gap
    rows = [row for row, _ in kept["cuts"]]
    assert (rows == sorted(set(rows)), rows[0] >= 0, rows[-1] <= kept["frames"]) == (True, True, True), rows
    begins, ends = (any(place == at for place in gap.values()) for at in (places[0], places[2]))
    assert (0 in rows, kept["frames"] in rows) == (begins, ends), (gap, rows)


def test_a_success_whose_end_is_left_out_is_in_no_row(tmp_path: Path) -> None:
    record(tmp_path / "bag", 1, 3.0, gap={"/wrist": (1.2, 3.0)})
    found = report(tmp_path / "bag", "--out", tmp_path / "set", "--no-videos", "--success")
    assert found["code"] == 1
    (each,) = found["reports"]
    assert each["error"].startswith("next.success cannot be determined: the last ")
    assert each["error"].endswith("since something is missing; --missing hold repeats the last value")
    held = report(tmp_path / "bag", "--out", tmp_path / "held", "--no-videos", "--success", "--missing", "hold")
    assert held["code"] == 0, held["err"]
    table = pq.read_table(tmp_path / "held/data/chunk-000/file-000.parquet").to_pydict()
    assert table["next.success"] == [False] * (len(table["index"]) - 1) + [True]
    brief = tmp_path / "brief"
    record(brief, 1, 3.0, gap={"/wrist": (2.7, 3.0)})
    short = report(brief, "--out", tmp_path / "short", "--no-videos", "--success")
    assert short["code"] == 0, "less than max_age is missing"


@pytest.mark.parametrize("name", [b"caf\xe9", b"e" * 245])
def test_a_folder_of_any_name_is_converted(tmp_path: Path, name: bytes) -> None:
    record(tmp_path / "bags/other", 2, 0.4)
    record(tmp_path / "bags/plain", 1, 0.3)
    (tmp_path / "bags/plain").rename(tmp_path / "bags" / os.fsdecode(name))
    found = report(tmp_path / "bags", "--out", tmp_path / "set")
    assert (found["code"], found["episodes"]) == (0, 2), found["err"]
    sources = [each["source"] for each in own(tmp_path / "set")["episodes"]]
    assert sorted(sources) == sorted(["other", name.decode("utf-8", "backslashreplace")])


def test_a_conversion_does_not_write_into_what_changed_meanwhile(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, (first, second) = tmp_path / "set", sorted((bags / "episodes").iterdir())
    assert convert(first, "--out", out).returncode == 0
    calls = 0

    class Changed:
        def __init__(self, writer: Any) -> None:
            self._writer = writer

        def __getattr__(self, name: str) -> Any:
            return getattr(self._writer, name)

        def summary(self, root: Path) -> Any:
            nonlocal calls
            calls += 1
            found = self._writer.summary(root)
            return found if calls == 1 else attrs.evolve(found, episodes=found.episodes + 1)

    monkeypatch.setattr(run_module, "make_writer", lambda request: Changed(make_writer(request)))
    done = convert(second, "--out", out, "--append")
    assert done.returncode == 2
    assert "another program has changed it; run the same command again" in done.stderr
    monkeypatch.undo()
    again = report(second, "--out", out, "--append")
    assert (again["episodes"], again["resumed"]) == (1, 1)


def test_the_episodes_of_the_benchmark_differ(tmp_path: Path) -> None:
    """Copies are not converted, and so would make it look twice as slow."""
    digests = set()
    for number in (1, 2):
        record_benchmark(tmp_path / f"two/episode_{number:06d}", 3, number)
        reader = installed_plugins().open_episode(tmp_path / f"two/episode_{number:06d}")
        digests.add(reader.digest())
        reader.close()
    assert len(digests) == 2
    found = report(tmp_path / "two", "--out", tmp_path / "set")
    assert (found["code"], found["episodes"], found["passed_over"]) == (0, 2, 0), found["err"]


def test_episodes_and_datasets_have_short_names(bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "episodes").mkdir()
    bags.rename(tmp_path / "episodes/pick")
    monkeypatch.chdir(tmp_path)
    assert report("pick:2", "--out", "set")["reports"][0]["source"] == "pick/episode_000002"
    assert "episodes/pick/episodes/episode_000002: " in run_here("replay", "pick:2", "--sim", "--dry-run").stderr
    assert "pick:3: there is no such episode" in run_here("replay", "pick:3", "--sim", "--dry-run").stderr
    (tmp_path / "set").rename("pick")  # a dataset of that name here: its episode 2, from 0
    assert "has no episode 2; available: 0 to 0" in convert("pick:2", "--out", "again").stderr
    assert report("pick:0", "episodes/pick:2", "--out", "again")["episodes"] == 2
