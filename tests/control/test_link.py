"""The shared memory and the socket between host and control process."""

from __future__ import annotations

import os
from collections.abc import Iterator
from zlib import crc32

import attrs
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ibrobot_core.control import link
from ibrobot_core.control.link import PLAN_ROWS, STATE_SLOTS, LinkLayout, SharedMemory
from ibrobot_core.interfaces.run_state import ControlState, PlanRecord
from ibrobot_core.memory import create_memory

LAYOUT = LinkLayout(joints=3, signals=2)
FLOATS = st.floats(width=64)
VECTOR = arrays(np.float64, 3, elements=FLOATS)


def state(tick: int, success: bool | None = None, vectors: np.ndarray | None = None, late_ns: int = 5) -> ControlState:
    position, velocity, effort, command = np.arange(12.0).reshape(4, 3) + tick if vectors is None else vectors
    return ControlState(
        tick, 1_000 * tick, late_ns, 2, tick % 2 == 0, tick % 3 == 0, success,
        position, velocity, effort, command, np.array([1.5, np.nan]),
    )  # fmt: skip


def plan(generation: int = 1, rows: int = 4) -> PlanRecord:
    return PlanRecord(generation, 100, 10, np.array([True, False, True]), np.arange(3.0 * rows).reshape(rows, 3))


def assert_same(one: object, other: object) -> None:
    for name in type(one).__attrs_attrs__:  # type: ignore[attr-defined]
        np.testing.assert_array_equal(getattr(one, name.name), getattr(other, name.name), err_msg=name.name)


@pytest.fixture
def sides() -> Iterator[tuple[SharedMemory, SharedMemory]]:
    """The same memory twice, as two processes have it."""
    descriptor = create_memory()
    both = SharedMemory(os.dup(descriptor), LAYOUT), SharedMemory(descriptor, LAYOUT)
    yield both
    for side in both:
        side.close()


class TestStates:
    def test_come_once_and_in_order(self, sides):
        control, host = sides
        for tick in range(1, 6):
            control.write_state(state(tick))

        assert [s.tick for s in host.read_states()] == [1, 2, 3, 4, 5]
        assert host.read_states() == []

        control.write_state(state(6))
        assert [s.tick for s in host.read_states()] == [6]

    @given(
        tick=st.integers(0, 2**62),
        late=st.integers(-(2**62), 2**62),
        success=st.sampled_from([None, True, False]),
        vectors=arrays(np.float64, (4, 3), elements=FLOATS),
    )
    def test_arrive_as_they_were_sent(self, tick, late, success, vectors):
        memory = SharedMemory(create_memory(), LAYOUT)
        sent = state(tick % 1000, success, vectors, late)
        memory.write_state(sent)
        (received,) = memory.read_states()
        memory.close()

        assert_same(received, sent)

    def test_that_were_read_are_not_changed_by_later_ones(self, sides):
        control, host = sides
        control.write_state(state(1))
        (first,) = host.read_states()
        for tick in range(2, STATE_SLOTS + 3):
            control.write_state(state(tick))

        assert_same(first, state(1))

    @given(written=st.integers(1, 3 * STATE_SLOTS))
    def test_that_were_overwritten_are_counted_as_lost(self, written):
        memory = SharedMemory(create_memory(), LAYOUT)
        for tick in range(1, written + 1):
            memory.write_state(state(tick))
        ticks = [s.tick for s in memory.read_states()]
        memory.close()

        assert ticks == list(range(memory.lost + 1, written + 1))
        assert (memory.lost > 0) == (written > STATE_SLOTS)

    def test_torn_ones_are_counted_and_never_given_out(self, sides):
        control, host = sides
        control.write_state(state(1))
        control.write_state(state(2))
        slot = host._states[2]  # a byte that a write under way has not reached yet
        slot["position"][1] += 1.0

        assert [s.tick for s in host.read_states()] == [1]
        assert host.torn == 1

        slot["position"][1] -= 1.0  # the write went on to its end
        assert [s.tick for s in host.read_states()] == [2]

    def test_one_that_is_being_written_waits(self, sides):
        control, host = sides
        control.write_state(state(1))
        host._states[1]["seq"] = -1

        assert host.read_states() == []
        host._states[1]["seq"] = 1
        assert [s.tick for s in host.read_states()] == [1]


class TestPlans:
    @pytest.mark.parametrize("reached", [0, 1, 8, 60, 119, 120])
    def test_one_torn_between_its_copy_and_its_check_is_refused(self, sides, monkeypatch, reached):
        """The writer had reached this byte of the rows when they were copied, and ends before they are checked."""
        host, control = sides
        for generation in (1, 2, 3):
            host.write_plan(attrs.evolve(plan(generation, rows=5), positions=np.full((5, 3), float(generation))))
        slot = control._plans[1]  # of the first and the third
        complete = slot.copy()
        rows = slot["positions"][:5].reshape(-1).view(np.uint8)
        rows[reached:] = np.full(15, 1.0).view(np.uint8)[reached:]

        def end_the_write(data: bytes, start: int = 0) -> int:
            control._plans[1] = complete
            return crc32(data, start)

        monkeypatch.setattr(link, "crc32", end_the_write)
        received = control.read_plan()
        again = control.read_plan()

        assert (received is None) == (reached < 120)
        assert control.torn == (reached < 120)
        (read,) = (each for each in (received, again) if each is not None)
        assert (read.positions == 3.0).all()

    def test_an_older_one_is_not_taken_for_the_newest(self, sides):
        """A processor may show the sequence number of a write before the rest of it."""
        host, control = sides
        host.write_plan(plan(1))
        old = host._plans[1].copy()
        host.write_plan(plan(2))
        host.write_plan(plan(3))
        new = host._plans[1].copy()
        old["seq"] = 3
        host._plans[1] = old

        assert control.read_plan() is None
        host._plans[1] = new
        received = control.read_plan()
        assert received is not None
        assert received.generation == 3

    def test_the_newest_comes_once(self, sides):
        host, control = sides
        assert control.read_plan() is None
        for generation in (1, 2, 3):
            host.write_plan(plan(generation))

        received = control.read_plan()
        assert received is not None
        assert_same(received, plan(3))
        assert control.read_plan() is None

    @given(
        positions=st.integers(1, 40).flatmap(lambda n: arrays(np.float64, (n, 3), elements=FLOATS)),
        mask=arrays(np.bool_, 3),
        start=st.integers(-(2**62), 2**62),
        step=st.integers(0, 2**40),
    )
    def test_arrive_as_they_were_sent(self, positions, mask, start, step):
        memory = SharedMemory(create_memory(), LAYOUT)
        sent = PlanRecord(3, start, step, mask, positions)
        memory.write_plan(sent)
        received = memory.read_plan()
        memory.close()

        assert received is not None
        assert_same(received, sent)

    def test_the_longest_fits(self, sides):
        host, control = sides
        host.write_plan(plan(rows=PLAN_ROWS))

        received = control.read_plan()
        assert received is not None
        assert_same(received, plan(rows=PLAN_ROWS))

    @pytest.mark.parametrize("rows", [0, PLAN_ROWS + 1])
    def test_of_a_wrong_length_are_refused(self, sides, rows):
        with pytest.raises(ValueError, match=f"1 to {PLAN_ROWS} setpoints, got {rows}"):
            sides[0].write_plan(plan(rows=rows))

    @pytest.mark.parametrize("field", ["generation", "start", "step", "rows", "mask", "positions", "crc"])
    def test_torn_ones_are_counted_and_never_given_out(self, sides, field):
        host, control = sides
        host.write_plan(plan())
        slot = control._plans[1]
        slot[field] = slot[field] + 1

        assert control.read_plan() is None
        assert control.torn == 1

        slot[field] = slot[field] - 1
        assert control.read_plan() is not None

    def test_while_one_is_being_written_the_last_one_can_be_read(self, sides):
        host, control = sides
        host.write_plan(plan(1))
        host.write_plan(plan(2))
        control._plans[0]["seq"] = -1  # where the second is

        received = control.read_plan()
        assert received is not None
        assert received.generation == 1
