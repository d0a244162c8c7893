"""The control table: coding of values, and that no registers overlap."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_feetech.registers import STS3215, register


@given(st.sampled_from(list(STS3215)), st.data())
def test_decode_undoes_encode(name: str, data: st.DataObject) -> None:
    it = register(name)
    value = data.draw(st.integers(*it.limits))
    assert it.decode(it.encode(value)) == value


def test_sign_and_magnitude() -> None:
    assert register("homing_offset").encode(-1) == b"\x01\x08"
    assert register("present_load").decode(b"\x0a\x04") == -10
    assert register("present_position").decode(b"\x00\x88") == -2048


def test_values_that_do_not_fit() -> None:
    with pytest.raises(ValueError, match="homing_offset must be -2047 to 2047, not 2048"):
        register("homing_offset").encode(2048)
    with pytest.raises(ValueError, match="id must be 0 to 255, not -1"):
        register("id").encode(-1)
    with pytest.raises(ValueError, match="present_position has 2 bytes, not 1"):
        register("present_position").decode(b"\x00")


def test_registers_lie_in_order_without_overlap_and_eprom_first() -> None:
    for before, after in pairwise(STS3215.values()):
        assert before.address + before.size <= after.address
    assert all((it.area == "eprom") == (it.address < 40) for it in STS3215.values())


def test_unknown_register_has_a_hint() -> None:
    with pytest.raises(KeyError, match="did you mean 'present_position'"):
        register("present_positon")
