"""Shared memory between host and control process, for states and plans. Commands and events use a socket.

The memory is an unnamed file passed by descriptor, so that nothing is left behind even if a process is killed. There is
no lock that a dead peer could hold: each record carries a sequence number and a checksum, and torn records are skipped.

Nothing here relies on the order in which one processor sees another's stores (weak on ARM). A reader copies a record
and accepts the copy if the checksum matches its sequence number and bytes. Any mixture of two records fails this check,
except for 1 in 2^32, and is read again a tick later.
"""

from __future__ import annotations

import mmap
import os
from typing import Any
from zlib import crc32

import attrs
import numpy as np

from ibrobot_core.interfaces.run_state import ControlState, PlanRecord

STATE_SLOTS = 256
"""Number of states kept for the host: 2.5 s at 100 Hz."""
PLAN_ROWS = 2048
"""Maximum length of a plan, in setpoints."""
_SEQUENCE_BYTES = 8
_BEAT_BYTES = 8
_PLAN_HEAD_BYTES = 48
"""The integers of a plan, before its mask; the checksum covers everything after the first two, `seq` and `crc`."""


@attrs.frozen
class LinkLayout:
    """The sizes that both sides agree on."""

    joints: int
    signals: int

    @property
    def state(self) -> np.dtype[Any]:
        """One slot of the state ring."""
        vector = ("f8", (self.joints,))
        names = ("tick", "stamp", "late", "generation", "stops", "estop", "stale", "success")
        integers = [(name, "i8") for name in names]
        arrays = [(name, *vector) for name in ("position", "velocity", "effort", "command")]
        return np.dtype([("seq", "i8"), *integers, *arrays, ("signals", "f8", (self.signals,)), ("crc", "i8")])

    @property
    def plan(self) -> np.dtype[Any]:
        """One of the two plan slots."""
        integers = [(name, "i8") for name in ("seq", "crc", "generation", "start", "step", "rows")]
        arrays = [("mask", "i8", (self.joints,)), ("positions", "f8", (PLAN_ROWS, self.joints))]
        return np.dtype([*integers, *arrays])

    @property
    def size(self) -> int:
        """Bytes of shared memory."""
        return STATE_SLOTS * self.state.itemsize + 2 * self.plan.itemsize + _BEAT_BYTES


class SharedMemory:
    """The ring of states (written by the control process), and the newest plan and the heartbeat (by the host).

    Args:
        descriptor: file descriptor from `create_memory`; the file is resized here and closed by `close`.
        layout: the sizes that both sides agree on.
    """

    def __init__(self, descriptor: int, layout: LinkLayout) -> None:
        os.ftruncate(descriptor, layout.size)
        self._map = mmap.mmap(descriptor, layout.size)
        self._descriptor = descriptor
        split = STATE_SLOTS * layout.state.itemsize
        self._bytes = memoryview(self._map)
        self._states = np.frombuffer(self._bytes[:split], layout.state)
        self._plans = np.frombuffer(self._bytes[split:-_BEAT_BYTES], layout.plan)
        self._beat = np.frombuffer(self._bytes[-_BEAT_BYTES:], np.int64)
        self._state_size = layout.state.itemsize
        self._plan_size = layout.plan.itemsize
        self._split = split
        self._body = np.zeros(1, layout.state)
        self._row_bytes = 8 * layout.joints
        self._written = 0
        self._read = 0
        self._plan_seq = 0
        self._seen_plan = 0
        self.lost = 0
        """The number of states overwritten before they were read."""
        self.torn = 0
        """The number of records that changed while being read, and were read again."""

    def write_state(self, state: ControlState) -> None:
        """Append a state, overwriting the oldest."""
        self._written += 1
        body = self._body
        success = -1 if state.success is None else int(state.success)
        body[0] = (
            self._written, state.tick, state.stamp_ns, state.late_ns, state.generation, state.stops,
            state.estop, state.stale, success, state.position, state.velocity, state.effort, state.command,
            state.signals, 0,
        )  # fmt: skip
        raw = body.view(np.uint8)
        body["crc"][0] = crc32(raw[: self._state_size - _SEQUENCE_BYTES])
        slot = self._states[self._written % STATE_SLOTS : self._written % STATE_SLOTS + 1]
        slot["seq"] = -1
        slot.view(np.uint8)[_SEQUENCE_BYTES:] = raw[_SEQUENCE_BYTES:]
        slot["seq"] = self._written

    def read_states(self) -> list[ControlState]:
        """The states since the last call, oldest first."""
        states: list[ControlState] = []
        while True:
            wanted = self._read + 1
            raw = self._states[wanted % STATE_SLOTS : wanted % STATE_SLOTS + 1].copy()
            seq = int(raw["seq"][0])
            if 0 <= seq < wanted:
                return states
            if seq > wanted:
                # Overtaken: continue with the oldest state that is not about to be overwritten.
                resume = seq - STATE_SLOTS // 2
                self.lost += resume - wanted
                self._read = resume - 1
                continue
            body = raw.view(np.uint8)
            if seq != wanted or crc32(body[: self._state_size - _SEQUENCE_BYTES]) != int(raw["crc"][0]):
                self.torn += 1
                return states
            self._read = wanted
            states.append(_state(raw[0]))

    def beat(self) -> None:
        """The host's sign of life: count on."""
        self._beat[0] += 1

    @property
    def beats(self) -> int:
        """The number of the host's signs of life; 0 before the first."""
        return int(self._beat[0])

    def write_plan(self, plan: PlanRecord) -> None:
        """Replace the plan.

        Raises:
            ValueError: if it has no rows or more than `PLAN_ROWS`.
        """
        rows = len(plan.positions)
        if not 0 < rows <= PLAN_ROWS:
            raise ValueError(f"a plan has 1 to {PLAN_ROWS} setpoints, got {rows}")
        self._plan_seq += 1
        slot = self._plans[self._plan_seq % 2]
        slot["seq"] = -1
        slot["generation"], slot["start"], slot["step"] = plan.generation, plan.start_ns, plan.step_ns
        slot["rows"] = rows
        slot["mask"] = plan.mask
        slot["positions"][:rows] = plan.positions
        slot["crc"] = _plan_checksum(self._plan_bytes(self._plan_seq % 2, rows), self._plan_seq)
        slot["seq"] = self._plan_seq

    def read_plan(self) -> PlanRecord | None:
        """The newest plan, or None if it was already read."""
        sequences = self._plans["seq"]
        index = int(np.argmax(sequences))
        seq = int(sequences[index])
        if seq <= self._seen_plan:
            return None
        copy = bytes(self._plan_bytes(index, int(self._plans["rows"][index])))
        head = np.frombuffer(copy[:_PLAN_HEAD_BYTES], np.int64).tolist()
        if head[0] != seq or head[1] != _plan_checksum(copy, seq):
            self.torn += 1
            return None
        self._seen_plan = seq
        _, _, generation, start_ns, step_ns, rows = head
        body = copy[_PLAN_HEAD_BYTES:]
        mask = np.frombuffer(body[: self._row_bytes], np.int64).astype(bool)
        positions = np.frombuffer(body[self._row_bytes :]).reshape(rows, -1)
        return PlanRecord(generation, start_ns, step_ns, mask, positions)

    def _plan_bytes(self, index: int, rows: int) -> memoryview:
        """The part of a plan's slot used by `rows` setpoints."""
        begin = self._split + index * self._plan_size
        used = _PLAN_HEAD_BYTES + self._row_bytes * (1 + max(0, min(rows, PLAN_ROWS)))
        return self._bytes[begin : begin + used]

    def close(self) -> None:
        """Unmap the memory; it is freed once both sides have unmapped it."""
        del self._states, self._plans, self._beat
        self._bytes.release()
        self._map.close()
        os.close(self._descriptor)


def _plan_checksum(plan: memoryview | bytes, seq: int) -> int:
    """The checksum of a plan's bytes under a sequence number."""
    return crc32(plan[2 * _SEQUENCE_BYTES :], seq)


def _state(record: Any) -> ControlState:
    success = int(record["success"])
    return ControlState(
        tick=int(record["tick"]), stamp_ns=int(record["stamp"]), late_ns=int(record["late"]),
        generation=int(record["generation"]), stops=int(record["stops"]),
        estop=bool(record["estop"]), stale=bool(record["stale"]),
        success=None if success < 0 else bool(success), position=record["position"], velocity=record["velocity"],
        effort=record["effort"], command=record["command"], signals=record["signals"],
    )  # fmt: skip
