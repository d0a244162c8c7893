"""Conversions of parts, and their datasets merged."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from command_line import run_here
from recordings import record

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("first_conversion")]
PARTS = 3


def merge(*arguments: object) -> CompletedProcess[str]:
    return run_here("datasets", "merge", *arguments)


def content(dataset: Path) -> dict[str, bytes]:
    return {str(path.relative_to(dataset)): path.read_bytes() for path in dataset.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five bags, the dataset `whole` of them, and the datasets `part1` to `part3` of its shards."""
    folder = tmp_path_factory.mktemp("shards")
    for number in range(1, 6):
        record(folder / f"bags/{number}", number, 0.3, "sort")
    convert = ("convert", folder / "bags", "--no-videos", "--jobs", 2)
    assert run_here(*convert, "--out", folder / "whole").returncode == 0
    for number in range(1, PARTS + 1):
        done = run_here(*convert, "--out", folder / f"part{number}", "--shard", f"{number}/{PARTS}")
        assert done.returncode == 0, done.stderr
    return folder


def test_merged_shards_are_the_whole_dataset(folder: Path) -> None:
    parts = [folder / f"part{number}" for number in range(1, PARTS + 1)]
    done = merge(*parts, "--out", folder / "merged")
    assert (done.returncode, done.stdout) == (0, f"5 episodes of 3 datasets -> {folder / 'merged'}\n"), done.stderr
    whole, merged = content(folder / "whole"), content(folder / "merged")
    own = "meta/ibrobot.json"
    one, other = (json.loads(each.pop(own)) for each in (whole, merged))
    assert whole == merged
    assert [run.pop("episodes") for run in other["runs"]] == [1, 2, 2]
    assert one | {"runs": []} == other | {"runs": []}
    again = merge(*parts, "--out", folder / "merged")
    assert (again.returncode, "exists already; choose a new folder" in again.stderr) == (2, True)


def test_episode_in_two_datasets_is_an_error(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "bags/1", tmp_path / "renamed")
    convert = ("convert", tmp_path / "renamed", "--no-videos", "--out", tmp_path / "copy")
    assert run_here(*convert).returncode == 0
    done = merge(folder / "part2", folder / "part1", tmp_path / "copy", "--out", tmp_path / "set")
    assert done.returncode == 2
    assert f"{tmp_path / 'copy'}: its episode renamed is in {folder / 'part1'}, too, as 1" in done.stderr
    assert not (tmp_path / "set").exists()


def test_datasets_that_do_not_fit_are_not_merged(folder: Path, tmp_path: Path) -> None:
    bag = folder / "bags/2"
    run_here("convert", bag, "--out", tmp_path / "other", "--no-videos", "--missing", "hold")
    settings = merge(folder / "part1", tmp_path / "other", "--out", tmp_path / "set")
    assert f"{tmp_path / 'other'}: was made with other settings than {folder / 'part1'}" in settings.stderr
    shutil.copytree(folder / "part2", tmp_path / "foreign")
    (tmp_path / "foreign/meta/ibrobot.json").write_text("{}")
    foreign = merge(folder / "part1", tmp_path / "foreign", "--out", tmp_path / "set")
    assert "was not made by ibrobot convert" in foreign.stderr
    own = json.loads((folder / "part2/meta/ibrobot.json").read_bytes())
    own["fingerprint"] = "0" * 64
    own["contract"]["rate_hz"] = 7.0
    (tmp_path / "foreign/meta/ibrobot.json").write_text(json.dumps(own))
    contract = merge(folder / "part1", tmp_path / "foreign", "--out", tmp_path / "set")
    assert f"its contract differs from that of {folder / 'part1'}" in contract.stderr
    assert "rate_hz" in contract.stderr
