"""Commands at once on one episode or dataset: what was reported as kept is there, once, and refusals name the owner.

    python tests/shared/owners.py [--times 20] [--kills 10] [--seed 0] [--only NAME]

Every pair of record, repair, trim, mark, delete, restore, convert, append, merge and train runs at once, `--times`
times, with random delays. Then each of them is killed (SIGKILL) at `--kills` times of its run, beside another one. Then
follow `ibrobot episodes repair` and, of conversions, merges and trainings, the same command, as a user would run them.
Prints a line per pair, and exits with 1 if anything was lost or doubled, or if a refusal names no owner, or more than
one.

All of them run the code of the commands in forked processes, which have imported it already. Episodes are converted in
the process of the command instead of one of their own, which takes a second longer to start. The program that `ibrobot
train` starts is a stand-in, which reads the dataset and writes checkpoints as LeRobot does, but loads no torch.
"""

from __future__ import annotations

import argparse
import io
import itertools
import json
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch
from uuid import UUID

import attrs

os.environ.setdefault("OMP_NUM_THREADS", "1")  # forked processes have one thread

import numpy as np
import pyarrow.parquet as pq
from ibrobot_data import run as convert_module
from ibrobot_data.episode import convert_episode
from ibrobot_data.episode_start import take_next_folder
from ibrobot_lerobot import trainer as training_module
from ibrobot_lerobot.layout import open_dataset
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_lerobot.training_checkpoints import newest_checkpoint
from ibrobot_lerobot.writer import LeRobotDatasetWriter
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.reader import Rosbag2Reader
from ibrobot_mcap.recorder import McapRecorder
from ibrobot_testing.contexts import host_context
from trainer import install as install_trainer

from ibrobot_core.cli.main import main as ibrobot
from ibrobot_core.clock import RealClock, SteppedClock
from ibrobot_core.contract.specs import ActionPart, Contract, ObservationPart
from ibrobot_core.errors import IbrobotError
from ibrobot_core.interfaces import EpisodeEnd, EpisodeStart, Feature
from ibrobot_core.messages import Float64MultiArray, Header, JointState
from ibrobot_core.schema import Align

START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
WHOLE, PART, RECORDED = 100, 61, 50
"""Joint states of the original, of the part that takes its place at first, and of the episode that is recorded."""
STEPS = 10
"""Of a training; each is saved."""
DELAY_S = 0.15
PATIENCE_S = 300.0
STATE, COMMAND = JointState.ros_type, Float64MultiArray.ros_type
PAN = Feature("float32", (1,))
CONTRACT = Contract(
    30.0,
    (ObservationPart("observation.state", "/joint_states", STATE, ("position.pan",), None, Align(), PAN),),
    (ActionPart("arm", "/commands", COMMAND, "hold", ("pan",)),),
)
STATES_LEGITIMATELY = (
    "there is no such", "is not an episode", "contains no episode", "already has a dataset", "is no longer there",
    "its trash has no", "the dataset has another state", "the dataset has this episode", "not an episode of a known",
    "run `ibrobot episodes repair` first", "outside it", "lacks messages", "has no .mcap", "nothing was added",
    "another program has changed it", "no message of", "has no message",
)  # fmt: skip
"""What a command may say because the other one ran before it."""


def write(folder: Path, count: int, number: int, pause_s: float = 0.0) -> None:
    """Record an episode; with a pause between messages in real time, by a thread, as a run does."""
    clock = RealClock() if pause_s else SteppedClock(START_NS)
    recorder = McapRecorder(McapOptions(min_free=0, chunk_period_s=0.02), host_context(clock=clock))
    metadata = {
        "uuid": str(UUID(int=number, version=4)),
        "contract": json.dumps(CONTRACT.canonical()),
        "prompt": "pick",
        "fingerprint": CONTRACT.fingerprint(),
        "config": "{}",
        "calibration": "{}",
    }
    folder.parent.mkdir(parents=True, exist_ok=True)
    recorder.begin(EpisodeStart(folder, START_NS, CONTRACT.topics, metadata))
    try:
        for i in range(count):
            at_ns = START_NS + i * STEP_NS
            recorder.write("/joint_states", JointState(Header(at_ns), ("pan",), [float(number) + i / 1e3]), at_ns)
            recorder.write("/commands", Float64MultiArray([float(i)]), at_ns)
            time.sleep(pause_s)
        recorder.end(EpisodeEnd(at_ns, "success"))
    finally:
        recorder.close()


def record(place: Path) -> None:
    taken = take_next_folder(place / "pick")
    with taken:
        write(taken.path, RECORDED, random.getrandbits(60), 0.016)


def merge(place: Path) -> None:
    writer = LeRobotDatasetWriter(LeRobotOptions())
    summary = writer.summary(place / "set")
    assert summary is not None
    writer.merge(place / "set", [place / "part"], summary.metadata)


def command(*words: str) -> Callable[[Path], None]:
    """A command line, in which `EPISODE` is the episode in question."""

    def run(place: Path) -> None:
        episode = place / "pick/episodes" / os.environ["OWNERS_EPISODE"]
        sys.argv = ["ibrobot", *(str(episode) if word == "EPISODE" else word for word in words)]
        os.chdir(place)
        ibrobot()

    return run


def restore(place: Path) -> None:
    oldest = min((each.name for each in (place / "pick/episodes").glob(".trash/*")), default="none")
    sys.argv = ["ibrobot", "episodes", "trash", str(place / "pick"), "--restore", oldest]
    ibrobot()


COMMANDS: dict[str, Callable[[Path], None]] = {
    "record": record,
    "repair": command("episodes", "repair", "EPISODE"),
    "trim": command("episodes", "trim", "EPISODE", "--in-place", "--to", "0.2"),
    "mark": command("episodes", "mark", "EPISODE", "failure"),
    "delete": command("episodes", "delete", "--to-trash", "EPISODE"),
    "restore": restore,
    "convert": command("convert", "pick", "--out", "new", "--jobs", "1"),
    "append": command("convert", "pick", "--out", "set", "--append", "--jobs", "1"),
    "merge": merge,
    "train": command("train", "set", "--out", "training", "--steps", str(STEPS), "--pause=0.02"),
}


def here(*arguments: object) -> None:
    """Run `ibrobot` to its end, which must be good."""
    with patch.object(sys, "argv", ["ibrobot", *map(str, arguments)]), redirect_stdout(io.StringIO()):
        err = io.StringIO()
        try:
            with redirect_stderr(err):
                ibrobot()
        except SystemExit as end:
            if end.code:
                raise RuntimeError(err.getvalue()) from None


def prepare_episode(place: Path) -> None:
    """An episode that was trimmed."""
    episode = place / "pick/episodes/episode_000001"
    write(episode, WHOLE, 1)
    here("episodes", "trim", episode, "--in-place", "--to", "0.6")


def prepare_datasets(place: Path) -> None:
    """A dataset of another episode, and a part to merge into it."""
    for number, name in ((2, "set"), (3, "part")):
        write(place / "other" / name, 40, number)
        here("convert", place / "other" / name, "--out", place / name)
    shutil.rmtree(place / "other")


@attrs.frozen
class Ended:
    """A command that has ended, and what it printed."""

    name: str
    pid: int
    code: int
    said: str


class Started:
    """A command in a forked process, after a delay."""

    def __init__(self, name: str, place: Path, delay_s: float) -> None:
        self.name = name
        self._said = place / f"said_{name}_{time.monotonic_ns()}"
        self.pid = os.fork()
        if self.pid == 0:
            self._run(place, delay_s)

    def _run(self, place: Path, delay_s: float) -> None:
        code = 1
        try:
            said = os.open(self._said, os.O_CREAT | os.O_WRONLY)
            os.dup2(said, 1)
            os.dup2(said, 2)
            sys.stdout, sys.stderr = (open(number, "w", closefd=False) for number in (1, 2))  # noqa: SIM115
            random.seed()
            time.sleep(delay_s)
            COMMANDS[self.name](place)
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0
        except IbrobotError as error:
            print(f"error: {error}", file=sys.stderr)
        finally:
            sys.stderr.flush()
            os._exit(code)

    def end(self) -> Ended:
        """Wait for its end; one that takes longer than `PATIENCE_S` is killed."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not (found := os.waitpid(self.pid, os.WNOHANG))[0]:
            if time.monotonic() > deadline_s:
                os.kill(self.pid, signal.SIGKILL)
            time.sleep(0.002)
        code = os.waitstatus_to_exitcode(found[1])
        return Ended(self.name, self.pid, code, self._said.read_text() if self._said.exists() else "")


def aside(act: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a function in a forked process, since pyarrow starts threads, and this process forks."""
    read, write_ = os.pipe()
    child = os.fork()
    if child == 0:
        with open(write_, "w") as stream:
            json.dump(act(*arguments), stream)
        os._exit(0)
    os.close(write_)
    with open(read) as stream:
        result = json.load(stream)
    assert os.waitpid(child, 0)[1] == 0
    return result


def all_faults(place: Path, ended: list[Ended]) -> list[str]:
    return list(faults(place, ended))


def contents(place: Path) -> Iterator[tuple[Path, int, dict[str, str], str, bool]]:
    """Every episode, in the trash or not: joint states, metadata, outcome, and whether it is finished."""
    root = place / "pick/episodes"
    for folder in (*root.glob("episode_*"), *root.glob(".trash/*/episode_*")):
        reader = Rosbag2Reader(folder)
        try:
            summary = reader.summary()
            stamps = [item.message.header.stamp_ns for item in reader.messages({"/joint_states"})]  # type: ignore[attr-defined]
        finally:
            reader.close()
        assert stamps == [START_NS + i * STEP_NS for i in range(len(stamps))], f"{folder}: other messages"
        yield folder, len(stamps), dict(summary.metadata), summary.outcome, summary.finished


def faults(place: Path, ended: list[Ended]) -> Iterator[str]:
    """What is wrong when all have ended."""
    found = list(contents(place))
    first = [each for each in found if each[0].name.startswith("episode_000001")]
    for count, what in ((WHOLE, "the original"), (PART, "its part")):
        if (there := sum(each[1] == count for each in first)) != 1:
            yield f"{what} is there {there} times"
    kept = {each.name for each in ended if each.code == 0}
    if "record" in kept and not any(each[1] == RECORDED and each[4] for each in found):
        yield "the recording is not there"
    if "mark" in kept and not any(each[2].get("marked") == "true" for each in found):
        yield "the mark is not there"
    if "trim" in kept and not any(each[2].get("trimmed", "").startswith("0 s to 0.2 s") for each in found):
        yield "the trimmed episode is not there"
    hidden = [path.name for path in (place / "pick/episodes").glob(".*")]
    if left := [name for name in hidden if name != ".trash" and not name.endswith(".lock")]:
        yield f"{left} is left"
    for name in ("set", "new"):
        if (place / name / "meta/info.json").exists():
            yield from dataset_faults(place / name, "merge" in {each.name for each in ended})
            left = [path.name for path in (place / name).glob(".*")]
            # What a refused conversion has converted stays for the next one.
            if left and not (left == [".staging"] and any(each.code for each in ended)):
                yield f"{name}: {left} is left"
    episodes = len(lengths(place / "set"))
    if "merge" in kept and episodes < 2:
        yield "the merged part is not there"
    if {"append", "merge"} <= kept and episodes < 3 and any("1 episode" in each.said for each in ended):
        yield "of what was appended and merged, one is missing"
    for each in ended:
        yield from refusal_faults(each)
        yield from training_faults(place / "training", each)


def lengths(dataset: Path) -> list[int]:
    there = open_dataset(dataset)
    assert there is not None
    return [row["length"] for row in there.episodes()]


def dataset_faults(dataset: Path, merged: bool) -> Iterator[str]:
    tables = [pq.read_table(path).to_pydict() for path in sorted((dataset / "data").rglob("*.parquet"))]
    index = np.concatenate([np.array(table["index"]) for table in tables])
    episodes = np.concatenate([np.array(table["episode_index"]) for table in tables])
    if index.tolist() != list(range(len(index))) or np.bincount(episodes).tolist() != lengths(dataset):
        yield f"{dataset.name}: its rows are not those of its episodes"
    kept = json.loads((dataset / "meta/ibrobot.json").read_bytes())["episodes"]
    if any(number > 1 for number in Counter(each["identity"] for each in kept).values()):
        yield f"{dataset.name}: has an episode twice"
    if not merged and len(kept) != len(lengths(dataset)):
        yield f"{dataset.name}: describes {len(kept)} of {len(lengths(dataset))} episodes"


def training_faults(out: Path, ended: Ended) -> Iterator[str]:
    newest = newest_checkpoint(out)
    if (ended.name, ended.code) != ("train", 0):
        return
    if newest is None or newest.step != STEPS:
        yield f"of the training, {newest} is there"


def refusal_faults(ended: Ended) -> Iterator[str]:
    if ended.code == 0 or ended.code < 0:
        return
    owners = set(re.findall(r"by process (\d+)", ended.said))
    if "Traceback" in ended.said or "(a bug at" in ended.said:
        yield f"{ended.name}: a bug: {ended.said[-500:]}"
    elif len(owners) > 1 or (owners and str(ended.pid) in owners):
        yield f"{ended.name}: names the owners {owners}"
    elif not owners and not any(words in ended.said for words in STATES_LEGITIMATELY):
        yield f"{ended.name}: was refused without an owner: {ended.said[-300:]}"


def trial(
    template: Path, folder: Path, names: tuple[str, str], delays: tuple[float, float], kill_s: float | None
) -> Any:
    """Run two commands at once; returns how they ended, and what is wrong. `kill_s`: when the first one is killed."""
    place = folder / "place"
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(template, place)
    os.environ["OWNERS_EPISODE"] = "episode_000002" if "record" in names else "episode_000001"
    begin_s = time.monotonic()
    started = [Started(name, place, delay_s) for name, delay_s in zip(names, delays, strict=True)]
    if kill_s is not None:
        time.sleep(max(0.0, begin_s + kill_s - time.monotonic()))
        os.kill(started[0].pid, signal.SIGKILL)
    ended = [each.end() for each in started]
    if kill_s is not None and ended[0].code < 0:
        with suppress(RuntimeError):  # of the episodes, some may be gone
            here("episodes", "repair", place / "pick")
        if names[0] in ("convert", "append", "merge", "train"):  # the others are done or not
            ended.append(Started(names[0], place, 0.0).end())
            if "already has a dataset" in ended[-1].said:
                return ended, [f"{names[0]}: does not go on: {ended[-1].said[-300:]}"]
    return ended, aside(all_faults, place, ended)


def length(template: Path, folder: Path, name: str) -> float:
    """How long a command takes by itself [s]."""
    place = folder / "place"
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(template, place)
    os.environ["OWNERS_EPISODE"] = "episode_000001"
    begin_s = time.monotonic()
    Started(name, place, 0.0).end()
    return time.monotonic() - begin_s


def _in_this_process(jobs: Any, pool: Any, watch: Callable[..., None]) -> Iterator[Any]:
    for job in jobs:
        yield convert_episode(job, lambda frames: None)


def run(times: int, kills: int, seed: int, only: str | None = None) -> bool:
    """Run all pairs, and then the kills; prints a line for each, and returns whether nothing was wrong."""
    rng, good = random.Random(seed), True
    convert_module._run_in_pool = _in_this_process
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        template = folder / "template"
        program = str(install_trainer(folder))
        vars(training_module)["find_trainer"] = lambda: program
        prepare_episode(template)  # in this process, which thereby imports what each of its forks would import
        aside(prepare_datasets, template)
        pairs = [pair for pair in itertools.combinations_with_replacement(COMMANDS, 2) if only is None or only in pair]
        for pair in pairs:
            tried = []
            for _ in range(times):
                delays = rng.uniform(0, DELAY_S), rng.uniform(0, DELAY_S)
                tried.append(trial(template, folder, pair, delays, None))
            good = told(" + ".join(pair), tried) and good
        for first in COMMANDS if kills else ():
            if only is not None and only != first:
                continue
            length_s = min(length(template, folder, first) for _ in range(3))
            tried = []
            for point in range(1, kills + 1):
                second = rng.choice(list(COMMANDS))
                delays = 0.0, rng.uniform(0, length_s)
                tried.append(trial(template, folder, (first, second), delays, length_s * point / (kills + 1)))
            good = told(f"{first} killed", tried) and good
    return good


def told(what: str, tried: list[Any]) -> bool:
    """Print a line about some trials; returns whether nothing was wrong."""
    codes = Counter(each.code for ended, _ in tried for each in ended)
    refused = sum("by process" in each.said for ended, _ in tried for each in ended if each.code)
    wrong = [fault for _, found in tried for fault in found]
    print(
        f"{what:20} {len(tried):3} times: kept {codes[0]:3}, refused by an owner {refused:3}, killed {codes[-9]:3}, "
        f"wrong {len(wrong)}",
        flush=True,
    )
    for fault, count in Counter(wrong).items():
        print(f"    {count} times: {fault}", flush=True)
    return not wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=COMMANDS)
    asked = parser.parse_args()
    return 0 if run(asked.times, asked.kills, asked.seed, asked.only) else 1


if __name__ == "__main__":
    sys.exit(main())
