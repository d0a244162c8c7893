"""PNG pictures of bags, with and without image_transport's header of depth."""

from __future__ import annotations

import struct
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from ibrobot_ros2.png import from_png, is_png
from PIL import Image as Pillow

from ibrobot_core.api import CompressedImage, ContractError, Header, pixels

SIZES = array_shapes(min_dims=2, max_dims=2, max_side=9)
GREY = arrays(np.uint8, SIZES)
DEEP = arrays(np.uint16, SIZES)
COLOURS = {3: "rgb8", 4: "rgba8"}


def png(array):
    file = BytesIO()
    Pillow.fromarray(array).save(file, "PNG")
    return file.getvalue()


def message(data, format_="png"):
    return CompressedImage(Header(7, "top"), format_, np.frombuffer(data, np.uint8))


def decoded(data, format_="png"):
    assert is_png(message(data, format_))
    image = from_png(message(data, format_))
    assert image.header == Header(7, "top")
    return image.encoding, pixels(image)


@given(GREY)
def test_grey_is_exact(array):
    encoding, found = decoded(png(array), "mono8; png compressed mono8")
    assert encoding == "mono8"
    np.testing.assert_array_equal(found[..., 0], array)


@given(st.sampled_from([3, 4]), st.data())
def test_colours_are_exact_and_in_the_order_of_the_png(channels, data):
    array = data.draw(arrays(np.uint8, SIZES.map(lambda size: (*size, channels))))
    encoding, found = decoded(png(array), "bgr8; png compressed bgr8")
    assert encoding == COLOURS[channels]
    np.testing.assert_array_equal(found, array)


@given(DEEP, st.sampled_from(["", "\0" * 12]))
def test_16_bits_are_exact(array, header):
    name = "16UC1; compressedDepth png" if header else "16UC1; png compressed"
    encoding, found = decoded(header.encode() + png(array), name)
    assert encoding == "16UC1"
    np.testing.assert_array_equal(found[..., 0], array)


def test_inverse_depth_is_metres_and_no_reading_is_0():
    values = np.array([[0, 1, 100], [10000, 65535, 0]], np.uint16)
    a, b = 100.0 * 101.0, 1.0 - 100.0 * 101.0 / 10.0  # depth_quantization 100, 10 m at most
    encoding, found = decoded(struct.pack("<iff", 1, a, b) + png(values), "32FC1; compressedDepth")
    assert encoding == "32FC1"
    expected = [[0, 10, a / (100 - b)], [a / (10000 - b), a / (65535 - b), 0]]
    np.testing.assert_allclose(found[..., 0], expected, rtol=1e-6)
    assert found[0, 0, 0] == 0.0


@pytest.mark.parametrize(("a", "b"), [(np.nan, 0), (-1, 0), (np.inf, 0), (1, np.nan), (1, 5), (1, 1)])
def test_damaged_header_of_depth_is_an_error(a, b):
    data = struct.pack("<iff", 1, a, b) + png(np.array([[1, 9]], np.uint16))
    with pytest.raises(ContractError, match="compressedDepth picture: its header is damaged"):
        from_png(message(data, "32FC1; compressedDepth png"))


WHOLE = png(np.arange(64, dtype=np.uint16).reshape(8, 8))


@given(st.integers(8, len(WHOLE) - 1), st.integers(1, 255))
def test_changed_byte_of_a_png_is_an_error(at, change):
    data = bytearray(WHOLE)
    data[at] ^= change
    with pytest.raises(ContractError, match="PNG"):
        from_png(message(bytes(data)))


@given(st.integers(8, len(WHOLE) - 1))
def test_cut_png_is_an_error(length):
    with pytest.raises(ContractError, match="PNG"):
        from_png(message(WHOLE[:length]))


def test_16_bit_colours_are_refused_by_name_and_not_rounded():
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 1, 1, 16, 2, 0, 0, 0)
    with pytest.raises(ContractError, match="a PNG of 16 bits and RGB cannot be read, only 8-bit grey, RGB and RGBA"):
        from_png(message(head))


@pytest.mark.parametrize("data", [b"", b"\xff\xd8\xff", b"RVL"])
@pytest.mark.parametrize("format_", ["16UC1; compressedDepth rvl", "jpeg"])
def test_other_pictures_are_no_png(data, format_):
    assert not is_png(message(data, format_))
