"""JPEG pictures: encodings kept, webcams' habits understood, damage refused."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
import simplejpeg
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_ros2.jpeg import from_jpeg, own_jpeg, to_jpeg

from ibrobot_core.api import CompressedImage, ContractError, Header, Image

HEADER = Header(7, "top")


def picture(height: int, width: int, encoding: str, padding: int = 0) -> Image:
    """A smooth picture, which JPEG keeps well."""
    channels = 1 if encoding == "mono8" else 3
    row = np.linspace(0, 200, width * channels).astype(np.uint8)
    rows = np.pad(np.tile(row, (height, 1)), ((0, 0), (0, padding)))
    return Image(HEADER, height, width, encoding, rows.shape[1], rows.reshape(-1))


def file(strip_tables: bool = False, padding: bytes = b"") -> np.ndarray:
    """A JPEG; without its Huffman tables, as many webcams send it, or with bytes before its end."""
    jpeg = to_jpeg(picture(48, 64, "rgb8"), 90).data.tobytes()
    kept, at = jpeg[:2], 2
    while True:
        marker, length = jpeg[at + 1], int.from_bytes(jpeg[at + 2 : at + 4])
        if marker == 0xDA:
            break
        kept += b"" if strip_tables and marker == 0xC4 else jpeg[at : at + 2 + length]
        at += 2 + length
    return np.frombuffer(kept + jpeg[at:-2] + padding + jpeg[-2:], np.uint8)


@given(st.integers(1, 40), st.integers(1, 40), st.sampled_from(["rgb8", "bgr8", "mono8"]), st.integers(0, 5))
def test_encoding_size_and_stamp_are_kept(height: int, width: int, encoding: str, padding: int) -> None:
    given = picture(height, width, encoding, padding)
    found = from_jpeg(to_jpeg(given, 95))
    assert (found.header, found.height, found.width, found.encoding) == (HEADER, height, width, encoding)
    assert found.data.size == found.height * found.step


@given(st.binary(max_size=200), st.binary(max_size=8))
def test_no_bytes_raise_anything_but_a_contract_error(content: bytes, cut: bytes) -> None:
    for data in (content, b"\xff\xd8\xff" + content, file().tobytes()[: len(content) * 3] + cut):
        with suppress(ContractError):
            from_jpeg(CompressedImage(HEADER, "jpeg", np.frombuffer(data, np.uint8)))


def test_a_cameras_own_bytes_stay_as_they_are() -> None:
    data = file()
    message, size = own_jpeg(data, HEADER)
    assert (message.header, message.format, size) == (HEADER, "jpeg", (48, 64))
    assert message.data is data


def test_without_huffman_tables_the_standard_ones_count() -> None:
    whole, stripped = (from_jpeg(own_jpeg(file(strip), HEADER)[0]) for strip in (False, True))
    assert stripped.encoding == "rgb8"
    np.testing.assert_array_equal(stripped.data, whole.data)


def test_padding_that_cheap_webcams_leave_is_accepted() -> None:
    padded = file(padding=bytes(200))
    with pytest.raises(ValueError, match="extraneous bytes"):
        simplejpeg.decode_jpeg(padded.tobytes())
    np.testing.assert_array_equal(
        from_jpeg(own_jpeg(padded, HEADER)[0]).data, from_jpeg(own_jpeg(file(), HEADER)[0]).data
    )


@pytest.mark.parametrize("length", [0, 2, 100, 600])
def test_a_cut_picture_is_refused_by_camera_and_decoder(length: int) -> None:
    cut = file()[:length]
    with pytest.raises(ContractError, match=f"JPEG picture of {length} bytes"):
        own_jpeg(cut, HEADER)
    with pytest.raises(ContractError, match=f"JPEG picture of {length} bytes"):
        from_jpeg(CompressedImage(HEADER, "jpeg", cut))
