"""Damages bags at random and sees that reading and conversion take no harm from them.

    python tests/integration/fuzz_bags.py --mutants 5000
    python tests/integration/fuzz_bags.py --only 2:612 mcap

Every mutant of every container is read, and its rows are made as `ibrobot convert` makes them. It must hold that

- nothing but ibrobot's own errors is raised, and nothing hangs;
- an episode that lacks a row is not a success, unless it has every message at its time, and only their contents differ;
- rows are those of the undamaged bag, from the first on. This can only be asked of containers with checksums, which
  all have that ibrobot records; a sqlite3 file, or an MCAP file whose writer leaves them out as that of `rosbags` does,
  cannot tell a flipped bit within a message.

Prints a line for each container, and SEED:NUMBER of the first mutants that break a rule, which `--only` runs again
alone. Exits with 1 where there is one.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path

import attrs
import numpy as np
from ibrobot_data.episode import recorded_contract
from ibrobot_data.ticks import Ticks
from ibrobot_mcap.metadata import METADATA
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.reader import Rosbag2Reader
from ibrobot_mcap.recorder import McapRecorder
from ibrobot_ros2 import encode
from ibrobot_testing.contexts import START_NS, host_context
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from ibrobot_core.contract.specs import ActionPart, Contract, ObservationPart
from ibrobot_core.errors import IbrobotError
from ibrobot_core.interfaces import EpisodeEnd, EpisodeStart, Feature
from ibrobot_core.messages import Float64MultiArray, Header, JointState
from ibrobot_core.schema import Align

JOINTS = ("pan", "tilt")
CONTRACT = Contract(
    30.0,
    (
        ObservationPart(
            "observation.state",
            "/joint_states",
            JointState.ros_type,
            tuple(f"position.{j}" for j in JOINTS),
            None,
            Align(),
            Feature("float32", (2,), JOINTS),
        ),
    ),
    (ActionPart("arm", "/commands", Float64MultiArray.ros_type, "hold", JOINTS),),
)
SPAN_NS = 1_200_000_000
RATES = {"/joint_states": 100, "/commands": 50}
EDGES = (0, 1, 127, 128, 255, 2**15, 2**16 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)
SHOWN = 3
"""Mutants of a container that are kept where they break a rule."""
PATIENCE_S = 20

Rows = list[dict[str, list[float]]]
Times = list[tuple[str, int]]


@attrs.frozen
class Container:
    """A way to keep an episode."""

    write: Callable[[Path], None]
    """Writes the episode into a folder."""
    checked: bool = False
    """Whether the messages have checksums."""
    damages: Callable[[Path], bool] = lambda path: path.name != METADATA
    """Which of its files are damaged."""


def _events():
    chance = np.random.default_rng(1)
    for topic, rate in RATES.items():
        for number in range(SPAN_NS * rate // 1_000_000_000):
            at_ns = START_NS + number * 1_000_000_000 // rate
            values = chance.uniform(-1, 1, 2)
            message = JointState(Header(at_ns), JOINTS, values) if "states" in topic else Float64MultiArray(values)
            yield at_ns + 1_000_000, topic, message


def _metadata():
    canonical = json.dumps(CONTRACT.canonical())
    return {"contract": canonical, "fingerprint": CONTRACT.fingerprint(), "prompt": "pick"}


def _record(folder: Path, **options) -> None:
    recorder = McapRecorder(McapOptions(chunk_size=2048, **options), host_context())
    recorder.begin(EpisodeStart(folder, START_NS, CONTRACT.topics, _metadata()))
    for received_ns, topic, message in sorted(_events(), key=lambda event: event[0]):
        recorder.write(topic, message, received_ns)
    recorder.end(EpisodeEnd(START_NS + SPAN_NS, "success"))


def _by_rosbags(folder: Path, storage: StoragePlugin, mode: CompressionMode | None) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = RosbagsWriter(folder, version=9, storage_plugin=storage)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        for key, value in {**_metadata(), "outcome": "success"}.items():
            writer.set_custom_data(key, value)
        known = {topic: writer.add_connection(topic, t, typestore=store) for topic, t in CONTRACT.topics.items()}
        for received_ns, topic, message in sorted(_events(), key=lambda event: event[0]):
            writer.write(known[topic], received_ns, bytes(encode(message)))


def _only_metadata(path: Path) -> bool:
    return path.name == METADATA


MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
CONTAINERS = {
    "recorded": Container(_record, checked=True),
    "recorded-lz4": Container(partial(_record, compression="lz4"), checked=True),
    "recorded-zstd": Container(partial(_record, compression="zstd"), checked=True),
    "recorded-metadata": Container(_record, damages=_only_metadata),
    "mcap": Container(partial(_by_rosbags, storage=MCAP, mode=None)),
    "mcap-message": Container(partial(_by_rosbags, storage=MCAP, mode=CompressionMode.MESSAGE)),
    "mcap-file": Container(partial(_by_rosbags, storage=MCAP, mode=CompressionMode.FILE)),
    "mcap-storage": Container(partial(_by_rosbags, storage=MCAP, mode=CompressionMode.STORAGE)),
    "sqlite3": Container(partial(_by_rosbags, storage=SQLITE, mode=None)),
    "sqlite3-message": Container(partial(_by_rosbags, storage=SQLITE, mode=CompressionMode.MESSAGE)),
    "sqlite3-file": Container(partial(_by_rosbags, storage=SQLITE, mode=CompressionMode.FILE)),
    "sqlite3-metadata": Container(partial(_by_rosbags, storage=SQLITE, mode=None), damages=_only_metadata),
}


def damaged(content: bytes, chance: random.Random) -> bytes:
    """A mutant: cut, flipped, overwritten, shortened or lengthened in places."""
    found = bytearray(content)
    for _ in range(chance.choice((1, 1, 1, 2, 5))):
        at = chance.randrange(len(found) + 1)
        span = chance.choice((1, 2, 8, 64, 1000))
        match chance.randrange(7):
            case 0:
                del found[at:]
            case 1:
                found[at : at + span] = bytes(len(found[at : at + span]))
            case 2:
                found[at : at + 8] = chance.choice(EDGES).to_bytes(8, "little")[: len(found[at : at + 8])]
            case 3:
                del found[at : at + span]
            case 4:
                found[at:at] = found[at : at + span]
            case _:
                for place in range(at, min(at + chance.choice((1, 1, 4)), len(found))):
                    found[place] ^= 1 << chance.randrange(8)
    return bytes(found)


def read(path: Path) -> tuple[str, Rows, str]:
    """Outcome and rows of an episode, and why there are no more of them."""
    outcome = "unknown"
    rows: Rows = []
    try:
        reader = Rosbag2Reader(path)
        try:
            summary = reader.summary()
            outcome = summary.outcome
            contract = recorded_contract(summary.metadata)
            if contract is None:
                return outcome, rows, "no contract"
            for row in Ticks(reader, contract, "refuse"):
                rows.append({key: value.tolist() for key, value in row.items()})
        finally:
            reader.close()
    except IbrobotError as error:
        return outcome, rows, str(error)
    return outcome, rows, ""


@contextmanager
def hurried() -> Iterator[None]:
    """Raises `TimeoutError` within after `PATIENCE_S`."""

    def late(*_: object) -> None:
        raise TimeoutError(f"still at it after {PATIENCE_S} s")

    signal.signal(signal.SIGALRM, late)
    signal.alarm(PATIENCE_S)
    try:
        yield
    finally:
        signal.alarm(0)


def times(path: Path) -> Times:
    """Topic and receipt [ns] of every message, in order."""
    reader = Rosbag2Reader(path)
    try:
        return [(raw.topic, raw.received_ns) for raw in reader.raw()]
    finally:
        reader.close()


@attrs.frozen
class Intact:
    """What an undamaged bag has."""

    rows: Rows
    times: Times


def wrong(container: Container, found: tuple[str, Rows, str], intact: Intact, mutant: Path) -> str:
    """The rule that a mutant breaks; empty for a good one."""
    outcome, rows, error = found
    if error:
        return ""
    if outcome == "success" and len(rows) < len(intact.rows):
        return "a success of fewer rows" if container.checked or times(mutant) != intact.times else ""
    if container.checked and rows != intact.rows[: len(rows)]:
        return "rows differ from those of the undamaged bag"
    return ""


def _ending(broken: str, found: tuple[str, Rows, str], intact: Intact) -> str:
    outcome, rows, error = found
    if broken:
        return f"wrong: {broken}"
    if error:
        return "refused"
    if len(rows) == len(intact.rows):
        return "read whole"
    return "read in part" if outcome != "success" else "read, with another content of a message"


def _mutants(files: dict[str, bytes], container: Container, chance: random.Random) -> Iterator[dict[str, bytes]]:
    """The files of one mutant after the other."""
    targets = [name for name in files if container.damages(Path(name))]
    while True:
        changed = chance.choice(targets)
        yield {**files, changed: damaged(files[changed], chance)}


def _judge(container: Container, mutant: Path, intact: Intact) -> tuple[str, str, str]:
    """How reading a mutant ended, the rule that it breaks, and what was raised."""
    try:
        with hurried():
            found = read(mutant)
            broken = wrong(container, found, intact, mutant)
    except Exception as error:  # noqa: BLE001 - this is what is looked for
        broken = f"raised {type(error).__name__}"
        return f"wrong: {broken}", broken, "".join(traceback.format_exception(error))
    return _ending(broken, found, intact), broken, found[2]


def fuzz(name: str, mutants: int, seed: int, only: int | None = None) -> Counter[str]:
    """Read mutants of a container; how they ended, with `wrong: …` for each that breaks a rule.

    Args:
        name: of the container.
        mutants: how many.
        seed: of all that is by chance.
        only: the number of one mutant to report in full; the others are skipped.
    """
    container, chance = CONTAINERS[name], random.Random(f"{name} {seed}")
    ended: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as scratch:
        original, mutant = Path(scratch) / "intact", Path(scratch) / "mutant"
        container.write(original)
        outcome, rows, error = read(original)
        assert (outcome, len(rows) > 30, error) == ("success", True, "")
        intact = Intact(rows, times(original))
        files = {path.name: path.read_bytes() for path in sorted(original.iterdir())}
        original.rename(mutant)
        for number, contents in enumerate(islice(_mutants(files, container, chance), mutants)):
            if only not in (None, number):
                continue
            for file, content in contents.items():
                (mutant / file).write_bytes(content)
            how, broken, details = _judge(container, mutant, intact)
            ended[how] += 1
            if only is not None or (broken and sum(ended[key] for key in ended if key.startswith("wrong")) <= SHOWN):
                kept = Path(tempfile.gettempdir()) / f"ibrobot-fuzz-{name}-{seed}-{number}"
                shutil.rmtree(kept, ignore_errors=True)
                shutil.copytree(mutant, kept)
                print(f"{name} {seed}:{number}: {how}; kept at {kept}\n{details}", file=sys.stderr)
    return ended


def _run_alone(name: str, only: str) -> bool:
    """Run one mutant; whether it breaks a rule."""
    seed, number = map(int, only.split(":"))
    (how,) = fuzz(name, number + 1, seed, number)
    return how.startswith("wrong")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=5000, help="of each container")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", metavar="SEED:NUMBER", help="one mutant, as an earlier run named it")
    parser.add_argument("containers", nargs="*", metavar="CONTAINER", help=f"of {', '.join(CONTAINERS)}; all")
    arguments = parser.parse_args()
    if arguments.only:
        return any([_run_alone(name, arguments.only) for name in arguments.containers or CONTAINERS])
    failed = False
    with multiprocessing.Pool(arguments.jobs) as pool:
        for name in arguments.containers or CONTAINERS:
            begun, share = time.monotonic(), -(-arguments.mutants // (arguments.jobs * 4))
            seeds = range(arguments.seed, arguments.seed + arguments.jobs * 4)
            results = pool.starmap(fuzz, [(name, share, seed) for seed in seeds], chunksize=1)
            total = sum(results, Counter())
            failed |= any(key.startswith("wrong") for key in total)
            print(f"{name}: {json.dumps(dict(total))} in {time.monotonic() - begun:.0f} s", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
