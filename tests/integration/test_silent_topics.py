"""Topics that fall silent, begin late, end early, repeat a stamp or whose clock is set back: no row has an old sample.

What `convert` and `verify` report is compared with what mcap, rosbags and pyarrow read, and with the rules of alignment
applied to that by brute force.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import independent
import numpy as np
import pytest
from command_line import run_here
from ibrobot_data.ticks import Ticks
from ibrobot_mcap.reader import Rosbag2Reader
from recordings import CONTRACT, record

from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import ContractError, RecorderError

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("first_conversion")]

STATES, COMMANDS, TOP = "/joint_states", "/commands", "/top"
LONG_S = 2.0
LIMIT_NS = 250_000_000
TICKS = 60
BENCH = attrs.evolve(CONTRACT, observation_parts=CONTRACT.observation_parts[:2])
SILENT: dict[str, dict[str, tuple[float, float]]] = {
    f"{topic} {what}": {topic: span}
    for topic in (STATES, COMMANDS, TOP)
    for what, span in {"silent": (0.5, 1.3), "late": (0.0, 0.7), "ends early": (1.2, 9.0)}.items()
}
CLOCKS: dict[str, Callable[[float], float]] = {
    "repeats a stamp": lambda at_s: min(at_s, 1.0),
    "repeats a stamp for a time": lambda at_s: 0.6 if 0.6 < at_s < 1.4 else at_s,
    "is set back a little": lambda at_s: at_s - 0.6 * (at_s > 0.8),
    "is set back far": lambda at_s: at_s - 30.0 * (at_s > 0.8),
}
STAMPED = {f"{topic} {what}": {topic: clock} for topic in (STATES, TOP) for what, clock in CLOCKS.items()}


def check(folder: Path, out: Path, topic: str) -> None:
    """A fault of `topic` costs ticks, and all agree on which."""
    lost, verified = independent.check(folder, out, BENCH)
    assert lost, "the fault costs ticks"
    assert f"{topic}: " in verified


@pytest.mark.parametrize("fault", SILENT)
def test_a_silent_topic_is_a_gap(fault: str, tmp_path: Path) -> None:
    record(tmp_path / "bag", 5, LONG_S, "sort", contract=BENCH, gap=SILENT[fault])
    check(tmp_path / "bag", tmp_path / "set", fault.split(maxsplit=1)[0])


@pytest.mark.parametrize("fault", STAMPED)
def test_old_stamps_are_a_gap(fault: str, tmp_path: Path) -> None:
    record(tmp_path / "bag", 5, LONG_S, "sort", contract=BENCH, stamped=STAMPED[fault])
    check(tmp_path / "bag", tmp_path / "set", fault.split(maxsplit=1)[0])


def test_without_a_fault_there_is_no_gap(tmp_path: Path) -> None:
    record(tmp_path / "bag", 5, LONG_S, "sort", contract=BENCH)
    done = run_here("convert", tmp_path / "bag", "--out", tmp_path / "set", "--no-videos", "--json")
    (report,) = json.loads(done.stdout)["reports"]
    assert (report["gaps"], report["skipped"]) == ({}, 0)
    assert run_here("episodes", "verify", tmp_path / "bag").stdout.endswith("good\n")


def rows(folder: Path, contract: Contract, missing: str = "skip") -> tuple[list[Any], Ticks]:
    reader = Rosbag2Reader(folder)
    try:
        ticks = Ticks(reader, contract, missing)
        return list(ticks), ticks
    finally:
        reader.close()


@pytest.mark.parametrize("span", [(0.0, 0.7), (0.5, 1.3), (1.2, 9.0)])
def test_the_next_command_is_missing_where_it_comes_late(span: tuple[float, float], tmp_path: Path) -> None:
    """With `align: next`, commands do not count for ticks long before them, and none follows an early end."""
    record(tmp_path / "bag", 5, LONG_S, gap={COMMANDS: span})
    (action,) = CONTRACT.action_parts
    parts: dict[str, Any] = {
        "observation_parts": BENCH.observation_parts[:1],
        "action_parts": (attrs.evolve(action, align="next"),),
    }
    contract = attrs.evolve(CONTRACT, **parts)
    read = independent.samples(tmp_path / "bag", BENCH)
    begin_ns = min(each.received_ns for of_topic in read.values() for each in of_topic)
    end_ns = max(each.received_ns for topic in (STATES, COMMANDS) for each in read[topic])
    wanted = []
    for t_ns in range(begin_ns, end_ns + 1, contract.step_ns):
        following = [each.received_ns - t_ns for each in read[COMMANDS] if each.received_ns > t_ns]
        old = independent.age(read[STATES], t_ns)
        if following and min(following) <= LIMIT_NS and old is not None and old <= LIMIT_NS:
            wanted.append(t_ns)
    made, ticks = rows(tmp_path / "bag", contract)
    assert len(made) == len(wanted)
    assert ticks.stamp_ns == wanted[-1]
    assert ticks.gaps == {"action": 1}
    assert 10 < ticks.skipped <= (end_ns - begin_ns) // contract.step_ns + 1 - len(wanted)


def test_a_sparse_command_counts_for_as_long_as_its_action_says(tmp_path: Path) -> None:
    record(tmp_path / "bag", 5, LONG_S, gap={COMMANDS: (0.3, 1.8)})
    (action,) = BENCH.action_parts
    lasting = attrs.evolve(BENCH, action_parts=(attrs.evolve(action, max_age=1.6),))
    made, ticks = rows(tmp_path / "bag", lasting, "refuse")
    assert (len(made), ticks.gaps) == (TICKS - 1, {}), "but for the tick before the first state"
    assert lasting.fingerprint() != BENCH.fingerprint()
    assert Contract.from_canonical(lasting.canonical()).fingerprint() == lasting.fingerprint()


@pytest.mark.parametrize("span", [(0.0, 0.7), (1.2, 9.0)])
def test_refuse_names_what_is_missing_at_an_end(span: tuple[float, float], tmp_path: Path) -> None:
    record(tmp_path / "bag", 5, LONG_S, gap={STATES: span})
    with pytest.raises(RecorderError, match=r"observation\.state is missing"):
        rows(tmp_path / "bag", BENCH, "refuse")


def test_the_limit_is_part_of_the_contract_and_old_contracts_have_its_default() -> None:
    old = BENCH.canonical()
    assert "max_age" not in old
    assert Contract.from_canonical(old).max_age == 0.25
    longer = attrs.evolve(BENCH, max_age=1.0)
    assert longer.fingerprint() != BENCH.fingerprint()
    assert Contract.from_canonical(longer.canonical()).fingerprint() == longer.fingerprint()
    assert longer.difference(BENCH) == "max_age\n   this: 1.0\n  other: 0.25"


@pytest.mark.parametrize("age", [0, -1, "soon", None, float("nan"), float("inf")])
def test_a_recorded_limit_that_is_none_is_refused(age: object) -> None:
    with pytest.raises(ContractError, match="not a recorded contract"):
        Contract.from_canonical(BENCH.canonical() | {"max_age": age})


def test_a_longer_limit_lets_older_states_count(tmp_path: Path) -> None:
    record(tmp_path / "bag", 5, LONG_S, gap={STATES: (0.5, 1.3)})
    assert len(rows(tmp_path / "bag", attrs.evolve(BENCH, max_age=1.0), "refuse")[0]) == TICKS - 1
    assert np.isfinite(rows(tmp_path / "bag", BENCH)[0][-1]["observation.state"]).all()
