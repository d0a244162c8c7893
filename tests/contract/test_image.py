"""Images of every encoding, with row padding and either byte order, converted and resized exactly."""

from __future__ import annotations

from fractions import Fraction

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_testing.images import encode_image

from ibrobot_core.contract.image import ENCODINGS, decode_image, pixels, resize
from ibrobot_core.errors import ContractError
from ibrobot_core.messages import Header, Image
from ibrobot_core.schema import ImageSpec

HEADER = Header(5, "camera")


def picture(encoding: str, height: int, width: int, seed: int = 0) -> np.ndarray:
    element, channels = ENCODINGS[encoding]
    rng = np.random.default_rng(seed)
    if element is np.float32:
        return rng.normal(size=(height, width, channels)).astype(np.float32)
    largest = 2 ** (8 * np.dtype(element).itemsize) - 1
    return rng.integers(0, largest + 1, (height, width, channels)).astype(element)


@settings(deadline=None)
@given(
    encoding=st.sampled_from(list(ENCODINGS)),
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    padding=st.integers(0, 7),
    bigendian=st.booleans(),
)
def test_every_encoding_comes_back_with_padding_and_either_byte_order(
    encoding: str, height: int, width: int, padding: int, bigendian: bool
) -> None:
    array = picture(encoding, height, width, seed=height)
    message = encode_image(array, encoding, HEADER, padding=padding)
    row = width * array.shape[2] * array.itemsize
    assert (message.step, message.data.size) == (row + padding, height * (row + padding))
    if bigendian:
        rows = message.data.reshape(height, -1).copy()
        rows[:, :row] = array.astype(array.dtype.newbyteorder(">")).view(np.uint8).reshape(height, row)
        message = attrs.evolve(message, data=rows.reshape(-1), is_bigendian=1)
    found = pixels(message)
    assert found.dtype == array.dtype
    assert found.dtype.isnative
    np.testing.assert_array_equal(found, array)


RGB = picture("rgb8", 4, 6)
ALPHA = np.full((4, 6, 1), 7, np.uint8)


@pytest.mark.parametrize(
    ("encoding", "array", "wanted", "expected"),
    [
        ("rgb8", RGB, "rgb8", RGB),
        ("rgb8", RGB, "bgr8", RGB[..., ::-1]),
        ("bgr8", RGB[..., ::-1], "rgb8", RGB),
        ("bgr8", RGB[..., ::-1], "bgr8", RGB[..., ::-1]),
        ("rgba8", np.concatenate([RGB, ALPHA], axis=2), "rgb8", RGB),
        ("bgra8", np.concatenate([RGB[..., ::-1], ALPHA], axis=2), "rgb8", RGB),
        ("bgra8", np.concatenate([RGB[..., ::-1], ALPHA], axis=2), "bgr8", RGB[..., ::-1]),
        ("mono8", RGB[..., :1], "rgb8", np.repeat(RGB[..., :1], 3, axis=2)),
        ("mono8", RGB[..., :1], "mono8", RGB[..., :1]),
        ("mono16", picture("mono16", 4, 6), "16UC1", picture("mono16", 4, 6)),
        ("16UC1", picture("16UC1", 4, 6), "16UC1", picture("16UC1", 4, 6)),
        ("32FC1", picture("32FC1", 4, 6), "32FC1", picture("32FC1", 4, 6)),
    ],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_conversions(encoding: str, array: np.ndarray, wanted: str, expected: np.ndarray, padding: int) -> None:
    message = encode_image(np.ascontiguousarray(array), encoding, HEADER, padding=padding)
    found = decode_image(message, ImageSpec(encoding=wanted))
    assert found.dtype == expected.dtype
    assert found.flags.c_contiguous
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("encoding", ["rgb8", "bgra8"])
def test_grey_is_luma(encoding: str) -> None:
    colours = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255], [0, 0, 0]]], np.uint8)
    array = colours if encoding == "rgb8" else np.concatenate([colours[..., ::-1], ALPHA[:1, :5]], axis=2)
    found = decode_image(encode_image(np.ascontiguousarray(array), encoding, HEADER), ImageSpec(encoding="mono8"))
    assert found[..., 0].tolist() == [[76, 150, 29, 255, 0]]


def shares(old: int, new: int) -> list[list[Fraction]]:
    """Of each old pixel, the share of each new one that it covers."""
    edges = [(Fraction(i * old, new), Fraction((i + 1) * old, new)) for i in range(new)]
    return [
        [max(min(hi, Fraction(j + 1)) - max(lo, Fraction(j)), Fraction(0)) / (hi - lo) for j in range(old)]
        for lo, hi in edges
    ]


sizes = st.integers(1, 12)


@settings(deadline=None)
@given(height=sizes, width=sizes, rows=sizes, columns=sizes, white=st.booleans())
def test_resizing_colours_is_the_exact_mean_over_the_area(
    height: int, width: int, rows: int, columns: int, white: bool
) -> None:
    array = np.full((height, width, 3), 255, np.uint8) if white else picture("rgb8", height, width, seed=width)
    found = resize(array, rows, columns)
    assert found.shape == (rows, columns, 3)
    down, across = shares(height, rows), shares(width, columns)
    for i in range(rows):
        for j in range(columns):
            mean = sum(
                down[i][y] * across[j][x] * int(array[y, x, 1])
                for y in range(height)
                for x in range(width)
                if down[i][y] and across[j][x]
            )
            assert found[i, j, 1] == int(mean + Fraction(1, 2))


def test_large_reductions_do_not_overflow() -> None:
    for height, width in ((480, 640), (1080, 1921), (2160, 3840)):
        assert (resize(np.full((height, width, 1), 255, np.uint8), 1, 7) == 255).all()
    assert resize(np.full((257, 1, 1), 255, np.uint8), 1, 1) == 255, "255 * 257 is all that 16 bits hold"


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_resizing_depth_picks_and_never_mixes(encoding: str) -> None:
    depth = picture(encoding, 8, 6)
    found = decode_image(encode_image(depth, encoding, HEADER, padding=3), ImageSpec(resize=(4, 2), encoding=encoding))
    np.testing.assert_array_equal(found, depth[1::2, 1::3])


def test_depth_without_a_reading_is_zero() -> None:
    depth = np.array([[np.nan, -np.inf, np.inf, 1.5]], np.float32)
    found = decode_image(encode_image(depth, "32FC1", HEADER), ImageSpec(encoding="32FC1"))
    assert found.dtype == np.float32
    assert found.ravel().tolist() == [0, 0, 0, 1.5]


@pytest.mark.parametrize(
    ("message", "wanted", "fault"),
    [
        (Image(HEADER, 2, 2, "yuv422", 4, np.zeros(8)), "rgb8", "encoding 'yuv422' is not one of: rgb8, bgr8"),
        (Image(HEADER, 2, 2, "rgb8", 5, np.zeros(10)), "rgb8", "rows of at least 6 bytes.*step of 5 and 10 bytes"),
        (Image(HEADER, 2, 2, "rgb8", 6, np.zeros(11)), "rgb8", "step of 6 and 11 bytes"),
        (Image(HEADER, 0, 2, "rgb8", 6, np.zeros(0)), "rgb8", "an image of 0x2 rgb8 .* not zero"),
        (Image(HEADER, 2, 0, "rgb8", 6, np.zeros(12)), "rgb8", "an image of 2x0 rgb8 .* not zero"),
        (encode_image(picture("16UC1", 2, 2), "16UC1", HEADER), "rgb8", "encoded as 16UC1 cannot be converted to rgb8"),
        (encode_image(picture("rgb8", 2, 2), "rgb8", HEADER), "32FC1", "encoded as rgb8 cannot be converted to 32FC1"),
        (encode_image(picture("32FC1", 2, 2), "32FC1", HEADER), "16UC1", "32FC1 cannot be converted to 16UC1"),
    ],
)
def test_what_cannot_be_decoded_is_refused(message: Image, wanted: str, fault: str) -> None:
    with pytest.raises(ContractError, match=fault):
        decode_image(message, ImageSpec(encoding=wanted))
