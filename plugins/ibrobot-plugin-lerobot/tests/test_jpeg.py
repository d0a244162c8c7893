"""JPEG of images on their way to a model: close to what was sent, and damage is reported."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_lerobot.jpeg import Jpeg

from ibrobot_core.app import WireError

CODEC = Jpeg(90)


def picture(height: int, width: int, channels: int) -> np.ndarray:
    return (np.indices((height, width, channels)).sum(0) % 200).astype(np.uint8)


@given(st.integers(1, 70), st.integers(1, 70), st.sampled_from([1, 3]))
def test_pictures_come_back_nearly_as_they_were(height: int, width: int, channels: int) -> None:
    sent = picture(height, width, channels)
    jpeg = CODEC.encode("top", sent)
    assert jpeg is not None
    found = CODEC.decode(memoryview(jpeg), (height, width, channels))
    assert found.shape == sent.shape
    assert np.abs(found.astype(int) - sent).mean() < 30


@given(st.binary(max_size=300), st.integers(0, 250))
def test_other_bytes_are_refused_as_jpeg(noise: bytes, at: int) -> None:
    jpeg = CODEC.encode("top", picture(24, 32, 3))
    assert jpeg is not None
    with pytest.raises(WireError, match="a damaged JPEG"):
        CODEC.decode(memoryview(noise), (24, 32, 3))
    with pytest.raises(WireError, match="JPEG of 24x32 pixels where 480x640 were announced"):
        CODEC.decode(memoryview(jpeg), (480, 640, 3))
    try:
        damaged = CODEC.decode(memoryview(jpeg[:at] + noise + jpeg[at:]), (24, 32, 3))
    except WireError:
        return
    assert damaged.shape == (24, 32, 3)
